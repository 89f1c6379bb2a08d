"""`sweep`: configurations x seeds on one capture, each a job; their scores in one tidy table."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neeco import __version__
from neeco.capture import Capture
from neeco.capture.checks import read_checked
from neeco.capture.writer import fingerprint
from neeco.errors import NeecoError
from neeco.evaluation.evaluate import held_out_splits
from neeco.evaluation.image_metrics import WEIGHTS_VARIABLE, find_lpips
from neeco.files import own_folder, require_same, write_json, write_text
from neeco.raster.devices import device_of
from neeco.scene.method_registry import method_class, unmet_need
from neeco.scene.training_session import UNLIMITED
from neeco.settings import plain
from neeco.studies.configurations import MEASURES, Study, SweepRequest
from neeco.studies.machine import machine
from neeco.studies.study import REMEDY, JobEvent, Result, check_output, check_workers, run_jobs
from neeco.studies.tables import csv_text
from neeco.studies.training_job import JOB_FILE, TrainingJob, read_result
from neeco.training.config import TrainConfig, training_config
from neeco.training.run import require_same_capture

SCHEMA = "neeco-sweep/1"
SWEEP_FILE = "sweep.json"
RESULTS_FILE = "results.csv"
COLUMNS = ("configuration", "method", "seed", "split", "frames", *MEASURES, "error")
SHARED = {"seed": "seeds", "iterations": "iterations", "minutes": "minutes", "transforms": "--transforms"}
Rows = Sequence[Mapping[str, Any]]  # of the tidy table: one for each configuration, seed and split, by COLUMNS


@dataclass(frozen=True, kw_only=True)
class SweepPlan:
    """A checked request, ready to work on."""

    request: SweepRequest
    study: Study
    capture: Capture
    splits: tuple[str, ...]
    jobs: tuple[TrainingJob, ...]
    machine: dict[str, Any]
    notes: tuple[str, ...]


def plan_sweep(request: SweepRequest, study: Study, source: Path | None = None) -> SweepPlan:
    """Check everything that can be known before the work. source: the study's file, for messages. Raises NeecoError for
    whatever cannot be trained or scored, and an output that holds something else."""
    device = device_of(request.device)
    check_workers(request.workers, device)
    place = f"{source}: " if source else ""
    try:
        study = study.prepared(request)
    except NeecoError as error:
        raise NeecoError(f"{place}{error}") from None
    configs = {name: config_of(request, study, name, place) for name in study.configurations}
    capture = read_checked(request.capture, request.transforms)
    for name, config in configs.items():
        if need := unmet_need(config.method, capture):
            raise NeecoError(f"{place}{name}: needs {need}, which {request.capture} has not; leave it out")
    splits = held_out_splits(capture, request.splits)
    notes = []
    if not find_lpips(request.lpips_weights):
        notes.append(f"lpips: no weights; give --lpips-weights or set {WEIGHTS_VARIABLE}")
    if study.seeds == 1:
        notes.append("no ± is given: one seed has no standard deviation; give --seeds 2 or more")
    jobs = tuple(
        TrainingJob(
            name=name,
            capture=request.capture,
            folder=request.run_folder(name, seed),
            config=dataclasses.replace(config, seed=seed),
            clock="wall" if study.cpu_minutes is None else "processor",
            splits=request.splits,
            lpips_weights=request.lpips_weights,
            device=request.device,
        )
        for seed in range(study.seeds)  # every configuration's first seed comes first: half of the runs show all
        for name, config in configs.items()
    )
    stored = check_output(request.output, SWEEP_FILE, SCHEMA, request.capture, "a sweep")
    if stored is not None:
        same = [("clock", stored.get("clock"), jobs[0].clock)]
        require_same(str(request.output / SWEEP_FILE), same, REMEDY)
    digest = fingerprint(capture)
    for job in jobs:
        job.check()
        require_same_capture(job.folder, capture.root, digest)
    facts = machine(device, request.workers)
    return SweepPlan(
        request=request, study=study, capture=capture, splits=splits, jobs=jobs, machine=facts, notes=tuple(notes)
    )


def run_sweep(plan: SweepPlan, progress: Callable[[JobEvent], None] | None = None) -> Rows:
    """Train and score every configuration on every seed; return the rows of the tidy table.

    Writes sweep.json and, after each job, results.csv. Given again after an interruption it goes on where it stopped;
    with more configurations or seeds it adds them. A failed job has its reason in its rows.
    """
    output = plan.request.output
    with own_folder(output):
        files = {index: job.folder / JOB_FILE for index, job in enumerate(plan.jobs)}
        finished = {index: read_result(path) for index, path in files.items() if path.exists()}
        finished = {index: result for index, result in finished.items() if list(result["splits"]) == list(plan.splits)}

        def record(results: Sequence[Result]) -> Rows:
            rows = [
                {**result, **result["splits"].get(split, {}), "configuration": result["name"], "split": split}
                for result in results
                for split in plan.splits
            ]
            write_text(output / RESULTS_FILE, csv_text(COLUMNS, rows))
            write_json(output / SWEEP_FILE, _document(plan) | {"complete": len(results) == len(plan.jobs)})
            return rows

        record([finished[index] for index in sorted(finished)])
        captures = {plan.request.capture: plan.capture}
        return record(run_jobs(plan.jobs, plan.request.workers, record, finished, progress, captures))


def failures(rows: Rows) -> list[str]:
    """Return `name, seed k: why` of every job that failed."""
    failed = [f"{row['configuration']}, seed {row['seed']}: {row['error']}" for row in rows if row.get("error")]
    return list(dict.fromkeys(failed))


def _document(plan: SweepPlan) -> dict[str, Any]:
    """The contents of sweep.json: how the results were made."""
    return {
        "schema": SCHEMA,
        "version": __version__,
        "capture": str(plan.request.capture.absolute()),
        "transforms": plan.request.transforms,
        "clock": plan.jobs[0].clock,
        "splits": list(plan.splits),
        "settings": list(plan.request.set),
        "machine": plan.machine,
        "study": plain(plan.study),
    }


def config_of(request: SweepRequest, study: Study, name: str, place: str) -> TrainConfig:
    """Return the settings of a configuration: those of the study, its own, then those of --set. place: of the study,
    for messages. Raises NeecoError naming the field of the study, or --set."""
    configuration, where = study.configurations[name], f"{place}configurations.{name}"
    key, length = study.length_of(name)
    values: dict[str, Any] = {"transforms": request.transforms, "iterations": length}
    if key != "iterations":
        values |= {"minutes": length, "iterations": UNLIMITED}
    settings: list[str] = []
    try:
        method = training_config(configuration.method, values).method
        settings += [*_of_method(study.settings, study, method), *configuration.settings]
        settings += _of_method(request.set, study, method)
        for field in (setting.partition("=")[0] for setting in settings):
            if field in SHARED:
                raise NeecoError(f"--set {field}: give {SHARED[field]}, which all runs share")
        return training_config(configuration.method, values, settings)
    except NeecoError as error:
        text = str(error).removeprefix("--set ")
        field = text.partition(":")[0]
        if field in (setting.partition("=")[0] for setting in request.set):
            raise
        if field in (setting.partition("=")[0] for setting in study.settings):
            raise NeecoError(f"{place}settings: {text}") from None
        raise NeecoError(f"{where}{'' if text == str(error) else '.settings'}: {text}") from None


def _of_method(settings: Sequence[str], study: Study, method: str) -> list[str]:
    """Select from `settings` of all configurations those that `method` has: `deformation.FIELD` is a method's own.
    Raises NeecoError for a field that no method of the study has."""

    def has(name: str, setting: str) -> bool:
        group, _, field = setting.partition("=")[0].partition(".")
        own = {item.name for item in dataclasses.fields(method_class(name).Settings)}
        return group != "deformation" or field in own

    names = {str(item.method).partition("+")[0] for item in study.configurations.values()}
    for setting in settings:
        if not any(has(name, setting) for name in names):
            raise NeecoError(f"--set {setting.partition('=')[0]}: no such field in the methods {', '.join(names)}")
    return [setting for setting in settings if has(method, setting)]
