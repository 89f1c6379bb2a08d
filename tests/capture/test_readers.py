"""What is written reads back; foreign formats arrive as the same capture."""

from __future__ import annotations

import json
import math
import shutil
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from image_files import read_image
from PIL import Image
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.capture import check_capture, errors_only, read_capture, write_capture
from neeco.capture.images import read_labels, read_mask, write_image, write_labels
from neeco.capture.model import (
    BaseUncertainty,
    Capture,
    Frame,
    FromVideo,
    Instrument,
    InstrumentState,
    PointCloud,
    State,
    Uncertainty,
    evenly_spaced,
)
from neeco.capture.points import points_in_view, read_ply
from neeco.capture.writer import fingerprint
from neeco.evaluation.masks import load_reference
from neeco.geometry.lens import Lens
from neeco.raster import Camera

ASCII_HEADER = b"ply\nformat ascii 1.0\nelement vertex 1\n" + b"".join(b"property float %c\n" % axis for axis in b"xyz")
ASCII_HEADER += b"end_header\n"
SAMPLE = Path(__file__).parents[2] / "samples" / "liver-mini"


def assert_same(one, two):
    assert one.instruments == two.instruments
    assert one.registered == two.registered
    assert torch.equal(torch.from_numpy(one.points.positions), torch.from_numpy(two.points.positions))
    assert np.array_equal(one.points.colors, two.points.colors)
    assert [frame.name for frame in one.frames] == [frame.name for frame in two.frames]
    for mine, other in zip(one.frames, two.frames, strict=True):
        assert (mine.split, mine.state.time) == (other.split, other.state.time)
        assert torch.equal(mine.camera.world_from_camera, other.camera.world_from_camera)
        assert [getattr(mine.camera, key) for key in ("fx", "fy", "cx", "cy", "width", "height")] == [
            getattr(other.camera, key) for key in ("fx", "fy", "cx", "cy", "width", "height")
        ]
        for name, state in mine.state.instruments.items():
            assert torch.equal(state.pose, other.state.instruments[name].pose)
            assert dict(state.joints) == dict(other.state.instruments[name].joints)


def test_a_written_capture_reads_back_exactly(folder, tmp_path):
    Image.new("L", (32, 24), 255).save(folder.root / "keep.png")
    folder.edit(lambda d: d["frames"][2].update(mask_path="keep.png"))
    capture = read_capture(folder.root)
    write_capture(capture, tmp_path / "copy")
    copy = read_capture(tmp_path / "copy")
    assert_same(capture, copy)
    assert torch.equal(capture.frames[3].load_image(), copy.frames[3].load_image())
    assert copy.frames[2].load_mask().all()
    assert not errors_only(check_capture(tmp_path / "copy"))
    with pytest.raises(NeecoError, match="already holds a capture"):
        write_capture(capture, tmp_path / "copy")


LENS = Lens(30.0, 31.0, 16.5, 12.0, (-0.2, 0.05, 0.0, 0.001), (32, 24), border=(16.0, 12.0, 14.0))


@pytest.mark.parametrize("lens", [LENS, Lens(30.0, 30.0, 16.0, 12.0, (), (32, 24))])
def test_the_lens_of_a_recording_is_written_and_read_back(folder, tmp_path, lens):
    capture = read_capture(folder.root)
    assert capture.lens is None
    write_capture(replace(capture, lens=lens), tmp_path / "copy")
    copy = read_capture(tmp_path / "copy")
    assert copy.lens == lens
    assert fingerprint(copy) != fingerprint(replace(copy, lens=None)) == fingerprint(capture)


def test_what_was_found_in_video_is_written_and_read_back(folder, tmp_path):
    capture = read_capture(folder.root)
    shared = BaseUncertainty((1.0, 2.0, 90.0), tuple(map(tuple, np.diag([1e-4] * 3 + [0.5, 0.5, 2.0]).tolist())))
    (item,) = capture.instruments
    instruments = (replace(item, from_video=FromVideo(5.0, 26.0), base_uncertainty=shared),)
    (name, state), *_ = capture.frames[0].state.instruments.items()
    sure = Uncertainty((0.2, 0.1, 1.5), (0.5, 0.7, 180.0), {"jaw_angle": 6.0})
    first = replace(capture.frames[0], state=State({name: replace(state, uncertainty=sure)}))
    changed = replace(capture, instruments=instruments, frames=(first, *capture.frames[1:]))
    write_capture(changed, tmp_path / "copy")
    copy = read_capture(tmp_path / "copy")
    assert copy.instruments == instruments
    assert copy.frames[0].state.instruments[name].uncertainty == sure
    assert copy.frames[1].state.instruments[name].uncertainty is None
    assert fingerprint(copy) == fingerprint(changed) != fingerprint(replace(changed, instruments=capture.instruments))
    without = replace(changed, instruments=(replace(item, from_video=FromVideo(5.0, 26.0)),))
    assert fingerprint(without) != fingerprint(changed)
    unsure = replace(changed, frames=(capture.frames[0], *capture.frames[1:]))
    assert fingerprint(unsure) != fingerprint(changed)


def test_the_sample_round_trips_and_has_truth(tmp_path):
    capture = read_capture(SAMPLE)
    write_capture(capture, tmp_path / "copy")
    assert_same(capture, read_capture(tmp_path / "copy"))
    reference = load_reference(capture, capture.frames[0])
    assert reference is not None
    labels = reference.parts
    assert labels.shape == (192, 240)
    assert set(labels.unique().tolist()) <= {0, 1, 2, 3, 4}
    assert load_reference(read_capture(tmp_path / "copy"), capture.frames[0]) is None


def test_exact_poses_of_the_truth_folder_are_read_as_another_transforms_file():
    truth = read_capture(SAMPLE, transforms="truth/transforms.json")
    assert truth.root == SAMPLE
    assert truth.frames[0].load_image().shape == (192, 240, 3)


def test_cameras_have_opencv_axes(folder):
    camera = read_capture(folder.root).frames[0].camera
    ahead = torch.tensor([30.0, -20.0, 50.0]) - camera.world_from_camera[:3, 3]
    assert torch.allclose(camera.world_from_camera[:3, :3].T @ ahead, torch.tensor([0.0, 0.0, 100.0]), atol=1e-3)
    assert camera.world_from_camera[1, 1] < 0  # y points down; up is +y in this world


def test_splits_come_from_lists_or_every_eighth(folder):
    folder.edit(lambda d: [frame.pop("split") for frame in d["frames"]])
    assert [frame.split for frame in read_capture(folder.root).frames] == ["test"] + ["train"] * 7
    names = [frame["file_path"] for frame in folder.document["frames"]]
    folder.edit(lambda d: d.update(train_filenames=names[:5], test_filenames=names[5:]))
    assert [frame.split for frame in read_capture(folder.root).frames] == ["train"] * 5 + ["test"] * 3


def test_instruments_are_derived_from_frames_when_not_declared(folder):
    folder.edit(lambda document: document.pop("instruments"))
    (instrument,) = read_capture(folder.root).instruments
    assert instrument.name == "grasper"
    assert dict(instrument.joints) == {"jaw_angle": None}


def test_a_scope_that_turns_about_its_trocar_gets_points_in_front_of_it():
    tilts = [Rotation.from_rotvec([0.2 * math.cos(a), 0.2 * math.sin(a), 0]).as_matrix() for a in range(6)]
    frames = []
    for tilt in tilts:
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = torch.from_numpy(tilt)
        pose[:3, 3] = 120 * pose[:3, 2]  # the lens, 120 mm from the trocar at the origin, looking away from it
        frames.append(Frame(Path("none.png"), Camera(pose, 100, 100, 32, 24, 64, 48), State(), "train"))
    points = torch.from_numpy(
        points_in_view(np.stack([frame.camera.world_from_camera for frame in frames])).positions
    ).double()
    for frame in frames:
        pose = frame.camera.world_from_camera
        depth = (points - pose[:3, 3]) @ pose[:3, 2]
        assert (depth > 0).float().mean() > 0.9


def test_a_capture_without_points_starts_from_random_ones_where_cameras_look(folder):
    folder.edit(lambda document: document.pop("ply_file_path"))
    points = read_capture(folder.root).points
    assert not points.measured
    assert np.abs(points.positions.mean(axis=0) - [30, -20, 50]).max() < 1
    assert np.array_equal(points.positions, read_capture(folder.root).points.positions)


def test_blender_captures_are_composited_and_split_by_file(folder, tmp_path):
    root = tmp_path / "blender"
    (root / "pics").mkdir(parents=True)
    frames = folder.document["frames"]
    for index, frame in enumerate(frames):
        Image.new("RGBA", (32, 24), (255, 0, 0, 127 if index else 0)).save(root / f"pics/r_{index}.png")
        frames[index] = {
            "file_path": f"./pics/r_{index}",
            "time": index / 8,
            "transform_matrix": frame["transform_matrix"],
        }
    for split, part in {"train": frames[:6], "val": frames[6:7], "test": frames[7:]}.items():
        (root / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": part}))
    capture = read_capture(root)
    assert [len(capture.split(name)) for name in ("train", "val", "test")] == [6, 1, 1]
    assert capture.frames[0].camera.fx == pytest.approx(16 / np.tan(0.35))
    assert capture.frames[0].load_image().min() == 1.0
    assert read_capture(root, background=0.0).frames[0].load_image().max() == 0.0
    assert np.abs(capture.points.positions).max() <= 1.5
    assert capture.frames[6].state.time == 0.75
    write_capture(capture, tmp_path / "copy")
    assert torch.allclose(
        read_capture(tmp_path / "copy").frames[1].load_image(), capture.frames[1].load_image(), atol=2e-3
    )


@pytest.mark.parametrize("timed", [(), (1,)])
def test_a_blender_folder_without_any_time_stands_still(folder, tmp_path, timed):
    frames = folder.document["frames"]
    for index, frame in enumerate(frames):
        frames[index] = {"file_path": frame["file_path"], "transform_matrix": frame["transform_matrix"]}
        frames[index] |= {"time": 0.5} if index in timed else {}
    for split, part in {"train": frames[:6], "test": frames[6:]}.items():
        (folder.root / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": part}))
    (folder.root / "transforms.json").unlink()
    times = [frame.state.time for frame in read_capture(folder.root).frames]
    asked = [problem for problem in check_capture(folder.root) if "not every frame has a time" in problem.message]
    assert times == ([0.0] * 8 if not timed else [float(order) for order in range(8)])
    assert bool(asked) == bool(timed)


def write_colmap(folder, root: Path, binary: bool, model: str = "PINHOLE", distortion: tuple[float, ...] = ()) -> None:
    capture = read_capture(folder.root)
    (folder.root / "images").rename(root / "images")
    sparse = root / "sparse" / "0"
    sparse.mkdir(parents=True)
    poses = []
    for frame in capture.frames:
        inverse = np.linalg.inv(frame.camera.world_from_camera.double().numpy())
        x, y, z, w = Rotation.from_matrix(inverse[:3, :3]).as_quat()
        poses.append((w, x, y, z, *inverse[:3, 3]))
    points = capture.points
    if binary:
        ids = {"PINHOLE": 1, "OPENCV": 4, "FISHEYE": 15, "EUCM": 16, "DIVISION": 13, "OF_TOMORROW": 99}
        params = (40.0, 41.0, 16.5, 12.0, *distortion)
        cameras = struct.pack("<QiiQQ", 1, 1, ids[model], 32, 24) + struct.pack(f"<{len(params)}d", *params)
        images = struct.pack("<Q", len(poses))
        for index, pose in enumerate(poses):
            images += struct.pack("<i7di", index, *pose, 1) + f"{index:06d}.png".encode() + b"\0"
            images += struct.pack("<Qddq", 1, 3.0, 4.0, -1)
        cloud = struct.pack("<Q", len(points.positions))
        for xyz in points.positions:
            cloud += struct.pack("<Q3d3BdQii", 1, *xyz, 200, 100, 50, 0.5, 1, 0, 0)
        contents = {"cameras.bin": cameras, "images.bin": images, "points3D.bin": cloud}
    else:
        rows = [f"{i} {' '.join(map(repr, map(float, pose)))} 1 {i:06d}.png\n" for i, pose in enumerate(poses)]
        cloud_rows = [
            f"1 {x!r} {y!r} {z!r} 200 100 50 0.5 0 0\n" for x, y, z in points.positions.astype(float).tolist()
        ]
        contents = {
            "cameras.txt": f"# cameras\n1 {model} 32 24 40 41 16.5 12 {' '.join(map(str, distortion))}\n".encode(),
            "images.txt": ("# images\n" + "\n".join(rows) + "\n").encode(),
            "points3D.txt": "".join(cloud_rows).encode(),
        }
    for name, content in contents.items():
        (sparse / name).write_bytes(content)


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize(
    ("model", "parameters", "message"),
    [
        ("FISHEYE", (), "FISHEYE: the images are distorted .*; undistort them: neeco ingest"),
        ("EUCM", (0.5, 1.1), "camera model is EUCM .*; convert it to PINHOLE with `colmap image_undistorter`"),
        ("DIVISION", (-0.1,), "camera model is DIVISION .*; convert it to PINHOLE with `colmap image_undistorter`"),
    ],
)
def test_camera_models_of_newer_colmap_are_named(folder, tmp_path, binary, model, parameters, message):
    write_colmap(folder, tmp_path, binary, model, parameters)
    with pytest.raises(NeecoError, match=message) as raised:
        read_capture(tmp_path)
    assert "damaged" not in str(raised.value)


def test_an_unknown_camera_model_of_colmap_is_newer_and_not_damage(folder, tmp_path):
    write_colmap(folder, tmp_path, True, "OF_TOMORROW")
    with pytest.raises(NeecoError, match=r"camera model 99 is unknown; run `colmap image_undistorter`"):
        read_capture(tmp_path)


@pytest.mark.parametrize("binary", [True, False])
def test_colmap_models_are_read(folder, tmp_path, binary):
    expected = read_capture(folder.root)
    write_colmap(folder, tmp_path, binary)
    capture = read_capture(tmp_path)
    assert [frame.split for frame in capture.frames] == ["test"] + ["train"] * 7
    assert np.allclose(capture.points.positions, expected.points.positions)
    assert np.allclose(capture.points.colors, expected.points.colors)
    for mine, other in zip(capture.frames, expected.frames, strict=True):
        assert torch.allclose(mine.camera.world_from_camera, other.camera.world_from_camera, atol=1e-4)
        assert (mine.camera.fx, mine.camera.fy, mine.camera.cx) == (40.0, 41.0, 16.5)
    assert not errors_only(check_capture(tmp_path))


@pytest.mark.parametrize("binary", [True, False])
def test_distorted_or_damaged_colmap_models_are_refused(folder, tmp_path, binary):
    write_colmap(folder, tmp_path, binary, "OPENCV", (-0.1, 0.0, 0.0, 0.001))
    with pytest.raises(NeecoError, match=r"OPENCV: the images are distorted .*: neeco ingest"):
        read_capture(tmp_path)
    for path in (tmp_path / "sparse/0").iterdir():
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2 + 3])
    with pytest.raises(NeecoError):
        read_capture(tmp_path)
    assert errors_only(check_capture(tmp_path))


def test_images_of_every_depth_become_rgb(tmp_path):
    Image.fromarray(np.full((2, 3), 65535, dtype=np.uint16)).save(tmp_path / "deep.png")
    Image.new("L", (3, 2), 51).save(tmp_path / "grey.png")
    Image.new("1", (3, 2), 1).save(tmp_path / "bit.png")
    assert read_image(tmp_path / "deep.png").eq(1).all()
    assert torch.allclose(read_image(tmp_path / "grey.png"), torch.full((2, 3, 3), 0.2))
    assert read_mask(tmp_path / "bit.png", (3, 2)).all()
    with pytest.raises(NeecoError, match="image is 3x2"):
        read_image(tmp_path / "grey.png", (4, 2))


def test_written_images_and_labels_read_back(tmp_path):
    image = torch.rand(5, 7, 3, generator=torch.Generator().manual_seed(1))
    write_image(tmp_path / "a.png", image)
    assert (read_image(tmp_path / "a.png", (7, 5)) - image).abs().max() <= 0.5 / 255 + 1e-6
    labels = torch.arange(35, dtype=torch.uint8).reshape(5, 7)
    write_labels(tmp_path / "b.png", labels)
    assert torch.equal(read_labels(tmp_path / "b.png"), labels)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"ply\n",
        ASCII_HEADER + b"1 2",
        ASCII_HEADER + b"1 2 a",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 99999999999\nproperty float x\nend_header\n1",
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1",
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n1",
    ],
)
def test_damaged_point_clouds_are_refused(tmp_path, content):
    (tmp_path / "bad.ply").write_bytes(content)
    with pytest.raises(NeecoError, match=r"bad\.ply"):
        read_ply(tmp_path / "bad.ply")


def arrays(count=5):
    """What a user's own recording may hold: images, camera poses, instrument poses, jaw angles."""
    random = np.random.default_rng(3)
    turns = Rotation.from_rotvec(random.uniform(-0.3, 0.3, (2, count, 3)).reshape(-1, 3)).as_matrix()
    poses = np.tile(np.eye(4), (2 * count, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = turns, random.uniform(-20, 20, (2 * count, 3))
    return random.uniform(0, 1, (count, 24, 32, 3)), poses[:count], poses[count:], random.uniform(0, 1, count)


def own_frames(images, cameras, instruments, jaws):
    return [
        Frame(
            f"{index:04d}.png",
            Camera(cameras[index], 40.0, 41.0, 16.5, 12.0, 32, 24),
            State(
                {"grasper": InstrumentState(instruments[index].tolist(), {"jaw_angle": jaws[index]})}, time=index / 25
            ),
            "test" if index == 0 else "train",
        )
        for index in range(len(images))
    ]


def test_a_capture_made_of_arrays_is_written_and_reads_back(tmp_path):
    images, cameras, instruments, jaws = arrays()
    points = PointCloud(np.random.default_rng(1).uniform(-10, 10, (30, 3)), np.full((30, 3), 0.2))
    grasper = Instrument("grasper", {"jaw_angle": (0.0, 1.2)})
    capture = Capture("mine", own_frames(images, cameras, instruments, jaws), [grasper], points)
    write_capture(capture, tmp_path, images=images)
    read = read_capture(tmp_path)
    assert_same(capture, read)
    for index, frame in enumerate(read.frames):
        assert np.abs(frame.load_image().numpy() - images[index]).max() <= 0.5 / 255 + 1e-6
        assert np.array_equal(frame.state.instruments["grasper"].pose, instruments[index])
        assert np.array_equal(frame.camera.world_from_camera, cameras[index].astype(np.float32))
    bytes_of = (images * 255).round().astype(np.uint8)
    bytes_of.flags.writeable = False  # as a decoder's are; PyTorch's warning is an error here
    write_capture(capture, tmp_path / "bytes", images=bytes_of)
    assert np.array_equal((read_capture(tmp_path / "bytes").frames[2].load_image() * 255).round(), bytes_of[2])
    write_capture(Capture("mine", capture.frames), tmp_path / "bare", images=images)
    bare = read_capture(tmp_path / "bare")
    assert [instrument.name for instrument in bare.instruments] == ["grasper"]
    assert not bare.points.measured


def test_images_that_do_not_fit_their_frames_are_refused(tmp_path):
    images, *poses = arrays()
    capture = Capture("mine", own_frames(images, *poses))
    with pytest.raises(NeecoError, match="images: there are 4 for 5 frames"):
        write_capture(capture, tmp_path, images=images[:4])
    with pytest.raises(NeecoError, match=r"0000\.png: image has shape \(24, 31, 3\), its camera says \(24, 32, 3\)"):
        write_capture(capture, tmp_path, images=images[:, :, :31])
    assert not (tmp_path / "transforms.json").exists()


@pytest.mark.parametrize(
    ("pose", "words"),
    [
        (np.eye(3), r"expected a 4x4 matrix, found shape \(3, 3\)"),
        (np.diag([2.0, 2, 2, 1]), "is not rigid: its rotation is scaled by 2"),
        (np.diag([1.0, 1, -1, 1]), "is a reflection"),
        ([["a"] * 4] * 4, "expected a 4x4 matrix of numbers, found list"),
        ([[1, 0, 0, 0], [0, 1, 0]], "expected a 4x4 matrix of numbers, found list"),
        (torch.eye(3), r"expected a 4x4 matrix, found shape \(3, 3\)"),
    ],
)
def test_what_is_no_pose_is_refused_with_the_fields_name(pose, words):
    with pytest.raises(NeecoError, match=f"InstrumentState.pose: {words}"):
        InstrumentState(pose)
    with pytest.raises(NeecoError, match=f"Camera.world_from_camera: {words}"):
        Camera(pose, 40.0, 40.0, 16, 12, 32, 24)


def test_poses_of_any_kind_become_tensors_and_tensors_keep_their_gradients():
    assert InstrumentState(np.eye(4, dtype=int)).pose.dtype == torch.float64
    assert Camera(np.eye(4).tolist(), 40.0, 40.0, 16, 12, 32, 24).world_from_camera.dtype == torch.float32
    moving = torch.eye(4, requires_grad=True)
    assert InstrumentState(moving).pose is moving
    given = np.eye(4)
    state = InstrumentState(given)
    given[0, 3] = 5.0
    assert state.pose[0, 3] == 0


def test_a_pose_that_is_not_rigid_is_not_written(tmp_path):
    images, *poses = arrays(1)
    (frame,) = own_frames(images, *poses)
    stretched = State({"grasper": InstrumentState(torch.diag(torch.tensor([2.0, 2, 2, 1])))})
    with pytest.raises(NeecoError, match=r"0000\.png: grasper: pose: is not rigid"):
        write_capture(Capture("mine", [replace(frame, state=stretched)]), tmp_path, images=images)


def test_points_that_are_not_rows_of_three_are_refused():
    with pytest.raises(NeecoError, match=r"PointCloud.positions: expected shape \[P, 3\], found \[4, 2\]"):
        PointCloud(np.zeros((4, 2)))
    with pytest.raises(NeecoError, match=r"PointCloud.colors: expected shape \[4, 3\], found \[3, 3\]"):
        PointCloud(np.zeros((4, 3)), np.zeros((3, 3)))


@pytest.mark.parametrize(("count", "most"), [(0, 4), (1, 4), (3, 4), (10, 4), (1000, 128)])
@pytest.mark.parametrize("floor", [False, True])
def test_evenly_spaced_items_run_from_the_first_to_the_last(count, most, floor):
    chosen = evenly_spaced(count, most, floor=floor)
    assert len(chosen) == min(count, most)
    assert chosen == sorted(set(chosen))
    assert chosen[:1] + chosen[-1:] == ([0, count - 1] if count else [])
    assert max(np.diff(chosen), default=1) - min(np.diff(chosen), default=1) <= 1


def test_of_several_colmap_models_the_largest_is_read_and_the_rest_noted(folder, tmp_path):
    write_colmap(folder, tmp_path, binary=False)
    sparse = tmp_path / "sparse"
    shutil.copytree(sparse / "0", sparse / "1")
    lines = (sparse / "0/images.txt").read_text().splitlines(keepends=True)
    (sparse / "0/images.txt").write_text("".join(lines[:7]))
    (tmp_path / "images/unregistered.png").write_bytes((tmp_path / "images/000000.png").read_bytes())
    assert len(read_capture(tmp_path).frames) == 8
    told = " ".join(str(problem) for problem in check_capture(tmp_path))
    assert "sparse/1 with 8 images is read; left out: sparse/0 with 3" in told
    assert "1 of 9 images in images/ have no camera ('unregistered.png')" in told


def rename(root: Path, names: list[str]) -> None:
    """Give the images of a COLMAP folder, in their order, other names."""
    file = root / "sparse/0/images.txt"
    text = file.read_text()
    for index, name in enumerate(names):
        old = f"{index:06d}.png"
        (root / "images" / name).parent.mkdir(exist_ok=True)
        (root / "images" / old).rename(root / "images" / name)
        text = text.replace(f" 1 {old}", f" {1 + name.startswith('right')} {name}")
    file.write_text(text)


def test_colmap_images_are_in_the_order_of_their_numbers(folder, tmp_path):
    write_colmap(folder, tmp_path, binary=False)
    rename(tmp_path, [f"{number}.png" for number in (0, 1, 10, 11, 2, 20, 3, 9)])
    times = {frame.image_path.stem: frame.state.time for frame in read_capture(tmp_path).frames}
    assert sorted(times, key=times.__getitem__) == ["0", "1", "2", "3", "9", "10", "11", "20"]


@pytest.mark.parametrize("lenses", [1, 2])
def test_two_cameras_of_a_rig_share_their_instants(folder, tmp_path, lenses):
    """With one lens, two folders hold one recording after the other."""
    write_colmap(folder, tmp_path, binary=False)
    rename(tmp_path, [f"{side}/{number}.png" for side in ("left", "right") for number in (8, 9, 10, 11)])
    sparse = tmp_path / "sparse/0"
    with (sparse / "cameras.txt").open("a") as stream:
        stream.write("2 PINHOLE 32 24 40 41 16 12\n")
    if lenses == 1:
        text = (sparse / "images.txt").read_text()
        (sparse / "images.txt").write_text(text.replace(" 2 right", " 1 right"))
    frames = read_capture(tmp_path).frames
    assert [frame.state.time for frame in frames] == ([0, 0, 1, 1, 2, 2, 3, 3] if lenses == 2 else [*range(8)])
    assert all(one.split == two.split for one, two in zip(frames[::2], frames[1::2], strict=True)) or lenses == 1


def test_nerfstudio_frames_without_time_are_in_the_order_of_their_numbers(folder):
    document = folder.document
    for frame in document["frames"]:
        frame.pop("time", None)
    names = [frame["file_path"] for frame in document["frames"]]
    document["frames"] = [document["frames"][index] for index in (5, 2, 7, 0, 1, 3, 6, 4)]
    folder.write(document)
    frames = read_capture(folder.root).frames
    assert [frame.image_path.relative_to(folder.root).as_posix() for frame in frames] == names
    assert [frame.state.time for frame in frames] == [*range(8)]


@pytest.mark.parametrize("factor", [0.5, 1.5])
def test_cameras_of_another_image_size_are_a_warning(folder, factor):
    document = folder.document
    for key in ("fl_x", "fl_y", "cx", "cy"):
        for place in (document, *document["frames"]):
            if key in place:
                place[key] *= factor
    folder.write(document)
    assert any("intrinsics of another image size" in problem.message for problem in check_capture(folder.root))
