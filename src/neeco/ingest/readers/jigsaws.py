"""Kinematics of JIGSAWS: text of 76 columns without a header, one row per image of its 30 Hz video.

Masters and slaves, each left and right, have 19 columns: the tool tip's place (m), its rotation matrix row by row,
velocity, angular velocity, and the gripper's angle (rad). Every arm is in the frame of its own base, so two arms do not
share one.

The layout is that of the data set's readme (Gao et al. 2014, "The JHU-ISI Gesture and Skill Assessment Working Set").
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from neeco.errors import NeecoError
from neeco.files import read_bytes
from neeco.ingest.readers import POSES, RecordingFormat, Stream, Table, choose_stream
from neeco.ingest.readers.columns import BASE, VIDEO_CLOCK
from neeco.ingest.readers.frame_names import NamedFrame
from neeco.placeholders import read_head

ARMS = ("master left", "master right", "slave left", "slave right")  # in the order of their columns
COLUMNS = 19  # of an arm
RATE_HZ = 30.0
MAX_BYTES = 2**28
GRIPPER = "gripper_angle_rad"
HEADER = ("t_s", "x_m", "y_m", "z_m", *(f"r{row}{column}" for row in range(3) for column in range(3)), GRIPPER)
USED = (*range(12), 18)  # of an arm's columns; its velocities follow from them


class JigsawsKinematics(RecordingFormat):
    """A stream is an arm; those at the patient are the slaves."""

    format = "JIGSAWS kinematics"
    holds = "poses and gripper angles of the arms: text of 76 columns without a header"

    def claims(self, path: Path) -> bool:
        return path.suffix.lower() == ".txt" and _row(read_head(path, 4096).partition(b"\n")[0]) is not None

    def streams(self, path: Path) -> tuple[Stream, ...]:
        count = len(_numbers(path))
        hints = ("poses are stated in the frame of this arm's own base",)
        return tuple(
            Stream(
                arm, POSES, "tool tip in the arm's base", count, RATE_HZ, offered=arm.startswith("slave"),
                body=arm.replace(" ", "_"), joints=(("gripper_angle", GRIPPER),), hints=hints, clock=VIDEO_CLOCK,
            )
            for arm in ARMS
        )  # fmt: skip

    def read(self, path: Path, stream: str | None = None) -> Table:
        arm = choose_stream(path, self.streams(path), stream, (POSES,)).name
        values = _numbers(path)
        first = COLUMNS * ARMS.index(arm)
        rows = np.column_stack([np.arange(len(values)) / RATE_HZ, values[:, [first + index for index in USED]]])
        lines = np.arange(1, len(rows) + 1)
        return Table(path, HEADER, rows, lines, stream=arm, meaning=NamedFrame(BASE), image_hz=RATE_HZ)


def _numbers(path: Path) -> np.ndarray:
    """float64 [R, 76]. Raises NeecoError naming the line that has not as many numbers."""
    if path.is_file() and path.stat().st_size > MAX_BYTES:
        raise NeecoError(f"{path}: has over {MAX_BYTES >> 20} MiB; cut it into trials")
    lines = read_bytes(path, "kinematics of 76 columns").splitlines()
    while lines and not lines[-1].strip():
        lines.pop()
    rows = [_row(line) for line in lines]
    bad = next((number for number, row in enumerate(rows, 1) if row is None), None)
    if bad is not None:
        raise NeecoError(f"{path}: line {bad}: has not {COLUMNS * len(ARMS)} numbers; repair it, or cut the file there")
    return np.array(rows, dtype=np.float64)


def _row(line: bytes) -> list[float] | None:
    """The 76 numbers of a line; None where it has others."""
    cells = line.split()
    if len(cells) != COLUMNS * len(ARMS) or b"_" in line:  # Python would read 1_000
        return None
    try:
        return [float(cell) for cell in cells]
    except ValueError:
        return None
