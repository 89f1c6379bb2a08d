"""`neeco render --video`: rendered views as an H.264 MP4, which browsers and slides play. PyAV encodes it."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from neeco.base.errors import NeecoError, install_hint
from neeco.base.files import write_atomically
from neeco.capture.images import to_bytes
from neeco.geometry.camera import Camera
from neeco.labels.drawing import draw, to_numpy
from neeco.synthesis.cameras import DrawnCameras
from neeco.synthesis.rendered_views import View
from neeco.synthesis.samplers import moved_camera
from neeco.synthesis.settings import AS_RECORDED, ImageSettings
from neeco.synthesis.states import PathStates, interpolate_pose

if TYPE_CHECKING:
    from neeco.scene import DrawableScene

FPS = 25
QUALITY = {"crf": "18"}  # of x264: visually lossless


def require_pyav() -> None:
    """Raise NeecoError where PyAV is missing."""
    if importlib.util.find_spec("av") is None:
        raise NeecoError(f"--video: needs PyAV; {install_hint('ingest')}")


def views_along(views: Sequence[View], count: int) -> list[View]:
    """Return `count` views evenly spread along given ones, the first and last included: states as `PathStates`, camera
    poses as `interpolate_pose`. Raises NeecoError for fewer than two views."""
    path, rng = PathStates([view.state for view in views], count), np.random.default_rng(0)
    return [View(f"{k:06d}", path(k, rng), _camera_between(views, *path.place(k))) for k in range(count)]


def _camera_between(views: Sequence[View], segment: int, weight: float) -> Camera:
    first, second = views[segment].camera, views[segment + 1].camera
    poses = [to_numpy(camera.world_from_camera) for camera in (first, second)]
    return moved_camera(first, interpolate_pose(poses[0], poses[1], weight))


def write_video(
    scene: DrawableScene,
    views: Sequence[View],
    path: Path,
    on_progress: Callable[[int], None] = lambda done: None,
    images: ImageSettings = AS_RECORDED,
) -> None:
    """Write the views' images in order, FPS of them a second, without the last row or column where that is odd (H.264
    has colours of two by two pixels). Raises NeecoError where PyAV is missing, images differ in size, or the disk
    refuses."""
    require_pyav()
    import av

    cameras = DrawnCameras.of(images, scene.recorded, (view.camera for view in views))
    if len(sizes := {(camera.width, camera.height) for camera in (cameras(view.camera) for view in views)}) != 1:
        raise NeecoError(f"--video: images of {len(sizes)} sizes; give --size")
    width, height = (2 * (side // 2) for side in sizes.pop())

    def frames() -> Iterator[av.VideoFrame]:
        for done, view in enumerate(views, 1):
            image = to_bytes(draw(scene, view.state, cameras(view.camera)).image)[:height, :width]
            yield av.VideoFrame.from_ndarray(np.ascontiguousarray(image.numpy()), format="rgb24")
            on_progress(done)

    def write(temporary: Path) -> None:
        with av.open(str(temporary), "w", format="mp4", options={"movflags": "faststart"}) as container:
            stream = container.add_stream("h264", rate=FPS, options=QUALITY)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            for frame in frames():
                container.mux(stream.encode(frame))
            container.mux(stream.encode())

    write_atomically(path, write)
