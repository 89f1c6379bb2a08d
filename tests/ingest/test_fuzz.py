"""Whatever is done to a recording's files, they are read with a note or refused in one line naming the file."""

from __future__ import annotations

import numpy as np
import pytest
from damaged_files import refusals

from neeco.base.errors import NeecoError
from neeco.ingest.calibration.lens import read_lens
from neeco.ingest.readers.interpolate import poses_at, readings_at
from neeco.ingest.readers.logs import read_pose_log, read_reading_log
from neeco.ingest.readers.sections import JointColumns, PoseColumns
from neeco.ingest.readers.video import open_video
from neeco.ingest.recording.model import read_recording
from neeco.ingest.recording.template import write_template

POSES, COUNTS, TABLE = "instrument.csv", "jaw.csv", "table.csv"
CELLS = ["", "nan", "inf", "-inf", "1e300", "1e19", "0", "-1", "x", "1,5", '"', "1e400", "\u00e9", "=1+1", "0x1F"]
NAMES = ["", "t", "time", "t_ns", "x_m", "qx", "x_mm", "Frame", "State", "q0", "roll", "t_s#2", "\u00b5", "12"]
YAML = [
    "", "null", "[]", "{}", "3", "-1", ".nan", ".inf", "1e999", "'x'", "[1, 2]", "{a: 1}", "*a", "!!python/none", "@",
    "yes", "2020-13-45", "video.mp4", "..", "/", "'\\0'", '"\\0"', "[[1]]", "10" * 30, "&a [*a]",
]  # fmt: skip


def cut(lines, pick):
    start = int(pick.integers(1, len(lines)))
    return lines[:start] + lines[start + int(pick.integers(0, len(lines))) :]


def shuffle(lines, pick):
    return [lines[0], *[lines[i] for i in pick.permutation(np.arange(1, len(lines)))]]


def drop_column(lines, pick):
    column = int(pick.integers(0, lines[0].count(",") + 1))
    return [",".join(cell for i, cell in enumerate(line.split(",")) if i != column) for line in lines]


def rename(lines, pick):
    names = lines[0].split(",")
    names[int(pick.integers(0, len(names)))] = str(pick.choice(NAMES))
    return [",".join(names), *lines[1:]]


def change_cells(lines, pick):
    lines = list(lines)
    for row in pick.integers(1, len(lines), int(pick.choice([1, 5, 60]))):
        cells = lines[row].split(",")
        cells[int(pick.integers(0, len(cells)))] = str(pick.choice(CELLS))
        lines[row] = ",".join(cells)
    return lines


def scale(lines, pick):
    column, factor = int(pick.integers(0, lines[0].count(",") + 1)), float(pick.choice([1e-9, -1, 1e3, 1e9, 0, 1e25]))
    rows = [line.split(",") for line in lines[1:]]
    for row in rows:
        row[column] = repr(float(row[column]) * factor)
    return [lines[0], *[",".join(row) for row in rows]]


CHANGES = [
    cut,
    shuffle,
    drop_column,
    rename,
    change_cells,
    scale,
    lambda lines, pick: lines + lines[1 : int(pick.integers(2, len(lines)))],  # rows twice
    lambda lines, pick: lines[1:],
    lambda lines, pick: lines[:1],
]


@pytest.fixture
def folder(world):
    rows = world.rows()[:80]
    world.write("t_s,x_mm,y_mm,z_mm,qw,qx,qy,qz", rows, POSES)
    world.write("t_s,hall_raw", np.column_stack([rows[:, 0], 1000 + 100 * world.jaw(rows[:, 0])]), COUNTS)
    world.write("hall_raw,angle_rad", [[1000, 0.0], [1050, 0.4], [1080, 0.9], [1120, 1.2]], TABLE)
    return world.folder


def refused(read, *names):
    """The message of the NeecoError that `read` raises (None when it raises none), which is one line naming a file."""
    try:
        read()
    except NeecoError as error:
        message = str(error)
        message.encode("utf-8")
        assert len(message.splitlines()) == 1
        assert any(name in message for name in names)
        assert ";" in message or "?" in message or "expected" in message or "no such file" in message
        return message
    return None


def read_logs(folder):
    with np.errstate(all="raise", under="ignore"):
        poses = read_pose_log(PoseColumns(folder / POSES))
        readings = read_reading_log(JointColumns(folder / COUNTS, "jaw", calibration=folder / TABLE))
    assert (np.diff(poses.times) > 0).all()
    assert (np.diff(readings.times) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(poses.quats, axis=1), 1, atol=1e-9)
    matrices, valid = poses_at(poses, np.linspace(poses.times[0], poses.times[-1], 9), 0.1)
    assert (np.isfinite(matrices).all(axis=(1, 2)) == valid).all()
    values, valid = readings_at(readings, np.linspace(readings.times[0], readings.times[-1], 9), 0.1)
    assert (np.isfinite(values) == valid).all()
    assert all("\n" not in note for note in (*poses.notes, *readings.notes))


@pytest.mark.parametrize("seed", range(45))
def test_no_table_makes_reading_raise(folder, seed):
    pick = np.random.default_rng(seed)
    for _ in range(int(pick.integers(1, 4))):
        path = folder / str(pick.choice([POSES, COUNTS, TABLE]))
        lines = path.read_text(encoding="utf-8").splitlines()
        try:
            changed = CHANGES[int(pick.integers(len(CHANGES)))](lines, pick)
        except ValueError:  # a change that does not apply to what another one left
            continue
        path.write_text("\n".join(changed) + "\n", encoding="utf-8")
    refused(lambda: read_logs(folder), POSES, COUNTS, TABLE)


def test_no_bytes_of_tables_make_reading_raise(folder):
    refusals([folder / name for name in (POSES, COUNTS, TABLE)], [lambda: read_logs(folder)], 40)


def test_no_bytes_of_a_film_make_reading_raise(world):
    path = world.video("damaged.mp4", frames=12)

    def read():
        video = open_video(path)
        assert len(list(video.read(range(len(video.times))))) == len(video.times)

    refusals([path], [read], 40)


@pytest.mark.parametrize("seed", range(60))
def test_no_recording_makes_reading_raise(folder, seed):
    (folder / "video.mp4").write_bytes(b"film")
    lines = write_template(folder).splitlines()
    lines = [line for line in lines if line.strip() and not line.startswith("#")]
    pick = np.random.default_rng(seed)
    for _ in range(int(pick.integers(1, 4))):
        row = int(pick.integers(0, len(lines)))
        key, colon, _ = lines[row].partition(":")
        match int(pick.integers(0, 4)):
            case 0:
                del lines[row]
            case 1:
                lines[row] = key[1:] + lines[row][len(key) :]
            case 2:
                lines.insert(row, lines[int(pick.integers(0, len(lines)))])
            case _:
                lines[row] = f"{key}{colon} {pick.choice(YAML)}"
        if not lines:
            break
    (folder / "recording.yaml").write_text("\n".join(lines), encoding="utf-8")
    refused(lambda: read_recording(folder / "recording.yaml"), "recording.yaml")
    (folder / "lens.yaml").write_text("\n".join(lines).replace("video", "camera_matrix"), encoding="utf-8")
    assert refused(lambda: read_lens(folder / "lens.yaml"), "lens.yaml")
