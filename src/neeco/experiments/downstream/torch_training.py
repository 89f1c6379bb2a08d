"""Training of models that are PyTorch modules: one loop for all of them.

AdamW for so many steps in every condition; the learning rate rises for the first tenth of them and falls as a cosine
(Loshchilov and Hutter, "SGDR", 2017). Of ten moments along the way the weights that did best on the images held back
are kept.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from neeco.errors import NeecoError
from neeco.experiments.downstream.model import Fitted, Model, Prediction, Task
from neeco.experiments.downstream.samples import Example, Sample
from neeco.experiments.downstream.scores import validation_score
from neeco.files import write_atomically

WEIGHTS_FILE = "weights.safetensors"
MOMENTS = 10  # at which the images held back are looked at
MOST_VALIDATION = 60  # images that are looked at
PREDICT_BATCH = 16
CLIP = 0.1  # of the gradient's norm, as D-FINE
WARM_UP = 0.1  # of the steps
TELL_EVERY = 10  # steps


class TorchModel(Model):
    """A model that is a module, a loss and an answer; `fit` is the same for all."""

    learning_rate: ClassVar[float]
    weight_decay: ClassVar[float] = 1e-4

    @abstractmethod
    def build(self, classes: int) -> nn.Module:
        """The untrained module, from torch's random numbers."""

    @abstractmethod
    def loss(self, module: Any, images: Tensor, examples: Sequence[Example]) -> Tensor:
        """Of a batch: images [B, 3, h, w] in [0, 1] as the model sees them, and the examples they were made from."""

    @abstractmethod
    def answer(self, module: Any, images: Tensor, sizes: Sequence[tuple[int, int]]) -> list[Prediction]:
        """Of images [B, 3, h, w]; sizes: (height, width) that each answer is for."""

    def fit(self, task: Task) -> Fitted:
        """Train it (see `Model.fit`); the kept weights stand in the folder's weights.safetensors."""
        with _seeded(task.seed):
            module = _channels_last(self.build(len(task.classes)).to(task.device))
            if task.weights is not None:
                load_weights(module, task.weights)
            curve, best_step = self._train(module, task)
        state = {name: value.detach().contiguous().cpu() for name, value in module.state_dict().items()}
        write_atomically(task.folder / WEIGHTS_FILE, lambda path: save_file(_unshared(state), path))

        def predict(images: Sequence[np.ndarray]) -> list[Prediction]:
            return self._predict(module, images, task)

        return Fitted(predict, best_step, curve)

    def _train(self, module: nn.Module, task: Task) -> tuple[list[tuple[int, float]], int]:
        optimizer = torch.optim.AdamW(module.parameters(), self.learning_rate, weight_decay=self.weight_decay)
        course = torch.optim.lr_scheduler.LambdaLR(optimizer, partial(_course, steps=task.steps))
        watched = _evenly(task.validation, MOST_VALIDATION)
        truth = [sample.load() for sample in watched]
        moments = {round(task.steps * (k + 1) / MOMENTS) for k in range(MOMENTS)} if truth else set()
        curve: list[tuple[int, float]] = []
        kept, best_step, best = None, task.steps, -1.0
        module.train()
        for step in range(1, task.steps + 1):
            examples = task.feed.batch(task.batch)
            loss = self.loss(module, to_input([example.image for example in examples], task), examples)
            if not torch.isfinite(loss):
                raise NeecoError(
                    f"{self.model}: its loss is not finite at step {step}; teach it with more images or other --weights"
                )
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(module.parameters(), CLIP)
            optimizer.step()
            course.step()
            if step % TELL_EVERY == 0 or step == task.steps:
                told = f"  validation {curve[-1][1]:.3f}" if curve else ""
                task.tell(step / task.steps, f"step {step}  loss {loss.item():.3f}{told}")
            if step in moments:
                predictions = self._predict(module, [example.image for example in truth], task)
                curve.append((step, validation_score(predictions, truth, len(task.classes))))
                if curve[-1][1] >= best:
                    best, best_step = curve[-1][1], step
                    kept = {name: value.clone() for name, value in module.state_dict().items()}
        if kept is not None:
            module.load_state_dict(kept)
        return curve, best_step

    def _predict(self, module: nn.Module, images: Sequence[np.ndarray], task: Task) -> list[Prediction]:
        training = module.training
        module.eval()
        answers: list[Prediction] = []
        with torch.inference_mode():
            for start in range(0, len(images), PREDICT_BATCH):
                some = images[start : start + PREDICT_BATCH]
                sizes = [(image.shape[0], image.shape[1]) for image in some]
                answers += self.answer(module, to_input(some, task), sizes)
        module.train(training)
        return answers


def _course(step: int, steps: int) -> float:
    """The learning rate at a step, as a share of the highest."""
    return min((step + 1) / (1 + WARM_UP * steps), (1 + math.cos(math.pi * step / steps)) / 2)


def to_input(images: Sequence[np.ndarray], task: Task) -> Tensor:
    """[B, 3, h, w] float32 in [0, 1] on the task's device, of uint8 images [H, W, 3]; shrunk by area."""
    shrunk = np.stack([cv2.resize(image, task.size, interpolation=cv2.INTER_AREA) for image in images])
    batch = torch.from_numpy(shrunk).permute(0, 3, 1, 2).to(task.device, torch.float32) / 255
    return batch.contiguous(memory_format=torch.channels_last)


def load_weights(module: nn.Module, path: Path) -> None:
    """Take what fits from a safetensors file: tensors of a name and shape that the module has. Raises NeecoError for a
    file that cannot be read, or of which less than half of the module's tensors are found."""
    try:
        stored = load_file(path)
    except (OSError, SafetensorError) as error:
        raise NeecoError(f"--weights: {path}: cannot be read as safetensors: {error}") from error
    own = module.state_dict()
    fitting = {name: value for name, value in stored.items() if name in own and own[name].shape == value.shape}
    if 2 * len(fitting) < len(own):
        raise NeecoError(f"--weights: {path}: {len(fitting)} of {len(own)} tensors fit; give weights of this model")
    module.load_state_dict(fitting, strict=False)


def _unshared(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Tied tensors once each: safetensors refuses memory that is stored twice."""
    first: dict[int, str] = {}
    for name, value in state.items():
        first.setdefault(value.data_ptr(), name)
    return {name: state[name] for name in first.values()}


def _channels_last(module: nn.Module) -> nn.Module:
    """The module with its weights as convolutions on a CPU want them."""
    return module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def _evenly(samples: Sequence[Sample], most: int) -> list[Sample]:
    if len(samples) <= most:
        return list(samples)
    return [samples[int(k)] for k in np.linspace(0, len(samples) - 1, most).round()]


@contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """Torch's own random numbers begin at `seed` in the block, and go on afterwards as if it had not been."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        yield
