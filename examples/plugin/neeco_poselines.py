"""Pose lines: a log of one JSON object a line, {"t": s, "position": [x, y, z] mm, "quaternion": [w, x, y, z]}."""

import json
from pathlib import Path

import numpy as np

from neeco.base.errors import NeecoError
from neeco.base.files import read_text
from neeco.ingest.readers import RecordingFormat, Table

HEADER = ("t_s", "x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz")  # names with units need no more in recording.yaml


class PoseLines(RecordingFormat):
    format = "pose lines"
    holds = "poses of one body: .poselines, a JSON object a line"
    suffixes = (".poselines",)

    def read(self, path: Path, stream: str | None = None) -> Table:
        rows = []
        for number, line in enumerate(read_text(path, "pose lines").splitlines(), start=1):
            try:
                pose = json.loads(line)
                rows.append([float(value) for value in (pose["t"], *pose["position"], *pose["quaternion"])])
            except (ValueError, TypeError, KeyError):
                raise NeecoError(f"{path}: line {number}: is no pose; repair or remove it") from None
            if len(rows[-1]) != len(HEADER):
                raise NeecoError(f"{path}: line {number}: has not {len(HEADER)} numbers; repair or remove it")
        values = np.array(rows).reshape(-1, len(HEADER))
        return Table(path, HEADER, values, np.arange(1, len(values) + 1))
