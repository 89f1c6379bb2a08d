"""Captures: data model, readers, writer and checks."""

from neeco.capture.checks import check_capture
from neeco.capture.documents import Problem, errors_only
from neeco.capture.kinematics import KinematicTree, Link
from neeco.capture.model import (
    Camera,
    Capture,
    Frame,
    Instrument,
    InstrumentState,
    PointCloud,
    State,
    Uncertainty,
    evenly_spaced,
)
from neeco.capture.readers import (
    read_capture,
    read_dvrk_tool,
    read_urdf,
)
from neeco.capture.writer import fingerprint, write_capture

__all__ = [
    "Camera",
    "Capture",
    "Frame",
    "Instrument",
    "InstrumentState",
    "KinematicTree",
    "Link",
    "PointCloud",
    "Problem",
    "State",
    "Uncertainty",
    "check_capture",
    "errors_only",
    "evenly_spaced",
    "fingerprint",
    "read_capture",
    "read_dvrk_tool",
    "read_urdf",
    "write_capture",
]
