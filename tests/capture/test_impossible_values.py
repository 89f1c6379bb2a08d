"""Captures with values that cannot be: cameras, masks, paths; and states that no reader may lose."""

from __future__ import annotations

import json
import unicodedata

import numpy as np
import pytest
from PIL import Image

from neeco.capture import check_capture, read_capture
from neeco.capture.documents import Problem, condensed
from neeco.capture.readers.parsed import similar_file


def told(folder) -> list[str]:
    return [str(problem) for problem in check_capture(folder.root)]


@pytest.mark.parametrize(
    "intrinsics",
    [
        {"fl_x": 40 / 32, "fl_y": 41 / 24, "cx": 0.5, "cy": 0.5},  # shares of the image's size
        {"fl_x": 3.0, "fl_y": 3.0},  # mm
        {"fl_x": 40.0, "fl_y": 4000.0},
        {"fl_x": 1e6, "fl_y": 1e6},
    ],
)
def test_focal_lengths_that_fit_no_lens_are_an_error(folder, intrinsics):
    folder.edit(lambda document: document.update(intrinsics))
    (line,) = [line for line in told(folder) if "fl_x" in line]
    assert "px fit no lens on a 32x24 image, for 8 of 8 frames; give them in pixels" in line


def test_times_in_nanoseconds_are_an_error_told_once(folder):
    folder.edit(lambda document: [frame.update(time=1.7e18 + 4e7 * k) for k, frame in enumerate(document["frames"])])
    (line,) = [line for line in told(folder) if "].time: is" in line]
    assert "frames[0].time: is 1.7e+18 s (and 7 more like it); give seconds" in line


def give_field_of_view(document: dict) -> None:
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
        document.pop(key)
    document["camera_angle_x"] = 2 * float(np.arctan(16 / 40))


@pytest.mark.parametrize("in_header", [True, False])
def test_states_beside_a_field_of_view_are_read(folder, in_header):
    before = read_capture(folder.root)
    folder.edit(give_field_of_view)
    if not in_header:
        folder.edit(lambda document: document.pop("instruments"))
    capture = read_capture(folder.root)
    assert [item.name for item in capture.instruments] == ["grasper"]
    assert len(capture.points.positions) == len(before.points.positions)
    for mine, other in zip(capture.frames, before.frames, strict=True):
        assert dict(mine.state.instruments["grasper"].joints) == dict(other.state.instruments["grasper"].joints)
        assert mine.camera.fx == pytest.approx(40)
        assert mine.split == other.split


def test_states_of_a_file_for_each_split_are_read(folder):
    folder.edit(give_field_of_view)
    document = folder.document
    (folder.root / "transforms.json").unlink()
    for split in ("train", "test"):
        frames = [frame for frame in document["frames"] if frame["split"] == split]
        chosen = json.dumps({**document, "instrument_frame": "unregistered", "frames": frames})
        (folder.root / f"transforms_{split}.json").write_text(chosen)
    capture = read_capture(folder.root)
    assert capture.instruments[0].joints == {"jaw_angle": (0.0, 1.5)}
    assert not capture.registered
    assert all("grasper" in frame.state.instruments for frame in capture.frames)
    assert [frame.split for frame in capture.frames] == ["train"] * 7 + ["test"]


@pytest.mark.parametrize("key", ["tools", "joints", "instrument"])
def test_states_under_another_name_are_not_dropped_in_silence(folder, key):
    folder.edit(lambda document: document.pop("instruments"))
    folder.edit(lambda document: [frame.update({key: frame.pop("instruments")}) for frame in document["frames"]])
    (line,) = [line for line in told(folder) if "is ignored" in line]
    assert f"frames[0].{key}: is ignored: instrument states must be in `instruments`" in line


def mask_frames(folder, shown: np.ndarray) -> None:
    Image.fromarray(shown.astype(np.uint8) * 255).save(folder.root / "mask.png")
    folder.edit(lambda document: [frame.update(mask_path="mask.png") for frame in document["frames"]])


def test_masks_that_hide_most_of_most_images_are_doubted(folder):
    rows, columns = np.indices((24, 32))
    field = np.hypot(columns - 15.5, rows - 11.5) < 12
    mask_frames(folder, ~field)
    (line,) = [line for line in told(folder) if "polarity" in line]
    assert "frames[*].mask_path: loss masks hide 58% of most images and " in line
    assert "of the sparse points in view: inverted polarity?" in line


def test_a_round_border_may_hide_most_of_an_image(folder):
    rows, columns = np.indices((24, 32))
    field = np.hypot(columns - 15.5, rows - 11.5) < 9  # 34% of the image
    for path in (folder.root / "images").iterdir():
        Image.fromarray(np.asarray(Image.open(path)) * field[..., None].astype(np.uint8)).save(path)
    mask_frames(folder, field)
    assert not [line for line in told(folder) if "polarity" in line]
    mask_frames(folder, ~field)
    assert [line for line in told(folder) if "polarity" in line]


RENAMED = {
    "upper": (
        lambda path: path.with_suffix(".PNG"),
        lambda text: text,
        "'images/000000.PNG' exists, in another Unicode form or case",
    ),
    "backslash": (lambda path: path, lambda text: text.replace("/", "\\"), "'images/000000.png' exists"),
    "no extension": (lambda path: path, lambda text: text[:-4], "'images/000000.png' exists"),
    "other extension": (lambda path: path, lambda text: text[:-3] + "jpeg", "'images/000000.png' exists"),
    "other folder": (lambda path: path, lambda text: text.replace("images", "rgb"), "'images/000000.png' exists"),
    "decomposed": (
        lambda path: path.with_name(unicodedata.normalize("NFD", f"ü{path.name}")),
        lambda text: text.replace("/", "/ü"),
        "in another Unicode form or case",
    ),
}


@pytest.mark.parametrize(("moved", "written", "words"), RENAMED.values(), ids=RENAMED)
def test_many_images_that_are_not_there_are_one_line_that_says_what_is(folder, moved, written, words):
    for path in list((folder.root / "images").iterdir()):
        path.rename(moved(path))
    folder.edit(lambda document: [f.update(file_path=written(f["file_path"])) for f in document["frames"]])
    (line,) = [line for line in told(folder) if "no such file" in line]
    assert line.startswith("transforms.json: frames[0].file_path: no such file: ")
    assert "(and 7 more like it)" in line
    assert words in line


def test_a_similar_file_is_never_looked_for_outside(tmp_path):
    (tmp_path / "inner").mkdir()
    (tmp_path / "a.png").write_bytes(b"")
    assert similar_file(tmp_path / "inner", "..\\a.png") is None
    assert similar_file(tmp_path, "A.jpg") == "a.png"
    assert similar_file(tmp_path / "nowhere", "a.png") is None


def test_problems_of_one_kind_are_counted_and_a_few_are_listed():
    def of(index: int, message: str) -> Problem:
        return Problem("error", "transforms.json", f"frames[{index}].pose", message, "repair it")

    few = [of(k, f"is {k} mm off") for k in range(3)]
    assert condensed(few) == few
    many = [of(k, f"is {k} mm off") for k in range(9)]
    assert [problem.message for problem in condensed([*many, of(3, "is missing")])] == [
        "is 0 mm off (and 8 more like it)",
        "is missing",
    ]
