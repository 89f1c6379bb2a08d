"""Instruments that nothing tracked: the axis of a shaft of known diameter, found in the video."""
