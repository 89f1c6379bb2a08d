"""Run the ablations: one job per distinct variant, whatever tables it stands in, then the tables from the jobs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from neeco import __version__
from neeco.capture.check import read_checked
from neeco.errors import NeecoError
from neeco.experiments.ablation_results import LabelScores, table_of
from neeco.experiments.ablations import (
    ABLATIONS,
    INITIAL_SHARE,
    LONGEST_REST,
    OURS,
    PAPER,
    PAPER_SETTINGS,
    PHASE_1_SHARE,
    REST_STEPS,
    Ablation,
    Variant,
)
from neeco.experiments.cluster import require_ray
from neeco.experiments.derived import derive_capture
from neeco.experiments.jobs import Budget, Job, JobNews, check_folder, held_out_splits
from neeco.experiments.running import run_jobs
from neeco.experiments.settings import check_settings, settings_for
from neeco.files import new_folder, read_json, write_json
from neeco.scene.deformations.nps import WARM_UP
from neeco.training.config import TrainConfig
from neeco.training.options import training_config
from neeco.training.schedule import CLOSEST_RESETS
from neeco.training.train import ROW_INTERVAL

SCHEMA = "neeco-ablation/1"
LABELS_FILE = "label_ways.json"
KINEMATIC_LEAST = 1_000  # its shaft starts to spin and its hinges to learn after 600

# Mask IoU of a run by label way and split: {"composited": {"test": 0.9}, ...}; None where it cannot be told
LabelScorer = Callable[[Path, Sequence[str]], dict[str, dict[str, float | None]]]


@dataclass(frozen=True)
class AblationPlan:
    """What to run. `iterations` are those of `neeco`, `kinematic_iterations` of `kinematic`, whose steps cost less."""

    capture: Path
    output: Path
    tables: tuple[str, ...] = ("paper", "ours")
    iterations: int = 1_000
    kinematic_iterations: int | None = None  # None: as many, but at least KINEMATIC_LEAST
    seed: int = 0
    transforms: str = "transforms.json"
    settings: tuple[str, ...] = ()

    def budget(self, method: str) -> Budget:
        """Iterations of a run of `method`."""
        if method == "kinematic":
            return Budget(None, self.kinematic_iterations or max(KINEMATIC_LEAST, self.iterations))
        return Budget(None, self.iterations)


def run_ablations(
    plan: AblationPlan,
    score_labels: LabelScorer,
    workers: int = 1,
    progress: Callable[[JobNews], None] | None = None,
) -> dict[str, Any]:
    """Train and score every variant of the chosen tables, write DIR/ablation.json and return what it holds.

    Runs lie in DIR/runs/, derived captures in DIR/captures/. What is finished is not done again; the same command goes
    on after an interruption. A run that fails leaves its cells empty and its reason under "failures". Raises NeecoError
    for unknown tables and settings, a capture without instruments, or an output that holds other runs.
    """
    if workers > 1:
        require_ray()
    chosen = chosen_ablations(plan.tables)
    variants = distinct_variants(chosen)
    _check_plan(plan, variants)
    with new_folder(plan.output):
        jobs = [_job(plan, variant) for variant in variants]
        for job in jobs:
            check_folder(job)
        for job, variant in zip(jobs, variants, strict=True):
            if variant.derived is not None:
                derive_capture(plan.capture, plan.transforms, variant.derived, plan.seed, job.capture)
        results = run_jobs(jobs, workers, progress)
    finished = {job.name: result for job, result in zip(jobs, results, strict=True) if "error" not in result}
    failures = [{"run": result["name"], "error": result["error"]} for result in results if "error" in result]
    splits = held_out_splits(_job(plan, Variant("capture", "kinematic")))
    folders = {job.name: job.folder for job in jobs if job.name in finished}
    labels, untold = _label_scores(chosen, folders, splits, score_labels)
    ablation = {
        "schema": SCHEMA,
        "version": __version__,
        "capture": str(plan.capture.absolute()),
        "seed": plan.seed,
        "iterations": {method: plan.budget(method).iterations for method in sorted({v.method for v in variants})},
        "settings": list(plan.settings),
        "splits": list(splits),
        "tables": [table_of(table, folders, finished, labels, splits) for table in chosen],
        "runs": [finished[name] for name in finished],
        "failures": failures + untold,
        "notes": notes(plan, {variant.method for variant in variants}),
    }
    write_json(plan.output / "ablation.json", ablation)
    return ablation


def notes(plan: AblationPlan, methods: set[str]) -> list[str]:
    """What runs of this length are too short to show, in words."""
    steps, kinematic = plan.budget("neeco").iterations or 0, plan.budget("kinematic").iterations or 0
    told = []
    if "neeco" in methods and PHASE_1_SHARE * steps < ROW_INTERVAL:
        told.append(
            f"phase-1 PSNR: not known, phase 1 of {steps} steps ends before the first row of metrics.jsonl "
            f"({ROW_INTERVAL} steps); give --iterations {math.ceil(ROW_INTERVAL / PHASE_1_SHARE)} or more"
        )
    if "neeco" in methods and TrainConfig().density_stop * steps <= CLOSEST_RESETS:
        told.append(
            f"opacity reset: none comes in {steps} steps (intervals do not scale below {CLOSEST_RESETS}, and density "
            "control ends half-way), so P_oi changes nothing here"
        )
    if "kinematic" in methods and kinematic < KINEMATIC_LEAST:
        told.append(
            f"kinematic: {kinematic} steps are few: hinges begin to learn and the shaft to spin after 600, labels to "
            f"sharpen after 1,000; give --kinematic-iterations {KINEMATIC_LEAST} or more"
        )
    return told


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


def _check_plan(plan: AblationPlan, variants: Sequence[Variant]) -> None:
    """Raises NeecoError for what no run could be made of."""
    for name, value in (("iterations", plan.iterations), ("kinematic-iterations", plan.kinematic_iterations)):
        if value is not None and value < 1:
            raise NeecoError(f"--{name}: {value} is no training; give at least 1")
    check_settings(plan.settings, dict.fromkeys(variant.method for variant in variants), "--seed")
    capture = read_checked(plan.capture, plan.transforms)
    if not capture.instruments:
        raise NeecoError(f"{plan.capture}: instruments: no states are recorded; every ablation needs them")


def _job(plan: AblationPlan, variant: Variant) -> Job:
    """The job of one variant. Settings: the paper's schedule, then the user's, then what the variant is about."""
    budget = plan.budget(variant.method)
    given = settings_for(variant.method, plan.settings)
    common = PAPER_SETTINGS if variant.method == "neeco" else ()
    values = {"iterations": budget.iterations, "seed": plan.seed, "transforms": plan.transforms}
    config = training_config(variant.method, values, [*common, *given, *variant.settings])
    if variant.method == "neeco":
        config = _started(config, budget.iterations or 1)
    capture = plan.capture
    if variant.derived is not None:
        capture = plan.output / "captures" / variant.derived.name
        config = replace(config, transforms="transforms.json")
    return Job(variant.name, plan.seed, capture, plan.output / "runs" / variant.name, config, budget)


def _started(config: TrainConfig, iterations: int) -> TrainConfig:
    """How all runs of `neeco` begin, unless the user set it.

    With INITIAL_SHARE of the tissue's budget: were it full of sparse points, density control could do nothing. The
    network rests for its usual share of the run or REST_STEPS, whichever is longer.
    """
    if config.initial_points is None:
        config = replace(config, initial_points=max(1, round(INITIAL_SHARE * config.tissue_budget)))
    if "warm_up" not in config.deformation:
        rest = max(WARM_UP, min(LONGEST_REST, REST_STEPS / iterations))
        config = replace(config, deformation=config.deformation | {"warm_up": round(rest, 4)})
    return config


def _label_scores(
    chosen: Sequence[Ablation], folders: dict[str, Path], splits: tuple[str, ...], score: LabelScorer
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
                stored = {"splits": list(splits), "mask_iou": score(folders[name], splits)}
            except NeecoError as error:
                failures.append({"run": name, "error": f"label ways: {error}"})
                continue
            write_json(file, stored)
        scores[name] = stored["mask_iou"]
    return scores, failures
