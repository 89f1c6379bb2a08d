"""Kinematics of JIGSAWS: text of 76 columns without a header, one row per image of its 30 Hz video.

Masters and slaves, each left and right, have 19 columns: the tool tip's position (m), its rotation matrix row by row,
velocity, angular velocity, and the gripper's angle (rad). Every arm is expressed in the frame of its own base; the arms
do not share a frame.

The layout is that of the data set's readme (Gao et al. 2014, "The JHU-ISI Gesture and Skill Assessment Working Set").
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from neeco.base.errors import NeecoError
from neeco.base.placeholders import read_head
from neeco.ingest.readers import Kind, RecordingFormat, Stream, Table, read_once, to_numbers
from neeco.ingest.readers.delimited import read_cells
from neeco.ingest.readers.names import BASE, VIDEO_CLOCK, NamedFrame

ARMS = ("master left", "master right", "slave left", "slave right")  # in the order of their columns
COLUMNS = 19  # of an arm
RATE_HZ = 30.0
GRIPPER = "gripper_angle_rad"
HEADER = ("t_s", "x_m", "y_m", "z_m", *(f"r{row}{column}" for row in range(3) for column in range(3)), GRIPPER)
USED = (*range(12), 18)  # of an arm's columns; its velocities follow from them


class JigsawsKinematics(RecordingFormat):
    """A stream is an arm; the slaves are the patient-side arms."""

    format = "JIGSAWS kinematics"
    holds = "poses and gripper angles of the arms: text of 76 columns without a header"

    def claims(self, path: Path) -> bool:
        first = read_head(path, 4096).partition(b"\n")[0].decode("utf-8", "replace").split()
        is_long = path.suffix.lower() == ".txt" and len(first) == COLUMNS * len(ARMS)
        return is_long and bool(np.isfinite(to_numbers(np.array(first, object))).all())

    def streams(self, path: Path) -> tuple[Stream, ...]:
        count = len(_lines(path)[0])
        return tuple(
            Stream(
                arm,
                Kind.POSES,
                "tool tip in the arm's base",
                count,
                RATE_HZ,
                offered=arm.startswith("slave"),
                body=arm.replace(" ", "_"),
                joints=(("gripper_angle", GRIPPER),),
                clock=VIDEO_CLOCK,
                hints=("poses are expressed in the frame of this arm's own base",),
            )
            for arm in ARMS
        )

    def read(self, path: Path, stream: str | None = None) -> Table:
        arm = self.choose(path, stream, Kind.POSES).name
        values, lines = _lines(path)
        bad = np.isnan(values).any(axis=1)
        if bad.any():
            problem = f"expected {COLUMNS * len(ARMS)} numbers"
            raise NeecoError(f"{path}: line {lines[bad][0]}: {problem}; repair the line, or truncate the file there")
        used = [COLUMNS * ARMS.index(arm) + index for index in USED]
        rows = np.column_stack([np.arange(len(values)) / RATE_HZ, values[:, used]])
        return Table(path, HEADER, rows, lines, stream=arm, meaning=NamedFrame(BASE), image_hz=RATE_HZ)


@read_once
def _lines(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return numbers [R, 76], NaN in lines with another number of cells, and their line numbers [R]."""
    text, count = read_cells(path), COLUMNS * len(ARMS)
    values = np.full((len(text.lines), count), np.nan)
    whole = text.counts == count
    values[whole] = to_numbers(text.cells[whole, :count]) if whole.any() else np.nan
    return values, text.lines
