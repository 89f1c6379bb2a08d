"""A frame's name is not its axes: each reader's poses land where the tool is seen, or the axes are asked for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.ingest.readers.logs import PoseLog, read_pose_log
from neeco.ingest.readers.names import BASE, CAMERA, meaning_in, meaning_of, without_frame
from neeco.ingest.readers.sections import PoseColumns
from neeco.ingest.recording.model import read_recording
from neeco.ingest.recording.template import write_template

COUNT = 12
TIMES = np.arange(COUNT) / 25
SEEN = [-20.0, -10.0, 100.0]  # mm, OpenCV's axes: left, up, in front
ECM, BODY, OPENGL = [20.0, 10.0, 100.0], [100.0, 20.0, 10.0], [-20.0, 10.0, -100.0]  # the same point in other axes
OPENCV_FROM_ECM = Rotation.from_matrix(np.diag([-1.0, -1.0, 1.0]))
TURN = Rotation.from_rotvec([0.3, -0.2, 0.5])  # of the tool, in OpenCV's axes
ROS_HEADER = "%time,field.header.frame_id," + ",".join(
    [*(f"field.pose.position.{axis}" for axis in "xyz"), *(f"field.pose.orientation.{axis}" for axis in "xyzw")]
)


def as_ecm() -> tuple[list[float], list[float]]:
    """Place m and turn xyzw of the tool as a dVRK writes them."""
    return (np.array(ECM) / 1000).tolist(), (OPENCV_FROM_ECM.inv() * TURN).as_quat().tolist()


def table(path: Path, names: str, place: list[float], frame: str | None = None) -> Path:
    """A CSV file of COUNT poses of the tool, turned by nothing; names: x y z of its columns' names."""
    columns = [*(f"{names}{axis}_mm" for axis in "xyz"), *(f"{names}q{axis}" for axis in "wxyz")]
    rows = [[time, *place, 1, 0, 0, 0] + ([frame] if frame else []) for time in TIMES]
    header = ["t_s", *columns] + (["frame_id"] if frame else [])
    path.write_text("\n".join(",".join(map(str, row)) for row in [header, *rows]) + "\n")
    return path


def assert_seen(log: PoseLog, turn: Rotation | None = None) -> None:
    """The tool's place, and its turn where that is known."""
    assert log.frame == CAMERA
    np.testing.assert_allclose(log.positions, [SEEN] * len(log.times), atol=1e-9)
    if turn is not None:
        off = (Rotation.from_quat(log.quats, scalar_first=True).inv() * turn).magnitude()
        assert off.max() < 1e-7


@pytest.mark.parametrize(
    ("name", "images", "dvrk", "frame"),
    [
        ("ECM", (), True, "ecm"),
        ("/dvrk/ecm", ("left",), False, "ecm"),
        ("Cart", ("left",), True, BASE),
        ("ECM_base", (), True, BASE),
        ("PSM1_base", (), True, BASE),
        ("tracker", ("left",), False, BASE),
        ("", (), True, BASE),
        ("left", ("left",), False, CAMERA),
        ("camera_color_optical_frame", ("camera_color_optical_frame",), True, CAMERA),
        ("stereo_left_optical_frame", (), False, CAMERA),
        # nothing certain: asked for
        ("left", ("left",), True, None),
        ("ECM", ("ECM",), True, None),
        ("ecm_end_link", (), True, None),
        ("jhu_ecm_tool", ("left",), False, None),
        ("camera_link", ("camera_optical_frame",), False, None),
        ("camera_link", ("camera_link",), False, None),
        ("right_optical_frame", ("left_optical_frame",), False, None),
        ("endoscope", (), False, None),
    ],
)
def test_what_a_frames_name_says(name, images, dvrk, frame):
    found = meaning_of(name, images, dvrk=dvrk)
    assert found.frame == frame
    assert bool(found.question) == bool(found.asks) == (frame is None)


@pytest.mark.parametrize(
    ("names", "dvrk", "frame"),
    [
        (["psm1_in_ecm.x", "psm1_in_ecm.y"], True, "ecm"),
        (["tip_wrt_left_camera"], False, CAMERA),
        (["tip_in_camera"], True, None),
        (["tip_in_robot_base"], False, BASE),
    ],
)
def test_what_the_name_of_a_column_says_of_the_frame(names, dvrk, frame):
    assert meaning_in(names, dvrk=dvrk).frame == frame


def test_names_without_a_frame_say_nothing():
    assert meaning_in(["camera_pose.x", "tip_in_ecm.x"]) is None
    assert without_frame("psm1_in_ecm") == "psm1"
    assert without_frame("psm1_in_ecm_pose") == "psm1_pose"
    assert without_frame("camera_frame") == "camera_frame"


@pytest.mark.parametrize(
    ("frame", "place"), [("camera", SEEN), ("ECM", ECM), ("ros_body", BODY), ("opengl", OPENGL), ("ros_optical", SEEN)]
)
def test_the_frame_that_a_recording_states(tmp_path, frame, place):
    table(tmp_path / "tip.csv", "", place)
    (tmp_path / "video.mp4").touch()
    path = tmp_path / "recording.yaml"
    path.write_text(f"video: video.mp4\ninstruments: [{{name: tip, poses: {{file: tip.csv, frame: {frame}}}}}]\n")
    assert_seen(read_pose_log(read_recording(path).instruments[0].poses))
    path.write_text(path.read_text().replace(frame, "sideways"))
    with pytest.raises(NeecoError, match=r"poses\.frame: 'sideways' is not known here; write one of camera, .*ecm"):
        read_recording(path)


def test_an_exported_topic_says_its_frame_in_a_column(world):
    place, turn = as_ecm()
    rows = [[round(time * 1e9), "ECM", *place, *turn] for time in TIMES]
    assert_seen(read_pose_log(PoseColumns(world.write(ROS_HEADER, rows))), TURN)


def test_tables_say_their_frame_in_the_names_of_columns_or_of_the_file(tmp_path):
    assert_seen(read_pose_log(PoseColumns(table(tmp_path / "a.csv", "psm1_in_ecm_", ECM))))
    assert_seen(read_pose_log(PoseColumns(table(tmp_path / "psm1_in_ecm.csv", "", ECM))))
    assert_seen(read_pose_log(PoseColumns(table(tmp_path / "b.csv", "", ECM, frame="ECM"))))
    with pytest.raises(NeecoError, match=r"b\.csv: frame: camera_link may be .*frame: ros_body \(.*x forward, y left"):
        read_pose_log(PoseColumns(table(tmp_path / "b.csv", "", BODY, frame="camera_link")))
    assert_seen(read_pose_log(PoseColumns(tmp_path / "b.csv", frame="ros_body")))


def test_columns_that_count_frames_or_name_images_are_no_frame_of_poses(tmp_path):
    for frame in ("3", "PSM1_base"):
        assert read_pose_log(PoseColumns(table(tmp_path / "a.csv", "", SEEN, frame))).frame == BASE
    path = table(tmp_path / "a.csv", "", SEEN, "image")
    path.write_text(path.read_text().replace("image", "image_1", 1))
    assert read_pose_log(PoseColumns(path)).frame == BASE


def test_poses_of_several_frames_in_one_table_are_refused_and_left_out_of_a_template(tmp_path):
    path = table(tmp_path / "a.csv", "", SEEN, "PSM1_base")
    path.write_text(path.read_text().replace("PSM1_base", "ECM", 1))
    with pytest.raises(NeecoError, match=r"frame_id: poses are in several frames \(ECM, PSM1_base\)"):
        read_pose_log(PoseColumns(path))
    (tmp_path / "video.mp4").touch()
    assert "#   a.csv: frame_id: poses are in several frames" in write_template(tmp_path)


def test_camera_means_opencvs_axes_and_is_refused_where_the_file_names_others(tmp_path):
    path = table(tmp_path / "psm1_in_ecm.csv", "", ECM)
    with pytest.raises(
        NeecoError, match=r"frame: camera means OpenCV's axes .* set frame: ecm\), or set frame: opencv"
    ):
        read_pose_log(PoseColumns(path, frame="camera"))
    np.testing.assert_allclose(read_pose_log(PoseColumns(path, frame="opencv")).positions[0], ECM)
    assert read_pose_log(PoseColumns(path, frame=BASE)).frame == BASE


def test_a_template_says_what_it_assumes_and_asks_the_rest(tmp_path):
    (tmp_path / "video.mp4").touch()
    table(tmp_path / "psm1_in_ecm.csv", "", ECM)
    table(tmp_path / "needle.csv", "", SEEN, frame="camera_link")
    text = write_template(tmp_path)
    path = tmp_path / "recording.yaml"
    path.write_text(text)
    assert [item.name for item in read_recording(path).instruments] == ["needle", "psm1"]
    assert "# poses are expressed in ECM, the frame of the camera in the dVRK's axes (x left, y up, z forward)" in text
    assert "# frame: ros_body   # or camera, base: camera_link may be the camera's frame" in text


def test_a_data_sets_columns_say_their_frame(tmp_path):
    lerobot_world = pytest.importorskip("lerobot_world")
    place, turn = as_ecm()
    parts = [*(f"position.{axis}" for axis in "xyz"), *(f"orientation.{axis}" for axis in "xyzw")]
    names = [*(f"psm1_in_ecm.{part}" for part in parts), "psm1_jaw"]
    states = [{"observation.state": np.tile([*place, *turn, 0.5], (COUNT, 1))}]
    path = lerobot_world.write_data_set(tmp_path / "set", "v2.1", states, names={"observation.state": names})
    text = write_template(path).replace("# units: {length: mm}", "units: {length: m}")
    (tmp_path / "recording.yaml").write_text(text)
    (instrument,) = read_recording(tmp_path / "recording.yaml").instruments
    assert instrument.name == "psm1"
    assert list(instrument.joints) == ["jaw"]
    assert "# frame:" not in text.partition("instruments:")[2]
    log = read_pose_log(instrument.poses)
    np.testing.assert_allclose(log.positions, [SEEN] * COUNT, atol=1e-5)  # the set holds float32


def test_a_plus_transform_to_the_ecm_is_turned_and_one_to_a_tracker_is_not(tmp_path):
    plus_world = pytest.importorskip("pluswriter")
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    poses[:, :3, 3] = ECM
    poses[1, :3, :3] = Rotation.from_rotvec([0, 0, 0.1]).as_matrix()  # it moves
    names = {name: poses for name in ("PSM1ToECM", "StylusToTracker", "StylusToCamera")}
    path = plus_world.write_sequence(tmp_path / "a.mha", plus_world.frame_fields(TIMES, names), (COUNT, 0, 0, 1), ())
    assert_seen(read_pose_log(PoseColumns(path, stream="PSM1ToECM")))
    log = read_pose_log(PoseColumns(path, stream="StylusToTracker"))
    assert log.frame == BASE
    np.testing.assert_allclose(log.positions[0], ECM)
    with pytest.raises(NeecoError, match="StylusToCamera: frame: Camera may be the camera's frame"):
        read_pose_log(PoseColumns(path, stream="StylusToCamera"))


def test_transforms_of_a_bag_are_turned_once_at_their_end(tmp_path):
    """PSM1 stated in ECM, ECM in Cart; a tool on PSM1 stated in ECM, and ECM's own place in PSM1."""
    bag_world = pytest.importorskip("bag_world")
    place, (x, y, z, w) = as_ecm()
    with bag_world.BagWriter(tmp_path, "recording.bag") as bag:
        for time in TIMES:
            bag.tf(time, place, [w, x, y, z], "ECM", "PSM1")
            bag.tf(time, [0.1, 0.2, 0.3], [1, 0, 0, 0], "Cart", "ECM")
        bag.tf(0.0, [0, 0, 0], [1, 0, 0, 0], "PSM1", "tool", static=True)
    for stream in ("tf:PSM1", "tf:PSM1 in ECM", "tf:tool in ECM"):
        assert_seen(read_pose_log(PoseColumns(bag.path, stream=stream)), TURN)
    away = read_pose_log(PoseColumns(bag.path, stream="tf:PSM1 in Cart"))
    assert away.frame == BASE
    np.testing.assert_allclose(away.positions[0], np.add(ECM, [100, 200, 300]), atol=1e-6)


def test_the_frame_of_another_camera_is_not_that_of_the_video(tmp_path):
    bag_world = pytest.importorskip("bag_world")
    with bag_world.BagWriter(tmp_path, "recording.bag") as bag:
        for time in TIMES:
            for side in ("left", "right"):
                bag.pose(f"/needle/{side}", time, np.array(SEEN) / 1000, [1, 0, 0, 0], f"{side}_eye")
                bag.image(f"/{side}/image_raw", time, np.zeros((8, 8, 3), np.uint8), "rgb8", f"{side}_eye")
    assert_seen(read_pose_log(PoseColumns(bag.path, stream="/needle/left")))
    assert read_pose_log(PoseColumns(bag.path, stream="/needle/right")).frame == BASE
