"""One model taught in one condition on one fold, and tested on recorded frames."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neeco.capture import Capture, read_capture
from neeco.capture.images import write_labels
from neeco.errors import NeecoError
from neeco.evaluation.mask_metrics import iou
from neeco.experiments.downstream.augment import augment
from neeco.experiments.downstream.conditions import Condition, Pick, held_back, labelled_frames
from neeco.experiments.downstream.feed import Feed
from neeco.experiments.downstream.model import Boxes, Fitted, Model, Prediction, Task, input_size, model_class
from neeco.experiments.downstream.samples import (
    CLASSES,
    JAWS,
    ClassNames,
    DataSet,
    Example,
    Sample,
    drawn_samples,
    frame_size,
    recorded_samples,
)
from neeco.experiments.downstream.scores import box_scores, mask_scores, mean_scores, near
from neeco.experiments.study import JobProgress
from neeco.files import read_json, write_json
from neeco.raster.devices import device_of

JOB_SCHEMA = "neeco-downstream-job/1"
JOB_FILE = "job.json"
PREDICTIONS = "predictions"
ALMOST = 0.2  # of the steps: weights kept from this last share say that more steps might still have helped
FINISH = 0.3  # of the steps at most: recorded frames alone, whose labels and looks are those of the test
FINISH_ROUNDS = 20  # in which each of them is seen at most so often: a few frames are learned by heart
PARTS_TAKE = 2.5  # times as many steps to learn as the instrument as one, until more of them help no more
JAWS_REACH = 4.0  # px about the true jaws in which `iou_jaws` judges: thin, and small beside the shaft


@dataclass(frozen=True)
class Teaching:
    """What all jobs of an experiment share. `labels`: folder of masks for the recorded training frames, None: the
    capture's truth. `side`, `batch`: None for the model's own."""

    capture: Path
    sets: tuple[DataSet, ...]
    classes: ClassNames
    splits: tuple[str, ...]
    labels: Path | None = None
    transforms: str = "transforms.json"
    pick: Pick = "spread"
    steps: int | None = None
    side: int | None = None
    batch: int | None = None
    device: str = "auto"

    def steps_of(self, kind: type[Model]) -> int:
        """How many steps a model is taught in."""
        return self.steps or round(kind.steps * (PARTS_TAKE if self.classes == "parts" else 1))

    def batch_of(self, kind: type[Model]) -> int:
        """How many images it sees in each."""
        return self.batch or kind.batch

    def side_of(self, kind: type[Model]) -> int:
        """The longer side that its images may have, px."""
        return self.side or kind.side

    def input_of(self, kind: type[Model], frame: tuple[int, int]) -> tuple[int, int]:
        """(width, height) it sees of frames of this size."""
        return input_size(frame, self.side_of(kind), kind.multiple)


@dataclass(frozen=True)
class DownstreamJob:
    """One training. `real`: how many recorded frames are labelled; 0 where the condition has none."""

    teaching: Teaching
    model: str
    condition: Condition
    real: int
    fold: int
    folder: Path
    weights: Path | None = None

    @property
    def capture(self) -> Path:
        return self.teaching.capture

    @property
    def device(self) -> str:
        """A word for `device_of`."""
        return self.teaching.device

    @property
    def title(self) -> str:
        """Model, condition, labelled frames and fold, as a person reads them."""
        labelled = f", {self.real} labelled" if self.condition.real else ""
        return f"{self.model}, {self.condition.name}{labelled}, fold {self.fold}"

    def identity(self) -> dict[str, Any]:
        """What a folder must agree with to be this job's."""
        teaching, kind = self.teaching, model_class(self.model)
        sets = [data.described() for data in teaching.sets if data.name in self.condition.sets]
        return {
            "model": self.model,
            "condition": self.condition.name,
            "real": self.real,
            "fold": self.fold,
            "capture": str(teaching.capture.absolute()),
            "labels": None if teaching.labels is None else str(teaching.labels.absolute()),
            "transforms": teaching.transforms,
            "sets": sets,
            "edges": self.condition.edges if sets else None,
            "finish": f"{FINISH} of the steps, {FINISH_ROUNDS} rounds at most" if self._finishes else None,
            "classes": teaching.classes,
            "pick": teaching.pick,
            "steps": teaching.steps_of(kind),
            "side": teaching.side_of(kind),
            "batch": teaching.batch_of(kind),
            "weights": None if self.weights is None else str(self.weights.absolute()),
        }

    @property
    def _finishes(self) -> bool:
        """Whether the last steps see recorded frames alone."""
        return self.condition.real and bool(self.condition.sets) and model_class(self.model).orders_images

    def check(self) -> None:
        """Raises NeecoError when the folder holds another job's result."""
        file = self.folder / JOB_FILE
        if not file.exists():
            return
        stored = read_json(file)
        if not isinstance(stored, dict) or stored.get("schema") != JOB_SCHEMA:
            raise NeecoError(f"{file}: schema: is not {JOB_SCHEMA}; give another --output")
        for key, value in self.identity().items():
            if stored.get(key) != value:
                raise NeecoError(f"{file}: {key}: is {stored.get(key)!r}, not {value!r}; give another --output")

    def run(self, progress: JobProgress | None = None, capture: Capture | None = None) -> dict[str, Any]:
        """Train, test, write `folder`/job.json last, and return what it holds; at once when it is there already."""
        self.check()
        file = self.folder / JOB_FILE
        if file.exists():
            stored = dict(read_json(file))
            if set(self.teaching.splits) <= set(stored["splits"]):
                return stored
        tell = progress or (lambda stage, share, text: None)
        tell("training", 0.0, "")
        capture = capture or read_capture(self.capture, self.teaching.transforms)
        began, spent = time.monotonic(), _processor_seconds()
        task = replace(self._task(capture), tell=lambda share, text: tell("training", share, text))
        fitted = model_class(self.model)().fit(task)
        seconds, processor = time.monotonic() - began, _processor_seconds() - spent
        tell("evaluating", 0.0, "")
        splits = {split: self._test(fitted, capture, split) for split in self.teaching.splits}
        result = {"schema": JOB_SCHEMA} | self.identity()
        result |= {
            "iterations": task.steps,
            "best_step": fitted.best_step,
            "validation": list(map(list, fitted.validation)),
        }
        result |= {"still_learning": fitted.best_step > (1 - ALMOST) * task.steps and _rises(fitted.validation)}
        result |= {"seconds": round(seconds, 1), "processor_seconds": round(processor, 1), "input": list(task.size)}
        result |= {"splits": splits}
        write_json(file, result)
        return result

    def _task(self, capture: Capture) -> Task:
        """What the model is to learn. Its training and validation images depend on the fold, its order on nothing
        else."""
        kind, teaching = model_class(self.model), self.teaching
        recorded = recorded_samples(capture, "train", teaching.classes, teaching.labels) if self.condition.real else ()
        chosen = [recorded[k] for k in labelled_frames(len(recorded), self.real, self.fold, teaching.pick)]
        size = frame_size(recorded or recorded_samples(capture, teaching.splits[0], teaching.classes))
        drawn = [
            drawn_samples(data, teaching.classes, self.condition.edges, size)
            for data in teaching.sets
            if data.name in self.condition.sets
        ]
        sources: list[Sequence[Sample]] = [chosen, *drawn]
        parts = [held_back(source, self.fold) for source in sources if source]
        validation: Sequence[Sample] = next((kept for _, kept in parts if kept), [])
        device = device_of(teaching.device, drawing=False)
        steps, batch = teaching.steps_of(kind), teaching.batch_of(kind)
        learned = [samples for samples, _ in parts]
        augmented = augment if self.condition.augment else None
        return Task(
            classes=CLASSES[teaching.classes],
            feed=Feed(learned, self.fold, augmented, self._mixed(len(learned[0]), steps, batch)),
            validation=tuple(validation),
            size=teaching.input_of(kind, size),
            steps=steps,
            batch=batch,
            seed=self.fold,
            device=device,
            folder=self.folder,
            weights=self.weights,
        )

    def _mixed(self, recorded: int, steps: int, batch: int) -> int | None:
        """How many images are of all sources before so many recorded frames come alone; None: all."""
        if not self._finishes:
            return None
        return (steps - min(round(FINISH * steps), FINISH_ROUNDS * recorded // batch)) * batch

    def _test(self, fitted: Fitted, capture: Capture, split: str) -> dict[str, Any]:
        """Scores on one split; what was answered is kept for pictures."""
        samples = recorded_samples(capture, split, self.teaching.classes)
        truth = [sample.load() for sample in samples]
        predictions = fitted.predict([example.image for example in truth])
        names = CLASSES[self.teaching.classes]
        self._keep(split, [sample.name for sample in samples], predictions)
        boxes = [answer for answer in predictions if isinstance(answer, Boxes)]
        if boxes:
            return {"frames": len(samples)} | box_scores(boxes, truth, names)
        frames = []
        for sample, answer, example in zip(samples, predictions, truth, strict=True):
            assert isinstance(answer, np.ndarray)
            row = mask_scores(answer, example, names)
            if (jaws := sample.part_pixels(JAWS)) is not None:
                row |= {"iou_jaws": iou(answer > 0, example.classes > 0, _judged(jaws, example))}
            frames.append(row)
        rows = [{"frame": sample.name} | _plain(row) for sample, row in zip(samples, frames, strict=True)]
        return {"frames": len(samples)} | mean_scores(frames) | {"per_frame": rows}

    def _keep(self, split: str, names: Sequence[str], predictions: Sequence[Prediction]) -> None:
        folder = self.folder / PREDICTIONS / split
        boxes: dict[str, Any] = {}
        for name, answer in zip(names, predictions, strict=True):
            if isinstance(answer, Boxes):
                sure = answer.scores > 0.05
                boxes[name] = {key: getattr(answer, key)[sure].round(4).tolist() for key in vars(answer)}
            else:
                write_labels(folder / f"{name}.png", torch.from_numpy(answer))
        if boxes:
            write_json(folder / "boxes.json", boxes)


def _processor_seconds() -> float:
    """What this process and the programs that it has run have spent."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def _rises(curve: Sequence[tuple[int, float]]) -> bool:
    """Whether the last moment that was looked at is the best by more than what moments differ by chance."""
    return len(curve) >= 2 and curve[-1][1] > max(score for _, score in curve[:-1]) + 0.005


def _judged(jaws: np.ndarray, example: Example) -> np.ndarray:
    """bool [H, W]: near the true jaws [H, W], and counted."""
    close = near(jaws, JAWS_REACH)
    return close if example.counted is None else close & example.counted


def _plain(row: dict[str, float]) -> dict[str, float | None]:
    return {key: None if np.isnan(value) else round(value, 5) for key, value in row.items()}


def as_settings(teaching: Teaching) -> dict[str, Any]:
    """`teaching` as plain values, for a file."""
    values = asdict(teaching)
    values["splits"] = list(teaching.splits)
    values["capture"] = str(teaching.capture.absolute())
    values["labels"] = None if teaching.labels is None else str(teaching.labels.absolute())
    values["sets"] = [data.described() for data in teaching.sets]
    return values
