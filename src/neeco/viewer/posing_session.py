"""Content of the page of `neeco view CAPTURE --annotate`: requested frames, pictures along the shaft, answers."""

from __future__ import annotations

import contextlib
import datetime
import math
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from neeco.base.errors import NeecoError
from neeco.base.files import LOCK_WAIT_S, own_folder
from neeco.capture.images import open_image
from neeco.ingest.posing import posed_capture
from neeco.ingest.posing.along_shaft import crop
from neeco.ingest.posing.posed_capture import N_SUGGESTED, PosedCapture, SolvedPosing, half_turn
from neeco.labels.drawing import draw
from neeco.training.run import load_run

# of the working length, that a picture shows: before and beyond the origin, to its sides
ALONG, ACROSS = (-0.6, 1.4), 0.65
PICTURE_PX, THUMB_PX, GHOST_PX = 1000, 160, 500  # wide
RUN_FILE = "config.yaml"  # tells a run from a capture
QUALITY = 90
JOINT_RANGE_DEG = (0.0, 120.0)  # of a slider, where the capture states no limits


class PosingSession:
    """One capture that is posed by hand, by one or more browsers. Any thread may call it."""

    def __init__(self, root: Path) -> None:
        """root: a capture, or a run of one, whose scene then appears as a ghost. Raises NeecoError for a capture that
        cannot be posed, or whose answers cannot be read."""
        # posing changes the capture's states, so that a run of it is always of an earlier one
        run = load_run(root, force=True) if (root / RUN_FILE).exists() else None
        self.scene = None if run is None else run.scene
        self.posed = PosedCapture(root if run is None else run.capture().root)
        root = self.posed.root
        self._lock, self._drawing = threading.Lock(), threading.Lock()
        self._answers = posed_capture.read_answers(root)
        self._posings = self.posed.solve(self._answers)

    @property
    def instruments(self) -> list[str]:
        """Their names."""
        return list(self._posings)

    def overview(self, instrument: str) -> dict[str, Any]:
        """Requests, answers and estimates of an instrument, as JSON for the page. Raises NeecoError."""
        with self._lock:
            answers = posed_capture.read_answers(self.posed.root)
            if answers != self._answers:  # another server's, or an editor's
                self._answers, self._posings = answers, self.posed.solve(answers)
            return self._overview(instrument)

    def frame(self, instrument: str, index: int) -> dict[str, Any]:
        """Estimates in one frame, and the geometry of the page's lines. Raises NeecoError."""
        with self._lock:
            posing = self._posing(instrument, index)
            origin = posing.shafts.origins[index]
            towards, _ = posing.shafts.view_axes
            return {
                "index": index,
                "name": self.posed.frames[index],
                "roll": _known(posing.rolls.values[index], float(posing.rolls.deviations_deg[index]), wrap=True),
                "joints": {
                    name: _known(solved.values[index], float(solved.deviations_deg[index]))
                    for name, solved in posing.joints.items()
                },
                # a point a mm along the shaft, b across, c towards the camera is observed at (a, b) of another depth
                "origin_towards": float(towards[index] @ origin),
                "origin_along": float(posing.shafts.directions[index] @ origin),
            }

    def ghost(self, instrument: str, index: int, roll_deg: float, joints_deg: dict[str, float]) -> bytes:
        """The run's instruments at such a state, as `picture` shows the frame, as PNG that is clear elsewhere. Raises
        NeecoError."""
        posing = self._posing(instrument, index)
        if self.scene is None or not _possible(posing, roll_deg, joints_deg):
            raise NeecoError("ghost: no scene is shown, or the state is none")
        frame = self.posed.capture.frames[index]
        given = frame.state.instruments[instrument]
        pose = given.pose.clone()
        pose[:3, :3] = torch.from_numpy(posing.shafts.rotation(index, math.radians(roll_deg)))
        joints = {**given.joints, **{name: math.radians(value) for name, value in joints_deg.items()}}
        state = replace(given, pose=pose, joints=joints)
        with self._drawing, self.scene.torch_threads():
            shown = replace(frame.state, instruments={**frame.state.instruments, instrument: state})
            drawing = draw(self.scene, shown, frame.camera)
        if drawing.parts is None:
            raise NeecoError("ghost: the run's scene does not tell instruments from tissue; train method kinematic")
        color = (drawing.image.numpy() * 255).round().astype(np.uint8)
        clear = np.dstack([color, (drawing.parts.numpy() > 0).astype(np.uint8) * 255])
        return _encoded(self._along(posing, index, clear, GHOST_PX), ".png")

    def picture(self, instrument: str, index: int, small: bool) -> bytes:
        """A frame along the shaft, which points to the right, as JPEG. Raises NeecoError."""
        posing = self._posing(instrument, index)
        image = np.asarray(open_image(self.posed.capture.frames[index].image_path).convert("RGB"))
        return _encoded(self._along(posing, index, image, THUMB_PX if small else PICTURE_PX), ".jpg")

    def _along(self, posing: SolvedPosing, index: int, image: np.ndarray, width: int) -> np.ndarray:
        """An image [H, W, C] of a frame along the shaft, `width` px wide."""
        left, right, top, bottom = self._window(posing)
        height = round(width * (bottom - top) / (right - left))
        scale = (right - left) / width
        along = left + (np.arange(width) + 0.5) * scale
        across = top + (np.arange(height) + 0.5) * scale
        return crop(posing.shafts, index, image, along, across).transpose(1, 0, 2)

    def save(self, instrument: str, index: int, roll_deg: float, joints_deg: dict[str, float]) -> dict[str, Any]:
        """Add an answer, solve again and write both; the overview, and under `said` what contradicts the answer. Raises
        NeecoError."""
        with self._lock, self._own_capture():
            posing = self._posing(instrument, index)
            if not _possible(posing, roll_deg, joints_deg):
                names = ", ".join(["roll", *posing.joints])
                raise NeecoError(f"answer: expected {names} in degrees between -360 and 360")
            now = datetime.datetime.now().strftime("%Y-%m-%d %H:%M")
            answer = posed_capture.HandPose(self.posed.frames[index], instrument, roll_deg, joints_deg, now)
            self._keep([*posed_capture.read_answers(self.posed.root), answer])
            outliers = [outlier for outlier in self._posings[instrument].outliers() if outlier.frame == index]
            return self._overview(instrument) | {"said": [str(outlier) for outlier in outliers]}

    def undo(self, instrument: str) -> dict[str, Any]:
        """Take the last answer for an instrument out again; the overview, and under `frame` what it was of. Raises
        NeecoError."""
        with self._lock, self._own_capture():
            answers = posed_capture.read_answers(self.posed.root)
            own = [position for position, answer in enumerate(answers) if answer.instrument == instrument]
            if not own:
                return self._overview(instrument) | {"frame": None}
            gone = answers.pop(own[-1])
            self._keep(answers)
            return self._overview(instrument) | {"frame": self.posed.frames.index(gone.frame)}

    def _own_capture(self) -> contextlib.AbstractContextManager[None]:
        """The capture for this process alone, from reading its answers to writing them and its states."""
        return own_folder(self.posed.root, wait_s=LOCK_WAIT_S)

    def _keep(self, answers: list[posed_capture.HandPose]) -> None:
        posings = self.posed.solve(answers)  # raises before anything is written
        posed_capture.write_answers(self.posed.root, answers)
        self.posed.write_states(posings)
        self._answers, self._posings = answers, posings

    def _posing(self, instrument: str, index: int = 0) -> SolvedPosing:
        if instrument not in self._posings:
            raise NeecoError(f"no instrument {instrument!r}; known: {', '.join(self._posings)}")
        if not 0 <= index < len(self.posed.frames):
            raise NeecoError(f"no frame {index}; there are {len(self.posed.frames)}")
        return self._posings[instrument]

    def _window(self, posing: SolvedPosing) -> tuple[float, float, float, float]:
        """Left, right (mm along the shaft), top and bottom (across) of a picture."""
        length = posing.shafts.working_length_mm
        return ALONG[0] * length, ALONG[1] * length, -ACROSS * length, ACROSS * length

    def _overview(self, instrument: str) -> dict[str, Any]:
        posing = self._posing(instrument)
        answered = {frame for frame, _ in posing.answers}
        outliers: dict[int, list[str]] = {}
        for outlier in posing.outliers():
            outliers.setdefault(outlier.frame, []).append(str(outlier))
        return {
            "ghost": self.scene is not None,
            "capture": self.posed.root.resolve().name,
            "instrument": instrument,
            "instruments": self.instruments,
            "frames": len(self.posed.frames),
            "suggested": [
                {"frame": item.frame, "name": self.posed.frames[item.frame], "reason": item.reason}
                for item in posing.suggestions(max(1, N_SUGGESTED - len(answered)))
            ],
            "of": max(N_SUGGESTED, len(answered)),
            "answered": [
                {
                    "frame": frame,
                    "name": answer.frame,
                    "roll": answer.roll_deg,
                    "joints": answer.joints_deg,
                    "doubts": outliers.get(frame, []),
                }
                for frame, answer in posing.answers
            ],
            "done": len(answered),
            "sure": {name: [round(value, 1) for value in pair] for name, pair in posing.deviations().items()},
            "window": self._window(posing),
            "length": posing.shafts.working_length_mm,
            "radius": posing.shafts.diameter_mm / 2,
            "joints": {
                name: [math.degrees(value) for value in limits]
                if (limits := posing.instrument.joints[name]) is not None
                else list(JOINT_RANGE_DEG)
                for name in posing.joints
            },
        }


def _possible(posing: SolvedPosing, roll_deg: float, joints_deg: dict[str, float]) -> bool:
    values = (roll_deg, *joints_deg.values())
    return set(joints_deg) == set(posing.joints) and all(abs(value) <= 360 for value in values)


def _encoded(pixels: np.ndarray, kind: str) -> bytes:
    """Encode RGB or RGBA [H, W, C] as a file of that kind."""
    order = cv2.COLOR_RGB2BGR if pixels.shape[-1] == 3 else cv2.COLOR_RGBA2BGRA
    options = [cv2.IMWRITE_JPEG_QUALITY, QUALITY] if kind == ".jpg" else []
    done, encoded = cv2.imencode(kind, cv2.cvtColor(pixels, order), options)
    if not done:
        raise NeecoError(f"a picture of {pixels.shape} could not be encoded")
    return encoded.tobytes()


def _known(value: float, deviation: float, wrap: bool = False) -> dict[str, float]:
    degrees = math.degrees(float(value))
    return {"value": half_turn(degrees) if wrap else degrees, "deviation": deviation}
