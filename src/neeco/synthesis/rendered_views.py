"""`neeco render`: render the frames of a split, or given states, with part ids and masks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch

from neeco.base.errors import NeecoError
from neeco.base.files import write_json
from neeco.capture import read_capture
from neeco.capture.checks.truth import PARTS_FILE
from neeco.capture.images import write_image, write_labels
from neeco.capture.model import State
from neeco.capture.readers import read_states
from neeco.geometry.camera import Camera
from neeco.labels.drawing import draw
from neeco.synthesis.cameras import DrawnCameras
from neeco.synthesis.dataset import part_ids
from neeco.synthesis.samplers import moved_camera
from neeco.synthesis.settings import AS_RECORDED, ImageSettings

if TYPE_CHECKING:
    from neeco.scene import DrawableScene
    from neeco.training.run import TrainedRun

STATES_FOLDER = "states"


@dataclass(frozen=True)
class Rendered:
    """The rendered images: their folder and number."""

    folder: Path
    images: int
    labelled: bool  # False: the scene's method learns no labels, so there are no part ids and masks


class View(NamedTuple):
    """An image to render."""

    name: str
    state: State
    camera: Camera


def split_views(run: TrainedRun, split: str, capture_path: Path | None = None) -> list[View]:
    """The frames of one split of a capture (the run's own unless given), named by their files' stems.

    Stems that several frames share are made unique by the names of the folders above them. Raises NeecoError.
    """
    if capture_path is None:
        capture = run.capture()
    else:
        capture = run.scene.recorded.completed(read_capture(capture_path), run.scene.instruments)
    frames = capture.split(split)
    if not frames:
        known = ", ".join(capture.splits) or "none"
        raise NeecoError(f"{capture.root}: split {split!r} has no frames; the capture has {known}")
    counts = Counter(frame.name for frame in frames)
    views = []
    for frame in frames:
        path = frame.image_path.with_suffix("")
        folders = path.relative_to(capture.root).parts if path.is_relative_to(capture.root) else path.parts[-2:]
        views.append(View(frame.name if counts[frame.name] == 1 else "_".join(folders), frame.state, frame.camera))
    return views


def state_views(scene: DrawableScene, path: Path) -> list[View]:
    """The states of a JSON-lines file, each from its own camera, or the first recorded one where it has none."""
    first = scene.recorded.cameras[0]
    views = []
    instruments = scene.recorded.with_limits(scene.instruments)
    for k, line in enumerate(read_states(path, instruments)):
        camera = first if line.world_from_camera is None else moved_camera(first, line.world_from_camera)
        views.append(View(f"{k:06d}", line.state, camera))
    return views


def render(
    scene: DrawableScene,
    views: Sequence[View],
    folder: Path,
    on_progress: Callable[[int], None] = lambda done: None,
    images: ImageSettings = AS_RECORDED,
) -> Rendered:
    """Write NAME.png (or .jpg), NAME_parts.png (part ids) and NAME_mask.png (0/255) for every view, and parts.json:
    what the ids mean. How many threads torch takes is the caller's to set (`open_run`). Raises NeecoError."""
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
    return Rendered(folder, len(views), bool(scene.label_names))
