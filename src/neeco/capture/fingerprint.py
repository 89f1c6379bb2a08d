"""What a capture shows, as one number: whether it is still the same when work on it goes on."""

from __future__ import annotations

import hashlib
import json

from neeco.capture.model import Capture
from neeco.capture.statefile import camera_to_json, state_to_json
from neeco.files import read_bytes


def fingerprint(capture: Capture) -> str:
    """SHA-256 (hex) of all that is read of a capture: the files of its images and masks, cameras, states, splits,
    instruments, points; not of where it lies. Raises NeecoError for an image that cannot be read."""
    digest = hashlib.sha256()
    for frame in capture.frames:
        camera = frame.camera
        told = {
            "name": frame.name,
            "split": frame.split,
            "camera": camera_to_json(camera.world_from_camera.double().numpy()),
            "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, camera.near],
            "state": state_to_json(frame.state),
            "background": frame.background,
        }
        digest.update(json.dumps(told).encode())
        for path in (frame.image_path, frame.mask_path):
            digest.update(b"-" if path is None else hashlib.sha256(read_bytes(path, "an image")).digest())
    instruments = [[item.name, dict(item.joints)] for item in capture.instruments]
    digest.update(json.dumps([instruments, capture.registered, capture.timed]).encode())
    for numbers in (capture.points.positions, capture.points.colors):
        digest.update(numbers.tobytes())
    return digest.hexdigest()
