"""Small things to teach and to be tested on: examples in memory, and data set folders as `neeco synthesize` writes."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import nn

from neeco.studies.downstream.model import TorchModel, TrainingTask
from neeco.studies.downstream.models.unet import UNet
from neeco.studies.downstream.samples import Example
from neeco.studies.downstream.training_data import Batch, BatchSampler, TrainingImage, collate, shrink

PARTS = (("bar", "shaft"), ("bar", "wrist"), ("bar", "jaw_left"), ("bar", "jaw_right"))


def save_grey(path: Path, pixels: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.asarray(pixels, np.uint8), "L").save(path)
    return path


def save_rgb(path: Path, pixels: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.asarray(pixels, np.uint8), "RGB").save(path)
    return path


def read_grey(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path))


def write_ids(root: Path, names: tuple[tuple[str, str], ...] = PARTS) -> None:
    """dataset.json, saying what the ids of parts/ mean."""
    ids = [{"id": 0, "part": "tissue"}]
    ids += [{"id": k + 1, "instrument": name, "part": part} for k, (name, part) in enumerate(names)]
    (root / "dataset.json").write_text(json.dumps({"scene": "s", "settings": {"seed": 0}, "ids": ids}))


def bar_parts(index: int, size: tuple[int, int] = (48, 40)) -> np.ndarray:
    """Part ids [H, W]: a bar of shaft 1, wrist 2 and jaws 3 and 4, elsewhere in each image."""
    parts = np.zeros(size[::-1], np.uint8)
    row, column = 5 + 5 * (index % 5), 6 + 4 * (index % 4)
    for part in range(4):
        parts[row : row + 8, column + 5 * part : column + 5 * part + 5] = part + 1
    return parts


def picture_of(parts: np.ndarray, seed: int) -> np.ndarray:
    """uint8 [H, W, 3]: a bright instrument before dark tissue."""
    noise = np.random.default_rng(seed).integers(0, 60, (*parts.shape, 3))
    return (noise + 180 * (parts > 0)[..., None]).astype(np.uint8)


def write_set(root: Path, count: int = 6, size: tuple[int, int] = (48, 40), info: bool = True) -> Path:
    """A data set of `count` images."""
    for index in range(count):
        parts, name = bar_parts(index, size), f"{index:06d}.png"
        save_rgb(root / "images" / name, picture_of(parts, index))
        save_grey(root / "masks" / name, (parts > 0) * 255)
        save_grey(root / "parts" / name, parts)
    if info:
        write_ids(root)
    return root


def square(seed: int, side: int = 64) -> Example:
    """A bright rectangle somewhere on dark noise."""
    random = np.random.default_rng(seed)
    image = random.integers(0, 60, (side, side, 3)).astype(np.uint8)
    classes = np.zeros((side, side), np.uint8)
    width, height = random.integers(side // 4, side // 2, 2)
    x, y = random.integers(2, side // 2 - 2, 2)
    classes[y : y + height, x : x + width] = 1
    image[classes > 0] += 180
    return Example(image, classes)


@dataclass(frozen=True)
class Held:
    """A sample that is in memory already, and counts how often it is read."""

    example: Example
    name: str = "held"
    loads: list[str] = field(default_factory=list)

    @property
    def key(self) -> tuple[object, ...]:
        return tuple(None if array is None else array.tobytes() for array in vars(self.example).values())

    def load(self) -> Example:
        self.loads.append(self.name)
        return self.example


def squares(count: int, first: int = 0, side: int = 64) -> tuple[Held, ...]:
    return tuple(Held(square(first + k, side), str(first + k)) for k in range(count))


def task_of(folder: Path, **changes) -> TrainingTask:
    """To find bright rectangles, in a few steps."""
    given = {
        "classes": ("instrument",),
        "batches": BatchSampler(squares(12), seed=0),
        "size": (64, 64),
        "steps": 4,
        "batch": 2,
        "seed": 0,
        "device": torch.device("cpu"),
        "folder": folder,
    }
    return TrainingTask(**given | changes)


def batch_of(examples: list[Example], size: tuple[int, int], classes: int = 1) -> Batch:
    """The batch of these examples on the CPU."""
    images: list[TrainingImage] = [shrink(example, size, classes, outlines=True) for example in examples]
    return collate(images, torch.device("cpu"))


class Pixels(TorchModel):
    """A class for each pixel from its colour alone: taught in a blink."""

    model = "pixels"
    predicts = "masks"
    image_size, multiple, steps, batch, learning_rate = 48, 8, 6, 2, 0.1

    @classmethod
    def missing_requirement(cls) -> None:
        return None

    def build(self, classes: int) -> nn.Module:
        return nn.Conv2d(3, classes + 1, 1)

    loss = UNet.loss
    predictions = UNet.predictions
