"""Find everything that is wrong with a capture, at once."""

from __future__ import annotations

from pathlib import Path

from neeco.capture.check.frames import check_frames
from neeco.capture.check.geometry import check_geometry
from neeco.capture.check.images import check_images
from neeco.capture.check.states import check_states
from neeco.capture.check.summary import Summary, summarize
from neeco.capture.model import Capture
from neeco.capture.problems import Problem, Report, errors_only
from neeco.capture.reader import parse_capture, read_capture

__all__ = ["Problem", "Summary", "check_capture", "errors_only", "inspect_capture", "read_checked", "summarize"]


def check_capture(path: Path | str, transforms: str = "transforms.json") -> list[Problem]:
    """Everything that is wrong with a capture, errors and warnings, in the order found. Bad data never raises.

    Training refuses a capture with errors; warnings tell what may be meant but often is not.
    """
    return inspect_capture(path, transforms)[0]


def read_checked(path: Path | str, transforms: str = "transforms.json") -> Capture:
    """A capture that can be trained on. Raises NeecoError with the first error that `check_capture` finds."""
    Report(check_capture(path, transforms)).raise_first(path)
    return read_capture(path, transforms)


def inspect_capture(path: Path | str, transforms: str = "transforms.json") -> tuple[list[Problem], Summary]:
    """What is wrong with a capture, and what it holds."""
    report = Report()
    parsed = parse_capture(path, report, transforms)
    if parsed.frames:
        check_frames(parsed, report)
        check_images(parsed, report)
        check_states(parsed, report)
        check_geometry(parsed, report)
    elif not report.problems:
        report.error(transforms, "frames", "holds no usable frame", "list images and their cameras there")
    return report.problems, summarize(parsed)
