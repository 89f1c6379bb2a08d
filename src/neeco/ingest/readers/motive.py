"""Exports of OptiTrack's Motive as CSV: rigid bodies by name, units and rotation type in the preamble.

A preamble of pairs (`Length Units,Meters`), then a line each of the types, names and IDs (since Motive 3 of the
parents, too) of what the columns belong to, one of what they hold (Rotation, Position), and one of their axes. Cells
are empty where a body was not tracked. Angles are in degrees, about the body's own axes, in `Rotation Type`'s order.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.capture.documents import printable
from neeco.errors import NeecoError
from neeco.ingest.readers import Body, RecordingFormat, Table, numbers
from neeco.ingest.readers.columns import UNITS, canonical_unit
from neeco.ingest.readers.delimited import read_lines, unique_names
from neeco.placeholders import read_head

FIRST = b"Format Version"  # words of a file
BODY_TYPE = "rigid body"
QUATERNION, ORDERS = "quaternion", ("xyz", "xzy", "yxz", "yzx", "zxy", "zyx")  # rotation types
QUATS = ("qx", "qy", "qz", "qw")


class MotiveExport(RecordingFormat):
    """One table, in which `tool` names a rigid body. Markers and skeletons are left out."""

    format = "Motive export"
    holds = "poses of rigid bodies by name: OptiTrack's CSV with its preamble (Format Version, ...)"

    def claims(self, path: Path) -> bool:
        return read_head(path, 64).lstrip(b'\xef\xbb\xbf"').startswith(FIRST)

    def read(self, path: Path, stream: str | None = None) -> Table:
        if stream is not None:
            raise NeecoError(f"{path}: stream: an export is one table; name a rigid body as `tool` instead")
        lines = read_lines(path)
        preamble = dict(zip(lines[0].cells[::2], lines[0].cells[1::2], strict=False))
        types = next((n for n, line in enumerate(lines) if BODY_TYPE in map(str.lower, line.cells)), None)
        start = next((n for n, line in enumerate(lines) if line.cells[0].lower() == "frame"), 0)
        if types is None or start < types + 3:
            raise NeecoError(f"{path}: holds no rigid bodies; export the take from Motive with its rigid bodies")
        rows = lines[start + 1 :]
        if not rows:
            raise NeecoError(f"{path}: has a header but no rows; export the take again")
        axes = lines[start].cells
        cells, places = [line.cells for line in rows], np.array([line.number for line in rows])
        raw = Table(path, tuple(map(str, range(len(axes)))), cells, places, decimal_comma=lines[0].decimal_comma)
        kinds, names, parts = ([*lines[n].cells, *[""] * len(axes)] for n in (types, types + 1, start - 1))
        unit = canonical_unit(preamble.get("Length Units", ""))
        suffix = f"_{unit}" if unit in UNITS["length"] else ""
        header, columns, bodies = ["t_s"], [_times(raw, axes, preamble)], []
        owned = [i for i in range(len(axes)) if kinds[i].lower() == BODY_TYPE]
        for name, group in groupby(owned, key=lambda i: names[i].strip('"')):
            own = {(parts[i].lower(), axes[i].lower()): i for i in group}
            turns = _quats(raw, own, preamble.get("Rotation Type", QUATERNION).lower())
            positions = _values(raw, own, "position", "xyz")
            bodies.append(Body(name, tuple(range(len(header), len(header) + 7))))
            header += [*(axis + suffix for axis in "xyz"), *QUATS]
            columns += [positions, turns]
        return Table(path, unique_names(header), np.column_stack(columns), places, bodies=tuple(bodies))


def _times(raw: Table, axes: Sequence[str], preamble: dict[str, str]) -> np.ndarray:
    """[R] s: as they stand there, else of the frames at the export's rate."""
    column = next((i for i, name in enumerate(axes) if name.lower().startswith("time (sec")), None)
    if column is not None:
        return numbers(raw, [str(column)])[0][:, 0]
    try:
        rate = float(preamble.get("Export Frame Rate", preamble.get("Capture Frame Rate", "")))
    except ValueError:
        rate = 0.0
    if not 0 < rate < 1e6:  # NaN compares false
        raise NeecoError(f"{raw.path}: has no column of times and no Export Frame Rate; export the take with its times")
    return numbers(raw, ["0"])[0][:, 0] / rate


def _values(raw: Table, own: dict[tuple[str, str], int], part: str, axes: str) -> np.ndarray:
    """[R, A] of a body's columns; NaN where it was not tracked. own: by part and axis."""
    if not all((part, axis) in own for axis in axes):
        raise NeecoError(f"{raw.path}: {part}: a rigid body has no columns of it; export the take with 6 DoF data")
    return numbers(raw, [str(own[part, axis]) for axis in axes])[0]


def _quats(raw: Table, own: dict[tuple[str, str], int], kind: str) -> np.ndarray:
    """[R, 4] xyzw of a body."""
    if kind == QUATERNION:
        return _values(raw, own, "rotation", "xyzw")
    if kind not in ORDERS:
        raise NeecoError(f"{raw.path}: Rotation Type: {printable(kind)} is not read; export quaternions")
    angles = _values(raw, own, "rotation", kind)
    quats = np.full((len(angles), 4), np.nan)
    known = np.isfinite(angles).all(axis=1)
    if known.any():
        quats[known] = Rotation.from_euler(kind.upper(), angles[known], degrees=True).as_quat()
    return quats
