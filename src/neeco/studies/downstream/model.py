"""Downstream models: their interface, and the training loop that all share."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Literal

import cv2
import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from neeco.base.errors import NeecoError
from neeco.base.files import write_atomically
from neeco.base.registry import plugins
from neeco.studies.downstream.results import Prediction
from neeco.studies.downstream.training_data import Batch, BatchSampler, collate, training_image

WEIGHTS_FILE = "weights.safetensors"
Predict = Callable[[Sequence[np.ndarray]], list[Prediction]]  # of uint8 images [H, W, 3], at their size


@dataclass(frozen=True, kw_only=True)
class TrainingTask:
    """The training data, size and budget of a model."""

    classes: tuple[str, ...]
    batches: BatchSampler
    size: tuple[int, int]  # width, height of input images
    steps: int
    batch: int
    seed: int
    device: torch.device
    folder: Path  # output folder of the job
    keep_weights: bool = True  # whether to write the final weights to the folder
    progress: Callable[[float, str], None] = lambda share, text: None


class TorchModel(ABC):
    """A detector or segmenter: attributes, which are available before heavy imports, a module, a loss and predictions;
    `fit` is shared.

    AdamW, the same number of steps in every condition; the learning rate rises over the first steps and falls to 0 as
    a cosine (Loshchilov and Hutter, "SGDR", 2017). The weights after the last step are the model, without model
    selection, which would need a labelled validation set.
    """

    model: ClassVar[str]
    predicts: ClassVar[Literal["masks", "boxes"]]
    image_size: ClassVar[int]  # px, longer side of its input images unless --size is given
    multiple: ClassVar[int]  # both sides are multiples of it
    steps: ClassVar[int]  # sufficient for a few hundred images
    batch: ClassVar[int]
    learning_rate: ClassVar[float]
    weight_decay: ClassVar[float] = 1e-4
    gradient_clip: ClassVar[float] = 0.1  # limit on the norm of the gradient, as in D-FINE
    warmup: ClassVar[float] = 0.1  # share of the steps over which the learning rate rises
    prediction_batch: ClassVar[int] = 16  # images per batch of predictions
    report_every: ClassVar[int] = 10  # steps between two reports of progress

    @classmethod
    def missing_requirement(cls) -> str | None:
        """Return the requirement that this machine lacks, with the remedy; None if the model can be trained."""
        return None

    @classmethod
    def is_too_small(cls, size: tuple[int, int]) -> bool:
        """Return whether images of this size (width, height) are too small as input."""
        return False

    @abstractmethod
    def build(self, classes: int) -> nn.Module:
        """Return the untrained module, initialised with torch's random numbers."""

    @abstractmethod
    def loss(self, module: Any, batch: Batch) -> Tensor:
        """Return the loss of a batch."""

    @abstractmethod
    def predictions(self, module: Any, images: Tensor, sizes: Sequence[tuple[int, int]]) -> list[Prediction]:
        """Return the predictions of images [B, 3, h, w]; sizes: (height, width) of each prediction."""

    def fit(self, task: TrainingTask) -> Predict:
        """Train the model; write the weights to the folder's weights.safetensors. Raises NeecoError if it diverges.

        Deterministic on the CPU. Torch's random numbers start at the task's seed, and the previous state is restored
        afterwards.
        """
        with torch.random.fork_rng():
            torch.manual_seed(task.seed)
            module = self.build(len(task.classes)).to(task.device)
            module = module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # faster on a CPU
            self._train(module, task)
        if task.keep_weights:
            state = {name: value.detach().contiguous().cpu() for name, value in module.state_dict().items()}
            first = {value.data_ptr(): name for name, value in reversed(state.items())}  # tied tensors once each
            stored = {name: state[name] for name in reversed(first.values())}
            write_atomically(task.folder / WEIGHTS_FILE, lambda path: save_file(stored, path))
        return lambda images: self._predict(module.eval(), images, task)

    def _train(self, module: nn.Module, task: TrainingTask) -> None:
        fused = task.device.type == "cuda"
        decay = self.weight_decay
        optimizer = torch.optim.AdamW(module.parameters(), self.learning_rate, weight_decay=decay, fused=fused)

        def rate(step: int) -> float:  # as a share of the maximum
            return min((step + 1) / (1 + self.warmup * task.steps), (1 + math.cos(math.pi * step / task.steps)) / 2)

        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, rate)
        rng = torch.Generator(task.device).manual_seed(task.seed) if task.batches.augmented else None
        with_boxes = self.predicts == "boxes"
        module.train()
        for step in range(1, task.steps + 1):
            samples = task.batches.draw(task.batch, (step - 1) / task.steps)
            images = [training_image(sample, task.size, len(task.classes), with_boxes) for sample in samples]
            loss = self.loss(module, collate(images, task.device, rng))
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(module.parameters(), self.gradient_clip)
            optimizer.step()
            schedule.step()
            if step % self.report_every == 0 or step == task.steps:  # synchronises with the GPU
                value = loss.item()
                if not math.isfinite(value):
                    raise NeecoError(f"{self.model}: loss is not finite at step {step}; train with more images")
                task.progress(step / task.steps, f"step {step}  loss {value:.3f}")

    @torch.inference_mode()
    def _predict(self, module: nn.Module, images: Sequence[np.ndarray], task: TrainingTask) -> list[Prediction]:
        predictions: list[Prediction] = []
        for start in range(0, len(images), self.prediction_batch):
            chunk = images[start : start + self.prediction_batch]
            inputs = np.stack([cv2.resize(image, task.size, interpolation=cv2.INTER_AREA) for image in chunk])
            batch = torch.from_numpy(inputs).permute(0, 3, 1, 2).to(task.device, torch.float32) / 255
            batch = batch.contiguous(memory_format=torch.channels_last)
            predictions += self.predictions(module, batch, [(image.shape[0], image.shape[1]) for image in chunk])
        return predictions


@cache
def find_models() -> dict[str, type[TorchModel]]:
    """Return all model classes by their `model` name, of `models/` and of entry points in `neeco.models`. Raises
    NeecoError if two share a name, or one cannot be loaded."""
    return plugins(TorchModel, "model", "neeco.studies.downstream.models", "neeco.models")  # type: ignore[type-abstract]


def model_class(name: str, option: str = "--models") -> type[TorchModel]:
    """Return the model of that name, given by an option. Raises NeecoError if there is none."""
    models = find_models()
    if name not in models:
        available = ", ".join(models)
        raise NeecoError(f"{option}: {name!r} is unknown; choose one of: {available}, or install its package")
    return models[name]


def input_size(frame: tuple[int, int], longer_side: int, multiple: int) -> tuple[int, int]:
    """Return the input (width, height) of a model for frames of this size: at most `longer_side`, multiples of
    `multiple`, with nearly the frame's aspect ratio."""
    scale = min(1.0, max(multiple, longer_side - longer_side % multiple) / max(frame))
    width, height = (max(multiple, multiple * round(edge * scale / multiple)) for edge in frame)
    return width, height
