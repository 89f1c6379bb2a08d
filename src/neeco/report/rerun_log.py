"""An ingest as a file for the rerun viewer, to be scrubbed: images, cameras, poses, joints, what moves, all clocks."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from neeco.capture.model import Capture, Frame
from neeco.errors import NeecoError, install_hint
from neeco.files import write_atomically
from neeco.ingest.result import IngestResult
from neeco.report.ingest_figures import AXIS_COLORS, axis_length

MISSING = f"--rrd: needs the package rerun-sdk; {install_hint('rerun')}"
VIDEO_CLOCK = "video"  # the timeline of the video's seconds; others are the logs' clocks
WORLD, CAMERA, RIGHT_CAMERA = "world", "world/camera", "world/right_camera"


def require_rerun() -> Any:
    """Return the package rerun. Raises NeecoError where it is not installed."""
    try:
        import rerun
    except ImportError:
        raise NeecoError(MISSING) from None
    return rerun


def write_rrd(result: IngestResult, capture: Capture, path: Path) -> None:
    """Write a capture that an ingest made, and what the ingest found, into one file: `rerun FILE` shows it.

    In the viewer `world` has the tissue's points, the cameras with their images and what moves in them, and the
    instruments with their rough shapes; `joints` has curves; `clocks` lists how far each log is ahead. There is a
    timeline for the video and one for each clock, of several recordings for each clock of each. Poses that were not
    registered are under `unregistered`, a world of their own. Raises NeecoError when rerun is missing, an image cannot
    be read or the file cannot be written.
    """
    rerun = require_rerun()
    stream = rerun.RecordingStream("neeco ingest", recording_id=str(result.capture), send_properties=False)
    memory = stream.memory_recording()
    _log_still(rerun, stream, result, capture)
    shown = -math.inf
    for frame in sorted(capture.frames, key=lambda frame: frame.state.time):
        seconds = frame.state.time
        number = int(result.selected[np.abs(result.selected_times - seconds).argmin()])
        stream.reset_time()  # of several recordings, each has clocks of its own
        stream.set_time(VIDEO_CLOCK, duration=seconds)
        for name, time in result.log_times(number, seconds).items():
            if name != VIDEO_CLOCK:
                stream.set_time(name, duration=time)
        # a stereo partner's frame follows the left one of its time
        camera = RIGHT_CAMERA if seconds == shown else CAMERA
        _log_camera(rerun, stream, frame, camera)
        if camera == CAMERA:
            _log_states(rerun, stream, frame, capture.registered)
            if number in result.moving:
                _log_moving(rerun, stream, result.moving[number], frame)
        shown = seconds
    content = memory.drain_as_bytes()
    write_atomically(path, lambda file: file.write_bytes(content))


def _log_still(rerun: Any, stream: Any, result: IngestResult, capture: Capture) -> None:
    """Log what holds for the whole recording: points, shapes, axes, clocks."""
    stream.log(WORLD, rerun.ViewCoordinates.RIGHT_HAND_Y_DOWN, static=True)
    points = rerun.Points3D(capture.points.positions, colors=capture.points.colors)
    stream.log(f"{WORLD}/tissue", points, static=True)
    arrows = rerun.Arrows3D(
        vectors=axis_length(capture) * np.eye(3), colors=[[*_rgb(color), 255] for color in AXIS_COLORS]
    )
    for instrument in capture.instruments:
        place = _place(instrument.name, capture.registered)
        stream.log(place, arrows, static=True)
        if instrument.name in result.shapes:
            shape = result.shapes[instrument.name]
            spheres = rerun.Points3D(shape.points, radii=shape.spacing / 2, colors=[255, 225, 74, 255])
            stream.log([*place, "shape"], spheres, static=True)
    rows = [
        f"| {name} | {1000 * clock.seconds:+.1f} ms | {1000 * clock.sd:.1f} ms | {clock.rate:.5g} | {clock.source} |"
        for name, clock in result.clocks.items()
    ]
    table = "\n".join(["| clock | ahead of the video | sd | rate | from |", "|---|---|---|---|---|", *rows])
    stream.log("clocks", rerun.TextDocument(table, media_type="text/markdown"), static=True)


def _log_camera(rerun: Any, stream: Any, frame: Frame, place: str) -> None:
    """Log a frame's image and camera at a place in the viewer, at the time that is set."""
    camera = frame.camera
    matrix = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    stream.log(place, _transform(rerun, camera.world_from_camera.double().numpy()))
    pinhole = rerun.Pinhole(
        image_from_camera=matrix, resolution=[camera.width, camera.height], camera_xyz=rerun.ViewCoordinates.RDF
    )
    stream.log(f"{place}/image", pinhole)
    stream.log(f"{place}/image", rerun.Image(frame.load_image_bytes().numpy()).compress(jpeg_quality=90))


def _log_states(rerun: Any, stream: Any, frame: Frame, registered: bool) -> None:
    """Log a frame's instrument states, at the time that is set."""
    for name, state in frame.state.instruments.items():
        stream.log(_place(name, registered), _transform(rerun, state.pose.numpy()))
        for joint, value in state.joints.items():
            stream.log(["joints", name, joint], rerun.Scalars(value))


def _log_moving(rerun: Any, stream: Any, moving: np.ndarray, frame: Frame) -> None:
    """Log what moves [h, w] in [0, 1] (NaN: unknown), over the frame's image."""
    grey = Image.fromarray(np.nan_to_num(255 * moving).astype(np.uint8))
    full = np.asarray(grey.resize((frame.camera.width, frame.camera.height), Image.Resampling.BILINEAR))
    stream.log(f"{CAMERA}/image/moving", rerun.Image(full, opacity=0.5).compress(jpeg_quality=85))


def _place(name: str, registered: bool) -> list[object]:
    """Return the place of an instrument in the viewer, by parts: its name may hold any character."""
    return [WORLD if registered else "unregistered", name]


def _transform(rerun: Any, pose: np.ndarray) -> Any:
    return rerun.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3])


def _rgb(color: str) -> tuple[int, ...]:
    """Return the numbers of `#rrggbb`."""
    return tuple(bytes.fromhex(color.removeprefix("#")))
