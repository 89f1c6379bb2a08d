"""One training of a downstream study: its data, its test and its stored result."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from neeco.base.files import read_json, require_like, require_same, write_atomically, write_json
from neeco.capture import Capture, read_capture
from neeco.raster.devices import device_of
from neeco.studies.downstream.batches import BatchSampler
from neeco.studies.downstream.conditions import PASTE, PERMUTED, REAL, STRONG, Condition, labelled_frames
from neeco.studies.downstream.model import Predict, TorchModel, TrainingTask, input_size, model_class
from neeco.studies.downstream.paste import pasted_samples
from neeco.studies.downstream.samples import (
    ClassNames,
    ImageSet,
    RecordedSample,
    Sample,
    class_names,
    frame_size,
    loaded,
    permuted,
    recorded_samples,
    synthetic_samples,
)
from neeco.studies.downstream.scores import Detections, Prediction, box_iou, box_scores, mask_scores, mean_scores
from neeco.studies.study import REMEDY, JobProgress

JOB_SCHEMA = "neeco-downstream-job/3"
JOB_FILE = "job.json"
KEPT_FOLD = 0  # whose weights and predictions are kept
PREFIX = "frame_"  # of the names of frames in files of predictions


@dataclass(frozen=True, kw_only=True)
class DownstreamSettings:
    """A study: models, training data, budget and tests. None: the usual, or the model's."""

    capture: Path
    output: Path
    sets: tuple[ImageSet, ...] = ()
    models: tuple[str, ...] = ("unet",)
    tests: Mapping[str, Path] = field(default_factory=dict)  # other captures, by name
    num_real: tuple[str, ...] | None = None  # labelled recorded frames: numbers or all; 0 for sets alone
    folds: int = 5
    conditions: tuple[str, ...] | None = None
    backgrounds: Path | None = None  # folder of images to paste over; None: the labelled frames, filled in
    labels: Path | None = None  # folder of masks for the recorded training frames; None: the capture's truth
    classes: ClassNames = "instrument"
    splits: tuple[str, ...] = ()  # tested; empty: all but train that have truth
    steps: int | None = None
    size: int | None = None  # px, the longer side of a model's input images
    batch: int | None = None
    workers: int = 1
    transforms: str = "transforms.json"
    device: str = "auto"
    parts_steps: float = 2.5  # times as many steps to learn parts as one class: more of them do not help

    @property
    def all_tests(self) -> list[str]:
        """Names of what is tested on: splits of the own capture, and other captures."""
        return [*self.splits, *self.tests]

    def steps_of(self, kind: type[TorchModel]) -> int:
        """Return the number of steps of a model."""
        return self.steps or round(kind.steps * (self.parts_steps if self.classes == "parts" else 1))

    def batch_of(self, kind: type[TorchModel]) -> int:
        """Return the number of images in a step."""
        return self.batch or kind.batch

    def input_of(self, kind: type[TorchModel], frame: tuple[int, int]) -> tuple[int, int]:
        """Return its input (width, height) for frames of this size."""
        return input_size(frame, self.size or kind.image_size, kind.multiple)

    def samples(self, capture: Capture, test: str) -> tuple[RecordedSample, ...]:
        """The frames of a test: all with truth of the other capture of that name, else of a split of the own one.
        Raises NeecoError."""
        if test in self.tests:
            return recorded_samples(_read(self.tests[test], "transforms.json"), None, self.classes)
        return recorded_samples(capture, test, self.classes)

    def job_folder(self, model: str, condition: str, real: int, fold: int) -> Path:
        """Return the folder of one job."""
        return self.output / "jobs" / f"{model}-{condition}-real{real}-fold{fold}"


@dataclass(frozen=True)
class DownstreamJob:
    """One training, a `neeco.studies.study.Job`. real: how many recorded frames are labelled."""

    settings: DownstreamSettings
    model: str
    condition: Condition
    real: int  # 0 where the condition has none
    fold: int

    @property
    def capture(self) -> Path:
        return self.settings.capture

    @property
    def folder(self) -> Path:
        return self.settings.job_folder(self.model, self.condition.name, self.real, self.fold)

    @property
    def device(self) -> str:
        return self.settings.device

    @property
    def title(self) -> str:
        """Model, condition, labelled frames and fold, as a person reads them."""
        labelled = f", {self.real} labelled" if self.real else ""
        return f"{self.model}, {self.condition.name}{labelled}, fold {self.fold}"

    @property
    def sets(self) -> list[ImageSet]:
        """The image sets of its training data."""
        return [data for data in self.settings.sets if data.name in self.condition.sets]

    def identity(self) -> dict[str, Any]:
        """Return what a folder must agree with to be this job's. Its keys are those of job.json."""
        settings, kind = self.settings, model_class(self.model)
        return {
            "model": self.model,
            "condition": self.condition.name,
            "real": self.real,
            "fold": self.fold,
            "capture": str(settings.capture.absolute()),
            "labels": absolute(settings.labels),
            "transforms": settings.transforms,
            "sets": [data.described() for data in self.sets],
            "backgrounds": absolute(settings.backgrounds) if PASTE in self.condition else None,
            "classes": settings.classes,
            "steps": settings.steps_of(kind),
            "size": settings.size or kind.image_size,
            "batch": settings.batch_of(kind),
        }

    def check(self) -> None:
        """Raises NeecoError when the folder holds another job's result, or a test of another capture by this name."""
        file = self.folder / JOB_FILE
        if not file.exists():
            return
        stored = require_like(read_json(file), {"schema": str}, str(file), REMEDY)
        now = {"schema": JOB_SCHEMA} | self.identity()
        require_same(str(file), ((key, stored.get(key), now[key]) for key in now), REMEDY)
        tested = require_like(stored, {"tests": {str: str}, "splits": dict}, str(file), REMEDY)["tests"]
        for name, path in self.settings.tests.items():
            require_same(
                f"{file}: --test", [(name, tested.get(name, str(path.absolute())), str(path.absolute()))], REMEDY
            )

    def stored(self) -> dict[str, Any] | None:
        """Return the result of an earlier start, None where there is none of all tests. Raises NeecoError."""
        self.check()
        file = self.folder / JOB_FILE
        result = dict(read_json(file)) if file.exists() else None
        return result if result and set(self.settings.all_tests) <= set(result["splits"]) else None

    def run(self, progress: JobProgress | None = None, capture: Capture | None = None) -> dict[str, Any]:
        """Train, test, write `folder`/job.json last, and return what it holds; at once when it is there already."""
        if (earlier := self.stored()) is not None:
            return earlier
        report = progress or (lambda stage, share, text: None)
        report("training", 0.0, "")
        cv2.setNumThreads(torch.get_num_threads())  # else every worker takes all cores
        capture = capture or _read(self.capture, self.settings.transforms)
        started = time.monotonic()
        task = replace(self.task(capture), progress=lambda share, text: report("training", share, text))
        predict = model_class(self.model)().fit(task)
        seconds = time.monotonic() - started
        report("evaluating", 0.0, "")
        result = {
            "schema": JOB_SCHEMA,
            **self.identity(),
            "tests": {name: str(path.absolute()) for name, path in self.settings.tests.items()},
            "labelled": [sample.name for sample in self.labelled(capture)],
            "iterations": task.steps,
            "seconds": round(seconds, 1),
            "input": list(task.size),
            "splits": {test: self._test(predict, test, capture) for test in self.settings.all_tests},
        }
        write_json(self.folder / JOB_FILE, result)
        return result

    def labelled(self, capture: Capture) -> list[RecordedSample]:
        """The labelled frames."""
        if REAL not in self.condition:
            return []
        recorded = recorded_samples(capture, "train", self.settings.classes, self.settings.labels)
        return [recorded[index] for index in labelled_frames(len(recorded), self.real, self.fold)]

    def task(self, capture: Capture) -> TrainingTask:
        """Return the training task. Its images depend on the fold, their order on nothing else."""
        settings, kind, labelled = self.settings, model_class(self.model), self.labelled(capture)
        size = frame_size(labelled or recorded_samples(capture, settings.splits[0], settings.classes))
        names = class_names(capture, settings.classes)
        synthetic: list[Sequence[Sample]] = []
        for data in self.sets:
            samples = synthetic_samples(data, names, size)
            synthetic.append(permuted(samples) if PERMUTED in self.condition else samples)
        if PASTE in self.condition:
            synthetic.append(pasted_samples(labelled, settings.backgrounds, self.fold))
        return TrainingTask(
            classes=names,
            batches=BatchSampler(labelled, synthetic, seed=self.fold, augmented=STRONG in self.condition),
            size=settings.input_of(kind, size),
            steps=settings.steps_of(kind),
            batch=settings.batch_of(kind),
            seed=self.fold,
            device=device_of(settings.device, drawing=False),
            folder=self.folder,
            keep_weights=self.fold == KEPT_FOLD,
        )

    def _test(self, predict: Predict, test: str, capture: Capture) -> dict[str, Any]:
        """Scores on one split or capture; the predictions of one fold are stored for pictures."""
        names = class_names(capture, self.settings.classes)
        samples = self.settings.samples(capture, test)
        truth = [loaded(sample) for sample in samples]
        predictions = predict([example.image for example in truth])
        if self.fold == KEPT_FOLD:
            write_predictions(predictions_file(self.folder, test), [sample.name for sample in samples], predictions)
        frames: list[dict[str, float]] = []
        for found, example in zip(predictions, truth, strict=True):
            if isinstance(found, Detections):
                frames.append({"box_iou": box_iou(found, example)})
            else:
                frames.append(mask_scores(found, example, names))
        boxes = [found for found in predictions if isinstance(found, Detections)]
        rows = [
            {"frame": sample.name}
            | {key: None if np.isnan(value) else round(value, 5) for key, value in scores.items()}
            for sample, scores in zip(samples, frames, strict=True)
        ]
        scores = box_scores(boxes, truth, names) if boxes else mean_scores(frames)
        return {"frames": len(samples)} | scores | {"per_frame": rows}


def predictions_file(job: Path, test: str) -> Path:
    """Return the file of a job's predictions for a test."""
    return job / "predictions" / f"{test}.npz"


def write_predictions(path: Path, names: Sequence[str], predictions: Sequence[Prediction]) -> None:
    """Write predictions by the frames' names: masks uint8 [H, W], or boxes [n, 6] (x0, y0, x1, y1, class, score)."""
    arrays = {
        PREFIX + name: np.column_stack([found.boxes, found.classes, found.scores])
        if isinstance(found, Detections)
        else found
        for name, found in zip(names, predictions, strict=True)
    }

    def write(file: Path) -> None:
        with open(file, "wb") as stream:
            np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]

    write_atomically(path, write)


def read_predictions(path: Path) -> dict[str, Prediction]:
    """Return what `write_predictions` wrote; nothing where there is no file."""
    if not path.is_file():
        return {}
    with np.load(path, allow_pickle=False) as stored:
        arrays = {name.removeprefix(PREFIX): stored[name] for name in stored.files}
    return {
        name: array if array.dtype == np.uint8 else Detections(array[:, :4], array[:, 4].astype(np.int64), array[:, 5])
        for name, array in arrays.items()
    }


@lru_cache(maxsize=8)
def _read(path: Path, transforms: str) -> Capture:
    """A capture, once for all jobs of this process."""
    return read_capture(path, transforms)


def absolute(path: Path | None) -> str | None:
    """A path for a file; None stays None."""
    return None if path is None else str(path.absolute())
