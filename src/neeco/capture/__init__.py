"""Captures: what was recorded, how it is read, written and checked."""

from neeco.capture.check import Problem, check_capture, errors_only
from neeco.capture.model import Capture, Frame, Instrument, InstrumentState, PointCloud, State
from neeco.capture.reader import read_capture
from neeco.capture.writer import write_capture

__all__ = [
    "Capture",
    "Frame",
    "Instrument",
    "InstrumentState",
    "PointCloud",
    "Problem",
    "State",
    "check_capture",
    "errors_only",
    "read_capture",
    "write_capture",
]
