"""The possible meanings of a log of poses whose file leaves them open: orders of a quaternion, conventions of angles
and frames, with measures that distinguish them.

Both orders of a quaternion give the same turn from one frame to the next, but not the same direction of the shaft. It
passes through the trocar all the time: the lines along the right axis pass near one point.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.geometry.lines import distances_to_lines, nearest_point
from neeco.geometry.rotations import rotation_error
from neeco.ingest.readers import POSES, Stream, format_of, numbers, read_table
from neeco.ingest.readers.columns import (
    BASE,
    EULER,
    QUATERNION_WXYZ,
    QUATERNION_XYZW,
    ROTATION_MATRIX,
    ROTATION_VECTOR,
    recognise_pose,
)
from neeco.ingest.readers.frame_names import CAMERA_FRAMES, NamedFrame
from neeco.ingest.readers.logs import in_opencv, to_quaternions, with_named_frame

UNIT_TOLERANCE = 1e-3  # of a quaternion's length, and of R^T R - I: rounding of float32 and text
CONVENTIONS = ("XYZ", "ZYX", "xyz", "zyx")  # of three angles, as scipy names them
ANGLES = (("roll", "pitch", "yaw"), ("rx", "ry", "rz"), ("alpha", "beta", "gamma"))
QUATERNION = "quaternion"  # of either order
AXES = "xyz"


@dataclass(frozen=True)
class Shaft:
    """The point that all lines along one axis of a body pass nearest to. axis: 0 to 2; point [3] and rms distance in
    the log's unit of length."""

    axis: int
    point: np.ndarray
    rms: float


@dataclass(frozen=True)
class Reading:
    """One way to read the rotations. title: as recording.yaml writes it; quats [R, 4] wxyz."""

    title: str
    quats: np.ndarray


@dataclass(frozen=True)
class OpenPoses:
    """Poses whose meaning is left open. times [R] s; positions [R, 3] in the file's unit; frame: assumed, BASE or a
    camera's frame, whose axes are turned to OpenCV's."""

    title: str
    times: np.ndarray
    positions: np.ndarray
    readings: tuple[Reading, ...]
    frame: str


def find_rotations(values: np.ndarray) -> list[tuple[int, str]]:
    """Return (first column, QUATERNION or ROTATION_MATRIX) of rotations among numbers [R, C]: four of unit length, of
    which more than one changes, or nine that are a rotation matrix in every row."""
    values = values.astype(np.float64)
    values = values[np.isfinite(values).all(axis=1)]
    if not len(values):
        return []
    found, place = [], 0
    while place <= values.shape[1] - 4:
        four = values[:, place : place + 4]
        nine = values[:, place : place + 9]
        matrices = nine.reshape(-1, 3, 3) if nine.shape[1] == 9 else np.zeros((1, 3, 3))
        if rotation_error(matrices).max() < UNIT_TOLERANCE and (np.linalg.det(matrices) > 0).all():
            found.append((place, ROTATION_MATRIX))
            place += 9
        elif np.abs(np.linalg.norm(four, axis=1) - 1).max() < UNIT_TOLERANCE and (np.ptp(four, axis=0) > 0).sum() > 1:
            found.append((place, QUATERNION))
            place += 4
        else:
            place += 1
    return found


def open_poses(source: Path) -> list[OpenPoses]:
    """Return the poses of a file that leaves their meaning open, in every possible frame, with every possible reading.
    Raises NeecoError."""
    known = format_of(source)
    streams = () if known is None else known.streams(source)
    return [poses for stream in streams if stream.kind == POSES and stream.asks for poses in _open(source, stream)]


def shaft_of(positions: np.ndarray, quats: np.ndarray) -> Shaft:
    """Return the axis of a body whose lines through positions [R, 3] pass nearest to one point, by least squares."""
    best = None
    for axis in range(3):
        lines = axis_directions(quats, axis)
        point = nearest_point(positions, lines, ridge=1e-9)
        rms = float(np.sqrt((distances_to_lines(point, positions, lines) ** 2).mean()))
        if best is None or rms < best.rms:
            best = Shaft(axis, point, rms)
    assert best is not None
    return best


def axis_directions(quats: np.ndarray, axis: int) -> np.ndarray:
    """Return the directions [R, 3] of an axis of bodies with rotations quats [R, 4] wxyz."""
    return np.asarray(Rotation.from_quat(quats, scalar_first=True).as_matrix()[:, :, axis])


def largest_step(quats: np.ndarray) -> float:
    """Return the largest turn from one sample to the next, rad."""
    turns = Rotation.from_quat(quats, scalar_first=True)
    return float((turns[1:] * turns[:-1].inv()).magnitude().max(initial=0.0)) if len(quats) > 1 else 0.0


def _open(source: Path, stream: Stream) -> list[OpenPoses]:
    table = read_table(source, stream.name)
    columns = table.header[1:] if not stream.columns else stream.columns
    poses = recognise_pose(columns)
    values = numbers(table, columns)[0]
    position, ways = poses.position, _ways(values, columns, poses.rotation, poses.form)
    if position is None and ways:
        place = columns.index(ways[0][1][0])
        position = tuple(columns[place - 3 : place]) if place >= 3 else None
    if position is None or not ways:
        return []
    places = numbers(table, position)[0]
    readings, good = [], np.isfinite(places).all(axis=1)
    for title, used, form, convention in ways:
        cells = numbers(table, used)[0]
        degrees = form in (EULER, ROTATION_VECTOR) and float(np.nanmax(np.abs(cells), initial=0.0)) > 4 * np.pi
        quats, usable = to_quaternions(form, cells, convention, np.pi / 180 if degrees else 1.0)
        good &= usable
        readings.append(Reading(f"{title}{' in deg' if degrees else ''}", quats))
    if good.sum() < 2:
        return []
    times = numbers(table, table.header[:1])[0][good, 0]
    title = f"{stream.name}{f', {stream.body}' if stream.body else ''}"
    meaning = with_named_frame(table, position).meaning or NamedFrame(BASE)
    frames = [meaning.frame] if meaning.frame else [frame for frame in meaning.choices if frame in CAMERA_FRAMES]
    return [
        OpenPoses(
            title, times, in_opencv(frame, places[good], readings[0].quats[good])[0],
            tuple(Reading(way.title, in_opencv(frame, places[good], way.quats[good])[1]) for way in readings), frame,
        )
        for frame in frames
    ]  # fmt: skip


_Way = tuple[str, tuple[str, ...], str, str | None]  # title, columns, form, convention


def _ways(values: np.ndarray, columns: Sequence[str], rotation: tuple[str, ...] | None, form: str | None) -> list[_Way]:
    """Return every possible reading of the rotation that some columns hold."""
    if rotation and form:
        return [(f"{form}, as named", rotation, form, None)]
    for names in ANGLES:
        fitting = [[column for column in columns if re.split("[_.]", column.lower())[-1] == name] for name in names]
        if any(len(named) != 1 for named in fitting):
            continue
        found = tuple(column for (column,) in fitting)
        return [
            *((f"euler_convention: {way}", found, EULER, way) for way in CONVENTIONS),
            (ROTATION_VECTOR, found, ROTATION_VECTOR, None),
        ]
    for place, kind in find_rotations(values)[:1]:
        if kind == ROTATION_MATRIX:
            held = tuple(columns[place : place + 9])
            across = tuple(held[3 * column + row] for row in range(3) for column in range(3))
            return [
                ("rotation_matrix, row by row", held, kind, None),
                ("rotation_matrix, column by column", across, kind, None),
            ]
        held = tuple(columns[place : place + 4])
        return [(way, held, way, None) for way in (QUATERNION_WXYZ, QUATERNION_XYZW)]
    return []
