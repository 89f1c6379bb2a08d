"""`downstream`: models trained on recorded and on synthetic images within one budget, tested on recorded frames."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from neeco import __version__
from neeco.base.errors import NeecoError
from neeco.base.files import own_folder, write_json
from neeco.capture import Capture
from neeco.capture.checks import read_checked
from neeco.raster.devices import device_of
from neeco.studies.downstream.conditions import REAL, RESERVED, default_conditions, labelled_count, parse_condition
from neeco.studies.downstream.job import DownstreamJob, DownstreamSettings, absolute
from neeco.studies.downstream.model import model_class
from neeco.studies.downstream.paste import background_files
from neeco.studies.downstream.results import findings, summarise
from neeco.studies.downstream.samples import (
    class_names,
    frame_size,
    has_labels,
    recorded_samples,
    synthetic_samples,
)
from neeco.studies.machine import machine
from neeco.studies.study import JobEvent, check_output, check_workers, run_jobs

SCHEMA = "neeco-downstream/3"
FILE = "downstream.json"
DEFAULT_COUNTS = (5, 10, 20, 50)  # of labelled frames, besides all
WRITE_EVERY_S = 30.0  # the results so far are written no more often: they are thousands of frames' scores


@dataclass(frozen=True, kw_only=True)
class DownstreamPlan:
    """A study whose settings are checked, ready to run."""

    settings: DownstreamSettings  # with the splits that are tested
    capture: Capture
    jobs: tuple[DownstreamJob, ...]
    images: Mapping[str, int]  # of each set
    labelled: int  # recorded training frames with a label
    frame_size: tuple[int, int]  # width, height


def plan_downstream(settings: DownstreamSettings) -> DownstreamPlan:
    """Check all that can be known before the work. Raises NeecoError for what cannot be trained or tested."""
    for option in ("folds", "steps", "size", "batch"):
        value = getattr(settings, option)
        if value is not None and value < 1:
            raise NeecoError(f"--{option}: {value} is none at all; give at least 1")
    check_workers(settings.workers, device_of(settings.device, drawing=False), share_gpus=True)
    if not settings.models:
        raise NeecoError("--models: none is given; name at least one")
    names = [data.name for data in settings.sets]
    for name in names:
        if name in ("", *RESERVED) or {*name} & set("+/\\") or names.count(name) > 1:
            raise NeecoError(f"--sets {name}: conditions and folders go by this name; give each set one of its own")
    if settings.backgrounds is not None:
        background_files(settings.backgrounds)
    words = default_conditions(names) if settings.conditions is None else settings.conditions
    conditions = [parse_condition(word, names) for word in dict.fromkeys(words)]
    capture = read_checked(settings.capture, settings.transforms)
    settings = replace(settings, splits=_splits(capture, settings.splits))
    size = frame_size(recorded_samples(capture, settings.splits[0], settings.classes))
    classes = class_names(capture, settings.classes)
    images = {data.name: len(synthetic_samples(data, classes, size)) for data in settings.sets}
    _check_tests(settings, capture)
    _check_models(settings, capture, size)
    labelled, counts = 0, [0] if "0" in (settings.num_real or ("0",)) else []
    for word in settings.num_real or ():
        labelled_count(word, 10**9)
    if any(REAL in condition for condition in conditions) and set(settings.num_real or "all") != {"0"}:
        labelled = len(recorded_samples(capture, "train", settings.classes, settings.labels))
        wanted = settings.num_real or ("0", *(str(count) for count in DEFAULT_COUNTS if count < labelled), "all")
        counts = sorted({labelled_count(word, labelled) for word in wanted})
    jobs = tuple(
        DownstreamJob(settings, model, condition, real, fold)
        for fold in range(settings.folds)  # the first fold of everything comes first: results halfway are of all
        for model in settings.models
        for condition in conditions
        for real in counts
        if bool(real) == (REAL in condition)
    )
    trained = {job.condition.name for job in jobs}
    if missing := [item.name for item in conditions if item.name not in trained and (settings.conditions or not jobs)]:
        raise NeecoError(
            f"--num-real: leaves nothing to train {missing[0]} on; add 0 for sets alone, a number for real"
        )
    entries = [entry.name for entry in settings.output.iterdir()] if settings.output.is_dir() else []
    if [name for name in entries if not name.startswith(".")] != ["jobs"]:  # not just before its first result
        check_output(settings.output, FILE, SCHEMA, settings.capture, "a downstream experiment")
    for job in jobs:
        job.check()
    return DownstreamPlan(
        settings=settings, capture=capture, jobs=jobs, images=images, labelled=labelled, frame_size=size
    )


def _splits(capture: Capture, requested: Sequence[str]) -> tuple[str, ...]:
    """The splits to test on. Raises NeecoError."""
    usable = [split for split in capture.splits if split != "train" and has_labels(capture, split)]
    for split in requested or ("",):
        if split not in usable and (split or not usable):
            known = f"has true masks of {', '.join(usable)}" if usable else "has no true mask outside of split train"
            raise NeecoError(f"--splits: {split or 'none is given'}: {capture.root} {known}; choose what to test on")
    return tuple(requested or usable)


def _check_tests(settings: DownstreamSettings, capture: Capture) -> None:
    """Raises NeecoError for other captures that cannot be tested on, or whose names mean something else."""
    for name, path in settings.tests.items():
        if name in (*capture.splits, "") or {*name} & {"/", "\\"}:
            raise NeecoError(f"--test {name}: results go by this name; name it otherwise: --test NAME={path}")
        other = read_checked(path, "transforms.json")
        if class_names(other, settings.classes) != class_names(capture, settings.classes):
            raise NeecoError(f"--test {name}: {path} has other parts than {capture.root}; use --classes instrument")
        recorded_samples(other, None, settings.classes)


def _check_models(settings: DownstreamSettings, capture: Capture, frame: tuple[int, int]) -> None:
    """Raises NeecoError for models that cannot be trained here, or not on these images."""
    for name in settings.models:
        kind = model_class(name)
        if missing := kind.missing_requirement():
            raise NeecoError(f"--models {name}: {missing}")
        width, height = settings.input_of(kind, frame)
        if kind.is_too_small((width, height)):
            raise NeecoError(
                f"--models {name}: it would see images of {width}x{height} px, too small for it; give a larger --size"
            )
        several = [str(data.path) for data in settings.sets if data.instruments() > 1]
        several += [str(capture.root)] if len(capture.instruments) > 1 else []
        if kind.predicts == "boxes" and several:
            problem = f"{several[0]}: has several instruments, and labels do not tell them apart"
            raise NeecoError(f"--models {name}: {problem}; use a model that predicts masks")


def run_downstream(plan: DownstreamPlan, progress: Callable[[JobEvent], None] | None = None) -> dict[str, Any]:
    """Train and test every model in every condition on every fold; writes downstream.json, and returns what it holds.

    Started again after an interruption it continues where it stopped; started again with more models, sets, conditions,
    labelled frames or folds, it adds them. A failed job is reported in its place.
    """
    file, jobs = plan.settings.output / FILE, plan.jobs
    with own_folder(plan.settings.output):
        finished = {index: found for index, job in enumerate(jobs) if (found := job.stored()) is not None}
        captures = {plan.settings.capture: plan.capture}
        written, known = 0.0, list[Mapping[str, Any]]()

        def record(results: Sequence[Mapping[str, Any]]) -> None:
            nonlocal written
            known[:] = results
            if time.monotonic() > written + WRITE_EVERY_S:
                write_json(file, document(plan, known))
                written = time.monotonic()

        try:
            results = run_jobs(jobs, plan.settings.workers, record, finished, progress, captures, light=True)
        except KeyboardInterrupt:
            if known:
                write_json(file, document(plan, known))
            raise
        result = document(plan, results) | {"complete": True}
        write_json(file, result)
    return result


def document(plan: DownstreamPlan, results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the contents of downstream.json for these results."""
    settings, kinds = plan.settings, {name: model_class(name) for name in plan.settings.models}
    predicts = {name: kind.predicts for name, kind in kinds.items()}
    notes = []
    if settings.folds < 3:
        notes.append("intervals of fewer than three folds hardly cover other seeds; give --folds 5 before concluding")
    if settings.labels is not None:
        notes.append(f"labels of recorded training frames: {settings.labels}; tests are scored by the capture's truth")
    made: dict[str, Any] = {
        "schema": SCHEMA,
        "version": __version__,
        "complete": False,
        "capture": str(settings.capture.absolute()),
        "machine": machine(device_of(settings.device, drawing=False), settings.workers),
        "labels": absolute(settings.labels),
        "classes": list(class_names(plan.capture, settings.classes)),
        "tests": settings.all_tests,
        "captures": {name: str(path.absolute()) for name, path in settings.tests.items()},  # of tests
        "folds": settings.folds,
        "labelled": plan.labelled,
        "sets": [data.described() | {"images": plan.images[data.name]} for data in settings.sets],
        "models": [
            {
                "name": name,
                "predicts": kind.predicts,
                "steps": settings.steps_of(kind),
                "batch": settings.batch_of(kind),
                "input": list(settings.input_of(kind, plan.frame_size)),
            }
            for name, kind in kinds.items()
        ],
        "jobs": list(results),
        "summary": summarise(results, predicts, settings.all_tests),
        "notes": notes,
    }
    return made | {"findings": findings(made)}
