"""Run the ablations: one job per distinct variant, whatever tables it stands in, then the tables from the jobs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from neeco import __version__
from neeco.capture import Capture
from neeco.capture.check import read_checked
from neeco.errors import NeecoError
from neeco.evaluation.evaluate import held_out_splits
from neeco.experiments.ablation_results import table_of
from neeco.experiments.ablations import ABLATIONS, OURS, PAPER, Ablation, Variant
from neeco.experiments.derived import derive_capture
from neeco.experiments.families import KINEMATIC_RUNS, NEECO_RUNS, Family
from neeco.experiments.jobs import Budget, Job, check_settings, settings_for
from neeco.experiments.machine import machine
from neeco.experiments.masks import LabelScores, score_label_ways
from neeco.experiments.plans import AblationPlan
from neeco.experiments.running import check_workers, run_jobs
from neeco.experiments.work import JobNews
from neeco.files import own_folder, read_json, write_json
from neeco.raster.devices import device_of
from neeco.training.config import training_config
from neeco.training.run import open_run

SCHEMA = "neeco-ablation/1"
LABELS_FILE = "label_ways.json"


def run_ablations(plan: AblationPlan, progress: Callable[[JobNews], None] | None = None) -> dict[str, Any]:
    """Train and score every variant of the chosen tables, write DIR/ablation.json and return what it holds.

    Runs lie in DIR/runs/, derived captures in DIR/captures/. What is finished is not done again; the same command goes
    on after an interruption. A run that fails leaves its cells empty and its reason under "failures". Raises NeecoError
    for unknown tables and settings, a capture without instruments, or an output that holds other runs.
    """
    device = device_of(plan.device)
    check_workers(plan.workers, device)
    chosen = chosen_ablations(plan.tables)
    variants = distinct_variants(chosen)
    capture = _open_capture(plan, variants)
    splits = held_out_splits(capture)
    with own_folder(plan.output):
        jobs = [_job(plan, variant) for variant in variants]
        for job in jobs:
            job.check()
        for job, variant in zip(jobs, variants, strict=True):
            if variant.derived is not None:
                derive_capture(capture, plan.transforms, variant.derived, plan.seed, job.capture)
        results = run_jobs(jobs, plan.workers, progress, {plan.capture: capture})
    finished = {job.name: result for job, result in zip(jobs, results, strict=True) if "error" not in result}
    failures = [{"run": result["name"], "error": result["error"]} for result in results if "error" in result]
    folders = {job.name: job.folder for job in jobs if job.name in finished}
    families = [family for family in (NEECO_RUNS, KINEMATIC_RUNS) if any(v.family is family for v in variants)]
    labels, untold = _label_scores(chosen, folders, capture, splits, device)
    ablation = {
        "schema": SCHEMA,
        "version": __version__,
        "capture": str(plan.capture.absolute()),
        "seed": plan.seed,
        "iterations": dict(sorted((family.method, _steps(plan, family)) for family in families)),
        "machine": machine(device),
        "settings": list(plan.settings),
        "splits": list(splits),
        "tables": [table_of(table, folders, finished, labels, splits) for table in chosen],
        "runs": [finished[name] for name in finished],
        "failures": failures + untold,
        "notes": [note for family in families for note in family.shortcomings(_steps(plan, family))],
    }
    write_json(plan.output / "ablation.json", ablation)
    return ablation


def chosen_ablations(names: Sequence[str]) -> tuple[Ablation, ...]:
    """The tables behind `paper`, `ours` or their own names, each once. Raises NeecoError for an unknown name."""
    chosen: dict[str, Ablation] = {}
    groups = {"paper": PAPER, "ours": OURS}
    for name in names:
        if name not in groups and name not in ABLATIONS:
            raise NeecoError(f"--tables: {name!r} is unknown; choose of paper, ours, {', '.join(ABLATIONS)}")
        for ablation in groups.get(name, ()) or (ABLATIONS[name],):
            chosen[ablation.name] = ablation
    if not chosen:
        raise NeecoError("--tables: names none; leave it out for all of them")
    return tuple(chosen.values())


def distinct_variants(chosen: Sequence[Ablation]) -> list[Variant]:
    """Every run that the tables need, once."""
    variants = [entry.variant for table in chosen for item in table.comparisons for entry in item.entries]
    return list(dict.fromkeys(variants))


def _open_capture(plan: AblationPlan, variants: Sequence[Variant]) -> Capture:
    """The capture. Raises NeecoError for what no run could be made of."""
    for name, value in (("iterations", plan.iterations), ("kinematic-iterations", plan.kinematic_iterations)):
        if value is not None and value < 1:
            raise NeecoError(f"--{name}: {value} is no training; give at least 1")
    check_settings(plan.settings, dict.fromkeys(variant.family.method for variant in variants), "--seed")
    capture = read_checked(plan.capture, plan.transforms)
    if not capture.instruments:
        raise NeecoError(f"{plan.capture}: instruments: no states are recorded; every ablation needs them")
    return capture


def _steps(plan: AblationPlan, family: Family) -> int:
    """Iterations of a run of `family`."""
    given = {NEECO_RUNS: plan.iterations, KINEMATIC_RUNS: plan.kinematic_iterations}[family]
    return given or max(family.least_steps, plan.iterations)


def _job(plan: AblationPlan, variant: Variant) -> Job:
    """The job of one variant. Settings: its family's, then the user's, then what the variant is about."""
    family, steps = variant.family, _steps(plan, variant.family)
    values = {"iterations": steps, "seed": plan.seed, "transforms": plan.transforms}
    given = settings_for(family.method, plan.settings)
    common = family.settings(steps)
    config = family.started(training_config(family.method, values, [*common, *given, *variant.settings]))
    capture = plan.capture
    if variant.derived is not None:
        capture = plan.output / "captures" / variant.derived.name
        config = replace(config, transforms="transforms.json")
    folder = plan.output / "runs" / variant.name
    return Job(variant.name, plan.seed, capture, folder, config, Budget(None, steps), device=plan.device)


def _label_scores(
    chosen: Sequence[Ablation],
    folders: dict[str, Path],
    capture: Capture,
    splits: tuple[str, ...],
    device: torch.device,
) -> tuple[dict[str, LabelScores], list[dict[str, str]]]:
    """Scores by run of both ways to label it, for the runs whose table asks; and what could not be scored."""
    entries = [entry for table in chosen for item in table.comparisons for entry in item.entries]
    scores: dict[str, LabelScores] = {}
    failures = []
    for name in dict.fromkeys(entry.variant.name for entry in entries if entry.label_way):
        if name not in folders:
            continue
        file = folders[name] / LABELS_FILE
        stored = read_json(file) if file.exists() else None
        if stored is None or stored["splits"] != list(splits):
            try:
                with open_run(folders[name], device) as run:
                    scored = score_label_ways(run, capture, splits)
            except NeecoError as error:
                failures.append({"run": name, "error": f"label ways: {error}"})
                continue
            stored = {"splits": list(splits), "mask_iou": scored}
            write_json(file, stored)
        scores[name] = stored["mask_iou"]
    return scores, failures
