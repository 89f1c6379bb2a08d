"""Logs and video on one time axis."""
