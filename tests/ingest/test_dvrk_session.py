"""Sessions of the dVRK's data_collection become recordings: videos by their frames' times, topics from a bag or CSV."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from damaged_files import refusals

from neeco.base.errors import NeecoError
from neeco.ingest.readers import format_of
from neeco.ingest.readers.columns import BASE, CAMERA, JointColumns, PoseColumns
from neeco.ingest.readers.logs import read_pose_log, read_reading_log
from neeco.ingest.recording.file import read_recording
from neeco.ingest.recording.template import write_template

BEGIN = 1_768_663_926_000_000_000  # ns, Unix time of the first frame's arrival
LATENCY = 0.06  # s
COUNT = 30
SIDECAR = "endoscope_20260117_153206.json"
TICKS = np.arange(-5, 130) / 100  # of the robot, s from the first image on


def stamps(times):
    return [BEGIN - round(LATENCY * 1e9) + round(time * 1e9) for time in times]


def topic_csv(folder, topic, kind, header, rows):
    lines = [f"# Topic: {topic}", f"# Type: {kind}", ",".join(header), *(",".join(map(str, row)) for row in rows)]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{topic.strip('/').replace('/', '_')}.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_topics(world, folder, frame="PSM1_base"):
    """CSV files as `extract` writes them of /PSM1's topics: every field of a message, flattened, a column."""
    when = [(stamp + 2_000_000, frame, stamp % 10**9, stamp // 10**9) for stamp in stamps(TICKS)]
    head = ["timestamp", "header.frame_id", "header.stamp.nanosec", "header.stamp.sec"]
    places = world.positions(TICKS) / 1000
    quats = world.quats(TICKS)
    pose_head = [*head, *(f"pose.orientation.{a}" for a in "wxyz"), *(f"pose.position.{a}" for a in "xyz")]
    rows = [(*w, *map(repr, q.tolist()), *map(repr, p.tolist())) for w, q, p in zip(when, quats, places, strict=True)]
    topic_csv(folder, "/PSM1/measured_cp", "geometry_msgs/msg/PoseStamped", pose_head, rows)
    topic_csv(folder, "/PSM1/setpoint_cp", "geometry_msgs/msg/PoseStamped", pose_head, rows)
    names = ["yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw"]
    joint_head = [*head, *(f"name.{i}" for i in range(6)), *(f"position.{i}" for i in range(6))]
    rows = [(*w, *names, 0.1, 0.2, 0.12, 0, repr(float(j)), -0.5) for w, j in zip(when, world.jaw(TICKS), strict=True)]
    topic_csv(folder, "/PSM1/measured_js", "sensor_msgs/msg/JointState", joint_head, rows)
    rows = [(*w, "jaw", repr(float(j))) for w, j in zip(when, world.jaw(TICKS), strict=True)]
    topic_csv(folder, "/PSM1/jaw/measured_js", "sensor_msgs/msg/JointState", [*head, "name.0", "position.0"], rows)


def write_session(world, layout="LR"):
    folder = world.folder / "20260117_153206"
    folder.mkdir()
    world.video("20260117_153206/endoscope_20260117_153206.mp4", COUNT)
    frames = [{"cpu_ts": BEGIN + round(number * 40e6), "gst_ts": number} for number in range(COUNT)]
    sidecar = {"type": "dc::sidecar@1.0.0", "frames": frames, "estimated_latency": LATENCY, "side_by_side": layout}
    (folder / "endoscope_20260117_153206.json").write_text(json.dumps(sidecar), encoding="utf-8")
    index = {"type": "dc::index@1.0.0", "videos": [{"file": "endoscope_20260117_153206.mp4", "duration": 1.2}]}
    (folder / "index.json").write_text(json.dumps(index), encoding="utf-8")
    write_topics(world, folder / "extracted" / "full_session")
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
    joints = JointColumns(session, "video", value="wrist_pitch_rad", stream="/PSM1/measured_js")
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


def test_poses_in_the_endoscope_s_frame_say_so(world, session):
    write_topics(world, session / "extracted" / "full_session", frame="ECM")
    assert read_pose_log(PoseColumns(session, stream="/PSM1/measured_cp")).frame == CAMERA


def test_images_of_an_extract_are_read_by_the_times_in_their_names(world):
    folder = world.folder / "full_session"
    write_topics(world, folder)
    for number, stamp in enumerate(stamps(np.arange(12) * 0.04)):
        pixels = np.full((24, 32, 3), 10 * number, np.uint8)
        cv2.imwrite(str(folder / f"endoscope_left_{stamp * 1e-9:.9f}.png"), pixels)
    video = format_of(folder).open_images(folder)
    np.testing.assert_allclose(video.times, np.arange(12) * 0.04, atol=1e-6)
    assert [int(pixels[0, 0, 0]) for _, pixels in video.read([0, 7, 11])] == [0, 70, 110]
    log = read_pose_log(PoseColumns(folder, stream="/PSM1/measured_cp"))
    np.testing.assert_allclose(log.times, TICKS, atol=1e-6)


def test_topics_of_a_session_s_bag_are_on_its_clock(world, session):
    bag_world = pytest.importorskip("bag_world")
    shift = 3.5  # s, of the bag's first message before the video's first frame
    with bag_world.BagWriter(session, "recording-mcap") as bag:
        for tick in TICKS:
            place = world.positions(np.array([tick]))[0] / 1000
            bag.pose("/PSM1/measured_cp", tick + shift, place, [1, 0, 0, 0], "ECM")
    change(session / "index.json", rosbags=bag.path.name)
    begin = bag_world.START + round((shift + LATENCY) * 1e9)
    change(session / SIDECAR, frames=[{"cpu_ts": begin + round(k * 40e6), "gst_ts": 0} for k in range(COUNT)])
    log = read_pose_log(PoseColumns(session, stream="/PSM1/measured_cp"))
    np.testing.assert_allclose(log.times, TICKS, atol=1e-6)
    np.testing.assert_allclose(log.positions, world.positions(TICKS) * [-1, -1, 1], atol=1e-9)  # ECM: x left, y up
    assert log.frame == CAMERA


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": [{"cpu_ts": BEGIN + i} for i in range(12)]}, "has 30 images for 12 times"),
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


def test_a_missing_video_and_a_damaged_table_are_named_and_hide_no_other(session):
    name = "endoscope_20260117_153206"
    (session / f"{name}.mp4").unlink()
    (session / "extracted" / "full_session" / "PSM1_jaw_measured_js.csv").write_bytes(
        b"# Topic: /PSM1/jaw/measured_js\n"
    )
    streams = {stream.name: stream for stream in format_of(session).streams(session)}
    assert f"videos: '{name}.mp4' is not there" in streams[name].problem
    assert "holds only comments" in streams["/PSM1/jaw/measured_js"].problem
    assert streams["/PSM1/measured_cp"].problem is None
    for stream in (None, f"{name}.left"):
        with pytest.raises(NeecoError, match=r"index.json: videos: 'endoscope_20260117_153206.mp4' is not there"):
            format_of(session).open_images(session, stream)
    assert len(read_pose_log(PoseColumns(session, stream="/PSM1/measured_cp")).times) > 10
    with pytest.raises(NeecoError, match=r"holds no images that can be read: .*mp4' is not there"):
        write_template(session)


def test_an_extract_of_films_without_times_asks_for_the_session(world, session):
    extract = session / "extracted" / "full_session"
    (extract / "endoscope.mp4").write_bytes(b"film")
    with pytest.raises(NeecoError, match="give the session's own folder"):
        format_of(extract).streams(extract)


def test_no_bytes_make_reading_raise(session):
    files = [session / "index.json", session / "endoscope_20260117_153206.json"]
    files += sorted((session / "extracted" / "full_session").iterdir())

    def read():
        known = format_of(session)
        if known is not None:
            known.streams(session)
            read_pose_log(PoseColumns(session, stream="/PSM1/measured_cp"))

    refusals(files, [read], 60)


def test_a_bag_without_its_reader_s_package_says_what_to_install(session, monkeypatch):
    (session / "rosbag").mkdir()
    change(session / "index.json", rosbags="rosbag")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(NeecoError, match=r"rosbag: ROS bag: needs rosbags; pip install '\.\[ros\]'"):
        format_of(session).streams(session)


def test_frames_earlier_than_any_before_them_are_left_out(world):
    session = write_session(world)
    numbers = [number if number < 20 else number - 12 for number in range(COUNT)]
    change(session / SIDECAR, frames=[{"cpu_ts": BEGIN + round(number * 40e6)} for number in numbers])
    video = format_of(session).open_images(session, "endoscope_20260117_153206.left")
    assert (np.diff(video.times) > 0).all()
    assert any("10 frames are no later than" in note for note in video.notes)
