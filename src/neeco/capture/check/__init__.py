"""Find everything that is wrong with a capture, at once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from neeco.capture.check.frames import check_frames
from neeco.capture.check.geometry import check_geometry
from neeco.capture.check.images import check_images
from neeco.capture.check.states import check_states
from neeco.capture.check.summary import CaptureSummary, summarize
from neeco.capture.model import Capture
from neeco.capture.problems import Problem, ProblemReport, errors_only
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
