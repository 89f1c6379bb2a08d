"""A SurgPose trajectory becomes a recording by its folder alone."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from damaged_files import refusals

from neeco.base.errors import NeecoError
from neeco.ingest.readers import format_of
from neeco.ingest.readers.logs import read_pose_log, read_reading_log
from neeco.ingest.readers.sections import JointColumns, NamedJointColumns, PoseColumns
from neeco.ingest.recording.model import read_recording
from neeco.ingest.recording.template import write_template
from neeco.ingest.timing.reading import read_episodes
from tests.ingest.test_stereofile import LEFT, RIGHT, ini

COUNT = 30
TIMES = np.arange(COUNT) / 30


def write_trajectory(world):
    """The published layout: two arms, six joints each, two videos, a calibration, labels."""
    folder = world.folder / "000003"
    (folder / "regular").mkdir(parents=True)
    poses = world.poses(TIMES)
    arms = {"PSM1": 1.0, "PSM3": 0.5}
    cp = {
        str(i): {
            arm: {"R": pose[:3, :3].tolist(), "t": (pose[:3, 3] * scale / 1000).tolist()} for arm, scale in arms.items()
        }
        for i, pose in enumerate(poses)
    }
    jp = {str(i): {arm: [0.1, 0.2, 0.12, 0.3, float(world.jaw(t)), -0.2] for arm in arms} for i, t in enumerate(TIMES)}
    for name, document in (("api_cp_data", cp), ("api_jp_data", jp), ("keypoints_left", {"0": {"1": [3, 4]}})):
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(document), encoding="utf-8")
    for side in ("left", "right"):
        world.video(f"000003/regular/{side}_video.mp4", COUNT, lambda i: round(i * 1000 / 30))
    ini(folder)
    return folder


@pytest.fixture
def trajectory(world):
    return write_trajectory(world)


def test_poses_and_joints_come_back(world, trajectory):
    log = read_pose_log(PoseColumns(trajectory, stream="PSM1"))
    np.testing.assert_allclose(log.times, TIMES, atol=1e-9)
    np.testing.assert_allclose(log.positions, world.positions(TIMES), atol=1e-9)
    assert np.abs((log.quats * world.quats(TIMES)).sum(axis=1)).min() > 1 - 1e-12
    other = read_pose_log(PoseColumns(trajectory, stream="PSM3"))
    np.testing.assert_allclose(other.positions, world.positions(TIMES) / 2, atol=1e-9)
    joints = JointColumns(
        trajectory, "video", columns=NamedJointColumns(value=("wrist_pitch_rad",)), stream="PSM1_joints"
    )
    np.testing.assert_allclose(read_reading_log(joints).values, world.jaw(TIMES), atol=1e-12)


def test_the_lens_is_the_camera_s(trajectory):
    known = format_of(trajectory)
    left, right = (known.lens(trajectory, f"regular/{side}_video.mp4") for side in ("left", "right"))
    assert left.intrinsics == (LEFT[0, 0], LEFT[1, 1], LEFT[0, 2] + 0.5, LEFT[1, 2] + 0.5)
    assert right.fl_x == RIGHT[0, 0]


def test_the_right_video_is_the_second_camera_of_a_scope_that_stands_still(world, trajectory):
    for stands_still in (lambda video: True, lambda video: False):
        text = write_template(trajectory, stands_still=stands_still)
        recording = read_recording(world.text(text, "recording.yaml"))
        assert (recording.stereo is not None) is stands_still(None)
        if recording.stereo is not None:
            assert recording.stereo.source.stream == "regular/right_video.mp4"
            assert recording.read_stereo()[1].fl_x == RIGHT[0, 0]
    assert format_of(trajectory).stereo(trajectory, "regular/left_video.mp4", "green/left_video.mp4") is None


def test_a_template_of_the_folder_is_complete(world, trajectory):
    recording = read_recording(world.text(write_template(trajectory), "recording.yaml"))
    assert (recording.file, recording.stream) == (trajectory, "regular/left_video.mp4")
    assert [instrument.name for instrument in recording.instruments] == ["PSM1", "PSM3"]
    for instrument in recording.instruments:
        assert instrument.poses.clock == "video"
        assert set(instrument.joints) == {"wrist_pitch", "wrist_yaw"}
        assert len(read_pose_log(instrument.poses).times) == COUNT
        for joint in instrument.joints.values():
            assert len(read_reading_log(joint).times) == COUNT
    assert len(recording.source.open().times) == COUNT
    assert recording.read_lens()[0].size == (640, 480)


def test_a_video_of_another_length_is_refused(world, trajectory):
    world.video("000003/regular/left_video.mp4", 12, lambda i: round(i * 1000 / 30))
    recording = read_recording(world.text(write_template(trajectory), "recording.yaml"))
    with pytest.raises(
        NeecoError, match=r"left_video.mp4: has 12 images for 30 states at 30 Hz; the numbers do not match"
    ):
        read_episodes([recording])


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("api_cp_data.yaml", "", "expected states of arms by frame"),
        ("api_cp_data.yaml", "'0': 3", "expected states of arms by frame"),
        ("api_cp_data.yaml", "'0': {PSM1: {R: [[1, 0, 0]], t: [0, 0, 0]}}", "frame 0: 'PSM1': expected R"),
        ("api_cp_data.yaml", "first: {PSM1: 1}", "expected states of arms by frame"),
        ("api_cp_data.yaml", ".inf: {PSM1: 1}", "expected states of arms by frame"),
        ("api_cp_data.yaml", "1.5: {PSM1: 1}", "expected states of arms by frame"),
        ("api_jp_data.yaml", "'0': {PSM1: [1, 2]}", "expected six or seven joints"),
        ("api_jp_data.yaml", "'0': {PSM1: [1, 2, 3", "not valid YAML"),
    ],
)
def test_what_is_no_trajectory_is_refused_in_one_line(trajectory, name, text, message):
    (trajectory / name).write_text(text, encoding="utf-8")
    with pytest.raises(NeecoError, match=message) as caught:
        format_of(trajectory).streams(trajectory)
    assert str(caught.value).startswith(str(trajectory / name))
    assert len(str(caught.value).splitlines()) == 1


def test_no_bytes_make_reading_raise(trajectory):
    known = format_of(trajectory)
    reads = [
        lambda: known.streams(trajectory),
        lambda: known.lens(trajectory, "regular/left_video.mp4"),
        lambda: read_pose_log(PoseColumns(trajectory, stream="PSM1")),
    ]
    names = ("api_cp_data.yaml", "api_jp_data.yaml", "StereoCalibrationDVRK.ini")
    refusals([trajectory / name for name in names], reads, 30)
