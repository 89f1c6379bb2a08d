"""Captures made from recordings (video and logs); `pipeline.py` states the stages.

Folders, from the last stage back to the first; each imports only from those after it: posing, registration, shaft,
cameras, foreground, frames, timing, recording, readers, calibration.
"""
