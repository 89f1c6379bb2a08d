"""Readers of capture folders and of what they hold: cameras, lenses, instrument states and kinematic trees."""

from neeco.capture.readers._folder import capture_of, parse_capture, read_capture
from neeco.capture.readers._states import StateLine, read_states
from neeco.capture.readers.cameras import parse_lens
from neeco.capture.readers.dvrk import read_dvrk_tool
from neeco.capture.readers.kinematics import kinematics_of, parse_kinematics
from neeco.capture.readers.urdf import read_urdf

__all__ = [
    "StateLine",
    "capture_of",
    "kinematics_of",
    "parse_capture",
    "parse_kinematics",
    "parse_lens",
    "read_capture",
    "read_dvrk_tool",
    "read_states",
    "read_urdf",
]
