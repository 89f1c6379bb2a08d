"""Captures: what was recorded, how it is read, written and checked."""

from neeco.capture.check import check_capture
from neeco.capture.documents import Problem, errors_only
from neeco.capture.model import Camera, Capture, Frame, Instrument, InstrumentState, PointCloud, State
from neeco.capture.reader import read_capture
from neeco.capture.writer import write_capture

__all__ = [
    "Camera",
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
