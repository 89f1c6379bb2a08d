"""One training of a downstream study: its data, its test and its stored result."""

from __future__ import annotations

import os
import shlex
import time
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from neeco.capture import Capture, read_capture
from neeco.evaluation.mask_metrics import iou
from neeco.files import read_json, require_like, require_same, write_atomically, write_json
from neeco.raster.devices import device_of
from neeco.studies.downstream.batches import BatchSampler
from neeco.studies.downstream.conditions import Condition, FrameSelection, labelled_frames
from neeco.studies.downstream.model import Model, TrainedModel, TrainingTask, input_size, model_class
from neeco.studies.downstream.paste import PASTED_IMAGES, pasted_samples
from neeco.studies.downstream.samples import (
    ClassNames,
    Example,
    ImageSet,
    LeastRecentlyUsed,
    OtherCapture,
    RecordedSample,
    Sample,
    class_names,
    frame_size,
    permuted,
    recorded_samples,
    synthetic_samples,
)
from neeco.studies.downstream.scores import Detections, box_scores, mask_scores, mean_scores, near
from neeco.studies.study import REMEDY, JobProgress

JOB_SCHEMA = "neeco-downstream-job/2"
JOB_FILE = "job.json"
PARTS_STEPS = 2.5  # times as many steps to learn parts as one class: more of them do not help
PAIR_DISTANCE = 4.0  # px about a pair (jaws) in which `iou_jaws` is taken: thin, and small compared with the shaft
MIN_STORED_SCORE = 0.05  # boxes of a lower confidence are not stored
KEPT_FOLD = 0  # whose weights and predictions are kept
PREDICTIONS_FILE, MASK_PREFIX = "masks.npz", "mask_"  # the predicted masks of a test, by frame
PYTHON_ONLY = ("pasted",)


@dataclass(frozen=True, kw_only=True)
class DownstreamSettings:
    """A study: models, training data, budget and tests. None: the usual, or the model's."""

    capture: Path
    output: Path
    sets: tuple[ImageSet, ...] = ()
    models: tuple[str, ...] = ("unet",)
    tests: tuple[OtherCapture, ...] = ()
    num_real: tuple[str, ...] | None = None  # labelled recorded frames: numbers or all; 0 for sets alone
    folds: int = 5
    conditions: tuple[str, ...] | None = None
    backgrounds: Path | None = None  # folder of images to paste over; None: the labelled frames, filled in
    labels: Path | None = None  # folder of masks for the recorded training frames; None: the capture's truth
    classes: ClassNames = "instrument"
    frame_selection: FrameSelection = "spread"
    splits: tuple[str, ...] = ()  # tested; empty: all but train that have truth
    steps: int | None = None
    size: int | None = None  # px, the longer side of a model's input images
    batch: int | None = None
    weights: Mapping[str, Path] = field(default_factory=dict)  # safetensors to start from, by model
    workers: int = 1
    transforms: str = "transforms.json"
    device: str = "auto"
    pasted: int = PASTED_IMAGES  # by cut-and-paste

    def command(self) -> str:
        """The command that runs this study; settings that only Python has are not part of it."""
        words = ["neeco", "downstream", str(self.capture.absolute()), "--output", "DIR"]
        for entry in fields(self):
            value, option = getattr(self, entry.name), f"--{entry.name.replace('_', '-')}"
            if entry.name in ("capture", "output", *PYTHON_ONLY) or value == entry.default or not value:
                continue
            if entry.name == "tests":
                words += [word for test in value for word in ("--test", str(test))]
            elif entry.name == "weights":
                words += [word for name, path in value.items() for word in (option, f"{name}={path.absolute()}")]
            elif isinstance(value, Path):
                words += [option, str(value.absolute())]
            else:
                words += [option, *map(str, value if isinstance(value, tuple) else (value,))]
        return shlex.join(words)

    @property
    def other_captures(self) -> dict[str, Path]:
        """The captures tested on, by name."""
        return {test.name: test.path for test in self.tests}

    def steps_of(self, kind: type[Model]) -> int:
        """Return the number of steps of a model."""
        return self.steps or round(kind.steps * (PARTS_STEPS if self.classes == "parts" else 1))

    def batch_of(self, kind: type[Model]) -> int:
        """Return the number of images in a step."""
        return self.batch or kind.batch

    def input_of(self, kind: type[Model], frame: tuple[int, int]) -> tuple[int, int]:
        """Return its input (width, height) for frames of this size."""
        return input_size(frame, self.size or kind.image_size, kind.multiple)


def job_folder(output: Path, model: str, condition: str, real: int, fold: int) -> Path:
    """Return the folder of one job."""
    return output / "jobs" / f"{model}-{condition}-real{real}-fold{fold}"


def predictions_folder(job: Path, split: str) -> Path:
    """Return the folder of a job's predictions for a split."""
    return job / "predictions" / split


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
        return job_folder(self.settings.output, self.model, self.condition.name, self.real, self.fold)

    @property
    def device(self) -> str:
        return self.settings.device

    @property
    def title(self) -> str:
        """Model, condition, labelled frames and fold, as a person reads them."""
        labelled = f", {self.real} labelled" if self.condition.real else ""
        return f"{self.model}, {self.condition.name}{labelled}, fold {self.fold}"

    @property
    def sets(self) -> list[ImageSet]:
        """The image sets of its training data."""
        return [data for data in self.settings.sets if data.name in self.condition.sets]

    @property
    def tests(self) -> list[str]:
        """Names of what it is tested on: splits of its own capture, and other captures."""
        return [*self.settings.splits, *(test.name for test in self.settings.tests)]

    def identity(self) -> dict[str, Any]:
        """Return what a folder must agree with to be this job's. Its keys are those of job.json."""
        settings, kind, condition = self.settings, model_class(self.model), self.condition
        return {
            "model": self.model,
            "condition": condition.name,
            "real": self.real,
            "fold": self.fold,
            "capture": str(settings.capture.absolute()),
            "labels": absolute(settings.labels),
            "transforms": settings.transforms,
            "sets": [data.described() for data in self.sets],
            "backgrounds": absolute(settings.backgrounds) if condition.paste else None,
            "pasted": settings.pasted if condition.paste else None,
            "classes": settings.classes,
            "pick": settings.frame_selection,
            "steps": settings.steps_of(kind),
            "side": settings.size or kind.image_size,
            "batch": settings.batch_of(kind),
            "weights": absolute(settings.weights.get(self.model)),
        }

    def check(self) -> None:
        """Raises NeecoError when the folder holds another job's result, or a test of another capture by this name."""
        file = self.folder / JOB_FILE
        if not file.exists():
            return
        stored = require_like(read_json(file), {"schema": str}, str(file), REMEDY)
        now = {"schema": JOB_SCHEMA} | self.identity()
        require_same(str(file), ((key, stored.get(key), now[key]) for key in now), REMEDY)
        tested = require_like(stored, {"tests": dict, "splits": dict}, str(file), REMEDY)["tests"]
        for test in self.settings.tests:
            if test.name in tested:
                place = f"{file}: --test {test.name}"
                require_same(place, [("capture", tested[test.name], str(test.path.absolute()))], REMEDY)

    def run(self, progress: JobProgress | None = None, capture: Capture | None = None) -> dict[str, Any]:
        """Train, test, write `folder`/job.json last, and return what it holds; at once when it is there already."""
        self.check()
        file = self.folder / JOB_FILE
        if file.exists():
            stored = dict(read_json(file))
            if set(self.tests) <= set(stored["splits"]):
                return stored
        report = progress or (lambda stage, share, text: None)
        report("training", 0.0, "")
        cv2.setNumThreads(torch.get_num_threads())  # else every worker takes all cores
        capture = capture or _read(self.capture, self.settings.transforms)
        started, cpu_before = time.monotonic(), _cpu_seconds()
        task = replace(self.task(capture), progress=lambda share, text: report("training", share, text))
        trained = model_class(self.model)().fit(task)
        seconds, cpu_seconds = time.monotonic() - started, _cpu_seconds() - cpu_before
        report("evaluating", 0.0, "")
        names, others = class_names(capture, self.settings.classes), self.settings.other_captures
        result = {
            "schema": JOB_SCHEMA,
            **self.identity(),
            "tests": {name: str(path.absolute()) for name, path in others.items()},
            "labelled": self.labelled(capture),
            "iterations": task.steps,
            "seconds": round(seconds, 1),
            "processor_seconds": round(cpu_seconds, 1),
            "input": list(task.size),
            "splits": {
                test: self._test(trained, test, test_samples(capture, test, others, self.settings.classes), names)
                for test in self.tests
            },
        }
        write_json(file, result)
        return result

    def labelled(self, capture: Capture) -> list[str]:
        """Names of the labelled frames."""
        return [sample.name for sample in self._labelled(capture)]

    def _labelled(self, capture: Capture) -> list[RecordedSample]:
        if not self.condition.real:
            return []
        recorded = recorded_samples(capture, "train", self.settings.classes, self.settings.labels)
        chosen = labelled_frames(len(recorded), self.real, self.fold, self.settings.frame_selection)
        return [recorded[index] for index in chosen]

    def task(self, capture: Capture) -> TrainingTask:
        """Return the training task. Its images depend on the fold, their order on nothing else."""
        settings, kind, condition = self.settings, model_class(self.model), self.condition
        labelled = self._labelled(capture)
        size = frame_size(labelled or recorded_samples(capture, settings.splits[0], settings.classes))
        names = class_names(capture, settings.classes)
        synthetic: list[Sequence[Sample]] = []
        for data in self.sets:
            samples = synthetic_samples(data, names, size)
            synthetic.append(permuted(samples) if condition.permuted else samples)
        if condition.paste:
            synthetic.append(pasted_samples(labelled, settings.backgrounds, self.fold, settings.pasted))
        return TrainingTask(
            classes=names,
            batches=BatchSampler(labelled, synthetic, seed=self.fold, augmented=condition.strong),
            size=settings.input_of(kind, size),
            steps=settings.steps_of(kind),
            batch=settings.batch_of(kind),
            seed=self.fold,
            device=device_of(settings.device, drawing=False),
            folder=self.folder,
            weights=settings.weights.get(self.model),
            keep_weights=self.fold == KEPT_FOLD,
        )

    def _test(
        self, trained: TrainedModel, test: str, samples: Sequence[RecordedSample], names: Sequence[str]
    ) -> dict[str, Any]:
        """Scores on one split or capture; the predictions of one fold are stored for pictures."""
        truths = [_truth(sample) for sample in samples]
        truth = [found.example for found in truths]
        predictions = trained.predict([example.image for example in truth])
        folder = predictions_folder(self.folder, test)
        boxes = {
            sample.name: found
            for sample, found in zip(samples, predictions, strict=True)
            if isinstance(found, Detections)
        }
        if boxes:
            if self.fold == KEPT_FOLD:
                write_json(folder / "boxes.json", {name: _stored(found) for name, found in boxes.items()})
            return {"frames": len(samples)} | box_scores(list(boxes.values()), truth, names)
        masks = [found for found in predictions if isinstance(found, np.ndarray)]
        if self.fold == KEPT_FOLD:
            by_name = {sample.name: mask for sample, mask in zip(samples, masks, strict=True)}
            write_atomically(folder / PREDICTIONS_FILE, lambda path: _save_masks(path, by_name))
        frames = []
        for mask, found in zip(masks, truths, strict=True):
            scores = mask_scores(mask, found.example, names)
            for pair, region in found.regions.items():
                scores |= {f"iou_{pair}": iou(mask > 0, found.example.classes > 0, region)}
            frames.append(scores)
        rows = [
            {"frame": sample.name}
            | {key: None if np.isnan(value) else round(value, 5) for key, value in scores.items()}
            for sample, scores in zip(samples, frames, strict=True)
        ]
        return {"frames": len(samples)} | mean_scores(frames) | {"per_frame": rows}


def test_samples(
    capture: Capture, test: str, others: Mapping[str, Path], classes: ClassNames
) -> tuple[RecordedSample, ...]:
    """The frames of a test: all with truth of the other capture of that name, else of a split of this one. Raises
    NeecoError."""
    if test in others:
        return recorded_samples(_read(others[test], "transforms.json"), None, classes)
    return recorded_samples(capture, test, classes)


@dataclass(frozen=True)
class _Truth:
    """A tested frame, decoded."""

    example: Example
    regions: Mapping[str, np.ndarray]  # bool [H, W] by pair of parts: what is near them, and valid

    @property
    def bytes(self) -> int:
        return self.example.bytes + sum(region.nbytes for region in self.regions.values())


_truths: LeastRecentlyUsed[Hashable, _Truth] = LeastRecentlyUsed()


def _truth(sample: RecordedSample) -> _Truth:
    """A tested frame, kept for the next job of this process while there is room."""

    def load() -> _Truth:
        example = sample.load()
        regions = {pair: near(pixels, PAIR_DISTANCE) for pair, pixels in sample.pairs().items()}
        if example.valid is not None:
            regions = {pair: region & example.valid for pair, region in regions.items()}
        return _Truth(example, regions)

    return _truths.get(sample.key, load, lambda truth: truth.bytes)


@lru_cache(maxsize=8)
def _read(path: Path, transforms: str) -> Capture:
    """A capture, once for all jobs of this process."""
    return read_capture(path, transforms)


def _save_masks(path: Path, masks: Mapping[str, np.ndarray]) -> None:
    with open(path, "wb") as stream:
        np.savez_compressed(stream, **{f"{MASK_PREFIX}{name}": mask for name, mask in masks.items()})  # type: ignore[arg-type]


def absolute(path: Path | None) -> str | None:
    """A path for a file; None stays None."""
    return None if path is None else str(path.absolute())


def _stored(found: Detections) -> dict[str, Any]:
    return {key: values[found.scores > MIN_STORED_SCORE].round(4).tolist() for key, values in vars(found).items()}


def _cpu_seconds() -> float:
    """Return the CPU time, in s, of this process and the programs that it has run."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system
