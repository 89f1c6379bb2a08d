"""What a model to train says of itself, what it is given, and what it answers with."""

from __future__ import annotations

import importlib.util
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import torch

from neeco.errors import NeecoError
from neeco.experiments.downstream import models
from neeco.experiments.downstream.feed import Feed
from neeco.experiments.downstream.samples import Sample
from neeco.registry import named_classes

Answers = Literal["masks", "boxes"]


@dataclass(frozen=True)
class Boxes:
    """What a detector found in one image, best first."""

    boxes: np.ndarray  # [n, 4] x0, y0, x1, y1 px
    classes: np.ndarray  # [n] int64, from 1
    scores: np.ndarray  # [n] in [0, 1]


Prediction = np.ndarray | Boxes  # classes of pixels uint8 [H, W], 0 tissue; or boxes


@dataclass(frozen=True)
class Task:
    """What a model is to learn, and within which means."""

    classes: tuple[str, ...]
    feed: Feed
    validation: tuple[Sample, ...]  # may be empty
    size: tuple[int, int]  # width, height of images as the model sees them
    steps: int
    batch: int
    seed: int
    device: torch.device
    folder: Path  # the job's, for what training writes
    weights: Path | None = None  # to begin from; None: from scratch
    tell: Callable[[float, str], None] = lambda share, text: None


@dataclass(frozen=True)
class Fitted:
    """A trained model. `predict` answers for uint8 images [H, W, 3] at their size.

    validation: (step, score in [0, 1]) along the way. best_step: the step whose weights are kept.
    """

    predict: Callable[[Sequence[np.ndarray]], list[Prediction]]
    best_step: int
    validation: list[tuple[int, float]] = field(default_factory=list)


class Model(ABC):
    """A detector or segmenter. Its class attributes are what is known before anything is imported."""

    model: ClassVar[str]
    answers: ClassVar[Answers]
    side: ClassVar[int]  # px, the longer side of the images it sees unless --size says otherwise
    multiple: ClassVar[int]  # both sides are multiples of it
    steps: ClassVar[int]  # until it is taught what a few hundred images teach
    batch: ClassVar[int]
    accepts_weights: ClassVar[bool] = True
    orders_images: ClassVar[bool] = True  # it sees them in the feed's order

    @classmethod
    @abstractmethod
    def unmet(cls) -> str | None:
        """What it needs and this machine lacks, with the remedy, in words; None when it can be trained."""

    @classmethod
    def sees_too_little(cls, size: tuple[int, int]) -> bool:
        """Whether images of this size (width, height), as it would see them, are too small for it."""
        return False

    @abstractmethod
    def fit(self, task: Task) -> Fitted:
        """Train it. The same task gives the same model on the CPU. Raises NeecoError for weights that do not fit."""


def lacking(*packages: str) -> str | None:
    """`unmet` of a model that needs packages of the extra `downstream`."""
    absent = [name for name in packages if importlib.util.find_spec(name) is None]
    return f"needs {' and '.join(absent)}; pip install 'neeco[downstream]'" if absent else None


@cache
def find_models() -> dict[str, type[Model]]:
    """Every class with a `model` name of its own in a public module of `models/`, by that name."""
    return named_classes(Model, "model", models)  # type: ignore[type-abstract]


def model_class(name: str) -> type[Model]:
    """The model of that name. Raises NeecoError when there is none."""
    known = find_models()
    if name not in known:
        raise NeecoError(f"--models: {name!r} is unknown; choose of {', '.join(known)}")
    return known[name]


def input_size(frame: tuple[int, int], side: int, multiple: int) -> tuple[int, int]:
    """(width, height) a model sees of frames of this size: the longer side at most `side`, both multiples of
    `multiple`, the nearest to the frame's shape."""
    scale = min(1.0, max(multiple, side - side % multiple) / max(frame))
    width, height = (max(multiple, multiple * round(edge * scale / multiple)) for edge in frame)
    return width, height
