"""Kinematics of JIGSAWS, 76 columns without a header, are read arm by arm on the clock of their video."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.ingest.readers import format_of
from neeco.ingest.readers.logs import read_pose_log, read_reading_log
from neeco.ingest.readers.sections import PoseColumns
from neeco.ingest.recording.model import read_recording
from neeco.ingest.recording.template import write_template
from neeco.ingest.timing.reading import read_episodes

ROWS = 40
ARMS = ("master left", "master right", "slave left", "slave right")


def arm(number: int) -> tuple[np.ndarray, Rotation, np.ndarray]:
    """Places [R, 3] m, turns and gripper angles [R] rad of an arm, each with its own motion."""
    times = np.arange(ROWS) / 30
    place = np.stack([0.02 * np.sin(times + number), 0.03 * np.cos(2 * times), 0.1 + 0.02 * number + 0.01 * times], 1)
    turns = Rotation.from_rotvec(np.outer(1 + times, [0.2 + 0.1 * number, 0.5, -0.3]))
    return place, turns, -0.4 + 0.1 * number + 0.2 * np.sin(3 * times)


def row_blocks() -> np.ndarray:
    """[R, 76] in the layout of the readme."""
    blocks = []
    for number in range(4):
        place, turns, gripper = arm(number)
        velocity = np.gradient(place, 1 / 30, axis=0)
        spin = np.tile([0.2 + 0.1 * number, 0.5, -0.3], (ROWS, 1))
        blocks.append(np.column_stack([place, turns.as_matrix().reshape(-1, 9), velocity, spin, gripper]))
    return np.concatenate(blocks, 1)


def lines_of(values: np.ndarray) -> list[str]:
    return ["".join(f"{value:14.6f}" for value in row) for row in values]


@pytest.fixture
def trial(tmp_path: Path) -> Path:
    path = tmp_path / "Suturing_B001.txt"
    path.write_text("\n".join(lines_of(row_blocks())) + "\n")
    return path


@pytest.mark.parametrize("number", range(4))
def test_every_arm_has_its_poses_in_its_base(trial, number):
    log = read_pose_log(PoseColumns(trial, stream=ARMS[number]))
    place, turns, _ = arm(number)
    np.testing.assert_allclose(log.times, np.arange(ROWS) / 30, atol=1e-12)
    np.testing.assert_allclose(log.positions, 1000 * place, atol=1e-3)  # six decimals of a metre
    off = (Rotation.from_quat(log.quats, scalar_first=True).inv() * turns).magnitude()
    assert off.max() < 5e-6
    assert (log.frame, log.notes) == ("base", ())


def test_a_template_takes_the_slaves_on_the_videos_clock(trial, world):
    (trial.parent / "Suturing_B001_capture1.avi").write_bytes(b"not looked into")
    place = trial.parent / "recording.yaml"
    place.write_text(write_template(trial.parent))
    recording = read_recording(place)
    assert recording.file == trial.parent / "Suturing_B001_capture1.avi"
    assert [item.name for item in recording.instruments] == ["slave_left", "slave_right"]
    assert recording.clocks == ("video",)
    for number, instrument in zip((2, 3), recording.instruments, strict=True):
        assert instrument.poses is not None
        np.testing.assert_allclose(read_pose_log(instrument.poses).positions, 1000 * arm(number)[0], atol=1e-3)
        readings = read_reading_log(instrument.joints["gripper_angle"])
        np.testing.assert_allclose(readings.values, arm(number)[2], atol=1e-6)


@pytest.mark.parametrize(
    ("frames", "rate", "message"),
    [
        (40, 30, None),
        (20, 15, "has 39 images for 40 states at 30 Hz; both are assumed to start at the same time"),
        (38, 30, "has 38 images for 40 states at 30 Hz; both are assumed to start at the same time"),
        (12, 30, "has 12 images for 40 states at 30 Hz; the numbers do not match: give the video of this log"),
        (40, 15, "has 79 images for 40 states at 30 Hz; .*: its 40 images match the states: set `fps: 30`"),
    ],
)
def test_there_is_a_row_for_every_image_of_the_video(frames, rate, message, trial, world):
    world.video("Suturing_B001_capture1.mp4", frames, lambda i: round(i * 1000 / rate))
    world.text(write_template(trial.parent), "recording.yaml")
    recording = read_recording(world.folder / "recording.yaml")
    if message is None or "start at the same time" in message:
        notes = read_episodes([recording]).notes.sentences
        expected = [f"Suturing_B001_capture1.mp4: {message}"] if message else []
        assert [note for note in notes if "images for" in note] == expected
    else:
        with pytest.raises(NeecoError, match=message):
            read_episodes([recording])


def test_a_log_on_the_videos_clock_that_is_longer_than_the_video_is_noted(world):
    world.video(frames=40)
    world.write("t_s,x_mm,y_mm,z_mm,qw,qx,qy,qz", world.rows(), "tool.csv")  # 5 s
    world.text("video: video.mp4\ninstruments: [{name: a, poses: {file: tool.csv, clock: video}}]", "recording.yaml")
    notes = read_episodes([read_recording(world.folder / "recording.yaml")]).notes.sentences
    assert "tool.csv: goes from 0.0 to 5.0 s on the video's clock, the video from 0.0 to 1.6 s" in str(notes)


def test_an_arm_must_be_named(trial):
    with pytest.raises(NeecoError, match=r"has 4 streams of poses; .*master left, master right, slave left, slave"):
        read_pose_log(PoseColumns(trial))
    with pytest.raises(NeecoError, match="'PSM1' does not exist; choose one of: master left"):
        read_pose_log(PoseColumns(trial, stream="PSM1"))


@pytest.mark.parametrize("line", ["1 2 3", "x " * 76, "1 " * 77, "1_0 " * 76])
def test_lines_of_other_numbers_are_named(trial, line):
    lines = trial.read_text().splitlines()
    lines[16] = line
    trial.write_text("\n".join(lines))
    with pytest.raises(NeecoError, match=r"Suturing_B001\.txt: line 17: expected 76 numbers") as caught:
        read_pose_log(PoseColumns(trial, stream="slave left"))
    assert "\n" not in str(caught.value)


def test_a_matrix_that_is_no_rotation_is_refused(trial):
    values = row_blocks()
    values[:, 38 + 3 : 38 + 12] *= 1.5
    trial.write_text("\n".join(lines_of(values)))
    with pytest.raises(NeecoError, match=r"slave left: lines 1, 2, 3, .* are not a rotation"):
        read_pose_log(PoseColumns(trial, stream="slave left"))


def test_other_text_is_no_kinematics(tmp_path):
    for name, text in (("a.txt", "t_s x y\n1 2 3\n"), ("b.txt", "1 2 3\n"), ("c.csv", "1 " * 76), ("d.txt", "")):
        (tmp_path / name).write_text(text)
        known = format_of(tmp_path / name)
        assert known is None or known.format != "JIGSAWS kinematics"
