"""Joint sensors' calibration tables: from counts to angles, by a monotone curve through the measured points."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import PchipInterpolator

from neeco.errors import NeecoError
from neeco.ingest.tables import Table, count_rows, listed, numbers, read_table
from neeco.ingest.units import ANGLES, split_unit

CLAMPED = 0.05  # of the table's range: readings that far outside it count as its end


@dataclass(frozen=True)
class Calibration:
    """counts [K] increasing, angles [K] rad, increasing or decreasing; between them PCHIP (Fritsch & Carlson 1980)."""

    path: Path
    counts: np.ndarray
    angles: np.ndarray

    def angle(self, counts: np.ndarray) -> np.ndarray:
        """Angles [N] rad at counts [N] within the table."""
        return PchipInterpolator(self.counts, self.angles)(counts)


def read_calibration(path: Path, angle_unit: str | None = None) -> Calibration:
    """Read a table of two columns, counts and angle. The angle is the column with an angle's unit in its name, else
    the second; its unit comes from there or from `angle_unit`. Raises NeecoError naming file, row and remedy."""
    table = read_table(path)
    names = [name for name in table.header if name]
    angle_names = [name for name in names if split_unit(name, "angle")[1] or split_unit(name, "angle")[0] == "angle"]
    if len(names) < 2 or (len(names) > 2 and len(angle_names) != 1):
        raise NeecoError(f"{path}: header: expected two columns, counts and angle_rad (or angle_deg); repair the table")
    angle_name = angle_names[0] if len(angle_names) == 1 else names[1]
    count_name = next(name for name in names if name != angle_name)
    unit = split_unit(angle_name, "angle")[1] or angle_unit
    if unit is None:
        raise NeecoError(
            f"{path}: column {angle_name}: radians or degrees? Name it {angle_name}_rad or {angle_name}_deg"
        )
    values, missing, bad = numbers(table, (count_name, angle_name))
    wrong = [*bad, *((int(row), "has an empty cell") for row in np.flatnonzero(missing))]
    if wrong:
        row, what = min(wrong)
        raise NeecoError(f"{path}: line {table.lines[row]}: {what}; repair or remove the line")
    order = np.argsort(values[:, 0], kind="stable")
    counts, angles, lines = values[order, 0], values[order, 1] * ANGLES[unit], table.lines[order]
    if len(counts) < 2:
        raise NeecoError(f"{path}: has one point; a calibration table needs two or more")
    _check_monotone(Path(path), counts, angles, lines)
    if np.abs(angles).max() > 4 * np.pi:
        raise NeecoError(f"{path}: {angle_name}: goes beyond two turns; correct the column's unit")
    return Calibration(Path(path), counts, angles)


def apply_calibration(
    calibration: Calibration, table: Table, name: str, counts: np.ndarray, keep: np.ndarray
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Angles [R] rad of counts [R]; bool [R] rows too far outside the table to be used; notes.

    Readings outside by less than 5% of the table's range are read as its end.
    """
    low, high = calibration.counts[0], calibration.counts[-1]
    safe = np.where(keep, counts, low)
    excess = np.maximum(low - safe, safe - high)
    outside = excess > CLAMPED * (high - low)
    angles = calibration.angle(np.clip(safe, low, high))
    clamped = (excess > 0) & ~outside
    notes: tuple[str, ...] = ()
    if clamped.any():
        notes = (
            f"{table.path.name}: {count_rows(int(clamped.sum()))} with {name} just outside the table "
            f"{calibration.path.name} ({low:g} to {high:g}, by at most {excess[clamped].max():g}): "
            f"read as its end ({listed(table.lines[clamped])})",
        )
    return angles, outside, notes


def _check_monotone(path: Path, counts: np.ndarray, angles: np.ndarray, lines: np.ndarray) -> None:
    double = np.flatnonzero(np.diff(counts) <= 0)
    if len(double):
        raise NeecoError(
            f"{path}: lines {lines[double[0]]} and {lines[double[0] + 1]}: the same count {counts[double[0]]:g} twice; "
            "keep one of them"
        )
    steps = np.diff(angles) * np.sign(angles[-1] - angles[0])
    wrong = np.flatnonzero(steps <= 0)
    if len(wrong):
        raise NeecoError(
            f"{path}: lines {lines[wrong[0]]} and {lines[wrong[0] + 1]}: the angle does not go on rising (or falling) "
            "with the counts, so a count has no one angle; measure these points again"
        )
