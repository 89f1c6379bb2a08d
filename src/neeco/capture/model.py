"""What a capture is: frames, cameras, instrument states, splits, sparse points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from neeco.capture.images import read_image, read_mask
from neeco.raster.types import Camera


@dataclass(frozen=True)
class InstrumentState:
    """Where one instrument is and how its joints stand."""

    pose: Tensor  # [4, 4] float64, world_from_instrument, mm
    joints: Mapping[str, float] = field(default_factory=dict)  # name -> rad


@dataclass(frozen=True)
class State:
    """Everything that moves, at one moment: each instrument's state by name, and the time."""

    instruments: Mapping[str, InstrumentState] = field(default_factory=dict)
    time: float = 0.0  # s

    def to(self, device: torch.device | str) -> State:
        """The same state, its poses on `device`."""
        moved = {name: replace(given, pose=given.pose.to(device)) for name, given in self.instruments.items()}
        return replace(self, instruments=moved)


@dataclass(frozen=True)
class Instrument:
    """One tracked rigid body and its joints. `joints`: name -> (lower, upper) limit in rad, or None when not stated."""

    name: str
    joints: Mapping[str, tuple[float, float] | None] = field(default_factory=dict)


@dataclass(frozen=True)
class Frame:
    """One image with its camera, instrument states, time and split. Pixels are read on demand."""

    image_path: Path
    camera: Camera
    state: State
    split: str
    mask_path: Path | None = None  # black pixels are ignored by the loss
    background: float = 1.0  # what shows through transparent pixels: 0 black, 1 white

    @property
    def name(self) -> str:
        """The image file's stem; it names everything drawn for this frame."""
        return self.image_path.stem

    def load_image(self) -> Tensor:
        """float32 [H, W, 3] in [0, 1], sRGB as stored. Raises NeecoError when unreadable or of another size."""
        return read_image(self.image_path, (self.camera.width, self.camera.height), self.background)

    def load_mask(self) -> Tensor | None:
        """bool [H, W], True where the loss counts, or None when the frame has no mask. Raises NeecoError."""
        if self.mask_path is None:
            return None
        return read_mask(self.mask_path, (self.camera.width, self.camera.height))


@dataclass(frozen=True)
class PointCloud:
    """Sparse coloured points in the world frame."""

    positions: np.ndarray  # [P, 3] float32, mm
    colors: np.ndarray  # [P, 3] float32 in [0, 1]
    measured: bool = True  # False: random points, because the capture has none


@dataclass(frozen=True)
class Capture:
    """A recording ready to learn from."""

    root: Path
    frames: tuple[Frame, ...]
    instruments: tuple[Instrument, ...]
    points: PointCloud
    registered: bool = True  # instrument poses are in the cameras' world frame
    timed: bool = True  # the recording says when each frame was taken; else `State.time` counts the frames

    def split(self, name: str) -> tuple[Frame, ...]:
        """The frames of one split, in recorded order."""
        return tuple(frame for frame in self.frames if frame.split == name)

    @property
    def splits(self) -> tuple[str, ...]:
        """Names of the splits present, in order of first appearance."""
        return tuple(dict.fromkeys(frame.split for frame in self.frames))


def evenly_spaced(count: int, most: int, *, floor: bool = False) -> list[int]:
    """Indices of at most `most` of `count` items, evenly spaced from the first to the last, in order, none twice.

    Places between two items are rounded to the nearest (half to even), or with `floor` down.
    """
    places = np.linspace(0, count - 1, min(count, most))
    return np.unique((np.floor if floor else np.rint)(places).astype(int)).tolist()
