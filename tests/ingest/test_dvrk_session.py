"""Sessions of the dVRK's data_collection become recordings: videos by their frames' times, topics from their bag."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from bag_world import START, BagWriter
from damaged_files import refusals

from neeco.base.errors import NeecoError
from neeco.ingest.readers import format_of
from neeco.ingest.readers.logs import read_pose_log, read_reading_log
from neeco.ingest.readers.names import BASE, CAMERA
from neeco.ingest.readers.sections import JointColumns, NamedJointColumns, PoseColumns
from neeco.ingest.recording.model import read_recording
from neeco.ingest.recording.template import write_template

LATENCY = 0.06  # s
COUNT = 30
SIDECAR = "endoscope_20260117_153206.json"
TICKS = np.arange(-5, 130) / 100  # of the robot, s from the first image on


def write_session(world, layout="LR", frame="PSM1_base", shift=3.5):
    """shift: s of the bag's first message before the video's first frame."""
    folder = world.folder / "20260117_153206"
    folder.mkdir()
    world.video("20260117_153206/endoscope_20260117_153206.mp4", COUNT)
    with BagWriter(folder, "recording-mcap") as bag:
        places, quats, jaw = world.positions(TICKS) / 1000, world.quats(TICKS), world.jaw(TICKS)
        for tick, place, quat, angle in zip(TICKS, places, quats, jaw, strict=True):
            for topic in ("/PSM1/measured_cp", "/PSM1/setpoint_cp"):
                bag.pose(topic, tick + shift, place, quat, frame)
            bag.joints("/PSM1/measured_js", tick + shift, outer_wrist_pitch=angle, outer_wrist_yaw=-0.5)
            bag.joints("/PSM1/jaw/measured_js", tick + shift, jaw=angle)
    begin = START + round((shift + LATENCY) * 1e9)
    frames = [{"cpu_ts": begin + round(number * 40e6), "gst_ts": number} for number in range(COUNT)]
    sidecar = {"type": "dc::sidecar@1.0.0", "frames": frames, "estimated_latency": LATENCY, "side_by_side": layout}
    (folder / SIDECAR).write_text(json.dumps(sidecar), encoding="utf-8")
    videos = [{"file": "endoscope_20260117_153206.mp4", "duration": 1.2}]
    index = {"type": "dc::index@1.0.0", "videos": videos, "rosbags": bag.path.name}
    (folder / "index.json").write_text(json.dumps(index), encoding="utf-8")
    return folder


def change(file, **changes):
    file.write_text(json.dumps(json.loads(file.read_text(encoding="utf-8")) | changes), encoding="utf-8")


@pytest.fixture
def session(world):
    return write_session(world)


def test_topics_count_from_the_first_image(world, session):
    log = read_pose_log(PoseColumns(session, stream="/PSM1/measured_cp"))
    np.testing.assert_allclose(log.times, TICKS, atol=1e-6)
    np.testing.assert_allclose(log.positions, world.positions(TICKS), atol=1e-9)
    assert np.abs((log.quats * world.quats(TICKS)).sum(axis=1)).min() > 1 - 1e-12
    assert log.frame == BASE
    joints = JointColumns(
        session, "video", columns=NamedJointColumns(value=("outer_wrist_pitch_rad",)), stream="/PSM1/measured_js"
    )
    np.testing.assert_allclose(read_reading_log(joints).values, world.jaw(TICKS), atol=1e-12)


def test_each_half_of_a_stereo_video_is_a_camera(world, session):
    known = format_of(session)
    whole = cv2.VideoCapture(str(session / "endoscope_20260117_153206.mp4"))
    for _ in range(4):
        _, frame = whole.read()
    for side, columns in (("left", slice(0, 32)), ("right", slice(32, 64))):
        video = known.open_images(session, f"endoscope_20260117_153206.{side}")
        assert video.size == (32, 48)
        np.testing.assert_allclose(video.times, np.arange(COUNT) * 0.04, atol=1e-6)
        ((index, pixels),) = video.read([3])
        assert index == 3
        difference = pixels.astype(int) - frame[:, columns, ::-1]
        assert np.abs(difference).mean() < 3  # two converters of one decoded frame


def test_the_right_camera_may_stand_first(world):
    session = write_session(world, "RL")
    sides = [f"endoscope_20260117_153206.{side}" for side in ("right", "left")]
    halves = [next(iter(format_of(session).open_images(session, side).read([3])))[1] for side in sides]
    change(session / SIDECAR, side_by_side="undefined")
    (_, whole) = next(iter(format_of(session).open_images(session, None).read([3])))
    np.testing.assert_array_equal(np.concatenate(halves, axis=1), whole)


def test_a_template_of_a_session_is_complete(world, session):
    text = write_template(session)
    recording = read_recording(world.text(text, "recording.yaml"))
    assert (recording.file, recording.stream) == (session, "endoscope_20260117_153206.left")
    (instrument,) = recording.instruments
    assert instrument.name == "PSM1"
    assert instrument.poses.stream == "/PSM1/measured_cp"
    assert set(instrument.joints) == {"wrist_pitch", "wrist_yaw", "jaw"}
    for joint in instrument.joints.values():
        assert joint.clock == "video"
        assert len(read_reading_log(joint).times) == len(TICKS)
    assert "setpoint_cp" in text
    assert len(recording.source.open().times) == COUNT


def test_poses_in_the_endoscope_s_frame_are_turned(world):
    log = read_pose_log(PoseColumns(write_session(world, frame="ECM"), stream="/PSM1/measured_cp"))
    np.testing.assert_allclose(log.positions, world.positions(TICKS) * [-1, -1, 1], atol=1e-9)  # ECM: x left, y up
    assert log.frame == CAMERA


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": [{"cpu_ts": START + i} for i in range(12)]}, "has 30 images for 12 times"),
        ({"frames": 7}, "frames: expected a cpu_ts"),
        ({"frames": [{"cpu_ts": "x"}] * 30}, "frames: expected a cpu_ts"),
        ({"estimated_latency": "long"}, "estimated_latency: must be under 60 s"),
    ],
)
def test_times_that_do_not_fit_the_video_are_refused(session, changes, message):
    change(session / SIDECAR, **changes)
    with pytest.raises(NeecoError, match=message) as caught:
        format_of(session).open_images(session, "endoscope_20260117_153206.left")
    assert len(str(caught.value).splitlines()) == 1
    assert str(session) in str(caught.value)


def test_a_missing_video_hides_no_topic_and_a_missing_bag_no_video(session):
    name = "endoscope_20260117_153206"
    (session / f"{name}.mp4").rename(session / "kept")
    streams = {stream.name: stream for stream in format_of(session).streams(session)}
    assert f"videos: '{name}.mp4' is missing" in streams[name].problem
    assert streams["/PSM1/measured_cp"].problem is None
    for stream in (None, f"{name}.left"):
        with pytest.raises(NeecoError, match=r"index.json: videos: 'endoscope_20260117_153206.mp4' is missing"):
            format_of(session).open_images(session, stream)
    with pytest.raises(NeecoError, match=r"holds no images that can be read: .*mp4' is missing"):
        write_template(session)
    (session / "kept").rename(session / f"{name}.mp4")
    change(session / "index.json", rosbags="gone")
    problems = []
    assert f"stream: {name}.left" in write_template(session, problems.append)
    assert "rosbags: the session's bag does not exist; put it" in problems[0]
    with pytest.raises(NeecoError, match=r"index.json: rosbags: the session's bag does not exist"):
        format_of(session).read(session, "/PSM1/measured_cp")


def test_no_bytes_make_reading_raise(session):
    files = [session / "index.json", session / SIDECAR]

    def read():
        known = format_of(session)
        if known is not None:
            known.streams(session)
            read_pose_log(PoseColumns(session, stream="/PSM1/measured_cp"))

    refusals(files, [read], 30)


def test_frames_earlier_than_any_before_them_are_left_out(world):
    session = write_session(world)
    numbers = [number if number < 20 else number - 12 for number in range(COUNT)]
    change(session / SIDECAR, frames=[{"cpu_ts": START + round(number * 40e6)} for number in numbers])
    video = format_of(session).open_images(session, "endoscope_20260117_153206.left")
    assert (np.diff(video.times) > 0).all()
    assert any("10 frames left out: their times do not increase" in note for note in video.notes)
