"""Captures made from recordings (video and logs); `pipeline.py` lists the stages.

Folders from the last stage to the first; each imports only from later ones in this list: posing, registration, shaft,
cameras, foreground, frames, timing, recording, readers, calibration.
"""
