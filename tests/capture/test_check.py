"""`check_capture` finds each kind of problem and names its place."""

from __future__ import annotations

import json
import math
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from neeco.base.errors import NeecoError
from neeco.capture import check_capture, errors_only, read_capture
from neeco.capture.points import read_ply, write_ply
from neeco.capture.writer import fingerprint, write_capture
from neeco.cli import check as check_verb
from neeco.cli import main

LENS = {"w": 32, "h": 24, "fl_x": 30, "fl_y": 30, "cx": 16, "cy": 12}
SAMPLE = Path(__file__).parents[2] / "samples" / "liver-mini"


def problems(folder, severity="error"):
    return [problem for problem in check_capture(folder.root) if problem.severity == severity]


def assert_found(folder, field: str, words: str, severity: str = "error") -> None:
    found = problems(folder, severity)
    assert any(problem.field == field and words in problem.message for problem in found), [str(one) for one in found]


def test_a_good_capture_has_no_errors(folder):
    assert problems(folder) == []


def test_the_sample_capture_is_clean_and_quickly_checked():
    start = time.process_time()  # of all threads
    assert check_capture(SAMPLE) == []
    assert time.process_time() - start < 20


def _frame(index, key, value):
    return lambda document: document["frames"][index].__setitem__(key, value)


def _pose(index, row, column, value):
    return lambda document: document["frames"][index]["instruments"][0]["pose"][row].__setitem__(column, value)


def _mirror(index):
    def edit(document):
        for row in document["frames"][index]["instruments"][0]["pose"]:
            row[0] = -row[0]

    return edit


def _joint(index, value):
    return lambda document: document["frames"][index]["instruments"][0]["joints"].__setitem__("jaw_angle", value)


def _shared(covariance):
    given = {"center": [0, 0, 90], "covariance": covariance}
    return lambda document: document["instruments"][0].update(base_uncertainty=given)


def _uncertainty(**changes):
    given = {"translation_mm": [0.2, 0.2, 1.0], "rotation_deg": [1, 1, 180], **changes}
    return lambda document: document["frames"][3]["instruments"][0].update(uncertainty=given)


def _from_video(value):
    return lambda document: document["instruments"][0].update(from_video=value)


def _head(key, value):
    return lambda document: document.__setitem__(key, value)


EDITS = [
    (_frame(2, "file_path", "images/none.png"), "frames[2].file_path", "no such file"),
    (_frame(2, "file_path", "../../etc/passwd"), "frames[2].file_path", "leaves the capture's folder"),
    (_frame(2, "file_path", "/etc/passwd"), "frames[2].file_path", "absolute"),
    (_frame(2, "file_path", "C:\\x.png"), "frames[2].file_path", "absolute"),
    (_frame(2, "file_path", "a\0b"), "frames[2].file_path", "not a usable path"),
    (_frame(2, "file_path", None), "frames[2].file_path", "missing"),
    (_frame(2, "file_path", 7), "frames[2].file_path", "expected text"),
    (_frame(2, "file_path", "images/000001.png"), "frames[2].file_path", "same image as frames[1]"),
    (_frame(2, "mask_path", "masks/none.png"), "frames[2].mask_path", "no such file"),
    (_frame(2, "transform_matrix", [[1, 0], [0, 1]]), "frames[2].transform_matrix", "4x4"),
    (_frame(2, "transform_matrix", None), "frames[2].transform_matrix", "missing"),
    (lambda d: d["frames"][6]["transform_matrix"][0].__setitem__(3, 1e5), "frames[6].transform_matrix", "far from the"),
    (_frame(2, "time", "soon"), "frames[2].time", "expected a number"),
    (_frame(2, "instruments", {}), "frames[2].instruments", "expected a list"),
    (_frame(2, "instruments", []), "frames[2].instruments", "missing here"),
    (_frame(2, "fl_x", -3), "frames[2].fl_x", "positive"),
    (_frame(2, "k1", 0.1), "frames[2].k1", "distorted"),
    (_pose(3, 0, 3, math.nan), "frames[3].instruments[0].pose", "NaN"),
    (_pose(3, 0, 3, math.inf), "frames[3].instruments[0].pose", "infinity"),
    (_pose(3, 0, 3, "1"), "frames[3].instruments[0].pose", "not a number"),
    (_pose(3, 0, 3, 1e6), "frames[3].instruments[0].pose", "far from the points"),
    (_pose(3, 0, 0, 3.0), "frames[3].instruments[0].pose", "not rigid"),
    (_mirror(3), "frames[3].instruments[0].pose", "reflection"),
    (_pose(3, 3, 0, 5.0), "frames[3].instruments[0].pose", "last row"),
    (_joint(5, 2.0), "frames[5].instruments[0].joints.jaw_angle", "outside its limits"),
    (_joint(5, None), "frames[5].instruments[0].joints.jaw_angle", "expected a number"),
    (_joint(5, math.nan), "frames[5].instruments[0].joints.jaw_angle", "not a finite number"),
    (
        lambda d: d["frames"][5]["instruments"][0]["joints"].clear(),
        "frames[5].instruments[0].joints.jaw_angle",
        "missing",
    ),
    (_uncertainty(translation_mm=[1, 2]), "frames[3].instruments[0].uncertainty.translation_mm", "3 numbers"),
    (_uncertainty(rotation_deg=[1, -1, 2]), "frames[3].instruments[0].uncertainty.rotation_deg[1]", "out of range"),
    (_uncertainty(joints_deg={"x": 1}), "frames[3].instruments[0].uncertainty.joints_deg.x", "no such joint"),
    (_uncertainty(joints_deg=[]), "frames[3].instruments[0].uncertainty.joints_deg", "expected an object"),
    (_shared(np.diag([1.0] * 5 + [-1.0]).tolist()), "instruments[0].base_uncertainty.covariance", "not a covariance"),
    (_shared([[1.0] * 5] * 6), "instruments[0].base_uncertainty.covariance[0]", "6 numbers"),
    (_from_video({"shaft_diameter_mm": 0}), "instruments[0].from_video.shaft_diameter_mm", "out of range"),
    (_from_video({"shaft_diameter_mm": 5}), "instruments[0].from_video.working_length_mm", "expected a number"),
    (_head("cx", 900), "cx", "outside the image"),
    (_head("fl_x", 0), "fl_x", "positive"),
    (_head("camera_model", "OPENCV_FISHEYE"), "camera_model", "must be PINHOLE"),
    (_head("units", "m"), "units", "must be mm"),
    (_head("instrument_frame", "moon"), "instrument_frame", "'moon'"),
    (_head("ply_file_path", "../sparse.ply"), "ply_file_path", "leaves the capture's folder"),
    (_head("ply_file_path", "none.ply"), "ply_file_path", "no such file"),
    (_head("lens", []), "lens", "expected an object"),
    (_head("lens", LENS | {"fl_x": -1}), "lens.fl_x", "out of range"),
    (_head("lens", LENS | {"k3": "x"}), "lens.k3", "expected a number"),
    (_head("lens", LENS | {"border": {"cx": 3, "cy": 4}}), "lens.border.radius", "expected a number"),
    (_head("lens", LENS | {"k1": -90}), "lens", "folds the image over"),
    (_head("frames", []), "frames", "empty"),
    (lambda d: d.pop("frames"), "frames", "missing"),
    (lambda d: d["frames"].__delitem__(slice(2, None)), "frames", "too few frames"),
    (lambda d: [frame.update(split="test") for frame in d["frames"]], "frames", "'train' is empty"),
    (lambda d: d["frames"][1].pop("split"), "frames[1].split", "missing"),
    (lambda d: [f["instruments"][0].update(d["frames"][0]["instruments"][0]) for f in d["frames"]], "frames", "never"),
]


@pytest.mark.parametrize(("edit", "field", "words"), EDITS)
def test_a_damaged_file_is_an_error_that_names_its_field(folder, edit, field, words):
    folder.edit(edit)
    assert_found(folder, field, words)


def test_joints_in_degrees_are_noticed(folder):
    folder.edit(lambda document: document.pop("instruments"))
    folder.edit(lambda d: [f["instruments"][0]["joints"].update(jaw_angle=9.0 * i) for i, f in enumerate(d["frames"])])
    assert_found(folder, "frames[7].instruments[0].joints.jaw_angle", "degrees")


def _scale(pose, factor):
    pose = pose.copy()
    pose[:3, 3] *= factor
    return pose


@pytest.mark.parametrize(
    "mistake",
    [lambda pose: pose * [1, -1, -1, 1], np.linalg.inv, lambda pose: _scale(pose, 1e-3)],
)
def test_cameras_without_points_in_view_are_an_error(folder, mistake):
    folder.edit_cameras(mistake)
    assert_found(folder, "frames[*].transform_matrix", "no camera observes any point")


def test_positions_in_metres_are_an_error(folder):
    folder.edit_poses(lambda pose: _scale(pose, 1e-3))
    assert_found(folder, "frames[*].instruments[*].pose", "probably metres")


def test_a_whole_capture_in_metres_is_noticed(folder):
    points = read_capture(folder.root).points
    write_ply(folder.root / "sparse.ply", type(points)(points.positions / 1000, points.colors))
    folder.edit_poses(lambda pose: _scale(pose, 1e-3))
    folder.edit_cameras(lambda pose: _scale(pose, 1e-3))
    assert any("metres" in problem.message for problem in problems(folder))


@pytest.fixture
def sample(folder, tmp_path):
    """A copy of every second frame of the sample capture, whose instrument turns and moves as a real one does."""
    without_truth = shutil.ignore_patterns("truth")
    copied = type(folder)(Path(shutil.copytree(SAMPLE, tmp_path / "sample", ignore=without_truth)))
    copied.edit(lambda document: document.update(frames=document["frames"][::2]))
    return copied


@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        (np.linalg.inv, "instrument-from-world"),
        (lambda pose: np.diag([1.0, -1, -1, 1]) @ pose, "(x, y, z) should be (x, -y, -z)"),
        (lambda pose: _scale(pose, 1e3), "metres"),
    ],
)
def test_mistakes_in_instrument_poses_are_named(sample, mistake, words):
    sample.edit_poses(mistake)
    (problem,) = problems(sample)
    assert problem.field == "frames[*].instruments[*].pose"
    assert "outside" in problem.message
    assert words in problem.message


def test_a_sensor_mounted_behind_the_tip_is_nothing_where_the_images_fit_its_poses_else_only_a_warning(sample):
    behind = np.eye(4)
    behind[:3, 3] = [0, 0, -100.0]
    sample.edit_poses(lambda pose: pose @ behind)
    assert [str(problem) for problem in check_capture(sample.root)] == []
    sample.edit(lambda document: document.pop("ply_file_path"))  # now the images tell nothing
    found = check_capture(sample.root)
    assert errors_only(found) == []
    assert any("outside every image" in problem.message for problem in found)


def test_a_sensor_mounted_tilted_is_fine(folder):
    tilt = np.eye(4)
    tilt[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    folder.edit_poses(lambda pose: pose @ tilt)
    assert problems(folder) == []


def test_a_roll_that_nobody_knows_is_a_warning(folder):
    def found_in_video(document, roll):
        sure = {"translation_mm": [0.2, 0.2, 1.0], "rotation_deg": [1, 1, roll]}
        for frame in document["frames"]:
            frame["instruments"][0].update(uncertainty=sure)

    for roll, doubted in ((180, True), (5, False)):
        folder.edit(lambda document, roll=roll: found_in_video(document, roll))
        told = [problem.message for problem in check_capture(folder.root) if "roll" in problem.message]
        assert bool(told) == doubted


def test_a_tracker_dropout_is_a_warning(folder):
    folder.edit(lambda d: [d["frames"][6]["instruments"][0]["pose"][row].__setitem__(3, 200.0) for row in range(3)])
    assert_found(folder, "frames[6].instruments[0].pose", "its median position", "warning")


def test_unregistered_instruments_are_a_warning_and_not_located(folder):
    folder.edit_poses(lambda pose: _scale(pose, 20))
    folder.edit(_head("instrument_frame", "unregistered"))
    assert problems(folder) == []
    assert_found(folder, "instrument_frame", "unregistered", "warning")
    (said,) = [problem for problem in problems(folder, "warning") if problem.field == "instrument_frame"]
    assert "in recording.yaml state camera_from_base" in said.remedy


def test_damaged_images_are_errors(folder):
    images = folder.root / "images"
    (images / "000001.png").write_bytes(b"")
    (images / "000002.png").write_bytes((images / "000002.png").read_bytes()[:900])
    Image.new("RGB", (16, 12)).save(images / "000003.png")
    assert_found(folder, "frames[1].file_path", "not an image file")
    assert_found(folder, "frames[2].file_path", "cannot be decoded")
    assert_found(folder, "frames[3].file_path", "image is 16x12, its camera says 32x24")


def test_the_same_picture_under_two_names_is_an_error(folder):
    shutil.copy(folder.root / "images/000001.png", folder.root / "images/000005.png")
    assert_found(folder, "frames[5].file_path", "same pixels as frames[1]")


def test_a_mask_that_ignores_everything_is_an_error_and_missing_ones_a_warning(folder):
    Image.new("L", (32, 24), 1).save(folder.root / "mask.png")
    folder.edit(_frame(2, "mask_path", "mask.png"))
    assert_found(folder, "frames[2].mask_path", "ignores every pixel")
    assert_found(folder, "frames[0].mask_path", "no mask", "warning")


def test_a_missing_time_is_only_a_warning(folder):
    folder.edit(_frame(3, "time", None))
    assert problems(folder) == []
    assert any("time" in problem.message for problem in problems(folder, "warning"))


def test_bad_points_are_errors_and_few_a_warning(folder):
    points = read_capture(folder.root).points
    broken = points.positions.copy()
    broken[3] = np.nan
    write_ply(folder.root / "sparse.ply", type(points)(broken, points.colors))
    assert_found(type(folder)(folder.root), "vertex", "NaN")
    write_ply(folder.root / "sparse.ply", type(points)(points.positions[:9], points.colors[:9]))
    assert_found(folder, "vertex", "few sparse points", "warning")
    write_ply(folder.root / "sparse.ply", type(points)(points.positions[:0], points.colors[:0]))
    assert_found(folder, "vertex", "no points")


def test_all_problems_are_told_at_once_and_reading_raises_the_first(folder):
    folder.edit(_frame(1, "file_path", "none.png"))
    folder.edit(_joint(5, None))
    assert len(errors_only(check_capture(folder.root))) >= 2
    with pytest.raises(NeecoError, match=r"frames\[1\].file_path: no such file.*neeco check"):
        read_capture(folder.root)


@pytest.mark.parametrize(
    "text", ["", "[]", "{", "null", "[" * 100_000, '{"frames": 3}', '{"frames": [1' + "0" * 9999 + "]}"]
)
def test_a_file_that_is_no_capture_is_one_error(folder, text):
    (folder.root / "transforms.json").write_text(text)
    assert errors_only(check_capture(folder.root))
    with pytest.raises(NeecoError):
        read_capture(folder.root)


def test_no_folder_and_empty_folder_are_errors(tmp_path):
    assert (
        str(check_capture(tmp_path / "none")[0]) == f"{tmp_path / 'none'}: no such folder; give the folder of a capture"
    )
    assert str(check_capture(tmp_path)[0]).startswith(f"{tmp_path}: is not the folder of a capture; one holds")


def test_the_verb_prints_and_returns_a_status(folder, sample, capsys):
    assert check_verb.run(check_verb.Arguments(sample.root)) == 0
    assert "no problems found" in capsys.readouterr().out
    folder.edit(_joint(5, 2.0))
    assert main(["check", str(folder.root), "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert main(["check", str(folder.root), "--json", str(folder.root / "problems.json")]) == 1
    assert json.loads((folder.root / "problems.json").read_text()) == report
    assert "1 error" in capsys.readouterr().out
    assert report["errors"] == 1
    errors = [problem for problem in report["problems"] if problem["severity"] == "error"]
    assert errors[0]["field"] == "frames[5].instruments[0].joints.jaw_angle"
    assert report["summary"]["splits"] == {"train": 7, "test": 1}


def test_frames_that_are_all_left_out_are_an_error(folder):
    folder.edit(lambda document: document.update(train_filenames=[]))
    folder.edit(lambda document: [frame.pop("split") for frame in document["frames"]])
    assert_found(folder, "frames", "no usable frame")


def told(folder, field: str) -> list[str]:
    return [str(problem) for problem in problems(folder) if problem.field == field]


@pytest.mark.parametrize(
    ("edit", "field", "words"),
    [
        (lambda d: d.pop("fl_x"), "fl_x", "is missing, for 8 of 8 frames"),
        (lambda d: d.pop("w"), "w", "is missing, for 8 of 8 frames"),
        (_head("fl_x", -1), "fl_x", "is -1, must be positive, for 8 of 8 frames"),
        (_head("cy", "x"), "cy", "expected a number, found 'x', for 8 of 8 frames"),
        (_head("k1", 0.1), "k1", "the images are distorted, for 8 of 8 frames"),
        (_head("camera_model", "FISHEYE"), "camera_model", "cameras must be PINHOLE"),
    ],
)
def test_a_mistake_at_the_top_level_is_told_once_and_hides_nothing(folder, edit, field, words):
    folder.edit(edit)
    folder.edit(_joint(5, 2.0))
    folder.edit(_head("cx", 900))
    (folder.root / "images/000002.png").write_bytes(b"")
    write_ply(folder.root / "sparse.ply", type(read_points(folder))(np.zeros((0, 3)), np.zeros((0, 3))))
    (line,) = told(folder, field)
    assert words in line
    assert field in [problem.field for problem in problems(folder)[:2]]  # what concerns all comes first
    assert_found(folder, "cx", "outside the image")
    assert_found(folder, "frames[5].instruments[0].joints.jaw_angle", "outside its limits")
    assert_found(folder, "frames[2].file_path", "not an image file")
    assert_found(folder, "vertex", "no points")
    assert len(problems(folder)) == 5
    with pytest.raises(NeecoError, match=r"transforms.json: \w+: .*for 8 of 8 frames"):
        read_capture(folder.root)


def read_points(folder):
    return read_ply(folder.root / "sparse.ply")


def test_a_number_that_some_frames_give_is_told_with_how_many_lack_it(folder):
    folder.edit(lambda document: [frame.update(fl_x=document["fl_x"]) for frame in document["frames"][:5]])
    folder.edit(lambda document: document.pop("fl_x"))
    (line,) = told(folder, "fl_x")
    assert "is missing, for 3 of 8 frames; give the camera's intrinsics at the top level or in every frame" in line


def test_a_frame_with_a_wrong_camera_pose_is_checked_in_all_else(folder):
    folder.edit(_frame(5, "transform_matrix", None))
    folder.edit(_joint(5, 2.0))
    (folder.root / "images/000005.png").write_bytes(b"")
    fields = [problem.field for problem in problems(folder)]
    joint = "frames[5].instruments[0].joints.jaw_angle"
    assert sorted(fields) == ["frames[5].file_path", joint, "frames[5].transform_matrix"]


def test_frames_whose_cameras_are_right_are_still_held_against_the_points(folder):
    folder.edit(_frame(5, "fl_x", -1))
    folder.edit(lambda d: d["frames"][6]["transform_matrix"][0].__setitem__(3, 1e5))
    assert_found(folder, "frames[5].fl_x", "must be positive")
    assert_found(folder, "frames[6].transform_matrix", "far from the points")


def test_an_image_whose_size_nothing_states_is_told_once_when_damaged(folder):
    folder.edit(lambda document: [document.pop(key) for key in ("w", "h")])
    (folder.root / "images/000005.png").write_bytes(b"")
    (line,) = told(folder, "frames[5].file_path")
    assert "not an image file" in line


WRIST = {"name": "wrist", "parent": "shaft", "type": "revolute", "axis": [1, 0, 0], "value": {"jaw_angle": 1.0}}


def _tree(**changes):
    tree = {"links": [{"name": "shaft"}, WRIST | changes]}
    return lambda document: document.__setitem__(
        "instruments", [{"name": document["frames"][0]["instruments"][0]["name"], "joints": {}, "kinematics": tree}]
    )


@pytest.mark.parametrize(
    ("changes", "field", "words", "severity"),
    [
        ({"value": {"elbow": 1}}, "instruments", "'elbow' is not a joint of it (recorded: jaw_angle)", "error"),
        ({"offset": 50.0, "limits": [-1, 1]}, "instruments", "8 frames, outside its limits", "warning"),
        ({"parent": "wrist"}, "instruments[0].kinematics.links", "the links form a cycle", "error"),
        ({"type": "hinge"}, "instruments[0].kinematics.links[1].type", "is 'hinge'", "error"),
    ],
)
def test_kinematics_are_checked(folder, changes, field, words, severity):
    folder.edit(_tree(**changes))
    assert_found(folder, field, words, severity)


def test_kinematics_are_kept_and_told_apart(folder, tmp_path):
    before = fingerprint(read_capture(folder.root))
    folder.edit(_tree())
    capture = read_capture(folder.root)
    write_capture(capture, tmp_path / "again")
    again = read_capture(tmp_path / "again")
    assert again.instruments == capture.instruments
    assert again.instruments[0].kinematics.readings == ("jaw_angle",)
    folder.edit(_tree(offset=0.1))
    other = read_capture(folder.root)
    assert other.instruments != capture.instruments
    assert len({before, fingerprint(capture), fingerprint(other)}) == 3


def _unrecorded(stated=None, pose_of=None, keep=False):
    """The jaw's reading is taken out of the frames, and declared as not recorded."""

    def edit(document):
        _tree()(document)
        instrument = document["instruments"][0]
        instrument["joints"] = {"jaw_angle": stated or {"recorded": False, "limits": [0.0, 1.0]}}
        if pose_of is not None:
            instrument["kinematics"]["pose_of"] = pose_of
        for frame in document["frames"] if not keep else ():
            for state in frame["instruments"]:
                state["joints"].pop("jaw_angle")

    return edit


def test_a_joint_that_nobody_recorded_stands_halfway_and_is_not_written(folder, tmp_path):
    folder.edit(_unrecorded())
    assert problems(folder) == []
    capture = read_capture(folder.root)
    (instrument,) = capture.instruments
    assert instrument.unrecorded == ("jaw_angle",)
    assert {frame.state.instruments[instrument.name].joints["jaw_angle"] for frame in capture.frames} == {0.5}
    write_capture(capture, tmp_path / "again")
    assert read_capture(tmp_path / "again").instruments == capture.instruments
    assert '"jaw_angle": 0.5' not in (tmp_path / "again" / "transforms.json").read_text()


@pytest.mark.parametrize(
    ("edit", "field", "words"),
    [
        (_unrecorded({"recorded": False}), "instruments[0].joints.jaw_angle.limits", "is missing"),
        (_unrecorded({"recorded": 0, "limits": [0, 1]}), "instruments[0].joints.jaw_angle.recorded", "true or false"),
        (
            _unrecorded(pose_of="wrist"),
            "instruments",
            "the pose of 'wrist' depends on the unrecorded joint 'jaw_angle'",
        ),
        (_unrecorded(keep=True), "frames[0].instruments[0].joints.jaw_angle", "but the header declares it unrecorded"),
    ],
)
def test_a_joint_that_nobody_recorded_is_checked(folder, edit, field, words):
    folder.edit(edit)
    assert_found(folder, field, words)


def test_a_reading_that_the_others_tell_is_said(folder):
    def edit(document):
        _tree(value={"jaw_angle": 1.0, "elbow": 0.5})(document)
        frames = document["frames"] = [dict(frame) for frame in document["frames"] * 2]
        for k, frame in enumerate(frames):
            (state,) = frame["instruments"] = [dict(frame["instruments"][0])]
            state["joints"] = {"jaw_angle": 0.1 * k, "elbow": 0.3 - 0.2 * k + 0.1 * (k % 3)}

    folder.edit(edit)
    assert_found(folder, "instruments", "joint 'elbow' of", "warning")
    assert_found(folder, "instruments", "follows from the others (99", "warning")


def test_one_time_for_all_frames_is_a_warning_where_states_differ(folder):
    for index in range(8):
        folder.edit(_frame(index, "time", 0.0))
    assert_found(folder, "frames", "every frame has the time 0, though states differ", "warning")


def test_links_are_followed_where_the_user_says_so(folder, tmp_path, capsys):
    (folder.root / "images/000001.png").rename(tmp_path / "outside.png")
    (folder.root / "images/000001.png").symlink_to(tmp_path / "outside.png")
    assert main(["check", str(folder.root)]) == 1
    assert "is a link" in capsys.readouterr().out
    assert main(["check", str(folder.root), "--follow-links"]) == 0
    assert main(["check", str(folder.root)]) == 1
