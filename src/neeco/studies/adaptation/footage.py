"""Frames of a video, a folder of images or a capture, each before the camera that took it."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from neeco.base.errors import NeecoError
from neeco.base.files import write_unsynced
from neeco.capture.images import encoded_png, image_files, image_size
from neeco.capture.model import Frame, State, evenly_spaced
from neeco.capture.readers import read_capture
from neeco.geometry.camera import Camera
from neeco.scene import Recorded
from neeco.synthesis.writers import link

Intrinsics = tuple[float, float, float, float]  # fx, fy, cx, cy; px
TRANSFORMS = "transforms.json"
ORIGIN = torch.eye(4)


@dataclass(frozen=True, kw_only=True)
class FootageSettings:
    """Limits of footage."""

    # relative difference of aspect ratios, below which the run's camera, scaled, is that of the frames
    same_aspect: float = 0.01


FOOTAGE = FootageSettings()


def adapted_frames(
    footage: Path,
    folder: Path,
    most: int,
    intrinsics: Intrinsics | None,
    recorded: Recorded,
    progress: Callable[[int, int], None],
) -> list[Frame]:
    """Return at most `most` frames of the footage, evenly spaced, in order; their images are linked or decoded to
    `folder`. The world is the camera's own frame. Raises NeecoError for footage that cannot be read, and for frames of
    another shape than the run's where no intrinsics are known."""
    if footage.is_dir() and (footage / TRANSFORMS).exists():
        return _of_capture(footage, folder, most, intrinsics)
    folder.mkdir(parents=True, exist_ok=True)
    if footage.is_dir():
        files = image_files(footage)
        if not files:
            raise NeecoError(f"{footage}: contains no images; give a folder of .png or .jpg files, or a video")
        chosen = [files[k] for k in evenly_spaced(len(files), most)]
        if len({file.stem for file in chosen}) < len(chosen):
            raise NeecoError(f"{footage}: two images differ in their suffix alone; give them different names")
        paths = []
        for file in chosen:
            link(file, folder / file.name)
            paths.append(folder / file.name)
    else:
        paths = _of_video(footage, folder, most, progress)
    camera = _camera(footage, image_size(paths[0]), intrinsics, recorded)
    for path in paths:
        if image_size(path) != (camera.width, camera.height):
            raise NeecoError(f"{footage / path.name}: differs in size from the first image; give images of one size")
    return [Frame(path, camera, State({}, float(k)), "footage") for k, path in enumerate(paths)]


def _of_video(video: Path, folder: Path, most: int, progress: Callable[[int, int], None]) -> list[Path]:
    """Decode frames of a video to PNG files, those that are absent, and return their paths."""
    from neeco.ingest.readers.video import open_video, require_installed

    require_installed("av")
    source = open_video(video)
    if source.pixel_aspect != 1:
        raise NeecoError(f"{video}: its pixels are not square; convert it to square pixels, or give images")
    chosen = evenly_spaced(len(source.times), most)
    paths = {index: folder / f"{index:06d}.png" for index in chosen}
    absent = [index for index, path in paths.items() if not path.exists()]
    for done, (index, pixels) in enumerate(source.read(absent), 1):
        write_unsynced(paths[index], encoded_png(pixels[..., ::-1]))
        progress(done, len(absent))
    return [paths[index] for index in chosen]


def _of_capture(footage: Path, folder: Path, most: int, intrinsics: Intrinsics | None) -> list[Frame]:
    capture = read_capture(footage)
    frames = sorted(capture.frames, key=lambda frame: frame.state.time)
    folder.mkdir(parents=True, exist_ok=True)
    chosen = []
    for frame in (frames[k] for k in evenly_spaced(len(frames), most)):
        path = folder / frame.image_path.name
        link(frame.image_path, path)
        camera = frame.camera
        own = camera.fx, camera.fy, camera.cx, camera.cy
        camera = Camera(ORIGIN, *(intrinsics or own), camera.width, camera.height)
        chosen.append(replace(frame, image_path=path, camera=camera, state=State({}, frame.state.time)))
    return chosen


def _camera(footage: Path, size: tuple[int, int], intrinsics: Intrinsics | None, recorded: Recorded) -> Camera:
    """Return the camera of images of this size, at the world's origin."""
    learned = recorded.cameras[0]
    if intrinsics is not None:
        return Camera(ORIGIN, *intrinsics, *size)
    ratios = size[0] / size[1], learned.width / learned.height
    if abs(ratios[0] / ratios[1] - 1) > FOOTAGE.same_aspect:
        shapes = f"{size[0]}x{size[1]}, the run's {learned.width}x{learned.height}"
        raise NeecoError(f"{os.fspath(footage)}: images of another shape ({shapes}); state --intrinsics FX FY CX CY")
    factor = size[0] / learned.width
    fx, fy, cx, cy = (factor * value for value in (learned.fx, learned.fy, learned.cx, learned.cy))
    return Camera(ORIGIN, fx, fy, cx, cy, *size)
