"""Logs of trackers and joint sensors: read, put in order, and told what was wrong with them.

Whatever is left out is noted with how many rows and which; what cannot be told apart from a mistake in the recording
(units, columns, most of the rows bad) is refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from neeco.errors import NeecoError
from neeco.ingest import columns as named
from neeco.ingest.calibration import apply_calibration, read_calibration
from neeco.ingest.columns import (
    FORMS,
    JointColumns,
    PoseColumns,
    Recognised,
    recognise_pose,
    recognise_time,
    recognise_value,
)
from neeco.ingest.rotations import continuous, to_quaternions
from neeco.ingest.tables import Rows, Table, column_index, count_rows, listed, numbers, read_table
from neeco.ingest.units import scale_of

FEWEST = 4  # samples of a usable log
STATES_TOLD = 8  # of those that drop rows
GAP_STEPS, GAP_SECONDS = 4.0, 0.15  # a step in time longer than both is a gap
FARTHEST_MM = 20_000.0  # no tracker of instruments sees that far: the unit is wrong


@dataclass(frozen=True, eq=False)  # compared and remembered by identity: it holds arrays
class PoseLog:
    """Poses tracker_from_sensor over time, on the log's own clock: t_log = t_video + offset.

    times [T] s, increasing; positions [T, 3] mm; quats [T, 4] wxyz, unit, sign-continuous; gaps: (last time before,
    first time after) where samples are missing; notes: what was dropped or mended, in words.
    """

    path: Path
    clock: str
    times: np.ndarray
    positions: np.ndarray
    quats: np.ndarray
    gaps: tuple[tuple[float, float], ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)  # compared and remembered by identity: it holds arrays
class ReadingLog:
    """Readings of a joint, rad, over time; fields as in PoseLog."""

    path: Path
    clock: str
    times: np.ndarray
    values: np.ndarray
    gaps: tuple[tuple[float, float], ...] = ()
    notes: tuple[str, ...] = ()


def read_pose_log(source: PoseColumns) -> PoseLog:
    """Read a tracker's log. Raises NeecoError naming file, row or column, and remedy."""
    table = read_table(source.path)
    found = recognise_pose(table.header)
    rows = Rows(table)
    _keep_measured(rows, source, found.state)
    times = _times(rows, source, found)
    positions, quats = _poses(rows, source, found)
    times, order = _in_order(rows, times)
    quats, flips = continuous(quats[order])
    if flips:
        rows.mended.append(f"the quaternion's sign flipped {flips} times; undone")
    gaps = _gaps(times)
    notes = (*rows.notes(), *_gap_notes(table.path, gaps))
    return PoseLog(table.path, source.clock, times, positions[order], quats, gaps, notes)


def read_reading_log(source: JointColumns) -> ReadingLog:
    """Read a joint sensor's log, through its calibration table when there is one. Raises NeecoError naming file,
    row or column, and remedy."""
    table = read_table(source.path)
    value, found = recognise_value(table.header)
    value = source.value or value
    if value is None:
        raise NeecoError(
            f"{table.path}: header: which column is the joint's reading? Name it in the recording: columns.value"
        )
    rows = Rows(table)
    times = _times(rows, source, found)
    values = _cells(rows, (value,))[:, 0]
    notes: tuple[str, ...] = ()
    if source.calibration is not None:
        calibration = read_calibration(source.calibration, source.units.angle)
        values, outside, notes = apply_calibration(calibration, table, value, values, rows.keep)
        reason = f"{value} lies far outside the calibration table {source.calibration.name}"
        rows.drop_wrong(outside, reason + "; extend the table, or name the right column")
    else:
        hint = " Counts need a calibration table, `calibration`."
        values = values * scale_of(str(table.path), (value,), "angle", source.units.angle, None, hint)
        wild = np.abs(np.where(rows.keep, values, 0)) > 4 * np.pi
        reason = f"{value} is more than two turns; give the right unit, or a calibration table if these are counts"
        rows.drop_wrong(wild, reason)
    times, order = _in_order(rows, times)
    gaps = _gaps(times)
    notes = (*rows.notes(), *notes, *_gap_notes(table.path, gaps))
    return ReadingLog(table.path, source.clock, times, values[order], gaps, notes)


def _poses(rows: Rows, source: PoseColumns, found: Recognised) -> tuple[np.ndarray, np.ndarray]:
    """Positions [R, 3] mm and unit quaternions wxyz [R, 4]; rows without either are dropped."""
    table = rows.table
    form, rotation = _rotation_columns(table, source, found)
    position = source.position or found.position
    if form == named.MATRIX:
        position, read = tuple(rotation[i] for i in (3, 7, 11)), rotation
    elif position is None:
        raise NeecoError(f"{table.path}: header: {_unclear(table, found.unclear, 'position', 'x, y, z columns')}")
    else:
        read = (*position, *rotation)
    implied = found.length_unit if position == found.position else None
    scale = scale_of(str(table.path), position, "length", source.units.length, implied, "")
    angle = 1.0
    if form in (named.EULER, named.ROTATION_VECTOR):
        angle = scale_of(str(table.path), rotation, "angle", source.units.angle, None, "")
    positions, turns = _parts(table, form, _cells(rows, read))
    positions = positions * scale
    if form not in (named.EULER, named.ROTATION_VECTOR):  # trackers write zeros where they have no rotation
        rows.drop((turns == 0).all(axis=1), "the rotation is all zeros (no measurement)")
    quats, good = to_quaternions(form, turns, source.euler_convention, angle)
    what = "a unit quaternion" if form.startswith("quaternion") else "a rotation"
    rows.drop_wrong(~good, f"{rotation[0]} ... {rotation[-1]} are not {what}; name the right columns")
    _check_range(table, positions[rows.keep], position)
    return positions, quats


def _keep_measured(rows: Rows, source: PoseColumns, found: str | None) -> None:
    """Drop the rows whose state does not say that they were measured."""
    table, name = rows.table, source.state or found
    if name is None:
        return
    index = column_index(table, name)
    good = {value.lower() for value in source.good}
    states = [cells[index] if index < len(cells) else "" for cells in table.rows]
    by_state: dict[str, list[int]] = {}
    for row, state in enumerate(states):
        if state.lower() not in good:
            by_state.setdefault(state[:20], []).append(row)
    for number, (state, members) in enumerate(by_state.items()):
        if number < STATES_TOLD:
            rows.drop(members, f"{name} is {state or 'empty'!r}")
        rows.keep[members] = False
    if not rows.keep.any():
        raise NeecoError(
            f"{table.path}: {name}: no row is {' or '.join(source.good)} (line {table.lines[0]} has {states[0][:20]!r})"
            "; list the values that mark measured rows in the recording: columns.good"
        )


def _times(rows: Rows, source: PoseColumns | JointColumns, found: Recognised) -> np.ndarray:
    """Times [R] in s; rows without one are dropped."""
    table, names = rows.table, source.time or found.time
    if names is None:
        raise NeecoError(
            f"{table.path}: header: no column of times found; name it in the recording: columns.time (or add t_s)"
        )
    cells = _cells(rows, names)
    known = recognise_time(names)
    if len(names) == 2:
        return cells[:, 0] + cells[:, 1] * 1e-9
    if source.rate_hz is not None:
        return cells[:, 0] / source.rate_hz
    if known.counts_frames:
        raise NeecoError(
            f"{table.path}: {names[0]}: counts frames, and nothing says how many a second; say rate_hz in the "
            "recording (40 for NDI Aurora, 60 for NDI Polaris) or name a column of times"
        )
    steps = np.diff(cells[rows.keep, 0])
    steps = steps[steps > 0]
    hint = ""
    if len(steps):
        rates = {unit: 1 / (np.median(steps) * scale) for unit, scale in (("s", 1), ("ms", 1e-3), ("ns", 1e-9))}
        likely = [f"{unit} would be {rate:.3g} Hz" for unit, rate in rates.items() if 1 <= rate <= 5000]
        hint = f" Its steps in {', '.join(likely)}." if likely else ""
    return cells[:, 0] * scale_of(str(table.path), names, "time", source.units.time, known.time_unit, hint)


def _cells(rows: Rows, names: tuple[str, ...]) -> np.ndarray:
    """Numbers [R, C]; rows with missing or unreadable cells are dropped. Raises NeecoError when those are most."""
    table = rows.table
    values, missing, bad = numbers(table, names)
    rows.drop(missing, f"no value for {', '.join(names)}" if len(names) < 3 else "values are missing")
    bad = [(row, what) for row, what in bad if rows.keep[row]]
    if len(bad) > max(3, 0.5 * rows.keep.sum()):
        alike = f"{len(bad)} of {count_rows(len(table.rows))} like it"
        raise NeecoError(
            f"{table.path}: line {table.lines[bad[0][0]]}: {bad[0][1]} ({alike}); name other columns or repair the file"
        )
    if bad:
        rows.drop([row for row, _ in bad], f"not readable, first: {bad[0][1]}")
    if not rows.keep.any():
        raise NeecoError(
            f"{table.path}: {', '.join(names)}: no row has values; name other columns or another file in the recording"
        )
    return values


def _rotation_columns(table: Table, source: PoseColumns, found: Recognised) -> tuple[str, tuple[str, ...]]:
    """Form and columns of the rotation."""
    rotation, form = (source.rotation, source.form) if source.rotation else (found.rotation, found.form)
    if rotation is None or form is None:
        raise NeecoError(
            f"{table.path}: header: {_unclear(table, found.unclear, 'rotation', 'qw, qx, qy, qz columns')}"
        )
    if len(rotation) not in FORMS[form]:
        raise NeecoError(
            f"{table.path}: {form}: takes {' or '.join(map(str, FORMS[form]))} columns, not {len(rotation)}; "
            "list them all"
        )
    if form == named.EULER and not source.euler_convention:
        raise NeecoError(f"{table.path}: {', '.join(rotation)}: say their euler_convention in the recording (like XYZ)")
    return form, rotation


def _unclear(table: Table, unclear: dict[str, str], what: str, expected: str) -> str:
    reason = unclear.get(what) or (unclear.get("quaternion") if what == "rotation" else None)
    if reason:
        return f"{what}: {reason}"
    names = ", ".join(table.header[:12])
    return f"no {expected} found among {names[:120]!r}; name them in the recording under columns"


def _parts(table: Table, form: str, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions [R, 3] in the file's unit and rotation cells [R, C]."""
    if form != named.MATRIX:
        return cells[:, :3], cells[:, 3:]
    rows = cells[:, :12].reshape(-1, 3, 4)
    if cells.shape[1] == 16:
        last, column = cells[:, 12:], cells.reshape(-1, 4, 4)[:, :3, 3]
        if np.nanmedian(np.abs(last[:, :3])) > 1e-6 and np.nanmax(np.abs(column)) < 1e-9:
            raise NeecoError(
                f"{table.path}: matrix: is written by columns; list its columns in the recording row by row"
            )
    return rows[:, :, 3], rows[:, :, :3].reshape(-1, 9)


def _check_range(table: Table, positions: np.ndarray, names: tuple[str, ...]) -> None:
    """Refuse positions that no tracker of instruments gives, which is how a wrong unit shows."""
    distance = np.median(np.linalg.norm(positions, axis=1)) if len(positions) else 0.0
    if distance > FARTHEST_MM:
        raise NeecoError(
            f"{table.path}: {', '.join(names)}: half the samples are over {distance / 1000:.3g} m from the tracker; "
            "correct the unit in the header or in units.length"
        )


def _in_order(rows: Rows, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Increasing times [T] and which rows [T] they come from. Raises NeecoError when too few are left."""
    table, kept = rows.table, np.flatnonzero(rows.keep)
    order = kept[np.argsort(times[kept], kind="stable")]
    late = kept[1:][times[kept][1:] < np.maximum.accumulate(times[kept])[:-1]]
    doubled = np.concatenate([[False], np.diff(times[order]) <= 0])
    rows.drop(np.sort(order[doubled]), "a second row at one time")
    order = order[~doubled]
    if len(order) < FEWEST:
        why = "; ".join(note.partition(": ")[2] for note in rows.notes()[:2])
        raise NeecoError(
            f"{table.path}: {count_rows(len(order))} of {len(table.rows)} can be used{f' ({why})' if why else ''}; "
            "record again or name the right columns"
        )
    if len(late):
        rows.mended.append(f"{count_rows(len(late))} out of order in time; sorted ({listed(table.lines[late])})")
    return times[order], order


def _gaps(times: np.ndarray) -> tuple[tuple[float, float], ...]:
    """Where samples are missing: steps longer than 4 usual ones and 0.15 s."""
    steps = np.diff(times)
    longest = max(GAP_STEPS * float(np.median(steps)), GAP_SECONDS)
    return tuple((float(times[i]), float(times[i + 1])) for i in np.flatnonzero(steps > longest))


def _gap_notes(path: Path, gaps: tuple[tuple[float, float], ...]) -> tuple[str, ...]:
    if not gaps:
        return ()
    total = sum(end - start for start, end in gaps)
    first = ", ".join(f"{start:.2f}-{end:.2f} s" for start, end in gaps[:3])
    return (f"{path.name}: {len(gaps)} gap{'s' if len(gaps) > 1 else ''}, {total:.2f} s in all ({first}); not bridged",)
