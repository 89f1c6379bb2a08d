"""Checks of captures: values, images, placement of cameras and instruments, and states compared with the images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from neeco.capture.checks.evidence import read_pictures
from neeco.capture.checks.frames import check_frames, check_pictures, check_states, check_truth
from neeco.capture.checks.verdicts import ImageVerdicts, check_placement
from neeco.capture.documents import Problem, ProblemReport, condensed, errors_only, key_name
from neeco.capture.model import Capture
from neeco.capture.readers import capture_of, parse_capture
from neeco.capture.readers.parsed import Parsed

__all__ = ["CaptureSummary", "Checked", "check_capture", "inspect_capture", "read_checked"]


@dataclass(frozen=True, kw_only=True)
class CaptureSummary:
    """Counts and ranges of the parsed data."""

    splits: dict[str, int]  # name -> number of frames
    points: int  # number of measured points
    registered: bool
    joints: dict[str, tuple[float, float]]  # "instrument.joint" -> lowest and highest value, rad
    travel_mm: dict[str, float]  # instrument -> diagonal of the box its origin moves in
    still: bool = False  # whether the scope was still


@dataclass(frozen=True)
class Checked:
    """A capture that was read once and checked."""

    problems: list[Problem]  # errors and warnings, in the order found
    summary: CaptureSummary
    capture: Capture | None  # None: it could not be read


def check_capture(path: Path | str, transforms: str = "transforms.json") -> list[Problem]:
    """Return all faults of a capture, errors and warnings, in the order found. Bad data never raises.

    Training refuses a capture with errors; a warning names a likely but not certain fault.
    """
    return inspect_capture(path, transforms).problems


def read_checked(
    path: Path | str, transforms: str = "transforms.json", report: Callable[[str], None] | None = None
) -> Capture:
    """Read a capture for training.

    report: receives the contradictions between states and images, which take seconds to find. Raises NeecoError with
    the first error that `check_capture` finds.
    """
    checked = inspect_capture(path, transforms, motion=report is not None, truth=False)
    ProblemReport(checked.problems).raise_first(path)
    for problem in checked.problems:
        if report is not None and problem.contradicted:
            report(str(problem))
    assert checked.capture is not None  # else there would be an error
    return checked.capture


def inspect_capture(
    path: Path | str, transforms: str = "transforms.json", *, motion: bool = True, truth: bool = True
) -> Checked:
    """Read and check a capture. motion: also compare cameras and states with the images, which takes seconds and yields
    warnings only; truth: also open the masks used in evaluation."""
    report = ProblemReport()
    parsed = parse_capture(path, report, transforms)
    if not parsed.frames and not errors_only(report.problems):
        report.error(transforms, "frames", "contains no usable frame", "list images and their cameras there")
    capture = None if errors_only(report.problems) else capture_of(parsed)
    if parsed.frames:
        pictures = read_pictures(parsed)
        verdicts = ImageVerdicts(parsed, pictures)
        check_frames(parsed)
        check_pictures(parsed, pictures)
        check_states(parsed)
        if truth:
            check_truth(parsed)
        check_placement(parsed, verdicts)
        if motion and not errors_only(report.problems):
            verdicts.report()
    return Checked(condensed(report.problems), _summary(parsed), capture)


def _summary(parsed: Parsed) -> CaptureSummary:
    joints: dict[str, tuple[float, float]] = {}
    travel: dict[str, float] = {}
    for instrument in parsed.instruments:
        states = [state for _, state in parsed.states_of(instrument.name)]
        if not states:
            continue
        origins = np.stack([state.pose[:3, 3].numpy() for state in states])
        travel[instrument.name] = round(float(np.linalg.norm(np.ptp(origins, axis=0))), 3)
        for joint in instrument.joints:
            values = [state.joints[joint] for state in states if joint in state.joints]
            if values:
                joints[f"{instrument.name}.{key_name(joint)}"] = (min(values), max(values))
    points = parsed.points
    return CaptureSummary(
        splits=dict(Counter(frame.split for frame in parsed.frames)),
        points=len(points.positions) if points is not None and points.measured else 0,
        registered=parsed.registered,
        joints=joints,
        travel_mm=travel,
        still=parsed.still,
    )
