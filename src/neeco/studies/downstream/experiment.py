"""`downstream`: models trained on recorded and on synthetic images within one budget, tested on recorded frames."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from neeco import __version__
from neeco.capture import Capture
from neeco.capture.checks import read_checked
from neeco.errors import NeecoError
from neeco.files import own_folder, read_json, write_json
from neeco.raster.devices import device_of
from neeco.studies.downstream.conditions import (
    REAL,
    RESERVED,
    Condition,
    default_conditions,
    labelled_count,
    parse_condition,
)
from neeco.studies.downstream.job import JOB_FILE, DownstreamJob, DownstreamSettings, absolute
from neeco.studies.downstream.model import model_class
from neeco.studies.downstream.paste import background_files
from neeco.studies.downstream.results import comparisons, failed_jobs, findings, summarise_folds
from neeco.studies.downstream.samples import (
    ImageSet,
    class_names,
    frame_size,
    has_labels,
    recorded_samples,
    synthetic_samples,
)
from neeco.studies.machine import machine, threads_per_worker
from neeco.studies.study import JobEvent, check_output, check_workers, run_jobs

SCHEMA = "neeco-downstream/2"
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
    notes: tuple[str, ...]


def plan_downstream(settings: DownstreamSettings) -> DownstreamPlan:
    """Check all that can be known before the work. Raises NeecoError for what cannot be trained or tested."""
    for option in ("folds", "steps", "size", "batch"):
        value = getattr(settings, option)
        if value is not None and value < 1:
            raise NeecoError(f"--{option}: {value} is none at all; give at least 1")
    check_workers(settings.workers, device_of(settings.device, drawing=False), share_gpus=True)
    _check_models(settings)
    conditions = _conditions(settings)
    capture = read_checked(settings.capture, settings.transforms)
    settings = replace(settings, splits=_splits(capture, settings.splits))
    _check_tests(settings, capture)
    if settings.backgrounds is not None:
        background_files(settings.backgrounds)
    size = frame_size(recorded_samples(capture, settings.splits[0], settings.classes))
    classes = class_names(capture, settings.classes)
    images = {data.name: len(synthetic_samples(data, classes, size)) for data in settings.sets}
    counts, labelled = _counts(settings, capture, conditions)
    _check_inputs(settings, capture, size)
    entries = settings.output.iterdir() if settings.output.is_dir() else ()
    if [entry.name for entry in entries if not entry.name.startswith(".")] != [
        "jobs"
    ]:  # not just before its first result
        check_output(settings.output, FILE, SCHEMA, settings.capture, "a downstream experiment")
    absent = [item for item in conditions if not any(bool(real) == item.real for real in counts)]
    if absent and (settings.conditions is not None or len(absent) == len(conditions)):
        more = "a number of labelled frames" if absent[0].real else "0, for sets alone"
        raise NeecoError(f"--num-real: leaves nothing to train {absent[0].name} on; add {more}")
    jobs = _jobs(settings, conditions, counts)
    for job in jobs:
        job.check()
    return DownstreamPlan(
        settings=settings,
        capture=capture,
        jobs=jobs,
        images=images,
        labelled=labelled,
        frame_size=size,
        notes=tuple(_notes(settings)),
    )


def _check_models(settings: DownstreamSettings) -> None:
    if not settings.models:
        raise NeecoError("--models: none is given; name at least one")
    for name in settings.models:
        kind = model_class(name)
        if missing := kind.missing_requirement():
            raise NeecoError(f"--models {name}: {missing}")
        if name in settings.weights and not kind.accepts_weights:
            raise NeecoError(f"--weights {name}: this model takes none")
    for name, file in settings.weights.items():
        if name not in settings.models:
            raise NeecoError(f"--weights: {name!r} is not among --models {' '.join(settings.models)}")
        if not file.is_file():
            raise NeecoError(f"--weights {name}: {file}: no such file")


def _conditions(settings: DownstreamSettings) -> list[Condition]:
    names = [data.name for data in settings.sets]
    for name in names:
        if name in RESERVED or "+" in name or not name:
            raise NeecoError(f"--sets {name}: this name has a meaning of its own; call the set otherwise")
        if "/" in name or "\\" in name:
            raise NeecoError(f"--sets {name}: folders are named by it; call the set without / or \\")
    if len(set(names)) < len(names):
        raise NeecoError(f"--sets: a name stands twice in {' '.join(names)}; name each set differently")
    words = default_conditions(names) if settings.conditions is None else settings.conditions
    return [parse_condition(word, names) for word in dict.fromkeys(words)]


def _splits(capture: Capture, requested: Sequence[str]) -> tuple[str, ...]:
    for split in requested:
        if split not in capture.splits:
            raise NeecoError(f"--splits: {capture.root} has no split {split!r}; it has {', '.join(capture.splits)}")
        if split == "train":
            raise NeecoError("--splits: train: what is learned from is not tested; choose other splits")
        if not has_labels(capture, split):
            raise NeecoError(f"--splits: {split}: no frame of it has a true mask in {capture.root}; nothing to test on")
    found = requested or [split for split in capture.splits if split != "train" and has_labels(capture, split)]
    if not found:
        raise NeecoError(
            f"{capture.root}: no frame outside of split train has a true mask (truth/masks or reference_masks); "
            "nothing to test on"
        )
    return tuple(found)


def _check_tests(settings: DownstreamSettings, capture: Capture) -> None:
    """Raises NeecoError for other captures that cannot be tested on, or whose names mean something else."""
    names = [test.name for test in settings.tests]
    for test in settings.tests:
        if test.name in (*capture.splits, "") or names.count(test.name) > 1 or {*test.name} & {"/", "\\"}:
            raise NeecoError(f"--test {test.name}: results go by this name; name it otherwise: --test NAME={test.path}")
        other = read_checked(test.path, "transforms.json")
        if class_names(other, settings.classes) != class_names(capture, settings.classes):
            raise NeecoError(
                f"--test {test.name}: {test.path} has other parts than {capture.root}; use --classes instrument"
            )
        recorded_samples(other, None, settings.classes)


def _counts(settings: DownstreamSettings, capture: Capture, conditions: Sequence[Condition]) -> tuple[list[int], int]:
    """The counts of labelled frames, and how many there are."""
    for word in settings.num_real or ():
        labelled_count(word, 10**9)
    if not any(condition.real for condition in conditions) or set(settings.num_real or "all") <= {"0"}:
        return [0] if "0" in (settings.num_real or "0") else [], 0
    labelled = len(recorded_samples(capture, "train", settings.classes, settings.labels))
    if settings.num_real is None:
        return [0, *(count for count in DEFAULT_COUNTS if count < labelled), labelled], labelled
    return sorted({labelled_count(word, labelled) for word in settings.num_real}), labelled


def _check_inputs(settings: DownstreamSettings, capture: Capture, frame: tuple[int, int]) -> None:
    for name in settings.models:
        kind = model_class(name)
        size = settings.input_of(kind, frame)
        if kind.is_too_small(size):
            raise NeecoError(
                f"--models {name}: it would see images of {size[0]}x{size[1]} px, too small for it; give a larger "
                "--size, or leave it out"
            )
        if kind.predicts == "boxes" and len(capture.instruments) > 1:
            raise NeecoError(
                f"--models {name}: {capture.root}: labels do not tell the {len(capture.instruments)} "
                "instruments apart, so there is no box of each; use a model that predicts masks"
            )


def _jobs(
    settings: DownstreamSettings, conditions: Sequence[Condition], counts: Sequence[int]
) -> tuple[DownstreamJob, ...]:
    """The first fold of everything comes first: results halfway are of all conditions."""
    return tuple(
        DownstreamJob(settings, model, condition, real, fold)
        for fold in range(settings.folds)
        for model in settings.models
        for condition in conditions
        for real in counts
        if bool(real) == condition.real
    )


def _notes(settings: DownstreamSettings) -> list[str]:
    notes = []
    if settings.folds < 3:
        notes.append("intervals of fewer than three folds hardly cover other seeds; give --folds 5 before concluding")
    if settings.labels is not None:
        notes.append(f"labels of recorded training frames: {settings.labels}; tests are scored by the capture's truth")
    return notes


def run_downstream(plan: DownstreamPlan, progress: Callable[[JobEvent], None] | None = None) -> dict[str, Any]:
    """Train and test every model in every condition on every fold; writes downstream.json, and returns what it holds.

    Started again after an interruption it continues where it stopped; started again with more models, sets, conditions,
    labelled frames or folds, it adds them. Results of earlier commands stay, where models, sets and tests are the same.
    A failed job is reported in its place.
    """
    file, jobs = plan.settings.output / FILE, plan.jobs
    with own_folder(plan.settings.output):
        paths = {index: job.folder / JOB_FILE for index, job in enumerate(jobs)}
        finished = {index: read_json(path) for index, path in paths.items() if path.exists()}
        captures = {plan.settings.capture: plan.capture}
        earlier = _finished_earlier(plan)
        written, known = 0.0, list[Mapping[str, Any]]()

        def record(results: Sequence[Mapping[str, Any]]) -> None:
            nonlocal written
            known[:] = [*results, *earlier]
            if time.monotonic() > written + WRITE_EVERY_S:
                write_json(file, document(plan, known))
                written = time.monotonic()

        try:
            results = run_jobs(jobs, plan.settings.workers, record, finished, progress, captures, light=True)
        except KeyboardInterrupt:
            if known:
                write_json(file, document(plan, known))
            raise
        result = document(plan, [*results, *earlier]) | {"complete": True}
        write_json(file, result)
    return result


def _finished_earlier(plan: DownstreamPlan) -> list[Mapping[str, Any]]:
    """Return the results of other commands in the study's folder: jobs that differ from those of the plan only in
    condition, number of labelled frames and fold."""
    settings, planned = plan.settings, {job.folder for job in plan.jobs}
    found = []
    for file in sorted(settings.output.glob(f"jobs/*/{JOB_FILE}")):
        stored = read_json(file)
        try:
            condition = parse_condition(stored["condition"], [data.name for data in settings.sets])
            job = DownstreamJob(settings, stored["model"], condition, stored["real"], stored["fold"])
            job.check()
        except (NeecoError, KeyError):  # of other settings, sets or models
            continue
        if job.folder not in planned and job.model in settings.models and set(job.tests) <= stored["splits"].keys():
            found.append(stored)
    return sorted(found, key=lambda stored: stored["fold"])


def document(plan: DownstreamPlan, results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the contents of downstream.json for these results."""
    settings = plan.settings
    kinds = {name: model_class(name) for name in settings.models}
    predicts = {name: kind.predicts for name, kind in kinds.items()}
    threads = threads_per_worker(settings.workers) if settings.workers > 1 else None
    tests = [*settings.splits, *(test.name for test in settings.tests)]
    labelled = plan.labelled
    if not labelled and any(job["real"] for job in results):  # the plan's are sets alone
        labelled = len(recorded_samples(plan.capture, "train", settings.classes, settings.labels))
    made: dict[str, Any] = {
        "schema": SCHEMA,
        "version": __version__,
        "complete": False,
        "capture": str(settings.capture.absolute()),
        "command": settings.command(),
        "machine": machine(device_of(settings.device, drawing=False))
        | {"workers": settings.workers, "threads_per_worker": threads},
        "teaching": {
            "capture": str(settings.capture.absolute()),
            "sets": [data.described() for data in settings.sets],
            "classes": settings.classes,
            "splits": list(settings.splits),
            "labels": absolute(settings.labels),
            "transforms": settings.transforms,
            "pick": settings.frame_selection,
            "steps": settings.steps,
            "side": settings.size,
            "batch": settings.batch,
            "device": settings.device,
        },
        "classes": list(class_names(plan.capture, settings.classes)),
        "splits": tests,
        "tests": {test.name: str(test.path.absolute()) for test in settings.tests},
        "folds": max([settings.folds, *(job["fold"] + 1 for job in results)]),
        "labelled": labelled,
        "sets": [
            data.described() | {"images": plan.images[data.name], "made_by": _made_by(data)} for data in settings.sets
        ],
        "models": [
            {
                "name": name,
                "answers": kind.predicts,
                "steps": settings.steps_of(kind),
                "batch": settings.batch_of(kind),
                "input": list(settings.input_of(kind, plan.frame_size)),
                "weights": absolute(settings.weights.get(name)),
            }
            for name, kind in kinds.items()
        ],
        "jobs": list(results),
        "summary": summarise_folds(results, predicts, tests),
        "paired": comparisons(results, predicts, tests, [data.name for data in settings.sets]),
        "notes": [*plan.notes, *_result_notes(results)],
    }
    return made | {"answers": findings(made)}


def _made_by(data: ImageSet) -> dict[str, Any] | None:
    """Return how a set was synthesized, from its dataset.json; None where there is none."""
    info, keys = data.info(), ("settings", "scene", "scene_sha256", "version", "complete")
    return None if info is None else {key: info.get(key) for key in keys}


def _result_notes(results: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return notes on failures and on biased models."""
    notes = [f"failed: {line}" for line in failed_jobs({"jobs": results})]
    done = [job for job in results if "error" not in job]
    for model in dict.fromkeys(job["model"] for job in done):
        alone = [job for job in done if job["model"] == model and job["condition"] == REAL]
        most = max((job["real"] for job in alone), default=0)  # fewer frames miss what they do not show
        gaps = [
            scores["precision"] - scores["recall"]
            for job in alone
            if job["real"] == most
            for scores in job["splits"].values()
            if scores.get("precision") is not None and scores.get("recall") is not None
        ]
        if gaps and abs(sum(gaps) / len(gaps)) > 0.02:
            how = "over-segments" if sum(gaps) < 0 else "under-segments"
            notes.append(
                f"{model}: trained on {most} labelled frames alone it {how} (precision - recall "
                f"{sum(gaps) / len(gaps):+.3f}); that favours labels with the opposite error"
            )
    return notes
