"""What a capture holds, in a few numbers."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from neeco.capture.parsed import Parsed
from neeco.capture.problems import key_name


@dataclass(frozen=True)
class CaptureSummary:
    """Counts and ranges of what could be read."""

    splits: dict[str, int]  # name -> frames
    points: int  # measured points
    registered: bool
    joints: dict[str, tuple[float, float]]  # "instrument.joint" -> lowest and highest value, rad
    travel_mm: dict[str, float]  # instrument -> diagonal of the box its origin moves in

    def as_json(self) -> dict[str, Any]:
        return asdict(self)


def summarize(parsed: Parsed) -> CaptureSummary:
    """Count frames and points, and find the range of each joint and each instrument's travel."""
    joints: dict[str, tuple[float, float]] = {}
    travel: dict[str, float] = {}
    for instrument in parsed.instruments:
        states = [frame.state.instruments.get(instrument.name) for frame in parsed.frames]
        present = [state for state in states if state is not None]
        if not present:
            continue
        origins = np.stack([state.pose[:3, 3].numpy() for state in present])
        travel[instrument.name] = round(float(np.linalg.norm(np.ptp(origins, axis=0))), 3)
        for joint in instrument.joints:
            values = [state.joints[joint] for state in present if joint in state.joints]
            if values:
                joints[f"{instrument.name}.{key_name(joint)}"] = (min(values), max(values))
    points = parsed.points
    return CaptureSummary(
        splits=dict(Counter(frame.split for frame in parsed.frames)),
        points=len(points.positions) if points is not None and points.measured else 0,
        registered=parsed.registered,
        joints=joints,
        travel_mm=travel,
    )
