"""EndoNeRF folders arrive as captures without states; what they lack is named."""

from __future__ import annotations

import os

import numpy as np
import pytest
import torch
from PIL import Image

from neeco.base.errors import NeecoError
from neeco.capture import check_capture, errors_only, read_capture

COUNT, WIDTH, HEIGHT, FOCAL = 10, 32, 24, 40.0
LLFF_FROM_OPENCV = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])  # columns: down, right, backwards


def opencv_pose(index: int) -> np.ndarray:
    """Turned about y and moved: [4, 4]."""
    angle = 0.1 * index
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = [index, 2.0 * index, -0.5 * index]
    return pose


def table(poses: list[np.ndarray]) -> np.ndarray:
    rows = []
    for pose in poses:
        matrix = np.zeros((3, 5))
        matrix[:, :3] = pose[:3, :3] @ LLFF_FROM_OPENCV
        matrix[:, 3] = pose[:3, 3]
        matrix[:, 4] = HEIGHT, WIDTH, FOCAL
        rows.append(np.concatenate([matrix.ravel(), [20.0, 60.0]]))
    return np.array(rows)


@pytest.fixture
def endonerf(tmp_path):
    root = tmp_path / "pulling"
    generator = np.random.default_rng(1)
    for folder in ("images", "masks", "depth"):
        (root / folder).mkdir(parents=True)
    for index in range(COUNT):
        pixels = generator.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(root / f"images/frame-{index:06d}.color.png")
        tool = np.zeros((HEIGHT, WIDTH), np.uint8)
        tool[:, : index + 1] = 255
        Image.fromarray(tool).save(root / f"masks/frame-{index:06d}.mask.png")
        Image.fromarray(tool).save(root / f"depth/frame-{index:06d}.depth.png")
    np.save(root / "poses_bounds.npy", table([opencv_pose(index) for index in range(COUNT)]))
    return root


def test_llff_axes_become_opencv_axes(endonerf):
    capture = read_capture(endonerf)
    assert len(capture.frames) == COUNT
    for index, frame in enumerate(capture.frames):
        expected = torch.from_numpy(opencv_pose(index)).float()
        assert torch.allclose(frame.camera.world_from_camera, expected, atol=1e-6)
    camera = capture.frames[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    assert capture.frames[3].load_image().shape == (HEIGHT, WIDTH, 3)


def test_frames_pair_by_name_and_test_as_the_successors_do(endonerf):
    capture = read_capture(endonerf)
    assert [frame.name for frame in capture.frames] == [f"frame-{index:06d}.color" for index in range(COUNT)]
    assert [index for index, frame in enumerate(capture.frames) if frame.split == "test"] == [1, 9]
    assert capture.instruments == ()
    assert all(frame.mask_path is None for frame in capture.frames)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("images/frame-000004.color.png", "frame-000004.color.png: is not a file; expected an image"),
        ("poses_bounds.npy", "is not the folder of a capture"),
    ],
)
def test_a_pipe_is_refused_and_never_waited_for(name, told, endonerf):
    (endonerf / name).unlink()
    os.mkfifo(endonerf / name)
    (problem,) = errors_only(check_capture(endonerf))
    assert told in str(problem)


def test_random_points_fill_the_depth_bounds_of_a_still_camera(endonerf):
    np.save(endonerf / "poses_bounds.npy", table([np.eye(4)] * COUNT))
    points = read_capture(endonerf).points
    assert not points.measured
    assert points.positions[:, 2].min() == pytest.approx(20, abs=0.5)
    assert points.positions[:, 2].max() == pytest.approx(60, abs=0.5)


def test_check_says_what_is_missing(endonerf):
    problems = check_capture(endonerf)
    assert not errors_only(problems)
    told = "\n".join(map(str, problems))
    for piece in ("no instrument states", "no unit of length", "tool masks", "depth maps are not read", "LLFF's"):
        assert piece in told
    assert "no sparse points" in told
    np.save(endonerf / "poses_bounds.npy", table([np.eye(4)] * COUNT))
    assert "camera never moves" in "\n".join(map(str, check_capture(endonerf)))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda t: t[:-1], "has 9 rows for 10 images"),
        (lambda t: t[:, :15], r"shape \(10, 15\)"),
        (lambda t: np.array([{"a": 1}], dtype=object), "not an array of plain numbers"),
        (lambda t: np.where(np.arange(17) == 3, np.nan, t), r"\[0\]: contains NaN"),
        (lambda t: t * np.where(np.arange(17) == 14, -1, 1), "focal"),
        (lambda t: t * np.where(np.isin(np.arange(17), (0, 5, 10)), -1, 1), "reflection"),
    ],
)
def test_damaged_poses_are_named(endonerf, damage, message):
    damaged = damage(table([opencv_pose(index) for index in range(COUNT)]))
    np.save(endonerf / "poses_bounds.npy", damaged, allow_pickle=True)
    with pytest.raises(NeecoError, match=message):
        read_capture(endonerf)
    assert errors_only(check_capture(endonerf))


def test_a_table_that_python_2_wrote_is_read_without_a_word(endonerf, recwarn):
    file = endonerf / "poses_bounds.npy"
    file.write_bytes(file.read_bytes().replace(f"({COUNT}, 17)".encode(), f"({COUNT}L,17)".encode(), 1))
    assert read_capture(endonerf).frames
    assert not recwarn.list


@pytest.mark.parametrize("keep", [0, 5, 60, 128, 400])
def test_a_truncated_file_is_refused_in_one_line(endonerf, keep):
    file = endonerf / "poses_bounds.npy"
    file.write_bytes(file.read_bytes()[:keep])
    with pytest.raises(NeecoError, match=r"poses_bounds\.npy") as refused:
        read_capture(endonerf)
    assert "\n" not in str(refused.value)


def test_images_of_another_size_are_named(endonerf):
    Image.new("RGB", (8, 8)).save(endonerf / "images/frame-000002.color.png")
    told = "\n".join(map(str, errors_only(check_capture(endonerf))))
    assert "image is 8x8, its camera says 32x24" in told


def test_an_image_linked_from_elsewhere_is_refused(endonerf, tmp_path):
    Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / "secret.png")
    image = endonerf / "images/frame-000002.color.png"
    image.unlink()
    image.symlink_to(tmp_path / "secret.png")
    with pytest.raises(NeecoError, match="leaves the capture's folder"):
        read_capture(endonerf)
