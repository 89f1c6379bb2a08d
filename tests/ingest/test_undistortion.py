"""Folders whose cameras have a distortion become captures without one, of whatever lens model."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from neeco.base.errors import NeecoError
from neeco.capture import check_capture, errors_only, read_capture
from neeco.capture.model import Capture
from neeco.geometry.distortion import undistorted
from neeco.ingest.convert import convert_folder

WIDTH, HEIGHT, FOCAL, COUNT = 96, 72, 70.0, 5
BORDERS = 3  # px: beyond the recorded image nothing is known


def pattern(slopes: np.ndarray, phase: float) -> np.ndarray:
    """uint8 [H, W, 3] of a plane seen along slopes [H, W, 2]: waves, so that a shift of a tenth of a pixel shows."""
    x, y = 25 * slopes[..., 0] + phase, 25 * slopes[..., 1]
    return np.stack([128 + 100 * np.sin(x), 128 + 100 * np.sin(y), 128 + 100 * np.sin(x + y)], -1).astype(np.uint8)


def slopes_of(focal: tuple[float, float], center: tuple[float, float]) -> np.ndarray:
    rows, columns = np.indices((HEIGHT, WIDTH)) + 0.5
    return np.stack([(columns - center[0]) / focal[0], (rows - center[1]) / focal[1]], -1)


def radially(bend: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
    """From slopes in the image to those of the rays, for a lens that shows radius r at bend(r)."""
    known = np.linspace(0, 1.4, 10_000)

    def rays(slopes: np.ndarray) -> np.ndarray:
        radius = np.hypot(slopes[..., 0], slopes[..., 1])
        return slopes * (np.interp(radius, bend(known), known) / np.maximum(radius, 1e-12))[..., None]

    return rays


def fisheye(k1: float, k2: float = 0.0) -> Callable[[np.ndarray], np.ndarray]:
    return radially(lambda r: np.arctan(r) * (1 + k1 * np.arctan(r) ** 2 + k2 * np.arctan(r) ** 4))


def bent_by_opencv(slopes: np.ndarray) -> np.ndarray:
    return undistorted(slopes.reshape(-1, 2), (-0.2, 0.05, 0.004, -0.003)).reshape(slopes.shape)


def write_images(folder: Path, rays: Callable[[np.ndarray], np.ndarray]) -> None:
    folder.mkdir(parents=True)
    seen = rays(slopes_of((FOCAL, FOCAL), (WIDTH / 2, HEIGHT / 2)))
    for index in range(COUNT):
        Image.fromarray(pattern(seen, index)).save(folder / f"{index:03d}.png")


def write_transforms(root: Path, rays: Callable[[np.ndarray], np.ndarray], camera: dict[str, object]) -> None:
    write_images(root / "images", rays)
    frames = [{"file_path": f"images/{k:03d}.png", "transform_matrix": np.eye(4).tolist()} for k in range(COUNT)]
    known = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    (root / "transforms.json").write_text(json.dumps({**known, **camera, "frames": frames}))


def write_colmap(root: Path, rays: Callable[[np.ndarray], np.ndarray], camera: str) -> None:
    write_images(root / "images", rays)
    (root / "sparse").mkdir()
    (root / "sparse/cameras.txt").write_text(f"1 {camera.format(f=FOCAL, c=f'{WIDTH / 2} {HEIGHT / 2}')}\n")
    lines = [f"{k} 1 0 0 0 {k} 0 0 1 {k:03d}.png\n\n" for k in range(COUNT)]
    (root / "sparse/images.txt").write_text("".join(lines))
    (root / "sparse/points3D.txt").write_text("1 0 0 9 255 0 0 0.5 1 0 2 0\n2 3 4 9 255 0 0 0.5 1 0 2 0\n")


def assert_straight(capture: Capture) -> None:
    """The images show the pattern as their cameras, which have no distortion, see it."""
    assert len(capture.frames) == COUNT
    for index, frame in enumerate(capture.frames):
        camera = frame.camera
        assert not camera.distortion
        expected = pattern(slopes_of((camera.fx, camera.fy), (camera.cx, camera.cy)), index)
        error = np.abs(frame.load_image_bytes().numpy().astype(float) - expected)
        assert error[BORDERS:-BORDERS, BORDERS:-BORDERS].mean() < 2.0  # of 255; a third of a pixel is 8


K4 = {"k1": -0.2, "k2": 0.1, "k3": -0.05, "k4": 0.02}
NERFSTUDIO = [
    ({"camera_model": "OPENCV", "k1": -0.2, "k2": 0.05, "p1": 0.004, "p2": -0.003}, bent_by_opencv),
    ({"distortion_params": [-0.2, 0.05, 0, 0, 0.004, -0.003]}, bent_by_opencv),
    (
        {"camera_model": "OPENCV", **K4},
        radially(lambda r: r * (1 - 0.2 * r**2 + 0.1 * r**4 - 0.05 * r**6 + 0.02 * r**8)),
    ),
    ({"camera_model": "OPENCV_FISHEYE", "k1": 0.05, "k2": -0.02}, fisheye(0.05, -0.02)),
    ({"camera_model": "OPENCV_FISHEYE", "k1": 0, "k2": 0}, fisheye(0.0)),
    ({"is_fisheye": True, "k1": 0.05}, fisheye(0.05)),
]
COLMAP = [
    ("SIMPLE_RADIAL 96 72 {f} {c} -0.15", radially(lambda r: r * (1 - 0.15 * r**2))),
    ("RADIAL 96 72 {f} {c} 0.1 0.05", radially(lambda r: r * (1 + 0.1 * r**2 + 0.05 * r**4))),
    ("OPENCV 96 72 {f} {f} {c} -0.2 0.05 0.004 -0.003", bent_by_opencv),
    ("OPENCV_FISHEYE 96 72 {f} {f} {c} 0.05 -0.02 0 0", fisheye(0.05, -0.02)),
    ("RADIAL_FISHEYE 96 72 {f} {c} 0.05 -0.02", fisheye(0.05, -0.02)),
]


@pytest.mark.parametrize(("camera", "rays"), NERFSTUDIO)
def test_images_of_a_distorted_transforms_file_are_undistorted(tmp_path, camera, rays):
    write_transforms(tmp_path / "source", rays, camera)
    (problem,) = errors_only(check_capture(tmp_path / "source"))
    assert problem.message.endswith("the images are distorted, for 5 of 5 frames")
    assert problem.remedy == f"undistort them: neeco ingest {tmp_path / 'source'} --output CAPTURE"
    assert "5 of 5 images are undistorted; their lens is kept." in convert_folder(tmp_path / "source", tmp_path / "new")
    capture = read_capture(tmp_path / "new")
    assert_straight(capture)
    assert capture.lens is not None
    assert capture.lens.fl_x == FOCAL


@pytest.mark.parametrize(("camera", "rays"), COLMAP)
def test_images_of_a_distorted_colmap_model_are_undistorted(tmp_path, camera, rays):
    write_colmap(tmp_path / "source", rays, camera)
    (problem,) = errors_only(check_capture(tmp_path / "source"))
    assert "(and 4 more like it)" in problem.message
    convert_folder(tmp_path / "source", tmp_path / "new")
    assert_straight(read_capture(tmp_path / "new"))


def test_masks_are_undistorted_and_of_several_lenses_none_is_kept(tmp_path):
    source = tmp_path / "source"
    write_transforms(source, bent_by_opencv, NERFSTUDIO[0][0])
    document = json.loads((source / "transforms.json").read_text())
    mask = (slopes_of((FOCAL, FOCAL), (WIDTH / 2, HEIGHT / 2))[..., 0] > -0.4) * np.uint8(255)
    Image.fromarray(mask).save(source / "mask.png")
    for frame in document["frames"]:
        frame["mask_path"] = "mask.png"
    document["frames"][0]["k1"] = -0.1
    (source / "transforms.json").write_text(json.dumps(document))
    assert any("of their 2 lenses none is kept" in said for said in convert_folder(source, tmp_path / "new"))
    capture = read_capture(tmp_path / "new")
    assert capture.lens is None
    edges = [int(frame.load_mask()[HEIGHT // 2].float().argmax()) for frame in capture.frames]
    assert edges[0] != edges[1] == edges[2]


def test_frames_without_an_image_are_left_out_with_their_count(tmp_path):
    source = tmp_path / "source"
    write_colmap(source, bent_by_opencv, COLMAP[2][0])
    (source / "images/002.png").unlink()
    said = " ".join(convert_folder(source, tmp_path / "new"))
    assert "Left out: 1 of 5 frames, which have no image ('002.png'" in said
    assert len(read_capture(tmp_path / "new").frames) == COUNT - 1
    for file in (source / "images").iterdir():
        file.rename(file.with_suffix(".PNG"))
    with pytest.raises(NeecoError, match=r"no such file: '000.png'.*'000.PNG' exists"):  # nothing to leave out
        convert_folder(source, tmp_path / "other")


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        (
            {"camera_model": "EQUIRECTANGULAR"},
            "camera_model: is 'EQUIRECTANGULAR': this lens model cannot be undistorted",
        ),
        ({"ftheta_p0": 0.1}, "ftheta_p0: is 0.1: this lens model cannot be undistorted"),
        ({"distortion_params": [0.1, 0.2, 0.3]}, "distortion_params: expected 4, 5, 6 or 8 coefficients"),
        ({"distortion_params": [0.1, 0, 0, 0], "k1": 0.2}, "k1: is 0.2, but distortion_params.0. differs"),
        ({"k1": float("nan")}, "k1: is nan, not a finite number"),
        ({"k1": -5.0}, "folds the image over"),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 0.1}, "a fisheye lens has only coefficients k1 to k4"),
    ],
)
def test_a_distortion_that_cannot_be_undone_is_refused(tmp_path, camera, words):
    write_transforms(tmp_path / "source", bent_by_opencv, camera)
    with pytest.raises(NeecoError, match=words):
        convert_folder(tmp_path / "source", tmp_path / "new")
    assert not (tmp_path / "new").exists()
