"""Render a recording's frames and write their files."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy.spatial.transform import Rotation
from torch import Tensor

from neeco.base.files import write_atomically
from neeco.capture.images import write_labels
from rendered import instrument
from rendered.exposure import Processor
from rendered.kinematics import truth_ids
from rendered.motion import Array, Moment, Trajectory, is_unseen, rigid
from rendered.render import Drawing, Lens, Place, draw, shadowed, view_of
from rendered.scenes import SceneSpec
from rendered.tissue import ORGANS

DEPTH_UNIT_MM, DEPTH_STRIDE, DEPTH_EVERY = 0.05, 2, 4
# the right camera of a stereo scope: 4.6 mm beside the left one, turned towards what it looks at
RIGHT_FROM_LEFT = rigid(Rotation.from_rotvec([0.003, -0.035, 0.004]).as_matrix(), np.array([-4.6, 0.05, 0.08]))
Gains = dict[int, tuple[float, float, float]]


@dataclass(frozen=True)
class Settings:
    """What to render, and how."""

    lens: Lens = field(default_factory=Lens)
    resolution: int = 2400  # texels along the tissue's side
    every: int = 1  # keep one frame in so many (previews)
    frames: int | None = None  # slow the motion until it has so many training frames
    still: bool = False  # the scope stands still
    stereo: bool = False  # right/: the images of a second camera beside it
    processor: Processor = field(default_factory=Processor)

    def place(self, spec: SceneSpec) -> Place:
        """Tissue, instrument, lamps and lens."""
        tissue = ORGANS[spec.organ](spec.seed, self.resolution)
        return Place(tissue, spec.design, spec.lamps, self.lens)


@dataclass(frozen=True)
class Shot:
    """One frame of the recording: exact motion, and what was seen."""

    number: int
    time: float
    split: str
    moment: Moment


def take_shots(trajectory: Trajectory, spec: SceneSpec, every: int = 1) -> list[Shot]:
    """The recording's frames in order; checks that each obeys its split's rule."""
    shots = []
    for number, (moment_time, split) in enumerate(zip(trajectory.times, trajectory.splits, strict=True)):
        moment = trajectory.at(float(moment_time))
        if is_unseen(spec.path, moment) != (split == "unseen"):
            raise ValueError(f"frame {number} is {split}, but its state says otherwise")
        if number % every == 0:
            shots.append(Shot(number, float(moment_time), split, moment))
    return shots


@dataclass(frozen=True)
class Rendered:
    """One frame as the rest of the pipeline needs it: pixels uint8 [H, W, 3] and the rendering they came from."""

    pixels: Array
    drawing: Drawing


@dataclass(frozen=True)
class Renderer:
    """Renders frames of one scene into the folder `path`."""

    spec: SceneSpec
    settings: Settings
    path: Path
    place: Place
    gains: Gains  # by frame number; empty without automatic exposure

    def render(self, shot: Shot) -> Rendered:
        """Render a frame and write its image, its masks of parts and of the shadow, and its depth."""
        view, gain = view_of(shot.moment), self.gains.get(shot.number)
        drawing = draw(self.place, view, gain)
        pixels = self.stored(drawing.color, np.random.default_rng((self.spec.seed, shot.number)))
        _write_jpeg(self.path / image_name(shot), pixels)
        self._write_truth(shot, drawing, shadowed(self.place, view, drawing))
        if self.settings.stereo:
            color = draw(seen_from_right(self.place), view_of(beside(shot).moment), gain).color
            right = self.stored(color, np.random.default_rng((self.spec.seed, shot.number, 2)))
            _write_jpeg(self.path / right_name(shot), right)
        return Rendered(pixels, drawing)

    def stored(self, color: Tensor, generator: np.random.Generator) -> Array:
        processor = self.settings.processor
        return _add_noise(processor.develop(color) if processor != Processor() else color, processor.noise, generator)

    def _write_truth(self, shot: Shot, drawing: Drawing, shadow: Tensor) -> None:
        truth, name = self.path / "truth", f"{shot.number:06d}.png"
        ids = torch.tensor([0, instrument.SHAFT, instrument.WRIST, *truth_ids(self.spec)], dtype=torch.uint8)
        write_labels(truth / "masks" / name, ids[drawing.parts.long()])
        write_labels(truth / "shadow" / name, shadow.to(torch.uint8) * 255)
        if has_depth(shot):
            counts = (drawing.depth[::DEPTH_STRIDE, ::DEPTH_STRIDE] / DEPTH_UNIT_MM).round().clamp(0, 65535)
            depth = Image.fromarray(counts.numpy().astype(np.uint16))
            write_atomically(truth / "depth" / name, lambda target: depth.save(target, "PNG"))


def seen_from_right(place: Place) -> Place:
    """A place whose lamps stay where they are, in the right camera's frame."""
    lamps = np.array(place.lamps.positions) @ RIGHT_FROM_LEFT[:3, :3].T + RIGHT_FROM_LEFT[:3, 3]
    return replace(place, lamps=replace(place.lamps, positions=tuple(map(tuple, lamps.tolist()))))


def beside(shot: Shot) -> Shot:
    """A shot as the right camera takes it."""
    camera = shot.moment.scene_from_camera @ np.linalg.inv(RIGHT_FROM_LEFT)
    return replace(shot, moment=replace(shot.moment, scene_from_camera=camera))


def _add_noise(color: Tensor, factor: float, generator: np.random.Generator) -> Array:
    """uint8 [H, W, 3] with `factor` times the default sensor's noise (about 1.5/255, mostly luminance)."""
    noisy = color.numpy().astype(np.float64)
    noisy = noisy + generator.normal(0, factor * 1.4 / 255, (*noisy.shape[:2], 1))
    noisy = noisy + generator.normal(0, factor * 0.6 / 255, noisy.shape)
    return np.clip(np.rint(noisy * 255), 0, 255).astype(np.uint8)


def _write_jpeg(path: Path, pixels: Array) -> None:
    image = Image.fromarray(pixels, "RGB")
    write_atomically(
        path, lambda target: image.save(target, format="JPEG", quality=95, subsampling=0, progressive=True)
    )


def image_name(shot: Shot) -> str:
    """An image's path in the capture."""
    return f"images/{shot.number:06d}.jpg"


def right_name(shot: Shot) -> str:
    """The path of the right camera's image."""
    return f"right/{shot.number:06d}.jpg"


def has_depth(shot: Shot) -> bool:
    """Whether a frame's depth is stored."""
    return shot.number % DEPTH_EVERY == 0 or shot.split == "unseen"
