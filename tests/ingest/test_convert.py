"""A folder of another format becomes a capture of its own, and what it lacks is said."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from neeco.base.errors import NeecoError
from neeco.capture import check_capture, errors_only, read_capture
from neeco.ingest.convert import convert_folder

SAMPLE = Path(__file__).parents[2] / "samples" / "liver-mini"
COUNT, WIDTH, HEIGHT = 9, 16, 12


def write_images(root: Path, folder: str = "images") -> list[str]:
    generator = np.random.default_rng(3)
    (root / folder).mkdir(parents=True)
    names = [f"{folder}/{index:03d}.png" for index in range(COUNT)]
    for name in names:
        Image.fromarray(generator.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)).save(root / name)
    return names


@pytest.fixture
def nerfstudio(tmp_path):
    root = tmp_path / "nerfstudio"
    frames = [{"file_path": name, "transform_matrix": np.eye(4).tolist()} for name in write_images(root)]
    camera = {"camera_model": "OPENCV", "fl_x": 20, "fl_y": 20, "cx": 8, "cy": 6, "w": WIDTH, "h": HEIGHT, "k1": 0}
    (root / "transforms.json").write_text(json.dumps({**camera, "frames": frames}))
    return root


@pytest.fixture
def endonerf(tmp_path):
    root = tmp_path / "pulling"
    write_images(root)
    (root / "masks").mkdir()
    for index in range(COUNT):
        tool = np.zeros((HEIGHT, WIDTH), np.uint8)
        tool[:, : index + 1] = 255
        Image.fromarray(tool).save(root / f"masks/{index:03d}.png")
    matrix = np.concatenate([np.eye(3), np.zeros((3, 1)), [[HEIGHT], [WIDTH], [20.0]]], axis=1)
    np.save(root / "poses_bounds.npy", np.tile(np.concatenate([matrix.ravel(), [10.0, 50.0]]), (COUNT, 1)))
    return root


def test_a_nerfstudio_folder_becomes_a_capture(nerfstudio, tmp_path):
    said = convert_folder(nerfstudio, tmp_path / "new" / "capture")
    assert json.loads((tmp_path / "new/capture/transforms.json").read_text())["schema"] == "neeco-capture/1"
    old, new = read_capture(nerfstudio), read_capture(tmp_path / "new/capture")
    assert [frame.split for frame in old.frames] == [frame.split for frame in new.frames]
    for mine, other in zip(old.frames, new.frames, strict=True):
        assert mine.image_path.read_bytes() == other.image_path.read_bytes()
        assert torch.equal(mine.camera.world_from_camera, other.camera.world_from_camera)
    told = " ".join(said)
    for piece in ("No instrument states", "No sparse points", "no unit of length", "No times"):
        assert piece in told
    assert not [path for path in (tmp_path / "new").iterdir() if path.name != "capture"]


def test_the_sample_lacks_nothing(tmp_path):
    assert convert_folder(SAMPLE, tmp_path / "capture") == ()
    assert not errors_only(check_capture(tmp_path / "capture"))


def test_the_unit_of_length_is_doubted_only_where_none_is_said(nerfstudio, tmp_path):
    document = json.loads((nerfstudio / "transforms.json").read_text())
    (nerfstudio / "transforms.json").write_text(json.dumps({**document, "units": "mm"}))
    assert "unit" not in " ".join(convert_folder(nerfstudio, tmp_path / "capture"))


def test_tool_masks_become_loss_masks_that_ignore_the_tool(endonerf, tmp_path):
    said = convert_folder(endonerf, tmp_path / "capture")
    for index, frame in enumerate(read_capture(tmp_path / "capture").frames):
        counted = frame.load_mask().numpy()
        assert not counted[:, : index + 1].any()
        assert counted[:, index + 1 :].all()
    told = " ".join(said)
    assert "the tool is not learned" in told
    assert "camera never moves" in told
    assert told.count("instrument states") == 1
    assert not errors_only(check_capture(tmp_path / "capture"))


def test_tool_masks_of_the_other_polarity_are_told_by_what_they_show(endonerf, tmp_path):
    convert_folder(endonerf, tmp_path / "capture")
    for path in (endonerf / "masks").iterdir():
        Image.fromarray(255 - np.asarray(Image.open(path))).save(path)
    told = " ".join(convert_folder(endonerf, tmp_path / "inverted"))
    assert "inverted polarity: white is 69% of most images, so black is read as the tool" in told
    masks = [[frame.load_mask() for frame in read_capture(tmp_path / name).frames] for name in ("capture", "inverted")]
    assert all(torch.equal(one, other) for one, other in zip(*masks, strict=True))


def test_loss_masks_that_hide_most_of_the_images_are_doubted_when_they_are_copied(nerfstudio, tmp_path):
    Image.fromarray(np.uint8(255) * (np.indices((HEIGHT, WIDTH))[1] < 4)).save(nerfstudio / "mask.png")
    document = json.loads((nerfstudio / "transforms.json").read_text())
    frames = [{**frame, "mask_path": "mask.png"} for frame in document["frames"]]
    (nerfstudio / "transforms.json").write_text(json.dumps({**document, "frames": frames}))
    said = convert_folder(nerfstudio, tmp_path / "capture")
    assert any("Warning: loss masks hide 75% of most images: inverted polarity?" in sentence for sentence in said)


def test_poses_of_another_link_stay_those_of_that_link(tmp_path):
    """A capture whose poses are not of the root, converted: poses are then the root's, as read_capture gives them."""
    shutil.copytree(SAMPLE, tmp_path / "source")
    file = tmp_path / "source/transforms.json"
    document = json.loads(file.read_text())
    shaft = {"name": "shaft"}
    wrist = {"name": "wrist", "parent": "shaft", "type": "fixed", "origin": np.eye(4).tolist()}
    wrist["origin"][2][3] = 9.0
    kinematics = {"links": [shaft, wrist], "pose_of": "wrist"}
    document["instruments"] = [{"name": "maryland", "joints": {"jaw_angle": {}}, "kinematics": kinematics}]
    document["frames"] = document["frames"][::8]
    file.write_text(json.dumps(document))
    convert_folder(tmp_path / "source", tmp_path / "capture")
    old, new = read_capture(tmp_path / "source"), read_capture(tmp_path / "capture")
    for mine, other in zip(new.frames, old.frames, strict=True):
        pose, expected = (frame.state.instruments["maryland"].pose for frame in (mine, other))
        assert torch.allclose(pose, expected)


def test_the_round_border_of_a_colmap_folder_is_masked(tmp_path):
    generator, (width, height) = np.random.default_rng(0), (80, 60)
    (tmp_path / "colmap/images").mkdir(parents=True)
    (tmp_path / "colmap/sparse/0").mkdir(parents=True)
    rows, columns = np.indices((height, width))
    disc = np.hypot(columns - 40, rows - 30) < 33
    lines = []
    for index in range(12):
        image = generator.integers(60, 250, (height, width, 3)) * disc[..., None]
        Image.fromarray(image.astype(np.uint8)).save(tmp_path / f"colmap/images/{index:03d}.png")
        lines += [f"{index + 1} 1 0 0 0 {index} 0 0 1 {index:03d}.png", ""]
    model = tmp_path / "colmap/sparse/0"
    (model / "cameras.txt").write_text(f"1 PINHOLE {width} {height} 60 60 40 30\n")
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    (model / "points3D.txt").write_text("1 0 0 9 255 0 0 0.5 1 0 2 0\n2 3 4 9 255 0 0 0.5 1 0 2 0\n")
    told = " ".join(convert_folder(tmp_path / "colmap", tmp_path / "capture"))
    assert "dark border (" in told
    for frame in read_capture(tmp_path / "capture").frames:
        counted = frame.load_mask().numpy()
        assert not (counted & ~disc).any()
        assert (disc & ~counted).sum() < 0.1 * disc.sum()
    assert not errors_only(check_capture(tmp_path / "capture"))


def test_a_missing_tool_mask_is_named(endonerf, tmp_path):
    (endonerf / "masks/004.png").unlink()
    with pytest.raises(NeecoError, match="masks/: has 8 masks for 9 images"):
        convert_folder(endonerf, tmp_path / "capture")
    assert not (tmp_path / "capture").exists()


def test_a_mask_that_is_a_pipe_is_refused_and_never_waited_for(endonerf, tmp_path):
    (endonerf / "masks/004.png").unlink()
    os.mkfifo(endonerf / "masks/004.png")
    with pytest.raises(NeecoError, match=r"004.png: is not a file; expected an image"):
        convert_folder(endonerf, tmp_path / "capture")
    assert not (tmp_path / "capture").exists()


def test_poses_without_instrument_joints_or_registration_are_named(tmp_path):
    shutil.copytree(SAMPLE, tmp_path / "source")
    file = tmp_path / "source/transforms.json"
    document = json.loads(file.read_text())
    document["instrument_frame"] = "unregistered"
    for item in document.get("instruments", []):
        item.pop("joints", None)
    for frame in document["frames"]:
        for state in frame["instruments"]:
            state["joints"] = {}
    file.write_text(json.dumps(document))
    told = " ".join(convert_folder(tmp_path / "source", tmp_path / "capture"))
    assert "no joint readings" in told
    assert "unregistered" in told
    assert not read_capture(tmp_path / "capture").registered


def test_nothing_is_overwritten_and_failures_leave_nothing(nerfstudio, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full/mine.txt").write_text("keep")
    with pytest.raises(NeecoError, match="already exists"):
        convert_folder(nerfstudio, tmp_path / "full")
    assert (tmp_path / "full/mine.txt").read_text() == "keep"
    (tmp_path / "empty").mkdir()
    convert_folder(nerfstudio, tmp_path / "empty")
    (nerfstudio / "images/002.png").write_bytes(b"no image")
    with pytest.raises(NeecoError, match=r"002\.png: not an image file"):
        convert_folder(nerfstudio, tmp_path / "broken")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "full", "nerfstudio"]


def test_a_folder_that_is_no_capture_is_refused(tmp_path):
    (tmp_path / "photos").mkdir()
    with pytest.raises(NeecoError, match=r"photos: is not the folder of a capture; .* poses_bounds\.npy"):
        convert_folder(tmp_path / "photos", tmp_path / "capture")
    with pytest.raises(NeecoError, match="no such folder"):
        convert_folder(tmp_path / "absent", tmp_path / "capture")
