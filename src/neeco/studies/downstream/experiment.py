"""`downstream`: models trained on recorded and on synthetic images within one budget, tested on recorded frames.
`plan_downstream` checks a study, `run_downstream` runs its trainings, each a `DownstreamJob`."""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from neeco import __version__
from neeco.base.errors import NeecoError
from neeco.base.files import own_folder, read_json, require_like, require_same, write_atomically, write_json, write_text
from neeco.capture import Capture, read_capture
from neeco.capture.checks import read_checked
from neeco.evaluation.masks import truth_file
from neeco.raster.devices import device_of
from neeco.studies.downstream import DownstreamRequest
from neeco.studies.downstream.model import Predict, TorchModel, TrainingTask, input_size, model_class
from neeco.studies.downstream.results import (
    Detections,
    Prediction,
    box_iou,
    box_scores,
    findings,
    mask_scores,
    mean_scores,
    summarise,
    summary_text,
)
from neeco.studies.downstream.samples import (
    CACHE,
    ImageSet,
    RecordedSample,
    Sample,
    class_names,
    frame_size,
    permuted,
    recorded_samples,
    synthetic_samples,
)
from neeco.studies.downstream.training_data import (
    PASTE,
    PERMUTED,
    REAL,
    RESERVED,
    STRONG,
    BatchSampler,
    Condition,
    background_files,
    default_conditions,
    labelled_count,
    labelled_frames,
    parse_condition,
    pasted_samples,
)
from neeco.studies.study import REMEDY, Job, JobEvent, JobProgress, check_output, check_workers, machine, run_jobs

SCHEMA = "neeco-downstream/3"
FILE, TABLE = "downstream.json", "downstream.csv"
JOB_SCHEMA = "neeco-downstream-job/3"
JOB_FILE = "job.json"
PREFIX = "frame_"  # of frame names in files of predictions
_read = lru_cache(maxsize=8)(read_capture)  # for all jobs of this process


def steps_of(request: DownstreamRequest, kind: type[TorchModel]) -> int:
    """Return the number of steps of a model."""
    return request.steps or round(kind.steps * (request.parts_steps if request.classes == "parts" else 1))


def input_of(request: DownstreamRequest, kind: type[TorchModel], frame: tuple[int, int]) -> tuple[int, int]:
    """Return the input (width, height) of a model for frames of this size."""
    return input_size(frame, request.size or kind.image_size, kind.multiple)


def held_out_samples(request: DownstreamRequest, capture: Capture, test: str) -> tuple[RecordedSample, ...]:
    """Return the frames of a test: all frames with ground truth of the other capture of that name, else of a split of
    `capture`. Raises NeecoError."""
    if test in request.tests:
        return recorded_samples(_read(request.tests[test], "transforms.json"), None, request.classes)
    return recorded_samples(capture, test, request.classes)


@dataclass(frozen=True, kw_only=True)
class DownstreamJob(Job):
    """One training. real: number of labelled recorded frames."""

    request: DownstreamRequest
    model: str
    condition: Condition
    real: int  # 0 if the condition has none
    fold: int

    @property
    def title(self) -> str:
        """Model, condition, labelled frames and fold, for display."""
        labelled = f", {self.real} labelled" if self.real else ""
        return f"{self.model}, {self.condition.name}{labelled}, fold {self.fold}"

    @property
    def sets(self) -> list[ImageSet]:
        """The image sets of its training data."""
        return [data for data in self.request.image_sets if data.name in self.condition.sets]

    def identity(self) -> dict[str, Any]:
        """Return the description that identifies this job's folder, with the keys of job.json."""
        request, kind = self.request, model_class(self.model)
        backgrounds = request.backgrounds if PASTE in self.condition else None
        return {
            "model": self.model,
            "condition": self.condition.name,
            "real": self.real,
            "fold": self.fold,
            "capture": str(request.capture.absolute()),
            "labels": request.labels and str(request.labels.absolute()),
            "transforms": request.transforms,
            "sets": [data.described() for data in self.sets],
            "backgrounds": backgrounds and str(backgrounds.absolute()),
            "classes": request.classes,
            "steps": steps_of(request, kind),
            "size": request.size or kind.image_size,
            "batch": request.batch or kind.batch,
        }

    def check(self) -> dict[str, Any] | None:
        """Return the result of an earlier start; None unless it has all tests. Raises NeecoError if the folder has
        another job's result, or a test of this name on another capture."""
        file = self.folder / JOB_FILE
        if not file.exists():
            return None
        stored = require_like(read_json(file), {"schema": str}, str(file), REMEDY)
        now = {"schema": JOB_SCHEMA} | self.identity()
        require_same(str(file), ((key, stored.get(key), now[key]) for key in now), REMEDY)
        tested = require_like(stored, {"tests": {str: str}, "splits": dict}, str(file), REMEDY)["tests"]
        tests = {name: str(path.absolute()) for name, path in self.request.tests.items()}
        require_same(f"{file}: --test", ((name, tested.get(name, tests[name]), tests[name]) for name in tests), REMEDY)
        return dict(stored) if set(self.request.all_tests) <= set(stored["splits"]) else None

    def run(self, progress: JobProgress | None = None, capture: Capture | None = None) -> dict[str, Any]:
        """Train, test, write `folder`/job.json last, and return its content; only read it if it exists already."""
        if (earlier := self.check()) is not None:
            return earlier
        report = progress or (lambda stage, share, text: None)
        report("training", 0.0, "")
        cv2.setNumThreads(torch.get_num_threads())  # otherwise every worker uses all cores
        capture = capture or _read(self.capture, self.request.transforms)
        started = time.monotonic()
        task = replace(self.task(capture), progress=lambda share, text: report("training", share, text))
        predict = model_class(self.model)().fit(task)
        seconds = time.monotonic() - started
        report("evaluating", 0.0, "")
        result = {
            "schema": JOB_SCHEMA,
            **self.identity(),
            "tests": {name: str(path.absolute()) for name, path in self.request.tests.items()},
            "labelled": [sample.name for sample in self.labelled(capture)],
            "iterations": task.steps,
            "seconds": round(seconds, 1),
            "input": list(task.size),
            "splits": {test: self._test(predict, test, capture) for test in self.request.all_tests},
        }
        write_json(self.folder / JOB_FILE, result)
        return result

    def labelled(self, capture: Capture) -> list[RecordedSample]:
        """Return the labelled frames."""
        if REAL not in self.condition:
            return []
        recorded = recorded_samples(capture, "train", self.request.classes, self.request.labels)
        return [recorded[index] for index in labelled_frames(len(recorded), self.real, self.fold)]

    def task(self, capture: Capture) -> TrainingTask:
        """Return the training task. Images and their order depend only on the fold."""
        request, kind, labelled = self.request, model_class(self.model), self.labelled(capture)
        size = frame_size(labelled or recorded_samples(capture, request.splits[0], request.classes))
        names = class_names(capture, request.classes)
        synthetic: list[Sequence[Sample]] = []
        for data in self.sets:
            samples = synthetic_samples(data, names, size)
            synthetic.append(permuted(samples) if PERMUTED in self.condition else samples)
        if PASTE in self.condition:
            synthetic.append(pasted_samples(labelled, request.backgrounds, self.fold))
        return TrainingTask(
            classes=names,
            batches=BatchSampler(labelled, synthetic, seed=self.fold, augmented=STRONG in self.condition),
            size=input_of(request, kind, size),
            steps=steps_of(request, kind),
            batch=request.batch or kind.batch,
            seed=self.fold,
            device=device_of(request.device, drawing=False),
            folder=self.folder,
            keep_weights=self.fold == request.kept_fold,
        )

    def _test(self, predict: Predict, test: str, capture: Capture) -> dict[str, Any]:
        """Return the scores on one split or capture; the predictions of `kept_fold` are stored for figures."""
        names = class_names(capture, self.request.classes)
        samples = held_out_samples(self.request, capture, test)
        truth = [CACHE.load(sample) for sample in samples]
        predictions = predict([example.image for example in truth])
        if self.fold == self.request.kept_fold:
            write_predictions(self.folder, test, [sample.name for sample in samples], predictions)
        frames = [
            {"box_iou": box_iou(output, true)} if isinstance(output, Detections) else mask_scores(output, true, names)
            for output, true in zip(predictions, truth, strict=True)
        ]
        boxes = [prediction for prediction in predictions if isinstance(prediction, Detections)]
        rows = [
            {"frame": sample.name}
            | {key: None if np.isnan(value) else round(value, 5) for key, value in scores.items()}
            for sample, scores in zip(samples, frames, strict=True)
        ]
        scores = box_scores(boxes, truth, names) if boxes else mean_scores(frames)
        return {"frames": len(samples)} | scores | {"per_frame": rows}


def write_predictions(job: Path, test: str, names: Sequence[str], predictions: Sequence[Prediction]) -> None:
    """Write a job's predictions for a test by frame name: masks uint8 [H, W], or boxes [n, 6] (x0, y0, x1, y1, class,
    score)."""
    arrays = {
        PREFIX + name: np.column_stack([prediction.boxes, prediction.classes, prediction.scores])
        if isinstance(prediction, Detections)
        else prediction
        for name, prediction in zip(names, predictions, strict=True)
    }

    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
    write_atomically(job / "predictions" / f"{test}.npz", lambda file: file.write_bytes(stream.getvalue()))


def read_predictions(job: Path, test: str) -> dict[str, Prediction]:
    """Return the predictions written by `write_predictions`; {} if there is no file."""
    path = job / "predictions" / f"{test}.npz"
    if not path.is_file():
        return {}
    with np.load(path, allow_pickle=False) as stored:
        arrays = {name.removeprefix(PREFIX): stored[name] for name in stored.files}
    return {
        name: array if array.dtype == np.uint8 else Detections(array[:, :4], array[:, 4].astype(np.int64), array[:, 5])
        for name, array in arrays.items()
    }


@dataclass(frozen=True, kw_only=True)
class DownstreamPlan:
    """A checked request, ready to run."""

    request: DownstreamRequest  # with the test splits
    capture: Capture
    jobs: tuple[DownstreamJob, ...]
    images: Mapping[str, int]  # of each set
    labelled: int  # recorded training frames with a label
    frame_size: tuple[int, int]  # width, height


def plan_downstream(request: DownstreamRequest) -> DownstreamPlan:
    """Check a request before training. Raises NeecoError if it is invalid."""
    for option in ("folds", "steps", "size", "batch"):
        if (value := getattr(request, option)) is not None and value < 1:
            raise NeecoError(f"--{option} must be at least 1 (got {value})")
    check_workers(request.workers, device_of(request.device, drawing=False), share_gpus=True)
    if not request.models:
        raise NeecoError("--models: missing; give at least one")
    names = [data.name for data in request.image_sets]
    for name in names:
        if name in ("", *RESERVED) or {*name} & set("+/\\") or names.count(name) > 1:
            raise NeecoError(f"--sets {name}: reserved, duplicate, or not a valid file name; choose another name")
    if request.backgrounds is not None:
        background_files(request.backgrounds)
    words = dict.fromkeys(request.conditions or default_conditions(names))
    conditions = [parse_condition(word, names) for word in words]
    capture = read_checked(request.capture, request.transforms)
    with_truth = {frame.split for frame in capture.frames if truth_file(capture.root, frame.name)}
    usable = [split for split in capture.splits if split != "train" and split in with_truth]
    for split in request.splits or ("",):
        if split not in usable and (split or not usable):
            truth = f"has true masks of {', '.join(usable)}" if usable else "has no true mask outside of split train"
            raise NeecoError(f"--splits: {split or 'missing'}: {capture.root} {truth}; choose a split with true masks")
    splits = tuple(request.splits or usable)
    request = replace(request, splits=splits, models=tuple(dict.fromkeys(request.models)))
    size = frame_size(recorded_samples(capture, splits[0], request.classes))
    classes = class_names(capture, request.classes)
    images = {data.name: len(synthetic_samples(data, classes, size)) for data in request.image_sets}
    for name, path in request.tests.items():
        if name in capture.splits:
            raise NeecoError(f"--test {name}: is the name of a split; choose another: --test NAME={path}")
        other = read_checked(path, "transforms.json")
        if class_names(other, request.classes) != classes:
            raise NeecoError(f"--test {name}: {path} has other parts than {capture.root}; use --classes instrument")
        recorded_samples(other, None, request.classes)
    for name in request.models:  # that can be trained on this machine, and on these images
        kind = model_class(name)
        if missing := kind.missing_requirement():
            raise NeecoError(f"--models {name}: {missing}")
        width, height = input_of(request, kind, size)
        if kind.is_too_small((width, height)):
            raise NeecoError(f"--models {name}: input of {width}x{height} px is too small; give a larger --size")
        several = [str(data.path) for data in request.image_sets if data.instruments() > 1]
        several += [str(capture.root)] if len(capture.instruments) > 1 else []
        if kind.predicts == "boxes" and several:
            problem = f"{several[0]}: has several instruments, which the labels do not distinguish"
            raise NeecoError(f"--models {name}: {problem}; use a model that predicts masks")
    labelled, counts = 0, [0] if "0" in (request.num_real or ("0",)) else []
    for word in request.num_real:
        labelled_count(word, 10**9)
    if any(REAL in condition for condition in conditions) and set(request.num_real or "all") != {"0"}:
        labelled = len(recorded_samples(capture, "train", request.classes, request.labels))
        defaults = (str(count) for count in request.default_counts if count < labelled)
        requested = request.num_real or ("0", *defaults, "all")
        counts = sorted({labelled_count(word, labelled) for word in requested})
    jobs = tuple(
        DownstreamJob(
            capture=request.capture,
            folder=request.job_folder(model, condition.name, real, fold),
            device=request.device,
            request=request,
            model=model,
            condition=condition,
            real=real,
            fold=fold,
        )
        for fold in range(request.folds)  # folds in the outer loop, so that interim results include all conditions
        for model in request.models
        for condition in conditions
        for real in counts
        if bool(real) == (REAL in condition)
    )
    trained = {job.condition.name for job in jobs}
    if untrained := [item.name for item in conditions if item.name not in trained and (request.conditions or not jobs)]:
        problem = f"condition {untrained[0]} has no training data"
        raise NeecoError(f"--num-real: {problem}; add 0 for sets alone, a number for real")
    entries = [entry.name for entry in request.output.iterdir()] if request.output.is_dir() else []
    if [name for name in entries if not name.startswith(".")] != ["jobs"]:  # else interrupted before the first result
        same = {"schema": SCHEMA, "capture": str(request.capture.absolute())}
        check_output(request.output, FILE, "a downstream experiment", **same)
    for job in jobs:
        job.check()
    return DownstreamPlan(
        request=request, capture=capture, jobs=jobs, images=images, labelled=labelled, frame_size=size
    )


def run_downstream(plan: DownstreamPlan, progress: Callable[[JobEvent], None] | None = None) -> dict[str, Any]:
    """Train and test every model in every condition on every fold, except jobs finished earlier. Write downstream.csv
    and downstream.json, and return the content of the latter. A failed job is reported in its place."""
    file, jobs = plan.request.output / FILE, plan.jobs
    with own_folder(plan.request.output):
        finished = {index: stored for index, job in enumerate(jobs) if (stored := job.check()) is not None}
        captures = {plan.request.capture: plan.capture}
        written, recorded = 0.0, list[Mapping[str, Any]]()

        def record(results: Sequence[Mapping[str, Any]]) -> None:
            nonlocal written
            recorded[:] = results
            if time.monotonic() > written + plan.request.write_every_s:
                write_json(file, document(plan, recorded))
                written = time.monotonic()

        try:
            results = run_jobs(jobs, plan.request.workers, record, finished, progress, captures, light=True)
        except KeyboardInterrupt:
            if recorded:
                write_json(file, document(plan, recorded))
            raise
        result = document(plan, results) | {"complete": True}
        write_json(file, result)
        write_text(plan.request.output / TABLE, summary_text(result))
    return result


def document(plan: DownstreamPlan, results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the contents of downstream.json for these results."""
    request, kinds = plan.request, {name: model_class(name) for name in plan.request.models}
    predicts = {name: kind.predicts for name, kind in kinds.items()}
    notes = []
    if request.folds < 3:
        notes.append("with fewer than three folds, intervals underestimate the variance of seeds; use --folds 5")
    if request.labels is not None:
        notes.append(f"labels of recorded training frames: {request.labels}; tests are scored by the capture's truth")
    made: dict[str, Any] = {
        "schema": SCHEMA,
        "version": __version__,
        "complete": False,
        "capture": str(request.capture.absolute()),
        "machine": machine(device_of(request.device, drawing=False), request.workers),
        "labels": request.labels and str(request.labels.absolute()),
        "classes": list(class_names(plan.capture, request.classes)),
        "tests": request.all_tests,
        "captures": {name: str(path.absolute()) for name, path in request.tests.items()},  # of tests
        "folds": request.folds,
        "labelled": plan.labelled,
        "sets": [data.described() | {"images": plan.images[data.name]} for data in request.image_sets],
        "models": [
            {
                "name": name,
                "predicts": kind.predicts,
                "steps": steps_of(request, kind),
                "batch": request.batch or kind.batch,
                "input": list(input_of(request, kind, plan.frame_size)),
            }
            for name, kind in kinds.items()
        ],
        "jobs": list(results),
        "summary": summarise(results, predicts, request.all_tests),
        "notes": notes,
    }
    return made | {"findings": findings(made)}
