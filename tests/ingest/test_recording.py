"""recording.yaml says what was recorded; mistakes in it are told with their key, and `--init` writes a right one."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from ingest.conftest import POSE_HEADER
from PIL import Image

from neeco.base.errors import NeecoError
from neeco.ingest.readers.logs import read_pose_log, read_reading_log
from neeco.ingest.readers.sections import Units
from neeco.ingest.recording.model import IngestSettings, Splits, read_recording
from neeco.ingest.recording.template import open_questions, write_template
from neeco.ingest.request import IngestRequest
from neeco.ingest.sources import sources_of

HEADER = "t_s,x_mm,y_mm,z_mm,qw,qx,qy,qz"


@pytest.fixture
def folder(world):
    """video.mp4, logs/ of instrument, camera and jaw with its table, and sync.json."""
    (world.folder / "video.mp4").write_bytes(b"film")
    world.write(HEADER, world.rows(), "logs/instrument.csv")
    world.write(HEADER, world.rows(), "logs/camera.csv")
    world.write("t_s,hall_raw", np.column_stack([world.times, 1000 + world.times]), "logs/jaw.csv")
    world.write("hall_raw,angle_rad", [[900, 0.0], [1500, 0.5], [2000, 1.0]], "logs/jaw_calibration.csv")
    world.text(json.dumps({"note": "pulse", "clocks": {"em": 0.038, "jaw_angle": -0.01}}), "logs/sync.json")
    return world.folder


def flags(folder, **more):
    given = {
        "instrument": folder / "logs/instrument.csv",
        "laparoscope": folder / "logs/camera.csv",
        "joint": [("jaw_angle", folder / "logs/jaw.csv", folder / "logs/jaw_calibration.csv")],
        "intrinsics": (290, 290, 160, 128),
        "sync": folder / "logs/sync.json",
    }
    return sources_of(IngestRequest(video=folder / "video.mp4", **(given | more)), Path("out"))[1][0]


def test_flags(folder):
    recording = flags(folder, frames=120)
    assert recording.clocks == ("em", "jaw_angle")
    assert recording.sync == {"em": 0.038, "jaw_angle": -0.01}
    assert recording.intrinsics == (290.0, 290.0, 160.0, 128.0)
    assert recording.frames == 120
    [instrument] = recording.instruments
    assert len(read_pose_log(instrument.poses).times) == 200
    assert len(read_reading_log(instrument.joints["jaw_angle"]).times) == 200


def test_init_offers_every_angle_of_a_robots_table_as_a_joint_on_the_clock_of_its_poses(folder):
    (folder / "logs/jaw.csv").unlink()
    rows = "".join(f"{0.01 * k:.2f},0.1,{0.2 + 0.001 * k:.3f}\n" for k in range(20))
    (folder / "logs/joints.csv").write_text("t_s,wrist_pitch_rad,jaw_rad\n" + rows)
    (folder / "recording.yaml").write_text(write_template(folder))
    [instrument] = read_recording(folder / "recording.yaml").instruments
    assert sorted(instrument.joints) == ["jaw", "wrist_pitch"]
    assert {joint.clock for joint in instrument.joints.values()} == {"em"}
    assert read_reading_log(instrument.joints["jaw"]).values[0] == pytest.approx(0.2)


@pytest.mark.parametrize("body", ["", "psm1_", "left_gripper_"])
@pytest.mark.parametrize("jaw", ["jaw", "gripper", "opening_deg"])
def test_init_offers_the_jaw_that_stands_in_a_table_of_poses(world, body, jaw):
    (world.folder / "clip.mp4").write_bytes(b"film")
    names = ",".join(body + name for name in ("x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw", "speed", jaw))
    rows = [[0.01 * k, 0.1 * k, 2, 3, 0, 0, 0, 1, 9, 0.2 + 0.001 * k] for k in range(40)]
    world.write(f"t_s,{names}", rows, "arm.csv")
    (world.folder / "recording.yaml").write_text(
        write_template(world.folder).replace("# units: {angle: rad}", "units: {angle: rad}")
    )
    [instrument] = read_recording(world.folder / "recording.yaml").instruments
    [joint] = instrument.joints.values()
    assert (joint.columns.value, joint.clock) == ((body + jaw,), instrument.poses.clock)
    assert len(read_reading_log(joint).values) == 40


def test_init_writes_what_the_flags_say(folder):
    (folder / "recording.yaml").write_text(write_template(folder))
    recording = read_recording(folder / "recording.yaml")
    same = flags(folder)
    assert (recording.sync, recording.clocks) == (same.sync, same.clocks)
    for mine, theirs in zip(recording.instruments, same.instruments, strict=True):
        assert mine.name == theirs.name
        np.testing.assert_array_equal(read_pose_log(mine.poses).quats, read_pose_log(theirs.poses).quats)
        for joint in theirs.joints:
            np.testing.assert_array_equal(
                read_reading_log(mine.joints[joint]).values, read_reading_log(theirs.joints[joint]).values
            )
    assert recording.laparoscope.file.name == "camera.csv"


def test_init_asks_for_the_lens_and_the_clock_that_no_file_states(folder):
    def asked() -> list[str]:
        draft = write_template(folder)
        return [draft.splitlines()[line - 1] for line, _ in open_questions(draft)]

    lens = folder / "lens.json"
    lens.write_text(json.dumps({"fl_x": 290, "fl_y": 290, "cx": 160, "cy": 128, "w": 320, "h": 256}))
    assert not any("intrinsics" in line or "clock" in line for line in asked())
    lens.unlink()
    (folder / "logs/sync.json").unlink()
    (folder / "capture").mkdir()
    document = {"fl_x": 1, "frames": [], "clocks": {"em": {"offset_s": 0.1, "sd_s": 0.001}}}  # as `ingest` writes it
    (folder / "capture/transforms.json").write_text(json.dumps(document))
    assert [line.strip() for line in asked() if "intrinsics" in line or "clock" in line] == [
        "# intrinsics: [290, 290, 160, 128]   # fl_x, fl_y, cx, cy px; no calibration was found",
        "# clock: em   # left out, it is its own, whose offset nothing states",
    ]
    (folder / "recording.yaml").write_text(write_template(folder).replace("# clock: em ", "clock: em "))
    [instrument] = read_recording(folder / "recording.yaml").instruments
    assert instrument.joints["jaw_angle"].clock == "em"


def test_init_asks_for_what_no_header_says(world):
    (world.folder / "clip.MOV").write_bytes(b"film")
    world.write("Frame,State,Q0,Qx,Qy,Qz,Tx,Ty,Tz", [[1, "OK", 1, 0, 0, 0, 1, 2, 3]] * 9, "aurora tool.csv")
    world.write("time,x,y,z,roll,pitch,yaw", [[1, 2, 3, 4, 5, 6, 7]] * 9, "scope.csv")
    world.write("t_s,gripper", [[1, 2]] * 9, "gripper.csv")
    world.text("%PDF nonsense", "notes.txt")
    text = write_template(world.folder)
    (world.folder / "recording.yaml").write_text(text)
    recording = read_recording(world.folder / "recording.yaml")
    assert "this rate is a guess" in text
    assert "# units: {time: s, length: mm}   # nothing says them" in text
    assert "# columns: rotation is not clear" in text
    assert "# units: {angle: rad}" in text
    [instrument] = recording.instruments
    assert instrument.name == "aurora tool"
    assert list(instrument.joints) == ["gripper_angle"]
    assert instrument.poses.rate_hz == 40


def test_inits_lines_on_a_still_scope_and_its_second_camera_are_right_once_they_count(world):
    for name in ("left.mp4", "right.mp4"):
        (world.folder / name).write_bytes(b"film")
    world.text("calibration", "stereo.yaml")
    world.write(POSE_HEADER, world.rows(), "tool.csv")
    lines = write_template(world.folder).splitlines()
    counting = [
        line.removeprefix("# ") if line.startswith(("# camera: still", "# stereo:")) else line for line in lines
    ]
    assert counting != lines
    (world.folder / "recording.yaml").write_text("\n".join(counting).replace("intrinsics: stereo.yaml", ""))
    recording = read_recording(world.folder / "recording.yaml")
    assert recording.camera == "still"
    assert recording.file == world.folder / "left.mp4"
    assert recording.stereo.file == world.folder / "right.mp4"
    assert recording.stereo.calibration == world.folder / "stereo.yaml"


def test_init_of_images_alone(world):
    for number in range(12):
        path = world.folder / "frames" / f"{number}.png"
        path.parent.mkdir(exist_ok=True)
        Image.new("RGB", (8, 6)).save(path)
    (world.folder / "recording.yaml").write_text(write_template(world.folder))
    recording = read_recording(world.folder / "recording.yaml")
    assert (recording.source.folder, recording.source.fps) == (world.folder / "frames", 25)
    assert recording.instruments == ()
    assert len(recording.source.open().times) == 12


def test_init_of_a_folder_without_frames(world):
    with pytest.raises(NeecoError, match="no video and no folder of images"):
        write_template(world.folder)


FULL = """
video: {file: video.mp4, fps: 50}
intrinsics: [290, 291, 160, 128]
instruments:
  - name: grasper
    poses:
      file: logs/instrument.csv
      columns: {time: t_s, position: [x_mm, y_mm, z_mm], quaternion: [qw, qx, qy, qz]}
      units: {length: millimetres}
    joints:
      jaw: {file: logs/jaw.csv, calibration: logs/jaw_calibration.csv, limits: [0, 1.5]}
      wrist: {file: logs/instrument.csv, columns: {value: qx}, units: {angle: deg}}
laparoscope: logs/camera.csv
sync: {em: 0.04, jaw: -1}
frames: 100
splits: {test_every: 0, unseen_fraction: 0.1, unseen_by: jaw, unseen: [3, 10-12]}
settings: {shape_frames: 20, tracker_noise_mm: 1}
"""


def test_everything_at_once(world, folder):
    recording = read_recording(world.text(FULL, "recording.yaml"))
    assert recording.source.fps == 50
    [instrument] = recording.instruments
    assert instrument.poses.columns.rotation[1] == "quaternion_wxyz"
    assert instrument.poses.units == Units(length="mm")
    assert instrument.joints["jaw"].limits == (0.0, 1.5)
    assert instrument.joints["wrist"].clock == "em"  # in the file of the poses
    assert recording.clocks == ("em", "jaw")
    assert recording.sync == {"em": 0.04, "jaw": -1.0}
    assert recording.splits == Splits(0, 0.1, "jaw", (), ((3, 3), (10, 12)))
    assert recording.settings == IngestSettings(shape_frames=20, tracker_noise_mm=1)


TOOL = """{"DH": {"convention": "modified", "joints": [ // a comment
{"name": "wrist_pitch", "type": "revolute", "alpha": -1.5708, "A": 0, "theta": 0, "D": 0, "offset": 0, "qmin": -1,
 "qmax": 1},
{"name": "wrist_yaw", "type": "revolute", "alpha": -1.5708, "A": 0.0091, "theta": 0, "D": 0, "offset": 0}
]}, "jaw": {"ftmax": 0.16}}"""
LINKS = "{links: [{name: shaft}, {name: tip, parent: shaft, type: prismatic, axis: [0, 0, 1], value: {jaw: 2}}]}"


def with_kinematics(words: str) -> str:
    return FULL.replace("laparoscope:", f"    kinematics: {words}\nlaparoscope:")


def test_links_are_given_inline_or_by_a_tool_file(world, folder):
    recording = read_recording(world.text(with_kinematics(LINKS), "recording.yaml"))
    tree = recording.instruments[0].kinematics
    assert tree.poses({"jaw": 0.5})["tip"][2, 3] == 1.0
    world.text(TOOL, "tool.json")
    tool = "{dvrk_tool: tool.json, readings: {wrist_pitch: wrist, wrist_yaw: jaw}}"
    recording = read_recording(world.text(with_kinematics(tool.replace("}}", ", jaw: jaw}}")), "recording.yaml"))
    assert recording.instruments[0].kinematics.readings == ("wrist", "jaw")
    assert recording.instruments[0].kinematics.pose_of == "tip"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (LINKS.replace("jaw", "elbow"), r"instruments\[0\]\.kinematics: 'elbow' is no joint of it; .*\(jaw, wrist\)"),
        (LINKS.replace("shaft, type", "tip, type"), r"kinematics\.links: the links form a cycle: 'tip'"),
        ("{dvrk_tool: none.json}", r"instruments\[0\]\.kinematics\.dvrk_tool: no such file: 'none\.json'"),
        ("{dvrk_tool: tool.json, reading: {}}", r"reading: it has no such field; .*did you mean readings\?"),
        ("{dvrk_tool: tool.json, readings: {yaw: jaw}}", r"kinematics\.readings\.yaw: unknown key"),
        ("{dvrk_tool: tool.json, readings: 3}", r"kinematics\.readings: is a group of fields"),
        ("{dvrk_tool: tool.json}", r"instruments\[0\]\.kinematics: 'wrist_pitch' is no joint of it"),
        ("7", r"instruments\[0\]\.kinematics: expected an object, found 7"),
    ],
)
def test_links_that_are_none_are_told_with_their_key(world, folder, words, message):
    world.text(TOOL, "tool.json")
    with pytest.raises(NeecoError, match=r"recording\.yaml: .*" + message) as caught:
        read_recording(world.text(with_kinematics(words), "recording.yaml"))
    assert "\n" not in str(caught.value)


def test_a_recording_without_settings_or_rules_has_the_usual_ones(world, folder):
    recording = read_recording(world.text("video: video.mp4\nsplits: {test: [3]}\n", "recording.yaml"))
    assert recording.settings == IngestSettings()
    assert recording.splits == Splits(None, 0.15, None, ((3, 3),))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("frames:", "frmes:", r"frmes: it has no such field; it has .*; did you mean frames\?"),
        ("quaternion:", "quaternions:", r"\[0\]\.poses\.columns\.quaternions: it has no such field; .*did you mean"),
        ("file: video.mp4", "file: vide.mp4", r"video\.file: no such file: 'vide\.mp4'"),
        ("fps: 50", "fps: fast", r"video\.fps: expected a number, found 'fast'"),
        ("[290, 291, 160, 128]", "[290, 291, 160]", r"intrinsics: expected 4 numbers"),
        ("- name: grasper", "- name:", r"instruments\[0\]\.name: missing"),
        ("[x_mm, y_mm, z_mm]", "[x_mm, y_mm, x_mm]", r"columns\.position: names a column twice"),
        ("[qw, qx, qy, qz]", "[a, b, c, d]", "the names do not say the order"),
        ("quaternion: [qw, qx, qy, qz]", "euler: [qx, qy, qz]", r"euler_convention: missing"),
        ("quaternion:", "rotation_vector: [a, b, c], quaternion:", "keep one of them"),
        ("millimetres", "inches", r"units\.length: 'inches' is not a unit of length; use one of: mm, cm, m"),
        ("[0, 1.5]", "[1.5, 0]", r"joints\.jaw\.limits: 1\.5 is not below 0"),
        ("jaw: -1}", "jaww: -1}", r"sync\.jaww: no log has the clock 'jaww'; did you mean jaw\?"),
        ("jaw: -1}", "jaw: soon}", r"sync\.jaw: 'soon' is not an offset in seconds"),
        ("frames: 100", "frames: 1.5", r"frames: 1\.5 is out of range; give a whole number"),
        ("unseen_by: jaw", "unseen_by: elbow", r"unseen_by: no joint is called 'elbow'; the joints are jaw, wrist"),
        ("10-12", "12-10", r"splits\.unseen: '12-10' is no range of frames"),
        ("video: {file: video.mp4, fps: 50}", "", "give either `video: FILE` or `images:"),
        ("video: {file: video.mp4, fps: 50}", "images: {folder: logs}", r"images\.fps: when were the images taken\?"),
        ("instruments:\n", "instruments: 3\nx:\n", r"x: it has no such field"),
        ("frames: 100", "frames: [100", r"line \d+: not valid YAML"),
        ("shape_frames: 20", "shape_frame: 20", r"shape_frame: it has no such .*did you mean shape_frames\?"),
        ("shape_frames: 20", "shape_frames: 0", r"shape_frames: 0 is out of range; give a whole number, 1 or"),
        ("tracker_noise_mm: 1", "tracker_noise_mm: 0", r"tracker_noise_mm: 0 is out of range; give a number above"),
    ],
)
def test_mistakes_are_told_with_their_key(world, folder, old, new, message):
    assert old in FULL
    path = world.text(FULL.replace(old, new), "recording.yaml")
    with pytest.raises(NeecoError, match=r"recording\.yaml: .*" + message) as caught:
        read_recording(path)
    assert "\n" not in str(caught.value)


def test_an_offset_of_a_log_that_was_not_given_is_noted(folder):
    recording = flags(folder, joint=())
    assert recording.sync == {"em": 0.038}
    assert any("'clocks.jaw_angle' belongs to no log" in note for note in recording.notes)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[]", "expected clock offsets"),
        ("{}", "clocks: expected clock offsets"),
        ('{"clocks": {"em": "x"}}', "'x' is not an offset"),
    ],
)
def test_sync_files_that_are_none(world, folder, content, message):
    with pytest.raises(NeecoError, match=rf"sync\.json: .*{message}"):
        flags(folder, sync=world.text(content, "sync.json"))


def test_flags_that_cannot_be(folder):
    joint = ("jaw_angle", folder / "logs/jaw.csv", None)
    exchanged = ("jaw_angle", folder / "logs/jaw_calibration.csv", folder / "logs/jaw.csv")
    for options, message in [
        ({"laparoscope": folder / "absent.csv"}, r"--laparoscope: no such file: .*absent\.csv"),
        ({"instrument": None}, "--joint jaw_angle: needs --instrument"),
        ({"frames": 1}, "--frames: 1 is too few"),
        ({"joint": [joint, joint]}, "--joint jaw_angle: given twice"),
        ({"joint": [exchanged]}, r"--joint jaw_angle: .*calibration\.csv has no times, .*jaw\.csv has; give the"),
    ]:
        with pytest.raises(NeecoError, match=message):
            flags(folder, **options)


def test_two_instruments_with_one_joint_name_have_two_clocks(world, folder):
    text = "video: video.mp4\ninstruments:\n"
    text += "".join(f"  - name: {name}\n    joints: {{jaw: logs/jaw.csv}}\n" for name in ("left", "right"))
    assert read_recording(world.text(text, "recording.yaml")).clocks == ("left.jaw", "right.jaw")


def test_a_fault_of_a_flag_is_told_by_its_flag(folder):
    (folder / "empty").mkdir()
    with pytest.raises(NeecoError, match=r"empty: holds 0 images"):
        sources_of(IngestRequest(video=folder / "empty", fps=25), Path("out"))[1][0].source.open()
    (folder / "frames").mkdir()
    Image.new("RGB", (8, 8)).save(folder / "frames" / "1.png")
    with pytest.raises(NeecoError, match=r"--fps: when were the images taken\?"):
        sources_of(IngestRequest(video=folder / "frames"), Path("out"))[1]
    with pytest.raises(NeecoError, match=r"^--intrinsics: fl_x, fl_y: must be two positive focal lengths in pixels"):
        flags(folder, intrinsics=(-290, 290, 160, 128)).read_lens()
    with pytest.raises(NeecoError) as told:
        flags(folder, intrinsics=None, calibration=folder / "logs/jaw.csv").read_lens()
    assert str(told.value).count("jaw.csv") == 1
