"""Logs of trackers and joint sensors: read, converted to mm, rad, s and quaternions, put in order.

Excluded rows are noted with their number and lines. What suggests a mistake in the recording (units, columns, most rows
unusable) raises NeecoError.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError, counted
from neeco.geometry.conventions import OPENCV
from neeco.geometry.rotations import rotation_error
from neeco.ingest.readers import Table, column_index, numbers, read_table, to_numbers
from neeco.ingest.readers import names as named
from neeco.ingest.readers.rows import Rows, drop_stuck, find_gaps, in_order, keep_measured, read_cells, read_times
from neeco.ingest.readers.sections import JointColumns, PoseColumns

_FORMS = ", ".join(f"{form} (with euler_convention)" if form == named.EULER else form for form in named.FORMS)
_FRAME_COLUMN = re.compile(r"(?!.*child)(.*[._/])?(reference[._ ]?)?frame([._ ]?id)?")


@dataclass(frozen=True, kw_only=True)
class LogSettings:
    """Limits on the numbers of a log."""

    max_distance_mm: float = 20_000.0  # limit on the distance in mm, beyond any tracker's reach: the unit is wrong
    max_angle: float = 4 * np.pi  # limit on an angle in rad: no joint turns farther, so the unit is wrong
    clamped_share: float = 0.05  # share of a calibration table's range: readings that far outside it count as its end
    norm_tolerance: float = 0.02  # tolerance of a quaternion's length: numbers of two decimals pass
    rounded_tolerance: float = 0.02  # tolerance of R^T R - I: loggers round to two decimals


SETTINGS = LogSettings()


@dataclass(frozen=True, eq=False)  # compared and cached by identity: it holds arrays
class SampleLog:
    """Samples over time, on the log's own clock: t_log = t_video + offset. times [T] s, increasing; gaps: (last time
    before, first time after) where samples are missing; notes: dropped and repaired rows, as text; image_hz: as in
    `Table`."""

    path: Path
    clock: str
    times: np.ndarray
    _: KW_ONLY
    gaps: tuple[tuple[float, float], ...] = ()
    notes: tuple[str, ...] = ()
    image_hz: float | None = None


@dataclass(frozen=True, eq=False)
class PoseLog(SampleLog):
    """Poses tracker_from_sensor: positions [T, 3] mm; quats [T, 4] wxyz, unit, sign-continuous; frame: CAMERA (OpenCV's
    axes) or BASE; stated_in: the file's name of the frame, None if it names none or the recording does."""

    positions: np.ndarray
    quats: np.ndarray
    _: KW_ONLY
    frame: str = named.BASE
    stated_in: str | None = None


@dataclass(frozen=True, eq=False)
class ReadingLog(SampleLog):
    """Readings of a joint: values [T] rad."""

    values: np.ndarray


def read_pose_log(source: PoseColumns) -> PoseLog:
    """Read a tracker's log. Raises NeecoError naming file, row or column, and remedy."""
    table = read_table(source.file, source.stream)
    names, (rotation, _) = source.columns, source.columns.rotation
    stated = _stated_columns(table, time=names.time, position=names.position, rotation=rotation)
    recognised = named.recognise_pose(table.header, stated)
    table = with_named_frame(table, (*(names.position or recognised.position or ()), *(rotation or ())))
    frame = source.frame or table.frame or named.BASE
    if source.frame is None and table.meaning is not None and table.frame is None:
        raise NeecoError(f"{table.where}: frame: {table.meaning.question}")
    axes = named.CAMERA_FRAMES.get(table.frame or "")
    if source.frame == named.CAMERA and axes is not None and axes.words != OPENCV.words:
        raise NeecoError(
            f"{table.where}: frame: {named.CAMERA} means OpenCV's axes ({OPENCV.words}), but the file's frame is "
            f"{table.stated_in or axes.name} with axes {axes.words}; remove `frame` (or set frame: "
            f"{axes.name}), or set frame: {OPENCV.name} if the poses are already converted"
        )
    rows = Rows(table)
    keep_measured(rows, source, recognised.state)
    times = read_times(rows, source, recognised)
    positions, quats = _poses(rows, source, recognised)
    drop_stuck(rows, times, np.column_stack([positions, quats]))
    times, order = in_order(rows, times, source.rate_hz)
    if np.ptp(quats[order], axis=0).max() == 0 and np.ptp(positions[order], axis=0).max() > 0:
        rows.repairs.append("its rotation is constant: the log may contain positions only")
    quats, flips = continuous(quats[order])
    if flips:
        rows.repairs.append(f"{counted(flips, 'sign flip')} of the quaternion corrected")
    gaps = find_gaps(rows, times)
    if frame != named.BASE and source.frame is None and table.meaning is not None:
        rows.repairs.append(f"poses are expressed in {table.meaning.why}")
    positions = positions[order]
    turn = named.CAMERA_FRAMES[frame].opencv_from_own[:3, :3] if frame != named.BASE else np.eye(3)
    if not np.array_equal(turn, np.eye(3)):  # from the camera's own axes to OpenCV's
        turned = Rotation.from_matrix(turn) * Rotation.from_quat(quats, scalar_first=True)
        positions, quats = positions @ turn.T, continuous(turned.as_quat(scalar_first=True))[0]
    return PoseLog(
        table.path,
        source.clock,
        times,
        positions,
        quats,
        gaps=gaps,
        notes=rows.notes(),
        image_hz=table.image_hz,
        frame=named.BASE if frame == named.BASE else named.CAMERA,
        stated_in=table.stated_in if source.frame is None else None,
    )


def with_named_frame(table: Table, columns: Sequence[str]) -> Table:
    """Return the table with the meaning of its poses' frame: by the column names, else by the file, else by a column of
    frame names, else by the file's name. Raises NeecoError if that column holds several."""
    dvrk = named.of_dvrk(table.path.stem, *columns)
    meaning = named.meaning_in(columns, dvrk=dvrk)
    if meaning is None and (table.meaning is not None or table.stream is not None):
        return table
    for index, name in enumerate(table.header if meaning is None and table.rows.dtype == object else ()):
        if not _FRAME_COLUMN.fullmatch(name.strip().lower()):
            continue
        names = sorted({cell.strip("/\"' ") for cell in table.rows[:, index]} - {""})
        if len(names) > 1 and any(named.meaning_of(cell).frame != named.BASE for cell in names):
            listed = ", ".join(names[:4])
            raise NeecoError(f"{table.where}: {name}: poses are in several frames ({listed}); export one only")
        if len(names) == 1 and np.isnan(to_numbers(np.array(names, object))[0]):  # else it numbers or names images
            return replace(table, stated_in=names[0], meaning=named.meaning_of(names[0], dvrk=dvrk))
    return replace(table, meaning=meaning or named.meaning_in([table.path.stem], dvrk=dvrk))


def read_reading_log(source: JointColumns) -> ReadingLog:
    """Read a joint sensor's log, through its calibration table when there is one. Raises NeecoError naming file,
    row or column, and remedy."""
    table = read_table(source.file, source.stream)
    stated = _stated_columns(table, time=source.columns.time, value=source.columns.value)
    recognised, when = named.recognise_value(table.header, stated)
    (value,) = source.columns.value or (recognised,)
    if value is None:
        raise NeecoError(f"{source.file}: header: the joint's column is ambiguous; name it as columns.value")
    rows = Rows(table)
    times = read_times(rows, source, when)
    values = read_cells(rows, (value,))[:, 0]
    if source.calibration is not None:
        # monotone interpolation of the table (PCHIP, Fritsch & Carlson 1980): readings just outside it become its end
        counts, angles = read_calibration(source.calibration, source.units.angle)
        low, high = counts[0], counts[-1]
        title = source.calibration.name
        values = np.where(rows.keep, values, low)
        excess = np.maximum(low - values, values - high)
        outside = excess > SETTINGS.clamped_share * (high - low)
        if (clamped := (excess > 0) & ~outside).any():
            by = f"{low:g} to {high:g}, by at most {excess[clamped].max():g}"
            words = f"{counted(int(clamped.sum()), 'row')} with {value} just outside the table {title} ({by})"
            rows.repairs.append(f"{words}: clamped to its end ({table.list_rows(table.lines[clamped])})")
        values = np.asarray(PchipInterpolator(counts, angles)(np.clip(values, low, high)))
        reason = f"{value} is far outside the calibration table {title}"
        rows.drop_wrong(outside, reason + "; extend the table, or name the right column")
    else:
        hint = " (counts need a table as `calibration`)"
        values = values * named.scale_of(table.where, (value,), "angle", source.units.angle, None, hint)
        impossible = np.abs(np.where(rows.keep, values, 0)) > SETTINGS.max_angle
        reason = f"{value} is more than two turns; give the right unit, or a calibration table if these are counts"
        rows.drop_wrong(impossible, reason)
    times, order = in_order(rows, times, source.rate_hz)
    gaps, image_hz = find_gaps(rows, times), table.image_hz
    return ReadingLog(table.path, source.clock, times, values[order], gaps=gaps, notes=rows.notes(), image_hz=image_hz)


def _stated_columns(table: Table, **columns: tuple[str, ...] | None) -> dict[str, tuple[str, ...]]:
    """Return the columns that a recording names, by meaning, as spelled in the file. Raises NeecoError for a missing
    column, or one with two meanings."""
    stated = {
        meaning: tuple(table.header[column_index(table, name)] for name in names)
        for meaning, names in columns.items()
        if names is not None
    }
    names = [name for group in stated.values() for name in group]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise NeecoError(f"{table.where}: columns: {twice} is named for two quantities; name a column for each")
    return stated


def _poses(rows: Rows, source: PoseColumns, recognised: named.RecognisedColumns) -> tuple[np.ndarray, np.ndarray]:
    """Return positions [R, 3] mm and unit quaternions wxyz [R, 4]; rows without either are dropped."""
    table = rows.table
    rotation, form = source.columns.rotation
    if rotation is None:
        rotation, form = recognised.rotation, recognised.form
    if rotation is None or form is None:
        raise _unclear(table, recognised, "rotation", "qw, qx, qy, qz columns")
    position = source.columns.position or recognised.position
    if form == named.MATRIX:
        position, read = tuple(rotation[i] for i in (3, 7, 11)), rotation
    elif position is None:
        raise _unclear(table, recognised, "position", "x, y, z columns")
    else:
        read = (*position, *rotation)
    readings = (recognised, named.recognise_pose(table.header), named.recognise_pose((*position, *rotation)))
    implied = next((kind.length_unit for kind in readings if kind.position == position), None)
    scale = named.scale_of(table.where, position, "length", source.units.length, implied, "")
    angle = 1.0
    if form in (named.EULER, named.ROTATION_VECTOR):
        angle = named.scale_of(table.where, rotation, "angle", source.units.angle, None, "")
    cells = read_cells(rows, read)
    positions, turns = cells[:, :3] * scale, cells[:, 3:]
    if form == named.MATRIX:
        top = cells[:, :12].reshape(-1, 3, 4)
        positions, turns = top[:, :, 3] * scale, top[:, :, :3].reshape(-1, 9)
        last, column = cells[:, 12:], cells[:, 3::4][:, :3]
        if cells.shape[1] == 16 and np.nanmedian(np.abs(last[:, :3])) > 1e-6 and np.nanmax(np.abs(column)) < 1e-9:
            raise NeecoError(f"{table.where}: matrix: is in column-major order; list its columns row by row")
    if form not in (named.EULER, named.ROTATION_VECTOR):  # trackers write zeros where they have no rotation
        rows.drop((turns == 0).all(axis=1), "the rotation is all zeros (no measurement)")
    # unit quaternions; rows that are not rotations are NaN, while scipy would accept any numbers
    quats, good = np.full((len(turns), 4), np.nan), np.isfinite(turns).all(axis=1)
    if form in (named.QUATERNION_WXYZ, named.QUATERNION_XYZW):
        good &= np.abs(np.linalg.norm(turns, axis=1) - 1) <= SETTINGS.norm_tolerance
        rotations = Rotation.from_quat(turns[good], scalar_first=form == named.QUATERNION_WXYZ)
    elif form in (named.EULER, named.ROTATION_VECTOR):
        good &= (np.abs(turns * angle) < 1e4).all(axis=1)  # larger values are not angles, or their sine is noise
        angles, convention = turns[good] * angle, source.columns.euler_convention or ""
        is_euler = form == named.EULER
        rotations = Rotation.from_euler(convention, angles) if is_euler else Rotation.from_rotvec(angles)
    else:
        matrices = np.where(good[:, None], turns, 0).reshape(-1, 3, 3)
        with np.errstate(all="ignore"):
            good &= (rotation_error(matrices) <= SETTINGS.rounded_tolerance) & (np.linalg.det(matrices) > 0)
        rotations = Rotation.from_matrix(matrices[good])
    quats[good] = rotations.as_quat(scalar_first=True)
    expected = "a unit quaternion" if form.startswith("quaternion") else "a rotation"
    rows.drop_wrong(~good, f"{rotation[0]} ... {rotation[-1]} are not {expected}; name the right columns")
    distance = np.median(np.linalg.norm(positions[rows.keep], axis=1)) if rows.keep.any() else 0.0
    if distance > SETTINGS.max_distance_mm:
        raise NeecoError(
            f"{table.where}: {', '.join(position)}: half the samples are over {distance / 1000:.3g} m from the tracker"
            "; correct the unit in the header or in units.length"
        )
    return positions, quats


def continuous(quats: np.ndarray) -> tuple[np.ndarray, int]:
    """Return quaternions [T, 4] with continuous signs, and the number of sign flips removed."""
    flips = np.concatenate([[False], (quats[1:] * quats[:-1]).sum(axis=1) < 0])
    signs = np.where(np.cumsum(flips) % 2, -1.0, 1.0)
    return quats * signs[:, None], int(flips.sum())


def _unclear(table: Table, recognised: named.RecognisedColumns, what: str, expected: str) -> NeecoError:
    reason = recognised.unclear.get(what) or (recognised.unclear.get("quaternion") if what == "rotation" else None)
    names = "position" if what == "position" else _FORMS
    listed = repr(", ".join(table.header[:12])[:120])
    problem = f"no {expected} found among {listed}; name them in the recording under columns: {names}"
    return NeecoError(f"{table.where}: header: {f'{what}: {reason}' if reason else problem}")


def read_calibration(path: Path, angle_unit: str | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Read a joint sensor's calibration table: counts [K] increasing, angles [K] rad, increasing or decreasing.

    It has two columns; the angle is the one with an angle's unit in its name, else the second. The unit comes from
    there or from `angle_unit`. Raises NeecoError naming file, row and remedy.
    """
    table = read_table(path)
    names = [name for name in table.header if name]
    split = [(name, *named.split_unit(name, "angle")) for name in names]
    angle_names = [name for name, word, unit in split if unit or word == "angle"]
    if len(names) < 2 or (len(names) > 2 and len(angle_names) != 1):
        raise NeecoError(f"{path}: header: expected two columns, counts and angle_rad (or angle_deg); repair the table")
    angle_name = angle_names[0] if len(angle_names) == 1 else names[1]
    count_name = next(name for name in names if name != angle_name)
    unit = named.split_unit(angle_name, "angle")[1] or angle_unit
    if unit is None:
        raise NeecoError(f"{path}: {angle_name}: unknown unit; rename it to {angle_name}_rad or {angle_name}_deg")
    values = numbers(table, (count_name, angle_name))
    if np.isnan(values).any():
        row, slot = np.argwhere(np.isnan(values))[0].tolist()
        problem = f"{(count_name, angle_name)[slot]}: a number is missing"
        raise NeecoError(f"{path}: line {table.lines[row]}: {problem}; repair or remove the line")
    order = np.argsort(values[:, 0], kind="stable")
    counts, angles, lines = values[order, 0], values[order, 1] * named.UNITS["angle"][unit], table.lines[order]
    turning = (np.diff(counts) <= 0) | (np.diff(angles) * np.sign(angles[-1] - angles[0]) <= 0)
    if len(counts) < 2 or turning.any():
        place = (
            f"lines {' and '.join(map(str, lines[int(turning.argmax()) :][:2]))}" if len(counts) > 1 else "one point"
        )
        raise NeecoError(
            f"{path}: {place}: expected at least two points, whose angles are monotonic in the counts; measure again"
        )
    if np.abs(angles).max() > SETTINGS.max_angle:
        raise NeecoError(f"{path}: {angle_name}: exceeds two turns; correct the column's unit")
    return counts, angles
