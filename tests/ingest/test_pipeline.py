"""A recording becomes a capture, whole or not at all."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image, ImageDraw, ImageFont
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from neeco.base.errors import NeecoError
from neeco.capture import check_capture, read_capture
from neeco.capture.documents import errors_only
from neeco.geometry.lens import Lens
from neeco.ingest.frames.images import choose_images
from neeco.ingest.pipeline import ingest
from neeco.ingest.recording.model import read_recording
from neeco.ingest.timing.reading import read_episodes

pytest.importorskip("pycolmap")

SAMPLE = Path(__file__).parents[2] / "samples" / "liver-mini"
OFFSET = 0.31  # s, the tracker's clock ahead of the images'
HAND_EYE = np.eye(4)
HAND_EYE[:3, :3] = Rotation.from_euler("xyz", [15, 25, -40], degrees=True).as_matrix()
HAND_EYE[:3, 3] = [12.0, -7.0, -30.0]


def silent(what: str, done: int, total: int) -> None:
    """StageProgress that nobody watches."""


def write_log(path: Path, times: np.ndarray, poses: np.ndarray, header: str = "t_s,x_mm,y_mm,z_mm,qw,qx,qy,qz") -> None:
    quats = Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header.split(","))
        writer.writerows(np.concatenate([times[:, None], poses[:, :3, 3], quats], 1).round(6).tolist())


def dense(times: np.ndarray, poses: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Poses [N, 4, 4] at other times, smoothly between the given ones."""
    inside = np.clip(at, times[0], times[-1])
    found = np.tile(np.eye(4), (len(at), 1, 1))
    found[:, :3, 3] = CubicSpline(times, poses[:, :3, 3])(inside)
    found[:, :3, :3] = RotationSpline(times, Rotation.from_matrix(poses[:, :3, :3]))(inside).as_matrix()
    return found


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """The sample's images with logs made of its states: recording.yaml in a folder of its own."""
    capture = read_capture(SAMPLE)
    frames = sorted(capture.frames, key=lambda frame: frame.state.time)
    times = np.array([frame.state.time for frame in frames])
    cameras = np.stack([frame.camera.world_from_camera.double().numpy() for frame in frames])
    name = capture.instruments[0].name
    tools = np.stack([frame.state.instruments[name].pose.double().numpy() for frame in frames])
    jaws = np.array([frame.state.instruments[name].joints["jaw_angle"] for frame in frames])
    ticks = np.arange(times[0], times[-1], 0.025)
    write_log(tmp_path / "scope.csv", ticks + OFFSET, dense(times, cameras @ HAND_EYE, ticks))
    write_log(tmp_path / "tool.csv", ticks + OFFSET, dense(times, tools, ticks))
    jaw_rows = "\n".join(f"{t:.4f},{a:.5f}" for t, a in zip(ticks, np.interp(ticks, times, jaws), strict=True))
    (tmp_path / "jaw.csv").write_text("t_s,angle_rad\n" + jaw_rows + "\n")
    (tmp_path / "times.csv").write_text(
        "file,t_s\n" + "\n".join(f"{frame.image_path.name},{frame.state.time:.4f}" for frame in frames) + "\n"
    )
    (tmp_path / "images").symlink_to(SAMPLE / "images")
    camera = frames[0].camera
    document = {
        "images": {"folder": "images", "times": "times.csv"},
        "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        "instruments": [{"name": "tool", "poses": "tool.csv", "joints": {"jaw_angle": {"file": "jaw.csv"}}}],
        "laparoscope": "scope.csv",
        "sync": {"jaw_angle": 0.0},
    }
    path = tmp_path / "recording.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


def test_what_a_console_draws_over_the_images_is_masked_and_said(recording: Path, tmp_path: Path) -> None:
    (tmp_path / "images").unlink()
    (tmp_path / "images").mkdir()
    for path in sorted((SAMPLE / "images").iterdir()):
        image = Image.open(path).convert("RGB")
        ImageDraw.Draw(image).text((8, 6), "PSM1", (250, 250, 250), ImageFont.load_default(24))
        image.save(tmp_path / "images" / path.name, quality=95)
    data = read_episodes([read_recording(recording)])
    images = choose_images(data, tmp_path, silent)
    assert any("drawn over the video" in sentence for sentence in data.notes.sentences)
    mask_path = images.mask_of(int(images.selected[0]))
    assert mask_path is not None
    hidden = np.array(Image.open(mask_path)) == 0
    assert hidden[6:32, 8:75].mean() > 0.5
    hidden[:45, :90] = False
    assert hidden.mean() < 1e-3


@pytest.mark.slow
def test_the_sample_recorded_again_becomes_the_sample(recording: Path, tmp_path: Path) -> None:
    result = ingest(read_recording(recording), tmp_path / "capture", silent)
    assert result.registration is not None
    assert result.clocks["em"].seconds == pytest.approx(OFFSET, abs=0.02)
    assert errors_only(check_capture(tmp_path / "capture")) == []
    truth = {frame.image_path.stem: frame for frame in read_capture(SAMPLE).frames}
    order = sorted(truth, key=lambda stem: truth[stem].state.time)
    made = read_capture(tmp_path / "capture")
    assert len(made.frames) > 70
    camera = made.frames[0].camera
    assert made.lens == Lens(camera.fx, camera.fy, camera.cx, camera.cy, (), (camera.width, camera.height))
    errors = []
    for frame in made.frames:
        given = truth[order[int(frame.image_path.stem)]]
        errors.append(float((frame.camera.world_from_camera - given.camera.world_from_camera)[:3, 3].norm()))
    # 96 frames of 240x192 leave the scale uncertain by percents of the 150 mm between lens and trocar
    assert np.median(errors) < 6.0, "mm"
    assert np.ptp(errors) < 4.0, "mm: what is off is off alike in all frames"
    assert json.loads(json.dumps(result.as_json()))["kept"] == len(made.frames)


@pytest.mark.slow
def test_without_a_tracked_scope_it_says_what_is_lost(recording: Path, tmp_path: Path) -> None:
    document = yaml.safe_load(recording.read_text())
    del document["laparoscope"], document["intrinsics"]
    recording.write_text(yaml.safe_dump(document))
    result = ingest(read_recording(recording), tmp_path / "capture", silent)
    assert result.registration is None
    assert any("laparoscope was not tracked" in note for note in result.notes)
    assert any("intrinsics were estimated" in note for note in result.notes)
    assert not read_capture(tmp_path / "capture").registered


def test_images_that_show_nothing_leave_nothing_behind(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for index in range(14):
        noise = rng.integers(0, 60, (48, 64, 3), dtype=np.uint8)
        Image.fromarray(noise).save(folder / f"{index:03d}.png")
    (tmp_path / "recording.yaml").write_text(
        "images: {folder: images, fps: 25}\nintrinsics: [50, 50, 32, 24]\n"
        "settings: {sfm_minutes: 0.001}\n"  # the first way is enough here
    )
    with pytest.raises(NeecoError, match=r"no cameras could be found"):
        ingest(read_recording(tmp_path / "recording.yaml"), tmp_path / "out" / "capture", silent)
    assert not (tmp_path / "out").exists()


def test_an_output_that_exists_is_not_touched(recording: Path, tmp_path: Path) -> None:
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / "mine.txt").write_text("keep")
    with pytest.raises(NeecoError, match="already exists"):
        ingest(read_recording(recording), tmp_path / "capture", silent)
    assert (tmp_path / "capture" / "mine.txt").read_text() == "keep"


def states_with_limits(recording: Path, limits: list[float]) -> list[float]:
    document = yaml.safe_load(recording.read_text())
    document["instruments"][0]["joints"]["jaw_angle"]["limits"] = limits
    document["sync"]["em"] = OFFSET
    recording.write_text(yaml.safe_dump(document))
    data = read_episodes([read_recording(recording)])
    states, usable = data.with_assumed_clocks().states_at(data.times)
    return states["tool"][1]["jaw_angle"][usable].tolist()


def test_noise_does_not_carry_readings_beyond_their_limits(recording: Path, tmp_path: Path) -> None:
    free = states_with_limits(recording, [-1.0, 3.0])
    least, greatest = min(free) + 0.02, max(free) + 0.5
    held = states_with_limits(recording, [least, greatest])
    assert min(held) == pytest.approx(least)
    assert max(held) == pytest.approx(max(free))
    with pytest.raises(NeecoError, match=r"jaw\.csv: readings go .* beyond the joint's limits"):
        states_with_limits(recording, [min(free) + 0.2, greatest])


def test_logs_that_never_meet_the_video_are_refused_before_any_work(recording: Path, tmp_path: Path) -> None:
    text = (tmp_path / "jaw.csv").read_text().splitlines()
    late = [text[0], *(f"{float(row.split(',')[0]) + 500},{row.split(',')[1]}" for row in text[1:])]
    (tmp_path / "jaw.csv").write_text("\n".join(late) + "\n")
    document = yaml.safe_load(recording.read_text())
    del document["sync"]
    recording.write_text(yaml.safe_dump(document))
    with pytest.raises(NeecoError, match=r"jaw\.csv: its times .* do not meet the video's"):
        ingest(read_recording(recording), tmp_path / "capture", silent)


def test_what_is_counted_is_counted_to_its_total(recorded, tmp_path):
    last: dict[str, tuple[int, int]] = {}

    def note(what: str, done: int, total: int) -> None:
        last[what] = done, total

    ingest(read_recording(recorded.folder / "recording.yaml"), tmp_path / "capture", note)
    counted = {what: count for what, count in last.items() if not what.startswith("cameras")}  # some find no place
    assert counted["looking at the frames"][1] == recorded.frames
    assert all(done == total for done, total in counted.values())


def test_an_arm_in_another_base_than_the_scopes_is_where_it_would_be_in_the_same(recorded, tmp_path):
    plain = read_capture(ingest(read_recording(recorded.folder / "recording.yaml"), tmp_path / "one", silent).capture)
    base = np.eye(4)  # world_from_base
    base[:3, :3], base[:3, 3] = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix(), [30, -200, 90]
    _restate(recorded, np.linalg.inv(base), {"world_from_base": {"transform": base.tolist()}})
    other = read_capture(ingest(read_recording(recorded.folder / "recording.yaml"), tmp_path / "two", silent).capture)
    assert other.registered
    held = {frame.name: frame.state.instruments["grasper"].pose for frame in plain.frames}
    both = [frame for frame in other.frames if frame.name in held]
    assert len(both) > 0.9 * len(plain.frames)
    for frame in both:
        np.testing.assert_allclose(frame.state.instruments["grasper"].pose, held[frame.name], atol=0.02)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"camera_from_base": {"transform": np.eye(4).tolist()}}, "camera_from_base: the scope moves, and the base of"),
        ({"world_from_base": "unknown", "laparoscope": None}, "world_from_base: where the base of grasper stands can"),
        (
            {"world_from_base": {"transform": np.eye(4).tolist()}, "camera": "still", "laparoscope": None},
            "world_from_base: the scope stands still; state the base of grasper to its camera",
        ),
        ({"world_from_base": "unknown", "camera_from_base": "unknown"}, "world_from_base: camera_from_base is given"),
    ],
)
def test_a_base_is_stated_to_what_stands_still(recorded, tmp_path, keys, words):
    _restate(recorded, np.eye(4), keys)
    with pytest.raises(NeecoError, match=words):
        ingest(read_recording(recorded.folder / "recording.yaml"), tmp_path / "capture", silent)
    assert not (tmp_path / "capture").exists()


def _restate(recorded, base_from_world, keys):
    """The instrument's log in another base, and more keys in the recording (None: without them)."""
    log = recorded.folder / "instrument.csv"
    header, *lines = log.read_text().splitlines()
    rows = np.array([[float(cell) for cell in line.split(",")] for line in lines])
    turns = Rotation.from_matrix(base_from_world[:3, :3]) * Rotation.from_quat(rows[:, 4:], scalar_first=True)
    places = rows[:, 1:4] @ base_from_world[:3, :3].T + base_from_world[:3, 3]
    recorded.world.write(header, np.column_stack([rows[:, 0], places, turns.as_quat(scalar_first=True)]), log.name)
    path = recorded.folder / "recording.yaml"
    document = yaml.safe_load(path.read_text()) | keys
    path.write_text(yaml.safe_dump({key: value for key, value in document.items() if value is not None}))
