"""Bags of ROS 1 and ROS 2 and MCAP say what was written into them, or why they cannot, in one line."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from bag_world import KINDS, BagWriter, known, refusal
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.ingest.readers import Kind, VideoSource, _bagfile, read_table
from neeco.ingest.readers.interpolate import poses_at
from neeco.ingest.readers.logs import PoseLog, read_pose_log, read_reading_log
from neeco.ingest.readers.names import BASE, CAMERA
from neeco.ingest.readers.sections import JointColumns, NamedJointColumns, PoseColumns

ARM, JAW, LEFT = "/PSM1/measured_cp", "/PSM1/jaw/measured_js", "/stereo/left/image_raw"
STEP = 0.025  # s
TICKS = np.arange(40) * STEP
SIZE = (24, 16)  # px
FOCAL = (30.0, 31.0, 12.5, 8.0)
NS = 1e-9


def place(time: float) -> np.ndarray:
    """[3] m"""
    return np.array([0.1 + 0.02 * np.sin(3 * time), -0.03, 0.12 + 0.01 * time])


def turn(time: float) -> np.ndarray:
    """wxyz"""
    return Rotation.from_rotvec([0.2, 0.4 * time, -0.3]).as_quat(scalar_first=True)


def picture(number: int) -> np.ndarray:
    """uint8 [H, W, 3] RGB, smooth, as JPEG keeps it."""
    rows, columns = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
    return np.stack([5 * rows + 2 * number, 7 * columns, 120 + rows - columns], 2).astype(np.uint8)


def write_arm(bag: BagWriter, frame: str = "PSM1_base") -> None:
    for time in TICKS:
        bag.pose(ARM, time, place(time), turn(time), frame)
        bag.joints("/PSM1/measured_js", time, outer_insertion=0.1, outer_wrist_pitch=time, outer_wrist_yaw=-time)
        bag.joints(JAW, time, jaw=0.5 * time)


def write_images(bag: BagWriter, topic: str = LEFT, count: int = 40) -> None:
    for number in range(count):
        bag.image(topic, TICKS[number], picture(number), "rgb8")


def whole(folder: Path, kind: str = "recording.bag", frame: str = "PSM1_base") -> Path:
    """A bag of an arm and a camera with its lens."""
    with BagWriter(folder, kind) as bag:
        write_arm(bag, frame)
        write_images(bag)
        bag.camera_info("/stereo/left/camera_info", 0.0, SIZE, FOCAL, [0.1, -0.2, 0.003, 0.004, 0.05])
    return bag.path


def poses(path: Path, stream: str = ARM) -> PoseLog:
    return read_pose_log(PoseColumns(path, stream=stream))


def images(path: Path, stream: str | None = None) -> VideoSource:
    return known(path).open_images(path, stream)


@pytest.fixture(params=KINDS)
def kind(request: pytest.FixtureRequest) -> str:
    return request.param


# --- poses, joints, transforms


@pytest.mark.parametrize(
    ("kind", "packed"),
    [*((kind, None) for kind in KINDS), *zip(("recording.bag", *KINDS), ("bz2", "lz4", "zstd", "zstd"), strict=True)],
)
def test_a_bag_gives_back_what_was_recorded(tmp_path: Path, kind: str, packed: str | None) -> None:
    with BagWriter(tmp_path, kind, packed=packed) as bag:
        write_arm(bag)
        write_images(bag)
    for path in {bag.path, bag.file} if "db3" not in kind or not packed else {bag.path}:
        log = poses(path)
        np.testing.assert_allclose(log.times, TICKS, atol=2 * NS)
        np.testing.assert_allclose(log.positions, 1000 * np.stack([place(time) for time in TICKS]), rtol=1e-12)
        np.testing.assert_allclose(log.quats, np.stack([turn(time) for time in TICKS]), atol=1e-12)
        assert log.notes == ()
        assert log.frame == BASE
        jaw = read_reading_log(JointColumns(path, "video", stream=JAW))
        np.testing.assert_allclose(jaw.values, 0.5 * TICKS, atol=1e-15)
        wrist = JointColumns(
            path, "video", columns=NamedJointColumns(value=("outer_wrist_yaw_rad",)), stream="/PSM1/measured_js"
        )
        np.testing.assert_allclose(read_reading_log(wrist).values, -TICKS, atol=1e-15)
        film = images(path)
        assert film.size == SIZE
        np.testing.assert_allclose(film.times, TICKS, atol=2 * NS)
        for number, pixels in film.read(range(40)):
            np.testing.assert_array_equal(pixels, picture(number))


def test_streams_say_what_there_is(tmp_path: Path, kind: str) -> None:
    with BagWriter(tmp_path, kind) as bag:
        write_arm(bag, "ECM")
        write_images(bag, count=20)
        bag.tf(0.0, [0, 0, 0], [1, 0, 0, 0], "world", "camera", static=True)
        bag.other("/chatter", 0.0)
    found = {stream.name: stream for stream in known(bag.path).streams(bag.path)}
    told = {name: (stream.kind, stream.count) for name, stream in found.items()}
    assert told == {
        LEFT: (Kind.IMAGES, 20), ARM: (Kind.POSES, 40), JAW: (Kind.READINGS, 40),
        "/PSM1/measured_js": (Kind.READINGS, 40), "tf:camera": (Kind.OTHER, 1), "/chatter": (Kind.OTHER, 1),
    }  # fmt: skip
    assert found[ARM].type == "geometry_msgs/PoseStamped in ECM"
    assert found[LEFT].type == "sensor_msgs/Image (rgb8, 24x16)"
    assert found["/chatter"].type == "std_msgs/String"
    assert found[ARM].rate_hz == pytest.approx(1 / STEP)


def test_a_dvrks_poses_in_the_images_own_frame_have_either_axes_and_are_asked_for(tmp_path: Path) -> None:
    path = whole(tmp_path, frame="camera")  # as its images
    message = refusal(lambda: poses(path))
    assert "camera is the frame of the images" in message
    assert "frame: ecm (the camera's, x left, y up, z forward), frame: camera (the camera's, x right" in message
    seen = {frame: read_pose_log(PoseColumns(path, stream=ARM, frame=frame)) for frame in ("ecm", "camera")}
    np.testing.assert_allclose(seen["ecm"].positions, seen["camera"].positions * [-1, -1, 1], atol=1e-12)
    assert {log.frame for log in seen.values()} == {CAMERA}


def test_times_are_the_headers_and_not_those_of_receipt(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    with BagWriter(tmp_path, "recording.bag") as bag:
        write_images(bag)
        for time in TICKS:
            bag.late = float(generator.uniform(0, 0.2))
            bag.pose(ARM, time, place(time), turn(time))
    np.testing.assert_allclose(np.sort(poses(bag.path).times), TICKS, atol=2 * NS)


def test_missing_stamps_and_those_of_another_clock_are_said(tmp_path: Path) -> None:
    with BagWriter(tmp_path, "recording.bag", late=0.0) as bag:
        write_images(bag)
        for time in TICKS:
            bag.late = 0.0
            bag.pose(ARM, time, place(time), turn(time), stamp=None if time > 0.5 else -1)
            bag.pose("/none", time, place(time), turn(time), stamp=-1)
            bag.late = 37.2
            bag.pose("/late", time, place(time), turn(time))
    log = poses(bag.path)
    np.testing.assert_allclose(log.times, TICKS, atol=2 * NS)
    assert log.notes == (f"recording.bag: {ARM}: 21 headers have no time; receipt times are used instead",)
    assert "its headers have no times" in poses(bag.path, "/none").notes[0]
    assert "37.20 s before the receipt times" in poses(bag.path, "/late").notes[0]


def test_transforms_are_poses(tmp_path: Path, kind: str) -> None:
    with BagWriter(tmp_path, kind) as bag:
        for time in TICKS:
            bag.transform("/arm/measured_cp", time, place(time), turn(time), "base", "tip")
            bag.tf(time, place(time), turn(time), "base", "tip")
    for stream in ("/arm/measured_cp", "tf:tip"):
        log = poses(bag.path, stream)
        np.testing.assert_allclose(log.positions, 1000 * np.stack([place(time) for time in TICKS]), rtol=1e-12)
        np.testing.assert_allclose(log.quats, np.stack([turn(time) for time in TICKS]), atol=1e-12)


def test_transforms_are_chained_to_a_named_frame(tmp_path: Path) -> None:
    """base_from_tip and world_from_base move, each at its own times; world_from_camera and base_from_post stay."""
    camera = Rotation.from_euler("xyz", [0.3, -0.2, 1.0])
    with BagWriter(tmp_path, "recording-mcap") as bag:
        bag.tf(0.0, [0.5, 0.1, -0.2], camera.as_quat(scalar_first=True), "/world", "/camera", static=True)
        bag.tf(0.0, [0.0, 0.0, 1.0], [1, 0, 0, 0], "base", "post", static=True)
        for time in TICKS:
            bag.tf(time, place(time), turn(time), "base", "tip")
        for time in np.arange(0.0, 1.2, 0.01):  # about one axis at one speed, as interpolation has it
            angles = Rotation.from_rotvec([0, 0, 0.7 * time]).as_quat(scalar_first=True)
            bag.tf(time, [time, 2 * time, 0.0], angles, "world", "base")
    assert "frame: camera may be the camera's frame" in refusal(lambda: poses(bag.path, "tf:tip in camera"))
    log = read_pose_log(PoseColumns(bag.path, stream="tf:tip in camera", frame=CAMERA))
    np.testing.assert_allclose(log.times, TICKS, atol=2 * NS)
    for row, time in enumerate(TICKS):
        spun, tip = Rotation.from_rotvec([0, 0, 0.7 * time]), Rotation.from_quat(turn(time), scalar_first=True)
        at = camera.inv().apply(np.array([time, 2 * time, 0.0]) + spun.apply(place(time)) - [0.5, 0.1, -0.2])
        np.testing.assert_allclose(log.positions[row], 1000 * at, atol=1e-5)
        assert (
            Rotation.from_quat(log.quats[row], scalar_first=True).inv() * camera.inv() * spun * tip
        ).magnitude() < 1e-7
    back, _ = poses_at(poses(bag.path, "tf:camera in tip"), TICKS, 0.0)
    there, _ = poses_at(log, TICKS, 0.0)
    np.testing.assert_allclose(back @ there, np.tile(np.eye(4), (40, 1, 1)), atol=1e-5)
    assert "all transforms between are static" in refusal(lambda: poses(bag.path, "tf:post in base"))
    assert "there is no transform of 'tipp'; choose one of: base, camera, post, tip" in refusal(
        lambda: poses(bag.path, "tf:tipp")
    )


def test_transforms_that_do_not_hang_together_are_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path, "recording.bag") as bag:
        for time in TICKS:
            for frame, child in (("a", "b"), ("b", "a"), ("one", "two"), ("left", "tip"), ("right", "tip")):
                bag.tf(time, place(time), turn(time), frame, child)
    assert "b is its own parent" in refusal(lambda: poses(bag.path, "tf:b in two"))
    assert "no transforms connect two to left" in refusal(lambda: poses(bag.path, "tf:two in left"))
    assert "has several parents (left, right)" in refusal(lambda: poses(bag.path, "tf:tip in one"))
    assert "several frames (left, right)" in refusal(lambda: poses(bag.path, "tf:tip"))


def test_joints_go_by_their_names(tmp_path: Path) -> None:
    """Two publishers on one topic, each with joints of its own, one of them in changing order."""
    with BagWriter(tmp_path, "recording-db3") as bag:
        for number, time in enumerate(TICKS):
            bag.joints("/joint_states", time, **({"a": time, "b": 1.0} if number % 2 else {"b": 1.0, "a": time}))
            bag.joints("/joint_states", time + 0.001, insertion=0.2)
    table = read_table(bag.path, "/joint_states")
    assert set(table.header) == {"t_s", "a_rad", "b_rad", "insertion_m"}
    log = read_reading_log(
        JointColumns(bag.path, "video", columns=NamedJointColumns(value=("a_rad",)), stream="/joint_states")
    )
    np.testing.assert_allclose(log.values, log.times, atol=2 * NS)
    assert len(log.times) == 40
    column = table.header.index("insertion_m")
    assert isinstance(table.rows, np.ndarray)
    assert np.isnan(table.rows[0, column])
    assert table.rows[1, column] == 0.2


def test_the_limit_of_joints_leaves_poses_whole_and_a_joint_named_twice_counts_once(tmp_path):
    with BagWriter(tmp_path, "recording.bag") as bag:
        write_arm(bag)
        for time in TICKS:
            bag.joints("/many", float(time), **{f"j{number}": time for number in range(401)})
    assert np.shape(read_table(bag.path, ARM).rows) == (40, 8)
    joints = read_table(bag.path, "/many")
    assert joints.header == ("t_s", *(f"j{number}_rad" for number in range(400)))
    np.testing.assert_allclose(joints.rows[:, -1], TICKS, atol=1e-15)
    header = SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=0), frame_id="")
    message = SimpleNamespace(name=["a", "b", "a"], position=np.array([1.0, 2.0, 3.0]), header=header)
    samples = _bagfile.Samples(_bagfile.JOINTS)
    for received in (1, 2):
        samples.add(received, message)
    np.testing.assert_array_equal(samples.table(), [[1, 2], [1, 2]])


def test_joints_without_names_are_numbered_or_the_dvrks(tmp_path: Path) -> None:
    with BagWriter(tmp_path, "recording.bag") as bag:
        for time in TICKS:
            bag.nameless("/arm/joints", time, [time, 0.0])
            bag.nameless("/PSM2/state_joint_current", time, [0, 0, 0.1, 0, time, 0])
            bag.nameless("/PSM2/state_jaw_current", time, [time])
    assert read_table(bag.path, "/arm/joints").header == ("t_s", "joint_1_rad", "joint_2_rad")
    header = read_table(bag.path, "/PSM2/state_joint_current").header
    assert header[3:6] == ("outer_insertion_m", "outer_roll_rad", "outer_wrist_pitch_rad")
    assert read_table(bag.path, "/PSM2/state_jaw_current").header == ("t_s", "jaw_rad")


# --- images and lenses


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "bgra8", "mono8", "8UC1"])
@pytest.mark.parametrize("padding", [0, 7])
def test_every_plain_encoding_gives_the_image(tmp_path: Path, encoding: str, padding: int) -> None:
    order = {"rgb8": "RGB", "bgr8": "BGR", "rgba8": "RGBA", "bgra8": "BGRA"}.get(encoding, "G")
    with BagWriter(tmp_path, "recording.bag") as bag:
        for number in range(4):
            full = np.concatenate([picture(number), np.full((*SIZE[::-1], 1), 9, np.uint8)], 2)
            bag.image(
                LEFT, number / 25, full[..., ["RGBA".index(letter) for letter in order]], encoding, padding=padding
            )
    for number, pixels in images(bag.path).read(range(4)):
        grey = np.repeat(picture(number)[..., 1:2], 3, axis=2)
        np.testing.assert_array_equal(pixels, grey if order == "G" else picture(number))


@pytest.mark.parametrize("encoding", ["bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"])
def test_bayer_mosaics_give_their_colours(tmp_path: Path, encoding: str) -> None:
    values = {"r": 200, "g": 120, "b": 40}
    tile = np.array([values[letter] for letter in encoding[6:10]], np.uint8).reshape(2, 2)
    shown = of_one_colour(tmp_path, np.tile(tile, (SIZE[1] // 2, SIZE[0] // 2)), encoding)
    np.testing.assert_array_equal(shown, np.broadcast_to([200, 120, 40], shown.shape))


@pytest.mark.parametrize("encoding", ["yuv422", "uyvy", "yuv422_yuy2", "yuyv"])
def test_both_orders_of_yuv_give_their_colours(tmp_path: Path, encoding: str) -> None:
    pair = [120, 90, 120, 160] if "yuy" in encoding else [90, 120, 160, 120]  # Y 120, U 90, V 160
    pixels = np.tile(np.array(pair, np.uint8), (SIZE[1], SIZE[0] // 2)).reshape(SIZE[1], SIZE[0], 2)
    luma = 1.164 * (120 - 16)  # BT.601, of values from 16 to 235
    rgb = [luma + 1.596 * 32, luma - 0.813 * 32 + 0.391 * 38, luma - 2.018 * 38]
    np.testing.assert_allclose(of_one_colour(tmp_path, pixels, encoding)[4, 5], rgb, atol=1.5)


def of_one_colour(folder: Path, pixels: np.ndarray, encoding: str) -> np.ndarray:
    """An image of a bag of three such ones."""
    with BagWriter(folder, "recording.bag") as bag:
        for number in range(3):
            bag.image(LEFT, number / 25, pixels, encoding)
    return next(images(bag.path).read([1]))[1]


def test_packed_images_are_decoded(tmp_path: Path, kind: str) -> None:
    with BagWriter(tmp_path, kind) as bag:
        for number in range(30):
            bag.compressed("/left/compressed", number / 25, picture(number))
            bag.compressed("/right/compressed", number / 25, picture(number), ".png")
    for number, pixels in images(bag.path, "/right/compressed").read([3, 17]):
        np.testing.assert_array_equal(pixels, picture(number))
    for number, pixels in images(bag.path, "/left/compressed").read([29, 3]):
        assert np.abs(pixels.astype(float) - picture(number)).mean() < 3  # of JPEG at OpenCV's usual quality


def test_images_come_by_time_and_doubled_or_damaged_ones_are_left_out(tmp_path: Path) -> None:
    order = [3, 0, 1, 2, 2, 5, 4, 6]
    with BagWriter(tmp_path, "recording.bag") as bag:
        for place_in_bag, number in enumerate(order):
            code = cv2.imencode(".png", picture(number)[..., ::-1])[1].ravel()
            bag.late = 0.05 * place_in_bag - number / 25
            bag.encoded("/left/compressed", number / 25, code[:-30] if number == 6 else code, "png")
        bag.late = 0.5
        bag.encoded("/left/compressed", 8 / 25, np.frombuffer(b"no image at all", np.uint8), "h264")
    film = images(bag.path)
    np.testing.assert_allclose(film.times, np.arange(6) / 25, atol=2 * NS)
    found = dict(film.read([5, 2, 0, 3]))
    assert list(found) == [0, 2, 3, 5]
    for number, pixels in found.items():
        np.testing.assert_array_equal(pixels, picture(number))
    assert len(film.notes) == 3
    assert "1 image left out: duplicate time" in film.notes[2]


def test_images_whose_time_begins_anew_are_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path, "recording.bag") as bag:
        for place_in_bag, number in enumerate([*range(20, 40), *range(20)]):
            bag.late = 0.04 * place_in_bag - number / 25
            bag.image(LEFT, number / 25, picture(number), "rgb8")
    assert "image 21: time restarts" in refusal(lambda: images(bag.path))


def test_a_wanted_few_of_many_images_are_sought_and_not_read_past(tmp_path: Path) -> None:
    with BagWriter(tmp_path, "recording-mcap") as bag:
        for number in range(400):
            bag.image(LEFT, number / 25, np.full((*SIZE[::-1], 3), number % 251, np.uint8), "bgr8")
    film = images(bag.path)
    wanted = [0, 1, 57, 58, 200, 399]
    assert [(number, pixels[0, 0, 0]) for number, pixels in film.read(wanted)] == [(i, i % 251) for i in wanted]


def test_the_lens_is_the_cameras_beside_the_images(tmp_path: Path, kind: str) -> None:
    with BagWriter(tmp_path, kind) as bag:
        for time in TICKS[:4]:
            for topic in (LEFT, "/stereo/left/image_rect_color", "/other/image_raw", "/fresh/image_raw"):
                bag.image(topic, time, picture(0), "rgb8")
            bag.compressed(f"{LEFT}/compressed", time, picture(0))
            bag.camera_info("/stereo/left/camera_info", time, SIZE, FOCAL, [0.1, -0.2, 0.003, 0.004, 0.05])
            bag.camera_info("/fresh/camera_info", time, SIZE, (0.0, 0.0, 12.0, 8.0))
    for topic in ("image_raw", "image_raw/compressed"):
        lens = known(bag.path).lens(bag.path, f"/stereo/left/{topic}")
        assert lens is not None
        assert lens.intrinsics == FOCAL
        assert lens.distortion == (0.1, -0.2, 0.003, 0.004, 0.05)
        assert lens.size == SIZE
    straight = known(bag.path).lens(bag.path, "/stereo/left/image_rect_color")
    assert straight is not None
    assert straight.intrinsics == pytest.approx((27.0, 27.9, 12.5, 8.0))
    assert not straight.distorted
    assert known(bag.path).lens(bag.path, "/other/image_raw") is None
    assert known(bag.path).lens(bag.path, "/fresh/image_raw") is None  # never calibrated


def write_stereo(folder: Path, kind: str = "recording.bag", baseline: float = 0.0055) -> Path:
    """A bag of a stereo camera, turned for rectification by 2 degrees to the left and 1 degree to the right."""
    with BagWriter(folder, kind) as bag:
        for side, degrees, offset in (("left", 2.0, 0.0), ("right", -1.0, baseline)):
            for name in ("image_raw", "image_rect_color"):
                for time in TICKS[:4]:
                    bag.image(f"/stereo/{side}/{name}", time, picture(0), "rgb8")
            turn = Rotation.from_rotvec([0, degrees, 0], degrees=True).as_matrix()
            lens = np.add(FOCAL, [2 * offset, 0, 0, 0])
            bag.camera_info(
                f"/stereo/{side}/camera_info", 0.0, SIZE, lens, [0.1, 0, 0, 0], rectification=turn, baseline=offset
            )
    return bag.path


@pytest.mark.parametrize("rectified", [False, True])
def test_the_right_cameras_camera_info_gives_its_pose_to_the_left_one(tmp_path, kind, rectified):
    path, name = write_stereo(tmp_path, kind), "image_rect_color" if rectified else "image_raw"
    found = known(path).stereo(path, f"/stereo/left/{name}", f"/stereo/right/{name}")
    assert found is not None
    left, right, right_from_left = found
    assert left == known(path).lens(path, f"/stereo/left/{name}")
    assert right.intrinsics == pytest.approx((0.9 * 30.011, 27.9, 12.5, 8.0) if rectified else (30.011, *FOCAL[1:]))
    # a point of the left camera's frame has the same x and depth in both rectified frames, but for the baseline
    of_left, of_right = (
        np.eye(3) if rectified else Rotation.from_rotvec([0, degrees, 0], degrees=True).as_matrix()
        for degrees in (2.0, -1.0)
    )
    point = np.array([3.0, -4.0, 80.0])
    seen = of_right @ (right_from_left[:3, :3] @ point + right_from_left[:3, 3])
    np.testing.assert_allclose(seen, of_left @ point - [5.5, 0, 0], atol=1e-9)


def test_a_bag_without_the_right_cameras_camera_info_says_what_to_give(tmp_path: Path) -> None:
    path = whole(tmp_path)
    assert "has no /stereo/right/camera_info; give a calibration of both cameras" in refusal(
        lambda: known(path).stereo(path, LEFT, "/stereo/right/image_raw")
    )


def without_profile(content: bytearray) -> None:
    length = int.from_bytes(content[9:17], "little")
    content[17 : 17 + length] = bytes(4) + (length - 8).to_bytes(4, "little") + b"-" * (length - 8)


def of_other_encoding(content: bytearray) -> None:
    content[:] = content.replace(b"\3\0\0\0cdr", b"\3\0\0\0own").replace(b"ros2msg", b"foreign")
    content[:] = content.replace(b"Header header", b"\xc9eader header")  # a schema that is no text


@pytest.mark.parametrize("change", [without_profile, of_other_encoding])
def test_an_mcap_file_need_not_name_a_profile_and_other_messages_are_called_what_they_are(tmp_path, change):
    with BagWriter(tmp_path, "recording-mcap") as bag:
        for index in range(5):
            bag.pose("/psm1", index / 25, (0.01 * index, 0.0, 0.1), (1.0, 0.0, 0.0, 0.0), "PSM1_base")
    content = bytearray(bag.file.read_bytes())
    change(content)
    path = tmp_path / "other.mcap"
    path.write_bytes(content)
    if change is without_profile:
        (stream,) = known(path).streams(path)
        assert (stream.name, stream.kind, stream.count) == ("/psm1", Kind.POSES, 5)
    else:
        said = refusal(lambda: known(path).streams(path))
        assert "/psm1 (geometry_msgs/PoseStamped) is encoded as own, not as CDR" in said


@pytest.mark.parametrize(
    ("baseline", "left", "right", "words"),
    [
        (0.0, "left", "right", "/stereo/right/camera_info: projection_matrix: has no baseline (its 4th number is 0)"),
        (0.0055, "right", "left", "/stereo/right/camera_info: projection_matrix: has a baseline, so it is the right"),
        (0.5, "left", "right", "/stereo/right/camera_info: T: 0.5 long, which is no stereo scope's"),
    ],
)
def test_a_calibration_of_no_stereo_scope_is_refused(tmp_path, baseline, left, right, words):
    path = write_stereo(tmp_path, baseline=baseline)
    with pytest.raises(NeecoError) as caught:
        known(path).stereo(path, f"/stereo/{left}/image_raw", f"/stereo/{right}/image_raw")
    assert words in str(caught.value)
