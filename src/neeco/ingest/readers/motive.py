"""Exports of OptiTrack's Motive as CSV: rigid bodies by name, units in the preamble.

A preamble of pairs (`Length Units,Meters`), then a line each of the types, names and IDs (since Motive 3 of the
parents, too) of what the columns belong to, one of what they hold (Rotation, Position), and one of their axes. Cells
are empty where a body was not tracked.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from neeco.base.errors import NeecoError
from neeco.base.placeholders import read_head
from neeco.capture.documents import printable
from neeco.ingest.readers import Body, RecordingFormat, Table, numbers, to_numbers
from neeco.ingest.readers.columns import UNITS, canonical_unit
from neeco.ingest.readers.delimited import read_cells, unique_names

FIRST = b"Format Version"  # words of a file
BODY_TYPE = "rigid body"
QUATERNION = "quaternion"  # the rotation type that is read
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
        text = read_cells(path)
        preamble = dict(zip(text.cells[0, ::2], text.cells[0, 1::2], strict=False))
        lower = np.char.lower(text.cells[: min(len(text.cells), 20)].astype(str))
        types = np.flatnonzero((lower == BODY_TYPE).any(axis=1))
        starts = np.flatnonzero(lower[:, 0] == "frame")
        if not len(types) or not len(starts) or starts[0] < types[0] + 3:
            raise NeecoError(f"{path}: holds no rigid bodies; export the take from Motive with its rigid bodies")
        start, names = int(starts[0]), text.cells[types[0] + 1]
        kinds, parts, axes = lower[types[0]], lower[start - 1], lower[start]
        if start + 1 == len(text.lines):
            raise NeecoError(f"{path}: has a header but no rows; export the take again")
        cells, lines = text.cells[start + 1 :], text.lines[start + 1 :]
        raw = Table(path, tuple(map(str, range(len(axes)))), cells, lines)

        def values(name: str, part: str, letters: str) -> np.ndarray:
            """[R, A] of a body's columns; NaN where it was not tracked."""
            places = {
                axes[i]: str(i) for i in range(len(axes)) if (names[i], kinds[i], parts[i]) == (name, BODY_TYPE, part)
            }
            if not set(letters) <= set(places):
                raise NeecoError(f"{path}: {part}: a rigid body has no columns of it; export the take with 6 DoF data")
            return numbers(raw, [places[letter] for letter in letters])

        kind, unit = preamble.get("Rotation Type", QUATERNION).lower(), canonical_unit(preamble.get("Length Units", ""))
        if kind != QUATERNION:
            raise NeecoError(f"{path}: Rotation Type: {printable(kind)} is not read; export quaternions")
        suffix = f"_{unit}" if unit in UNITS["length"] else ""
        header, columns, bodies = ["t_s"], [_times(raw, axes, preamble)], []
        for name in dict.fromkeys(names[kinds == BODY_TYPE]):
            bodies.append(Body(name, tuple(range(len(header), len(header) + 7))))
            header += [*(axis + suffix for axis in "xyz"), *QUATS]
            columns += [values(name, "position", "xyz"), values(name, "rotation", "xyzw")]
        return Table(path, unique_names(header), np.column_stack(columns), lines, bodies=tuple(bodies))


def _times(raw: Table, axes: np.ndarray, preamble: dict[str, str]) -> np.ndarray:
    """[R] s: as they stand there, else of the frames at the export's rate."""
    for index, name in enumerate(axes):
        if name.startswith("time (sec"):
            return numbers(raw, [str(index)])[:, 0]
    stated = preamble.get("Export Frame Rate", preamble.get("Capture Frame Rate", ""))
    rate = float(to_numbers(np.array(stated, object)))
    if not 0 < rate < 1e6:  # NaN compares false
        raise NeecoError(f"{raw.path}: has no column of times and no Export Frame Rate; export the take with its times")
    return numbers(raw, ["0"])[:, 0] / rate
