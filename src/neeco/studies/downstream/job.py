"""One training of a downstream study: its data, its test and its stored result."""

from __future__ import annotations

import os
import shlex
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import torch

from neeco.capture import Capture, read_capture
from neeco.capture.images import write_labels
from neeco.errors import NeecoError
from neeco.evaluation.mask_metrics import iou
from neeco.files import read_json, require_like, require_same, write_json
from neeco.raster.devices import device_of
from neeco.studies.downstream.model import Model, TrainedModel, TrainingTask, input_size, model_class
from neeco.studies.downstream.samples import (
    BatchSampler,
    ClassNames,
    Edges,
    ImageSet,
    Sample,
    augment,
    class_names,
    frame_size,
    recorded_samples,
    synthetic_samples,
)
from neeco.studies.downstream.scores import Detections, box_scores, mask_scores, mean_scores, near
from neeco.studies.study import REMEDY, JobProgress

JOB_SCHEMA = "neeco-downstream-job/1"
JOB_FILE = "job.json"
REAL, AUGMENT = "real", "augment"
EDGES: tuple[Edges, ...] = ("hard", "soft", "ignore")
DEFAULT_EDGES: Edges = "hard"
RESERVED = (REAL, AUGMENT, *EDGES)
PARTS_STEPS = 2.5  # times as many steps to learn parts as one class: more of them do not help
PAIR_DISTANCE = 4.0  # px about a pair (jaws) in which `iou_jaws` is taken: thin, and small compared with the shaft
HELD_OUT = ("validation_every", "min_validated")  # settings that job.json has only where they are not the default
PYTHON_ONLY = ("finetune_share", "finetune_epochs", *HELD_OUT)
MIN_STORED_SCORE = 0.05  # boxes of a lower confidence are not stored

FrameSelection = Literal["spread", "first"]
T = TypeVar("T")


@dataclass(frozen=True)
class Condition:
    """The training data of a model: a sum of words, `SET+real+augment`."""

    name: str
    sets: tuple[str, ...]  # names of data sets
    real: bool  # with labelled recorded frames
    augment: bool  # with classical augmentation of everything
    edges: Edges  # how the edges of synthetic labels are learned


def parse_condition(name: str, sets: Collection[str]) -> Condition:
    """`kinematic+real+augment`. Raises NeecoError for a word that is none of `sets` nor known, or a lack of images."""
    words = name.split("+")
    for word in words:
        if word not in RESERVED and word not in sets:
            raise NeecoError(
                f"--conditions {name}: {word!r} is neither {', '.join(RESERVED)} nor a set; name it in --sets"
            )
    if len(set(words)) < len(words):
        raise NeecoError(f"--conditions {name}: a word stands in it twice")
    edges = [edge for edge in EDGES if edge in words]
    chosen = tuple(word for word in words if word in sets)
    if len(edges) > 1 or (edges and not chosen):
        raise NeecoError(f"--conditions {name}: one of {', '.join(EDGES)} at most, and only together with a set")
    if not chosen and REAL not in words:
        raise NeecoError(f"--conditions {name}: nothing to learn from; add real or a set")
    return Condition(name, chosen, REAL in words, AUGMENT in words, edges[0] if edges else DEFAULT_EDGES)


def default_conditions(sets: Sequence[str]) -> list[str]:
    """Recorded frames without and with augmentation (the paper's conditions), each set alone and with them."""
    return [REAL, f"{REAL}+{AUGMENT}", *(word for name in sets for word in (name, f"{name}+{REAL}"))]


def labelled_count(word: str, frames: int) -> int:
    """Return the number of labelled frames, of so many, that a word of `--num-real` means. Raises NeecoError."""
    if word == "all":
        return frames
    if not word.isdecimal():
        raise NeecoError(f"--num-real: {word!r} is neither a number of labelled frames nor all")
    if int(word) > frames:
        raise NeecoError(f"--num-real: {word} labelled frames are asked for, the capture has {frames}; use all")
    return int(word)


def labelled_frames(frames: int, count: int, fold: int, selection: FrameSelection) -> list[int]:
    """Choose the `count` of so many recorded frames that are labelled in a fold, in their order.

    spread: the recording is cut into `count` stretches of one length and a frame is sampled from each. first: the
    recording's first, the same in every fold. The same for every condition and model of a fold.
    """
    if selection == "first" or count == frames:
        return list(range(count))
    edges = np.linspace(0, frames, count + 1)
    draws = np.random.default_rng(np.random.SeedSequence([fold, count])).random(count)
    places = edges[:-1] + draws * (edges[1:] - edges[:-1])
    chosen: list[int] = []
    for place in places:  # a frame on the border of two stretches is taken once, and the next one after it
        chosen.append(max(min(int(place), frames - 1), chosen[-1] + 1 if chosen else 0))
    return chosen


@dataclass(frozen=True, kw_only=True)
class DownstreamSettings:
    """A study: models, training data, budget and tests. None: the usual, or the model's."""

    capture: Path
    output: Path
    sets: tuple[ImageSet, ...] = ()
    models: tuple[str, ...] = ("unet",)
    num_real: tuple[str, ...] = ("0", "20", "all")  # labelled recorded frames: numbers or all; 0 for sets alone
    folds: int = 5
    conditions: tuple[str, ...] | None = None
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
    finetune_share: float = 0.3  # of the steps at most: the last are of recorded frames alone, as the test is
    finetune_epochs: int = 20  # passes over them at most: a few frames are soon overfitted
    validation_every: int = 5  # one in so many images of each source is held out for validation
    min_validated: int = 40  # images: of fewer all are learned, the held-out ones would be too few to choose weights by

    def command(self) -> str:
        """The command that runs this study; settings that only Python has are not part of it."""
        words = ["neeco", "downstream", str(self.capture.absolute()), "--output", "DIR"]
        for entry in fields(self):
            value, option = getattr(self, entry.name), f"--{entry.name.replace('_', '-')}"
            if entry.name in ("capture", "output", *PYTHON_ONLY) or value == entry.default or not value:
                continue
            if entry.name == "weights":
                words += [word for name, path in value.items() for word in (option, f"{name}={path.absolute()}")]
            elif isinstance(value, Path):
                words += [option, str(value.absolute())]
            else:
                words += [option, *map(str, value if isinstance(value, tuple) else (value,))]
        return shlex.join(words)

    def steps_of(self, kind: type[Model]) -> int:
        """Return the number of steps of a model."""
        return self.steps or round(kind.steps * (PARTS_STEPS if self.classes == "parts" else 1))

    def batch_of(self, kind: type[Model]) -> int:
        """Return the number of images in a step."""
        return self.batch or kind.batch

    def input_of(self, kind: type[Model], frame: tuple[int, int]) -> tuple[int, int]:
        """Return its input (width, height) for frames of this size."""
        return input_size(frame, self.size or kind.image_size, kind.multiple)

    def hold_out(self, samples: Sequence[T], fold: int) -> tuple[list[T], list[T]]:
        """(to learn from, to validate with): one in `validation_every`, another in each fold; none of too few."""
        if len(samples) < self.min_validated:
            return list(samples), []
        last = (self.validation_every - 1 + fold) % self.validation_every
        learned = [sample for index, sample in enumerate(samples) if index % self.validation_every != last]
        return learned, [sample for index, sample in enumerate(samples) if index % self.validation_every == last]


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
    def _finetunes(self) -> bool:
        """Whether the last steps are of recorded frames alone."""
        return self.condition.real and bool(self.condition.sets) and model_class(self.model).keeps_order

    def identity(self) -> dict[str, Any]:
        """Return what a folder must agree with to be this job's. Its keys are those of job.json."""
        settings, kind = self.settings, model_class(self.model)
        finish = f"{settings.finetune_share} of the steps, {settings.finetune_epochs} rounds at most"
        held_out = {key: getattr(settings, key) for key in HELD_OUT}
        return {
            "model": self.model,
            "condition": self.condition.name,
            "real": self.real,
            "fold": self.fold,
            "capture": str(settings.capture.absolute()),
            "labels": absolute(settings.labels),
            "transforms": settings.transforms,
            "sets": [data.described() for data in self.sets],
            "edges": self.condition.edges if self.sets else None,
            "finish": finish if self._finetunes else None,
            "classes": settings.classes,
            "pick": settings.frame_selection,
            "steps": settings.steps_of(kind),
            "side": settings.size or kind.image_size,
            "batch": settings.batch_of(kind),
            "weights": absolute(settings.weights.get(self.model)),
        } | {key: value for key, value in held_out.items() if value != getattr(DownstreamSettings, key)}

    def check(self) -> None:
        """Raises NeecoError when the folder holds another job's result."""
        file = self.folder / JOB_FILE
        if not file.exists():
            return
        stored = require_like(read_json(file), {"schema": str}, str(file), REMEDY)
        stored = {key: getattr(DownstreamSettings, key) for key in HELD_OUT} | stored
        now = {"schema": JOB_SCHEMA} | {key: getattr(self.settings, key) for key in HELD_OUT} | self.identity()
        require_same(str(file), ((key, stored.get(key), now[key]) for key in now), REMEDY)

    def run(self, progress: JobProgress | None = None, capture: Capture | None = None) -> dict[str, Any]:
        """Train, test, write `folder`/job.json last, and return what it holds; at once when it is there already."""
        self.check()
        file = self.folder / JOB_FILE
        if file.exists():
            stored = dict(read_json(file))
            if set(self.settings.splits) <= set(stored["splits"]):
                return stored
        report = progress or (lambda stage, share, text: None)
        report("training", 0.0, "")
        capture = capture or read_capture(self.capture, self.settings.transforms)
        started, cpu_before = time.monotonic(), _cpu_seconds()
        task = replace(self.task(capture), progress=lambda share, text: report("training", share, text))
        trained = model_class(self.model)().fit(task)
        seconds, cpu_seconds = time.monotonic() - started, _cpu_seconds() - cpu_before
        report("evaluating", 0.0, "")
        result = {
            "schema": JOB_SCHEMA,
            **self.identity(),
            "iterations": task.steps,
            "best_step": trained.best_step,
            "validation": list(map(list, trained.validation)),
            "still_learning": _still_rises(trained, task.steps),
            "seconds": round(seconds, 1),
            "processor_seconds": round(cpu_seconds, 1),
            "input": list(task.size),
            "splits": {split: self._test(trained, capture, split) for split in self.settings.splits},
        }
        write_json(file, result)
        return result

    def task(self, capture: Capture) -> TrainingTask:
        """Return the training task. Its training and validation images depend on the fold, their order on nothing
        else."""
        settings, kind = self.settings, model_class(self.model)
        recorded = recorded_samples(capture, "train", settings.classes, settings.labels) if self.condition.real else ()
        chosen = labelled_frames(len(recorded), self.real, self.fold, settings.frame_selection)
        size = frame_size(recorded or recorded_samples(capture, settings.splits[0], settings.classes))
        sources: list[Sequence[Sample]] = [[recorded[index] for index in chosen]]
        names = class_names(capture, settings.classes)
        sources += [synthetic_samples(data, names, self.condition.edges, size) for data in self.sets]
        parts = [settings.hold_out(source, self.fold) for source in sources if source]
        learned = [samples for samples, _ in parts]
        validation: Sequence[Sample] = next((held_out for _, held_out in parts if held_out), [])
        steps, batch = settings.steps_of(kind), settings.batch_of(kind)
        mixed = None
        if self._finetunes:
            most = settings.finetune_epochs * len(learned[0]) // batch
            mixed = (steps - min(round(settings.finetune_share * steps), most)) * batch
        return TrainingTask(
            classes=names,
            batches=BatchSampler(learned, self.fold, augment if self.condition.augment else None, mixed),
            validation=tuple(validation),
            size=settings.input_of(kind, size),
            steps=steps,
            batch=batch,
            seed=self.fold,
            device=device_of(settings.device, drawing=False),
            folder=self.folder,
            weights=settings.weights.get(self.model),
        )

    def _test(self, trained: TrainedModel, capture: Capture, split: str) -> dict[str, Any]:
        """Scores on one split; the predictions are stored for pictures."""
        samples = recorded_samples(capture, split, self.settings.classes)
        truth = [sample.load() for sample in samples]
        predictions = trained.predict([example.image for example in truth])
        names, folder = class_names(capture, self.settings.classes), predictions_folder(self.folder, split)
        boxes = {
            sample.name: found
            for sample, found in zip(samples, predictions, strict=True)
            if isinstance(found, Detections)
        }
        if boxes:
            write_json(folder / "boxes.json", {name: _stored(found) for name, found in boxes.items()})
            return {"frames": len(samples)} | box_scores(list(boxes.values()), truth, names)
        frames = []
        for sample, mask, example in zip(samples, predictions, truth, strict=True):
            assert isinstance(mask, np.ndarray)
            write_labels(folder / f"{sample.name}.png", torch.from_numpy(mask))
            scores = mask_scores(mask, example, names)
            for pair, pixels in sample.pairs().items():
                close = near(pixels, PAIR_DISTANCE)
                region = close if example.valid is None else close & example.valid
                scores |= {f"iou_{pair}": iou(mask > 0, example.classes > 0, region)}
            frames.append(scores)
        rows = [
            {"frame": sample.name}
            | {key: None if np.isnan(value) else round(value, 5) for key, value in scores.items()}
            for sample, scores in zip(samples, frames, strict=True)
        ]
        return {"frames": len(samples)} | mean_scores(frames) | {"per_frame": rows}


def absolute(path: Path | None) -> str | None:
    """A path for a file; None stays None."""
    return None if path is None else str(path.absolute())


def _stored(found: Detections) -> dict[str, Any]:
    return {key: values[found.scores > MIN_STORED_SCORE].round(4).tolist() for key, values in vars(found).items()}


def _cpu_seconds() -> float:
    """Return the CPU time, in s, of this process and the programs that it has run."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def _still_rises(trained: TrainedModel, steps: int) -> bool:
    """Return whether the last checkpoint is clearly the best: more steps may help."""
    curve = trained.validation
    if len(curve) < 2 or trained.best_step <= 0.8 * steps:
        return False
    return curve[-1][1] > max(score for _, score in curve[:-1]) + 0.005
