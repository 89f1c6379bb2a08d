"""Checks of captures: values, images, placement of cameras and instruments, and states compared with the images."""

from neeco.capture.checks.inspection import CaptureSummary, Checked, check_capture, inspect_capture, read_checked

__all__ = ["CaptureSummary", "Checked", "check_capture", "inspect_capture", "read_checked"]
