"""Untracked instruments: the axis of a shaft of known diameter, estimated from the video."""
