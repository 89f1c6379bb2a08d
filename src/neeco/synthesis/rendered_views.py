"""`neeco render`: render the frames of a split, or given states, with part ids and masks, or as a video."""

from __future__ import annotations

import importlib.util
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from neeco.base.errors import NeecoError, install_hint
from neeco.base.files import write_atomically, write_json
from neeco.capture import read_capture
from neeco.capture.checks.frames import PARTS_FILE
from neeco.capture.images import to_bytes, write_image, write_labels
from neeco.capture.model import State
from neeco.capture.readers import read_states
from neeco.geometry.camera import Camera
from neeco.labels.drawing import draw, to_numpy
from neeco.scene import DrawableScene
from neeco.synthesis.dataset import part_ids
from neeco.synthesis.samplers import DrawnCameras, PathStates, interpolate_pose, moved_camera
from neeco.synthesis.settings import AS_RECORDED, ImageSettings
from neeco.training.run import TrainedRun

STATES_FOLDER = "states"
FPS = 25  # of a video
QUALITY = {"crf": "18"}  # of x264: visually lossless


class View(NamedTuple):
    """An image to render."""

    name: str
    state: State
    camera: Camera


def split_views(run: TrainedRun, split: str, capture_path: Path | None = None) -> list[View]:
    """Return the frames of one split of a capture (default: the run's own), named by their files' stems.

    Shared stems are made unique by folder names. Raises NeecoError.
    """
    other = None if capture_path is None else read_capture(capture_path)
    capture = run.scene.recorded.completed(other, run.scene.instruments) if other else run.capture()
    frames = capture.split(split)
    if not frames:
        splits = ", ".join(capture.splits) or "none"
        raise NeecoError(f"{capture.root}: split {split!r} has no frames; the capture has {splits}")
    counts = Counter(frame.name for frame in frames)
    views = []
    for frame in frames:
        path = frame.image_path.with_suffix("")
        folders = path.relative_to(capture.root).parts if path.is_relative_to(capture.root) else path.parts[-2:]
        views.append(View(frame.name if counts[frame.name] == 1 else "_".join(folders), frame.state, frame.camera))
    return views


def state_views(scene: DrawableScene, path: Path) -> list[View]:
    """Return the states of a JSON-lines file, each with its own camera, else the first recorded one."""
    first, lines = scene.recorded.cameras[0], read_states(path, scene.recorded.with_limits(scene.instruments))
    poses = (line.world_from_camera for line in lines)
    cameras = [first if pose is None else moved_camera(first, pose) for pose in poses]
    return [View(f"{k:06d}", line.state, camera) for k, (line, camera) in enumerate(zip(lines, cameras, strict=True))]


def render(
    scene: DrawableScene,
    views: Sequence[View],
    folder: Path,
    on_progress: Callable[[int], None] = lambda done: None,
    images: ImageSettings = AS_RECORDED,
) -> None:
    """Write NAME.png (or .jpg), NAME_parts.png (part ids) and NAME_mask.png (0/255) for every view, and parts.json with
    the meaning of the ids. The caller sets the number of torch threads (`open_run`). Raises NeecoError."""
    cameras = DrawnCameras.of(images, scene.recorded, (view.camera for view in views))
    for done, view in enumerate(views, 1):
        drawing = draw(scene, view.state, cameras(view.camera))
        write_image(folder / f"{view.name}.{images.image_format}", drawing.image, images.jpeg_quality)
        if drawing.parts is not None:
            write_labels(folder / f"{view.name}_parts.png", drawing.parts)
            write_labels(folder / f"{view.name}_mask.png", (drawing.parts > 0).to(torch.uint8) * 255)
        on_progress(done)
    if scene.label_names:
        write_json(folder / PARTS_FILE, {"ids": part_ids(scene.label_names)})


def require_pyav() -> None:
    """Raise NeecoError where PyAV is missing."""
    if importlib.util.find_spec("av") is None:
        raise NeecoError(f"--video: needs PyAV; {install_hint('ingest')}")


def views_along(views: Sequence[View], count: int) -> list[View]:
    """Return `count` views evenly spaced along the given ones, the first and last included: states as `PathStates`,
    camera poses as `interpolate_pose`. Raises NeecoError for fewer than two views."""
    path, rng = PathStates([view.state for view in views], count), np.random.default_rng(0)
    poses = [to_numpy(view.camera.world_from_camera) for view in views]
    along = []
    for k in range(count):
        segment, weight = path.place(k)
        pose = interpolate_pose(poses[segment], poses[segment + 1], weight)
        along.append(View(f"{k:06d}", path(k, rng), moved_camera(views[segment].camera, pose)))
    return along


def write_video(
    scene: DrawableScene,
    views: Sequence[View],
    path: Path,
    on_progress: Callable[[int], None] = lambda done: None,
    images: ImageSettings = AS_RECORDED,
) -> None:
    """Write the views' images in order, FPS per second, without the last row or column if odd (H.264 stores colours for
    two by two pixels). Raises NeecoError if PyAV is missing, images differ in size, or the disk refuses."""
    require_pyav()
    import av

    cameras = DrawnCameras.of(images, scene.recorded, (view.camera for view in views))
    if len(sizes := {(camera.width, camera.height) for camera in (cameras(view.camera) for view in views)}) != 1:
        raise NeecoError(f"--video: images of {len(sizes)} sizes; give --size")
    width, height = (2 * (side // 2) for side in sizes.pop())

    def write(temporary: Path) -> None:
        with av.open(str(temporary), "w", format="mp4", options={"movflags": "faststart"}) as container:
            stream = container.add_stream("h264", rate=FPS, options=QUALITY)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            for done, view in enumerate(views, 1):
                image = to_bytes(draw(scene, view.state, cameras(view.camera)).image)[:height, :width]
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image.numpy()), format="rgb24")
                container.mux(stream.encode(frame))
                on_progress(done)
            container.mux(stream.encode())

    write_atomically(path, write)
