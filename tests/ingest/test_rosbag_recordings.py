"""A bag becomes a recording by one command, and what cannot be read of one is said in one line."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import yaml
from bag_world import KINDS, BagWriter, known, refusal
from damaged_files import refusals
from ingest.still_world import HEIGHT, RATE, WIDTH, Theatre
from scipy.spatial.transform import Rotation

from neeco.base.errors import install_hint
from neeco.capture import read_capture
from neeco.cli import main
from neeco.ingest.cameras.still_scene import read_right_camera
from neeco.ingest.pipeline import ingest
from neeco.ingest.readers import _bagfile, read_table
from neeco.ingest.readers.logs import read_pose_log, read_reading_log
from neeco.ingest.readers.names import CAMERA, VIDEO_CLOCK
from neeco.ingest.readers.sections import JointColumns, PoseColumns
from neeco.ingest.recording.model import read_recording
from neeco.ingest.recording.template import write_template
from neeco.ingest.timing.reading import read_episodes

SIZE = (64, 48)  # px
FOCAL = (60.0, 60.0, 32.0, 24.0)
LEFT, RIGHT = "/stereo/left/image_raw", "/stereo/right/image_raw"
OLD = ("position_cartesian_current", "state_joint_current", "state_jaw_current")
NEW = ("measured_cp", "measured_js", "jaw/measured_js")
CASES = 25


def shaft(time: float) -> np.ndarray:
    """[3] m"""
    return np.array([0.02 * np.sin(2 * time), 0.01, 0.1 + 0.01 * time])


def write_dvrk(bag: BagWriter, names: tuple[str, str, str] = NEW, frame: str = "ECM", scope: str = "world") -> None:
    """PSM1 and PSM2, ECM, setpoints, tf and two cameras, 2 s."""
    cp, js, jaw = names
    for time in np.arange(0, 2, 0.02):
        angles = Rotation.from_rotvec([0.3 * time, 0.1, 0]).as_quat(scalar_first=True)
        for arm in ("PSM1", "PSM2"):
            bag.pose(f"/dvrk/{arm}/{cp}", time, shaft(time), angles, frame)
            bag.pose(f"/dvrk/{arm}/setpoint_cp", time, shaft(time), angles, frame)
            bag.joints(
                f"/dvrk/{arm}/{js}",
                time,
                outer_yaw=0.1,
                outer_insertion=0.1,
                outer_wrist_pitch=time,
                outer_wrist_yaw=0.2,
            )
            bag.joints(f"/dvrk/{arm}/{jaw}", time, jaw=0.3 * time)
        bag.joints("/dvrk/MTMR/measured_js", time, outer_yaw=0.1)
        bag.pose(f"/dvrk/ECM/{cp}", time, [0, 0, 0.1], [1, 0, 0, 0], scope)
        bag.tf(time, [0, 0, 0.1], [1, 0, 0, 0], "world", "table")
    for number in range(50):
        for topic in (RIGHT, LEFT):
            bag.image(topic, number / 25, np.full((*SIZE[::-1], 3), number, np.uint8), "bgr8", "stereo_left")
    bag.camera_info("/stereo/left/camera_info", 0.0, SIZE, FOCAL)


def read_arm(path: Path) -> object:
    return read_pose_log(PoseColumns(path, stream="/dvrk/PSM1/measured_cp"))


def write_tool(bag: BagWriter, topics: Sequence[str] = ("/tool/pose",), frame: str = "tracker") -> None:
    """Poses of a tool on each topic and images of a camera, 40 at 25 a second."""
    for time in np.arange(40) / 25:
        for number, topic in enumerate(topics, 1):
            bag.pose(topic, time, number * shaft(time), [1, 0, 0, 0], frame)
        bag.image("/cam/image_raw", time, np.full((*SIZE[::-1], 3), 9, np.uint8), "bgr8")


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A short bag of every kind, by its kind."""
    folder, found = tmp_path_factory.mktemp("bags"), {}
    for kind in KINDS:
        with BagWriter(folder, kind) as bag:
            for time in np.arange(12) / 25:
                bag.pose("/dvrk/PSM1/measured_cp", time, shaft(time), [1, 0, 0, 0], "ECM")
                bag.joints("/dvrk/PSM1/jaw/measured_js", time, jaw=time)
                bag.tf(time, shaft(time), [1, 0, 0, 0], "world", "table")
                bag.compressed("/left/compressed", time, np.full((*SIZE[::-1], 3), 90, np.uint8))
                bag.image(RIGHT, time, np.full((8, 8, 3), 90, np.uint8), "bgr8")
            bag.camera_info("/left/camera_info", 0.0, SIZE, FOCAL)
        found[kind] = bag.path
    return found


@pytest.mark.parametrize(("kind", "names"), list(zip(KINDS, (NEW, OLD, NEW), strict=True)))
def test_a_dvrks_bag_becomes_a_recording_by_one_command(tmp_path, kind, names, capsys):
    with BagWriter(tmp_path, kind) as bag:
        write_dvrk(bag, names)
    assert main(["ingest", "--init", str(bag.path)]) == 0
    text = (tmp_path / "recording.yaml").read_text()
    recording = read_recording(tmp_path / "recording.yaml")
    assert (recording.file, recording.stream) == (bag.path, LEFT)
    assert [item.name for item in recording.instruments] == ["PSM1", "PSM2"]
    assert all(set(item.joints) == {"wrist_pitch", "wrist_yaw", "jaw"} for item in recording.instruments)
    assert text.count("# kinematics: {dvrk_tool: TOOL.json}") == 2
    assert text.count("# poses are expressed in ECM, the frame of the camera") == 2
    assert recording.laparoscope is not None
    assert recording.laparoscope.stream == f"/dvrk/ECM/{names[0]}"
    assert recording.clocks == (VIDEO_CLOCK,)
    for unused in ("setpoint_cp: geometry_msgs/PoseStamped in ECM, 100 at 50 a second", "MTMR/measured_js", "tf:table"):
        assert unused in text.partition("not used:")[2]
    lens, _ = recording.read_lens()
    assert lens is not None
    assert lens.intrinsics == FOCAL
    data = read_episodes([recording])
    times = data.times[2:-2]
    states, usable = data.with_assumed_clocks().states_at(times)
    assert usable.all()
    found, joints = states["PSM2"]
    turned = np.array([-1000, -1000, 1000])  # ECM: x left, y up
    np.testing.assert_allclose(found[:, :3, 3], [turned * shaft(time) for time in times], atol=0.01)
    np.testing.assert_allclose(joints["wrist_pitch"], times, atol=1e-6)
    np.testing.assert_allclose(joints["jaw"], 0.3 * times, atol=1e-6)
    assert data.parts[0].poses["PSM1"].frame == CAMERA


def test_a_laparoscope_in_another_base_than_the_arms_is_not_taken_for_registration(tmp_path: Path) -> None:
    with BagWriter(tmp_path, "recording.bag") as bag:
        write_dvrk(bag, frame="PSM_base", scope="ECM_base")
    text = write_template(bag.path)
    document = yaml.safe_load(text)
    assert "laparoscope" not in document
    assert "in ECM_base, the arms in PSM_base" in text
    scope: dict[str, object] = {"file": "recording.bag", "stream": "/dvrk/ECM/measured_cp"}
    for frame, refused in ((None, True), ("base", False)):
        path = tmp_path / "recording.yaml"
        path.write_text(yaml.safe_dump(document | {"laparoscope": scope | ({"frame": frame} if frame else {})}))
        recording = read_recording(path)
        if refused:
            message = refusal(lambda recording=recording: read_episodes([recording]))
            assert "laparoscope: its poses are stated in ECM_base, those of PSM1 in PSM_base" in message
        else:
            read_episodes([recording])


def test_bags_of_other_robots_offer_what_was_measured(tmp_path: Path) -> None:
    with BagWriter(tmp_path, "recording-mcap") as bag:
        write_tool(bag, ["/tool/left/pose", "/tool/right/pose", "/tool/left/pose_goal"])
        for time in np.arange(40) / 25:
            bag.joints("/tool/right/joint_states", time, grip=time)
    document = yaml.safe_load(write_template(bag.path))
    assert [item["name"] for item in document["instruments"]] == ["tool_left", "tool_right"]
    assert list(document["instruments"][1]["joints"]) == ["grip"]
    assert "joints" not in document["instruments"][0]


def test_names_in_a_bag_are_names_and_no_more(tmp_path: Path) -> None:
    """Neither keys of a recording.yaml nor what a terminal obeys."""
    bad = "ECM\nsettings: {sfm_features: 1}\x1b[2J"
    with BagWriter(tmp_path, "recording.bag") as bag:
        write_tool(bag, frame=bad)
        for time in np.arange(40) / 25:
            bag.tf(time, shaft(time), [1, 0, 0, 0], bad, f"child{bad}")
            bag.joints("/tool/joint_states", time, **{f"jaw{bad}": time})
    text = write_template(bag.path)
    assert "settings" not in yaml.safe_load(text)
    said = refusal(lambda: read_table(bag.path, "tf:nothing"))
    assert all(letter.isprintable() or letter == "\n" for letter in text + said)


# --- what cannot be read


def test_a_bag_in_the_place_of_a_recording_says_what_to_do(bags, capsys, tmp_path):
    for path in bags.values():
        assert main(["ingest", str(path), "--output", str(tmp_path / "out")]) == 1
        assert capsys.readouterr().err.rstrip().endswith(f"neeco ingest --init {path}")
    recording = tmp_path / "recording.yaml"
    recording.write_text(yaml.safe_dump({"video": {"file": str(bags["recording.bag"]), "fps": 25}}))
    assert "video.fps: the file has times of its own; leave it out" in refusal(lambda: read_recording(recording))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.97])
def test_a_truncated_bag_is_refused_with_what_repairs_it(tmp_path, bags, kind, share):
    path = _copy(bags[kind], tmp_path)
    file = _messages(path)
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    message = refusal(lambda: read_arm(path))
    assert message.startswith(f"{path}: is truncated, damaged or not a bag (")
    assert {"recording.bag": "rosbag reindex"}.get(kind, "ros2 bag reindex") in message
    if kind != "recording.bag":
        assert message.partition("(")[0] != refusal(lambda: read_arm(file)).partition("(")[0]


def test_a_bag_that_was_not_closed_is_refused(tmp_path: Path, bags: dict[str, Path]) -> None:
    path = _copy(bags["recording.bag"], tmp_path)
    content = path.read_bytes()
    at = content.index(b"index_pos=") + len(b"index_pos=")
    path.write_bytes(content[:at] + bytes(8) + content[at + 8 :])
    assert "(Bag is not indexed, reindex before reading); repair it with `rosbag reindex`" in refusal(
        lambda: read_arm(path)
    )


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3"])
@pytest.mark.parametrize("content", [b"", b"#ROSBAG V1.2\n", b"nothing of the kind" * 100])
def test_what_is_no_bag_is_refused(tmp_path: Path, name: str, content: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    assert refusal(lambda: read_arm(path)).startswith(f"{path}: is truncated, damaged or not a bag")


def test_topics_that_are_not_there_or_not_of_the_kind_are_named(bags: dict[str, Path]) -> None:
    path = bags["recording.bag"]
    poses = "choose one of: /dvrk/PSM1/measured_cp, tf:table, /dvrk/PSM1/jaw/measured_js"
    assert f"stream: '/PSM1/measured_cp' does not exist; {poses}" in refusal(
        lambda: read_table(path, "/PSM1/measured_cp")
    )
    message = f"'{RIGHT}' is sensor_msgs/Image (bgr8, 8x8), not poses or readings; {poses}"
    assert message in refusal(lambda: read_table(path, RIGHT))
    assert f"has 2 streams of images; set `stream` in the recording to one of: /left/compressed, {RIGHT}" in refusal(
        lambda: known(path).open_images(path)
    )
    assert "'tf:table' is tf2_msgs/TFMessage in world, not images" in refusal(
        lambda: known(path).open_images(path, "tf:table")
    )


@pytest.mark.parametrize("encoding", ["mono16", "16UC1", "32FC1", "yuv420"])
def test_encodings_that_are_not_read_are_named(tmp_path: Path, encoding: str) -> None:
    with BagWriter(tmp_path, "recording.bag") as bag:
        for time in range(3):
            bag.image(LEFT, float(time), np.zeros((8, 8, 2), np.uint8), encoding)
    message = refusal(lambda: known(bag.path).open_images(bag.path, LEFT))
    assert (
        f"{bag.path}: {LEFT}: only 0 of 3 images usable (3 left out: one has the unsupported encoding '{encoding}'"
        in message
    )
    fault = f"one has the unsupported encoding '{encoding}'"
    why = f"no images that can be read: {LEFT}: none of 3 messages can be used: {fault}"
    assert why in refusal(lambda: write_template(bag.path))


def test_images_of_two_sizes_and_lenses_of_a_part_are_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path, "recording.bag") as bag:
        for number in range(4):
            bag.image(LEFT, number / 25, np.zeros((8, 8 + 8 * (number > 1), 3), np.uint8), "rgb8")
        bag.camera_info("/stereo/left/camera_info", 0.0, SIZE, FOCAL, binning=2)
    assert "image size changes from 8x8 to 16x8 px" in refusal(lambda: known(bag.path).open_images(bag.path))
    assert "camera_info: uses binning" in refusal(lambda: known(bag.path).lens(bag.path, LEFT))


def test_a_type_that_is_defined_otherwise_is_not_read(tmp_path: Path, bags: dict[str, Path]) -> None:
    path = _copy(bags["recording.bag"], tmp_path)
    content = path.read_bytes()
    known = b"d3812c3cbc69362b77dc0b19b345f8f5"  # md5 of geometry_msgs/PoseStamped
    assert known in content
    path.write_bytes(content.replace(known, b"0" * 32))
    assert "which defines geometry_msgs/PoseStamped differently from ROS, not poses" in refusal(lambda: read_arm(path))


def test_without_rosbags_what_to_install_is_said(bags: dict[str, Path], uninstalled) -> None:
    uninstalled("rosbags")
    for path in bags.values():
        for action in (read_arm, write_template):
            said = refusal(lambda action=action, path=path: action(path))
            assert said == f"{path}: ROS bag: needs rosbags; {install_hint('ros')}"


def test_files_packed_as_a_whole_are_refused(tmp_path: Path, bags: dict[str, Path]) -> None:
    path = _copy(bags["recording-db3"], tmp_path)
    metadata = path / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("compression_mode: ''", "compression_mode: FILE"))
    assert "FILE" in metadata.read_text()
    assert "its files are compressed as a whole; decompress one with `zstd -d`" in refusal(lambda: read_arm(path))


def test_metadata_larger_than_any_recorder_writes_is_refused(tmp_path, bags):
    path = _copy(bags["recording-db3"], tmp_path)
    with (path / "metadata.yaml").open("ab") as metadata:
        metadata.write(b"#" * (16 << 20))
    said = refusal(lambda: known(path).streams(path))
    assert "metadata.yaml: is too large; rewrite it with `ros2 bag reindex`" in said


def test_chunks_that_unpack_without_measure_are_refused(tmp_path, monkeypatch):
    """The limit is lowered: a bomb of its real size would take seconds to make."""
    monkeypatch.setattr(_bagfile, "LIMITS", _bagfile.BagLimits(chunk_bytes=60_000))
    for kind, packed in (("a.bag", "bz2"), ("b.bag", "lz4"), ("c.bag", None), ("d-mcap", "zstd"), ("e-db3", "zstd")):
        with BagWriter(tmp_path, kind, packed=packed) as bag:
            for time in range(4):
                bag.pose("/dvrk/PSM1/measured_cp", float(time), [0, 0, 0], [1, 0, 0, 0])
                bag.image(LEFT, float(time), np.zeros((200, 200, 3), np.uint8), "rgb8")
        assert "a chunk of its messages" in refusal(lambda bag=bag: known(bag.path).open_images(bag.path))


def test_definitions_in_a_bag_are_never_executed(tmp_path: Path, bags: dict[str, Path]) -> None:
    """rosbags makes Python of definitions that it is given: a bag's own are not given to it."""
    before = set(sys.modules)
    for path in bags.values():
        read_arm(path)
    assert "rosbags.usertypes" not in set(sys.modules) - before or _only_ours()


def _only_ours() -> bool:
    module = sys.modules["rosbags.usertypes"]
    return set(module.FIELDDEFS) <= {"tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"}


@pytest.mark.parametrize("kind", KINDS)
def test_whatever_happens_to_its_bytes_a_bag_is_read_or_refused_in_one_line(tmp_path, bags, kind):
    path = _copy(bags[kind], tmp_path)
    bag = known(path)
    reads: list[Callable[[], object]] = [
        lambda: write_template(path),
        lambda: read_arm(path),
        lambda: read_reading_log(JointColumns(path, "video", stream="/dvrk/PSM1/jaw/measured_js")),
        lambda: list(bag.open_images(path, RIGHT).read(range(2))),
        lambda: list(bag.open_images(path, "/left/compressed").read(range(2))),
        lambda: bag.lens(path, "/left/compressed"),
    ]
    refusals([path] if path.is_file() else sorted(path.iterdir()), reads, CASES)


def _copy(path: Path, folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    copy = folder / path.name
    return Path((shutil.copytree if path.is_dir() else shutil.copy)(path, copy))


def _messages(path: Path) -> Path:
    return path if path.is_file() else next(file for file in path.iterdir() if file.suffix != ".yaml")


def test_two_cameras_of_a_bag_are_paired_by_their_stamps(tmp_path: Path) -> None:
    """As many images of each, but the right camera begins and ends later, and lost one on the way."""
    taken = {LEFT: [*range(20)], RIGHT: [*range(3, 9), *range(10, 24)]}
    with BagWriter(tmp_path, "recording.bag") as bag:
        for topic, numbers in taken.items():
            for number in numbers:
                bag.image(topic, number / 25, np.full((*SIZE[::-1], 3), 10 * number, np.uint8), "rgb8")
        for side, baseline in (("left", 0.0), ("right", 0.005)):
            bag.camera_info(f"/stereo/{side}/camera_info", 0.0, SIZE, FOCAL, baseline=baseline)
    path = tmp_path / "recording.yaml"
    document = {"video": {"file": "recording.bag", "stream": LEFT}, "camera": "still"}
    path.write_text(yaml.safe_dump(document | {"stereo": {"video": {"file": "recording.bag", "stream": RIGHT}}}))
    recording = read_recording(path)
    times = recording.source.open().times
    assert recording.stereo is not None
    assert len(recording.stereo.source.open().times) == len(times) == 20
    selected = np.arange(0, 20, 3)
    stems = [f"{number:02d}" for number in selected.tolist()]
    found = read_right_camera(recording, selected, times, stems, tmp_path / "right", lambda *_: None)
    shown = {stems[row]: int(found.load(row)[0, 0, 0]) // 10 for row in found.names}
    assert shown == {stem: int(stem) for stem in stems if stem not in ("00", "09")}
    np.testing.assert_allclose(found.world_from_camera[:3, 3], [5, 0, 0], atol=1e-9)


def test_a_delay_of_the_images_is_stated_as_the_offset_of_their_own_clock(tmp_path: Path) -> None:
    with BagWriter(tmp_path, "recording.bag") as bag:
        write_dvrk(bag)
    text = write_template(bag.path).replace("# sync: {video: 0.0}", "sync: {video: 0.04}")
    (tmp_path / "recording.yaml").write_text(text)
    data = read_episodes([read_recording(tmp_path / "recording.yaml")])
    times = data.times[2:-4]
    states, _ = data.with_assumed_clocks().states_at(times)
    np.testing.assert_allclose(states["PSM1"][1]["wrist_pitch"], times + 0.04, atol=1e-6)


def test_what_the_right_camera_took_later_shows_the_state_of_that_moment(tmp_path: Path) -> None:
    theatre, late, path = Theatre(tmp_path), 0.012, tmp_path / "recording.yaml"
    with BagWriter(tmp_path, "recording.bag") as bag:
        for number in range(30):
            for topic, offset in ((LEFT, 0.0), (RIGHT, late)):
                bag.image(topic, number / RATE + offset, theatre.image(number, topic == RIGHT), "rgb8")
        for time in np.arange(-0.1, 30 / RATE + 0.1, 0.01):
            bag.pose("/bar", time, theatre.place(time) / 1000, [1, 0, 0, 0])
        size, intrinsics = (WIDTH, HEIGHT), (150.0, 150.0, WIDTH / 2, HEIGHT / 2)
        bag.camera_info("/stereo/left/camera_info", 0.0, size, intrinsics)
        bag.camera_info("/stereo/right/camera_info", 0.0, size, intrinsics, baseline=0.008)
    bar = {"name": "bar", "poses": {"file": "recording.bag", "stream": "/bar", "frame": "camera"}}
    left, right = ({"file": "recording.bag", "stream": topic} for topic in (LEFT, RIGHT))
    document = {"video": left, "stereo": {"video": right}, "camera": "still", "instruments": [bar]}
    path.write_text(yaml.safe_dump(document))
    result = ingest(read_recording(path), tmp_path / "capture", lambda what, done, total: None)
    assert any("taken +12 ms after the left one's" in note for note in result.notes)
    frames = {frame.name: frame.state for frame in read_capture(result.capture).frames}
    pairs = [(state, frames[name.removesuffix("_right")]) for name, state in frames.items() if name.endswith("_right")]
    assert len(pairs) > 10
    for state, of_left in pairs:
        assert state.time - of_left.time == pytest.approx(late, abs=1e-6)
        for taken in (state, of_left):
            place = taken.instruments["bar"].pose[:3, 3].numpy()
            assert np.abs(place - theatre.place(taken.time)).max() < 0.05
