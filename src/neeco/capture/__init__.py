"""Captures: what was recorded, how it is read, written and checked."""

from neeco.capture.checks import CaptureSummary, Checked, check_capture, inspect_capture, read_checked
from neeco.capture.documents import Problem, errors_only
from neeco.capture.kinematics import KinematicTree, Link
from neeco.capture.model import (
    BaseUncertainty,
    Camera,
    Capture,
    Frame,
    FromVideo,
    Instrument,
    InstrumentState,
    PointCloud,
    State,
    Uncertainty,
    evenly_spaced,
)
from neeco.capture.readers import (
    StateLine,
    capture_of,
    kinematics_of,
    parse_capture,
    parse_kinematics,
    parse_lens,
    read_capture,
    read_dvrk_tool,
    read_states,
    read_urdf,
)
from neeco.capture.writer import camera_to_json, fingerprint, state_to_json, write_capture

__all__ = [
    "BaseUncertainty",
    "Camera",
    "Capture",
    "CaptureSummary",
    "Checked",
    "Frame",
    "FromVideo",
    "Instrument",
    "InstrumentState",
    "KinematicTree",
    "Link",
    "PointCloud",
    "Problem",
    "State",
    "StateLine",
    "Uncertainty",
    "camera_to_json",
    "capture_of",
    "check_capture",
    "errors_only",
    "evenly_spaced",
    "fingerprint",
    "inspect_capture",
    "kinematics_of",
    "parse_capture",
    "parse_kinematics",
    "parse_lens",
    "read_capture",
    "read_checked",
    "read_dvrk_tool",
    "read_states",
    "read_urdf",
    "state_to_json",
    "write_capture",
]
