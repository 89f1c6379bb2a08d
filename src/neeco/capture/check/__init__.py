"""Find everything that is wrong with a capture, at once, and what it holds in a few numbers."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neeco.capture.check.frames import check_frames, check_states
from neeco.capture.check.geometry import check_geometry
from neeco.capture.check.images import check_images
from neeco.capture.model import Capture
from neeco.capture.parsed import Parsed
from neeco.capture.problems import Problem, ProblemReport, errors_only, key_name
from neeco.capture.reader import capture_of, parse_capture

__all__ = [
    "CaptureSummary",
    "Checked",
    "Problem",
    "check_capture",
    "errors_only",
    "inspect_capture",
    "read_checked",
]


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


@dataclass(frozen=True)
class Checked:
    """A capture looked through, read once."""

    problems: list[Problem]  # errors and warnings, in the order found
    summary: CaptureSummary
    capture: Capture | None  # None: it could not be read


def check_capture(path: Path | str, transforms: str = "transforms.json") -> list[Problem]:
    """Everything that is wrong with a capture, errors and warnings, in the order found. Bad data never raises.

    Training refuses a capture with errors; warnings tell what may be meant but often is not.
    """
    return inspect_capture(path, transforms).problems


def read_checked(path: Path | str, transforms: str = "transforms.json") -> Capture:
    """A capture that can be trained on. Raises NeecoError with the first error that `check_capture` finds."""
    checked = inspect_capture(path, transforms)
    ProblemReport(checked.problems).raise_first(path)
    assert checked.capture is not None  # else there would be an error
    return checked.capture


def inspect_capture(path: Path | str, transforms: str = "transforms.json") -> Checked:
    """What is wrong with a capture, what it holds, and the capture itself."""
    report = ProblemReport()
    parsed = parse_capture(path, report, transforms)
    if not parsed.frames and not errors_only(report.problems):
        report.error(transforms, "frames", "holds no usable frame", "list images and their cameras there")
    capture = None if errors_only(report.problems) else capture_of(parsed)
    if parsed.frames:
        check_frames(parsed, report)
        check_images(parsed, report)
        check_states(parsed, report)
        check_geometry(parsed, report)
    return Checked(report.problems, summarize(parsed), capture)


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
