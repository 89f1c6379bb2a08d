"""`neeco view CAPTURE --annotate`: a small web server with the page on which a person poses frames by hand.

A question is a JSON object {"ask": what, ...}. Over the web socket each is answered by another object, in their order.
Pictures change nothing: GET /picture/{...} and /ghost/{...} bring them side by side.
"""

from __future__ import annotations

import contextlib
import datetime
import json
import math
import threading
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from http import HTTPStatus
from importlib.resources import files
from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import unquote

import cv2
import numpy as np
import torch

from neeco.base.errors import NeecoError, install_hint
from neeco.base.files import LOCK_WAIT_S, own_folder, require_like
from neeco.capture.images import open_image
from neeco.ingest.posing.along_shaft import crop
from neeco.ingest.posing.posed_capture import (
    POSING,
    HandPose,
    PosedCapture,
    SolvedPosing,
    half_turn,
    read_answers,
    write_answers,
)
from neeco.labels.drawing import draw
from neeco.training.run import load_run
from neeco.viewer.access import HOST, MAX_MESSAGE, PORT, Access, family_of, quiet

STATE = {"index": int, "roll": float, "joints": {str: float}}  # degrees
# what a page may ask, and its fields: by GET, and over the web socket
IMAGES: dict[str, dict[str, Any]] = {"picture": {"index": int, "small": bool}, "ghost": STATE}
QUESTIONS: dict[str, dict[str, Any]] = {"overview": {}, "frame": {"index": int}, "save": STATE, "undo": {}}


class PosingServer(contextlib.AbstractContextManager["PosingServer"]):
    """A running server on one capture; `address` is what to open. Use as a context manager, or call `stop`.

    Any thread may call it: one or more browsers pose the capture. Pictures are of frames along the shaft.
    """

    before: ClassVar[float] = 0.6  # length before the shaft's end, as a share of the working length
    beyond: ClassVar[float] = 1.4  # length beyond the shaft's end, as that share
    aside: ClassVar[float] = 0.65  # width to either side, as that share
    picture_width: ClassVar[int] = 1000  # width of a picture in px
    thumbnail_width: ClassVar[int] = 160  # width of a thumbnail in px
    ghost_width: ClassVar[int] = 500  # width of a ghost in px
    jpeg_quality: ClassVar[int] = 90
    joint_range_deg: ClassVar[tuple[float, float]] = (0.0, 120.0)  # of a slider, where the capture states no limits

    def __init__(self, root: Path, host: str = HOST, port: int = PORT) -> None:
        """root: a capture, or a run of one, whose scene then appears as a ghost. port: or the next that is free. Raises
        NeecoError, also for a capture that cannot be posed or whose answers cannot be read."""
        try:
            from websockets.sync.server import serve
        except ImportError:
            raise NeecoError(f"view: needs viser; {install_hint('view')}") from None
        # posing changes the capture's states, so that a run of it is always of an earlier one
        run = load_run(root, force=True) if (root / "config.yaml").exists() else None
        self.scene = None if run is None else run.scene
        self.posed = PosedCapture(root if run is None else run.capture().root)
        self._lock, self._drawing = threading.Lock(), threading.Lock()
        self._answers = read_answers(self.posed.root)
        self._posings = self.posed.solve(self._answers)
        access = Access.at(host, port)
        self.address = access.address
        self._server = serve(
            self._converse,
            access.host,
            access.port,
            family=family_of(access.host),
            process_request=access.controlled(self._respond),
            max_size=MAX_MESSAGE,
            logger=quiet,
        )
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """End the server."""
        self._server.shutdown()
        self._thread.join()

    def _converse(self, connection: Any) -> None:
        """Answer all that one page asks over its web socket."""
        for message in connection:
            try:
                ask, fields = self._question(json.loads(message), QUESTIONS)
                answer = getattr(self, ask)(**fields)
            except (NeecoError, ValueError, RecursionError) as error:
                answer = {"error": str(error)}
            connection.send(json.dumps(answer, allow_nan=False))

    def _respond(self, connection: Any, request: Any) -> Any:
        """The page or a picture; None for the web socket."""
        if "Upgrade" in request.headers:
            return None
        ask, _, text = request.path.removeprefix("/").partition("/")
        # scripts of a page may run: what is refused, which repeats what was asked, is none
        status, kind = HTTPStatus.OK, "text/plain; charset=utf-8"
        try:
            if not ask:
                body, kind = page(), "text/html; charset=utf-8"
            elif ask in IMAGES:
                message = json.loads(unquote(text))
                ask, fields = self._question(message | {"ask": ask} if isinstance(message, dict) else message, IMAGES)
                body, kind = getattr(self, ask)(**fields)
            else:
                status, body = HTTPStatus.NOT_FOUND, b"neeco view: no such page\n"
        except (NeecoError, ValueError, RecursionError) as error:
            status, body = HTTPStatus.BAD_REQUEST, str(error).encode(errors="replace")
        response = connection.respond(status, "")
        del response.headers["Content-Length"], response.headers["Content-Type"]
        response.headers.update({"Content-Length": str(len(body)), "Content-Type": kind})
        response.body = body
        return response

    def _question(self, message: Any, questions: Mapping[str, dict[str, Any]]) -> tuple[str, dict[str, Any]]:
        """Return what of the `questions`, which are methods, is asked, and its arguments. Raises NeecoError."""
        remedy = "reload the page"
        ask = require_like(message, {"ask": str}, "page", remedy)["ask"]
        if ask not in questions:
            raise NeecoError(f"page: ask: {ask!r} is unknown; {remedy}")
        question = require_like(message, {"ask": str, "instrument": str, **questions[ask]}, "page", remedy)
        instrument = question["instrument"] or next(iter(self._posings))
        self._posing(instrument, question.get("index", 0))
        return ask, {name: question[name] for name in questions[ask]} | {"instrument": instrument}

    def overview(self, instrument: str) -> dict[str, Any]:
        """Requests, answers and estimates of an instrument, as JSON for the page. Raises NeecoError."""
        with self._lock:
            if (answers := read_answers(self.posed.root)) != self._answers:  # another server's, or an editor's
                self._answers, self._posings = answers, self.posed.solve(answers)
            return self._overview(instrument)

    def frame(self, instrument: str, index: int) -> dict[str, Any]:
        """Estimates in one frame, and the geometry of the page's lines."""
        with self._lock:
            posing = self._posings[instrument]
            origin = posing.shafts.origins[index]
            towards, _ = posing.shafts.view_axes
            angles = {
                name: {"value": math.degrees(solved.values[index]), "deviation": float(solved.deviations_deg[index])}
                for name, solved in posing.angles.items()
            }
            roll = angles.pop("roll")
            return {
                "index": index,
                "name": self.posed.frames[index],
                "roll": roll | {"value": half_turn(roll["value"])},
                "joints": angles,
                # a point a mm along the shaft, b across, c towards the camera is observed at (a, b) of another depth
                "origin_towards": float(towards[index] @ origin),
                "origin_along": float(posing.shafts.directions[index] @ origin),
            }

    def save(self, instrument: str, index: int, roll: float, joints: Mapping[str, float]) -> dict[str, Any]:
        """Add an answer (degrees), solve again and write both; the overview, and under `said` what contradicts the
        answer. Raises NeecoError."""
        with self._lock, own_folder(self.posed.root, wait_s=LOCK_WAIT_S):
            _require_state(self._posings[instrument], roll, joints)
            now = datetime.datetime.now().strftime("%Y-%m-%d %H:%M")
            answer = HandPose(self.posed.frames[index], instrument, roll, dict(joints), now)
            self._keep([*read_answers(self.posed.root), answer])
            outliers = [outlier for outlier in self._posings[instrument].outliers() if outlier.frame == index]
            return self._overview(instrument) | {"said": [str(outlier) for outlier in outliers]}

    def undo(self, instrument: str) -> dict[str, Any]:
        """Take the last answer for an instrument out again; the overview, and under `frame` what it was of."""
        with self._lock, own_folder(self.posed.root, wait_s=LOCK_WAIT_S):
            answers = read_answers(self.posed.root)
            positions = [position for position, answer in enumerate(answers) if answer.instrument == instrument]
            if not positions:
                return self._overview(instrument) | {"frame": None}
            removed = answers.pop(positions[-1])
            self._keep(answers)
            return self._overview(instrument) | {"frame": self.posed.frames.index(removed.frame)}

    def _keep(self, answers: list[HandPose]) -> None:
        posings = self.posed.solve(answers)  # raises before anything is written
        write_answers(self.posed.root, answers)
        self.posed.write_states(posings)
        self._answers, self._posings = answers, posings

    def _posing(self, instrument: str, index: int) -> SolvedPosing:
        if instrument not in self._posings:
            raise NeecoError(f"no instrument {instrument!r}; known: {', '.join(self._posings)}")
        if not 0 <= index < len(self.posed.frames):
            raise NeecoError(f"no frame {index}; there are {len(self.posed.frames)}")
        return self._posings[instrument]

    def picture(self, instrument: str, index: int, small: bool) -> tuple[bytes, str]:
        """A frame along the shaft, which points to the right, and its media type. Raises NeecoError."""
        pixels = np.asarray(open_image(self.posed.capture.frames[index].image_path).convert("RGB"))
        width, quality = self.thumbnail_width if small else self.picture_width, self.jpeg_quality
        along = self._along_shaft(instrument, index, cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), width)
        return cv2.imencode(".jpeg", along, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes(), "image/jpeg"

    def ghost(self, instrument: str, index: int, roll: float, joints: Mapping[str, float]) -> tuple[bytes, str]:
        """The run's instruments in such a state (degrees) of a frame along the shaft, clear elsewhere, and the media
        type. Raises NeecoError."""
        if self.scene is None:
            raise NeecoError("ghost: no run is given")
        posing, frame = self._posings[instrument], self.posed.capture.frames[index]
        _require_state(posing, roll, joints)
        recorded = frame.state.instruments[instrument]
        pose = recorded.pose.clone()
        pose[:3, :3] = torch.from_numpy(posing.shafts.rotation(index, math.radians(roll)))
        turned = {**recorded.joints, **{joint: math.radians(value) for joint, value in joints.items()}}
        instruments = {**frame.state.instruments, instrument: replace(recorded, pose=pose, joints=turned)}
        with self._drawing, self.scene.torch_threads():
            drawing = draw(self.scene, replace(frame.state, instruments=instruments), frame.camera)
        if drawing.parts is None:
            raise NeecoError("ghost: the run's scene does not tell instruments from tissue; train method kinematic")
        color = (drawing.image.numpy()[..., ::-1] * 255).round().astype(np.uint8)
        pixels = np.dstack([color, (drawing.parts.numpy() > 0).astype(np.uint8) * 255])
        along = self._along_shaft(instrument, index, pixels, self.ghost_width)
        return cv2.imencode(".png", along)[1].tobytes(), "image/png"

    def _along_shaft(self, instrument: str, index: int, pixels: np.ndarray, width: int) -> np.ndarray:
        """The part of a frame's pixels [H, W, C] about the shaft, which points to the right, so wide."""
        posing = self._posings[instrument]
        left, right, top, bottom = _window(posing)
        scale = (right - left) / width
        along = left + (np.arange(width) + 0.5) * scale
        across = top + (np.arange(round((bottom - top) / scale)) + 0.5) * scale
        return np.ascontiguousarray(crop(posing.shafts, index, pixels, along, across).transpose(1, 0, 2))

    def _overview(self, instrument: str) -> dict[str, Any]:
        posing = self._posing(instrument, 0)
        answered = {frame for frame, _ in posing.answers}
        outliers: dict[int, list[str]] = {}
        for outlier in posing.outliers():
            outliers.setdefault(outlier.frame, []).append(str(outlier))
        limits = {name: posing.instrument.joints[name] for name in posing.joints}
        return {
            "ghost": self.scene is not None,
            "capture": self.posed.root.resolve().name,
            "instrument": instrument,
            "frames": len(self.posed.frames),
            "suggested": [
                {"frame": item.frame, "reason": item.reason}
                for item in posing.suggestions(max(1, POSING.n_suggested - len(answered)))
            ],
            "of": max(POSING.n_suggested, len(answered)),
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
            "window": _window(posing),
            "length": posing.shafts.working_length_mm,
            "radius": posing.shafts.diameter_mm / 2,
            "joints": {
                name: self.joint_range_deg if span is None else [math.degrees(end) for end in span]
                for name, span in limits.items()
            },
        }


@cache
def page() -> bytes:
    """The page, one file of HTML."""
    folder = files("neeco.viewer") / "posing_page"
    html, style, script = (folder.joinpath(f"page.{kind}").read_text("utf-8") for kind in ("html", "css", "js"))
    return html.replace("{{ style }}", style).replace("{{ script }}", script).encode()


def _window(posing: SolvedPosing) -> list[float]:
    """Left, right (mm along the shaft), top and bottom (across) of a picture."""
    shares = (-PosingServer.before, PosingServer.beyond, -PosingServer.aside, PosingServer.aside)
    return [share * posing.shafts.working_length_mm for share in shares]


def _require_state(posing: SolvedPosing, roll_deg: float, joints_deg: Mapping[str, float]) -> None:
    """Raise NeecoError where these are no roll and joints of the instrument."""
    turns = all(abs(value) <= 360 for value in (roll_deg, *joints_deg.values()))
    if set(joints_deg) != set(posing.joints) or not turns:
        raise NeecoError(f"answer: expected {', '.join(posing.angles)} in degrees between -360 and 360")
