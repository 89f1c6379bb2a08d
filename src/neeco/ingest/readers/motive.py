"""Exports of OptiTrack's Motive as CSV: rigid bodies by name, units in the preamble.

A preamble of pairs (`Length Units,Meters`) precedes header lines with type, name and ID (since Motive 3 also parent) of
each column's body, its quantity (Rotation, Position) and its axis. Cells of an untracked body are empty.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from neeco.base.errors import NeecoError
from neeco.base.placeholders import read_head
from neeco.capture.documents import printable
from neeco.ingest.readers import Kind, RecordingFormat, Stream, Table, to_numbers
from neeco.ingest.readers.delimited import read_cells, tool_stream
from neeco.ingest.readers.names import UNITS, canonical_unit

FIRST = b"Format Version"  # words of a file
BODY_TYPE = "rigid body"
QUATERNION = "quaternion"  # the rotation type that is read
QUATS = ("qx", "qy", "qz", "qw")


class MotiveExport(RecordingFormat):
    """A stream is a rigid body. Markers and skeletons are left out."""

    format = "Motive export"
    holds = "poses of rigid bodies by name: OptiTrack's CSV with its preamble (Format Version, ...)"

    def claims(self, path: Path) -> bool:
        return read_head(path, 64).lstrip(b'\xef\xbb\xbf"').startswith(FIRST)

    def streams(self, path: Path) -> tuple[Stream, ...]:
        start, places = _columns(path)
        return tuple(tool_stream(name, len(read_cells(path).lines) - start) for name in places)

    def read(self, path: Path, stream: str | None = None) -> Table:
        (start, places), streams, text = _columns(path), self.streams(path), read_cells(path)
        matching = next((name for name in places if name.lower() == str(stream).lower()), stream)
        name = self.choose(path, matching, Kind.POSES, streams=streams).name
        required = [*(("position", axis) for axis in "xyz"), *(("rotation", axis) for axis in "xyzw")]
        if absent := [part for part, axis in required if (part, axis) not in places[name]]:
            raise NeecoError(f"{path}: {absent[0]}: missing for a rigid body; export the take with 6 DoF data")
        preamble = dict(zip(text.cells[0, ::2], text.cells[0, 1::2], strict=False))
        kind, unit = preamble.get("Rotation Type", QUATERNION).lower(), canonical_unit(preamble.get("Length Units", ""))
        if kind != QUATERNION:
            raise NeecoError(f"{path}: Rotation Type: {printable(kind)} is not supported; export quaternions")
        suffix = f"_{unit}" if unit in UNITS["length"] else ""
        values = to_numbers(text.cells[start:, [places[name][column] for column in required]])
        stated = preamble.get("Export Frame Rate", preamble.get("Capture Frame Rate", ""))
        rate = float(to_numbers(np.array(stated, object)))
        names = [cell.lower() for cell in text.cells[start - 1]]
        column = next((index for index, cell in enumerate(names) if cell.startswith("time (sec")), None)
        if column is None and not 0 < rate < 1e6:  # NaN compares false
            raise NeecoError(f"{path}: has no column of times and no Export Frame Rate; export the take with its times")
        times = to_numbers(text.cells[start:, column or 0]) / (rate if column is None else 1.0)
        rows = np.column_stack([times, values])
        header = ("t_s", *(axis + suffix for axis in "xyz"), *QUATS)
        return Table(path, header, rows, text.lines[start:], stream=name)


def _columns(path: Path) -> tuple[int, dict[str, dict[tuple[str, str], int]]]:
    """Return the first row of numbers, and each rigid body's columns by quantity and axis. Raises NeecoError."""
    text = read_cells(path)
    lower = np.char.lower(text.cells[:20].astype(str))
    types = np.flatnonzero((lower == BODY_TYPE).any(axis=1))
    starts = np.flatnonzero(lower[:, 0] == "frame")
    if not len(types) or not len(starts) or starts[0] < types[0] + 3:
        raise NeecoError(f"{path}: contains no rigid bodies; export the take from Motive with its rigid bodies")
    start = int(starts[0]) + 1
    if start == len(text.lines):
        raise NeecoError(f"{path}: has a header but no rows; export the take again")
    places: dict[str, dict[tuple[str, str], int]] = {}
    for column in np.flatnonzero(lower[types[0]] == BODY_TYPE).tolist():
        part, axis = lower[start - 2, column], lower[start - 1, column]
        places.setdefault(text.cells[types[0] + 1, column], {})[part, axis] = column
    return start, places
