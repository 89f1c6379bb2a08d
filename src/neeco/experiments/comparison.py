"""`compare`: several methods on the same frames under the same budget, over several seeds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from neeco import __version__
from neeco.capture import Capture
from neeco.capture.check import read_checked
from neeco.capture.fingerprint import fingerprint
from neeco.errors import NeecoError
from neeco.evaluation.evaluate import EVALUATION_FILE, Progress, held_out_splits
from neeco.evaluation.lpips import WEIGHTS_VARIABLE, find_lpips
from neeco.experiments.comparison_tables import write_tables
from neeco.experiments.jobs import (
    BUDGET,
    JOB_FILE,
    Budget,
    Job,
    check_settings,
    read_result,
    settings_for,
)
from neeco.experiments.machine import machine
from neeco.experiments.masks import check_masks, score_folder, score_runs, splits_with_truth
from neeco.experiments.running import check_workers, run_jobs, threads_per_worker
from neeco.experiments.speed import measure_speed
from neeco.experiments.summary import distances_to_training, summarise
from neeco.experiments.watching import ANEW, CURVE_FILE, TOTALS, read_rows
from neeco.experiments.work import JobNews, check_output
from neeco.files import own_folder, read_json, require_like, write_json
from neeco.raster.devices import device_of
from neeco.scene.methods import unmet_need
from neeco.training.config import TrainConfig, variant_config
from neeco.training.run import load_run, require_same_capture

COMPARISON_SCHEMA = "neeco-comparison/1"
COMPARISON_FILE = "comparison.json"
FRAME_SCORES = {"frame": str} | dict.fromkeys(("psnr", "psnr_instrument", "mask_iou"), (float, None))


@dataclass(frozen=True)
class ComparisonSpec:
    """What to compare. `seeds`: how many, from 0. `splits` None: all but `train`. `masks`: folders of masks by name.
    `assignments`: NAME=VALUE, fields of the training config that are changed for every method."""

    capture: Path
    output: Path
    methods: tuple[str, ...]
    budget: Budget
    seeds: int = 1
    splits: tuple[str, ...] | None = None
    lpips_weights: Path | None = None
    workers: int = 1
    masks: Mapping[str, Path] = field(default_factory=dict)
    transforms: str = "transforms.json"
    assignments: tuple[str, ...] = ()
    device: str = "auto"  # a word for `device_of`


@dataclass(frozen=True)
class ComparisonPlan:
    """A checked specification, ready to work on."""

    spec: ComparisonSpec
    capture: Capture
    jobs: tuple[Job, ...]
    splits: tuple[str, ...]
    notes: tuple[str, ...]
    given_masks: tuple[dict[str, Any], ...]  # scores of the folders of masks


def plan_comparison(spec: ComparisonSpec) -> ComparisonPlan:
    """Check everything that can be known before the work. Raises NeecoError for whatever cannot be compared."""
    spec.budget.check()
    device = device_of(spec.device)
    if spec.seeds < 1:
        raise NeecoError(f"--seeds: {spec.seeds} is none at all; give at least 1")
    check_workers(spec.workers, device)
    configs = _configs(spec)
    capture = _open_capture(spec, configs)
    networks = find_lpips(spec.lpips_weights)
    _check_output(spec)
    jobs = _jobs(spec, configs)
    digest = fingerprint(capture)
    for job in jobs:
        job.check()
        require_same_capture(job.folder, capture.root, digest)
    splits = held_out_splits(capture, spec.splits)
    check_masks(spec.masks, capture, splits, spec.methods)
    notes = [] if networks else [f"lpips: no weights; give --lpips-weights or set {WEIGHTS_VARIABLE}"]
    scored: list[dict[str, Any]] = []
    for name, folder in spec.masks.items():
        rows, told = score_folder(name, None, folder, capture, splits_with_truth(capture, splits))
        scored += rows
        notes += told
    return ComparisonPlan(spec, capture, jobs, splits, tuple(notes), tuple(scored))


def compare(
    plan: ComparisonPlan, news: Callable[[JobNews], None] | None = None, progress: Progress | None = None
) -> dict[str, Any]:
    """Train and score every method on every seed, measure the speed of all, and write comparison.json and its tables.

    Given again after an interruption, it goes on where it stopped; given again with more methods or seeds, it adds
    them. A method that fails is told in its place. comparison.json is complete at every moment; `complete` says whether
    all is in it. news: told of the jobs; progress: of what follows them.
    """
    spec = plan.spec
    report = progress or (lambda what, done, total: None)
    with own_folder(spec.output):
        finished = _finished_before(plan)

        def write() -> None:  # what is known is on disk at every moment
            write_json(spec.output / COMPARISON_FILE, _document(plan, [finished[k] for k in sorted(finished)]))

        def keep(latest: JobNews) -> None:
            if latest.result is not None:
                finished[latest.index] = latest.result
                write()
            if news:
                news(latest)

        write()
        results = run_jobs(plan.jobs, spec.workers, keep, {spec.capture: plan.capture})
        result = _document(plan, results) | {"complete": True}
        _measure(plan, result, report)
        write_json(spec.output / COMPARISON_FILE, result)
        write_tables(spec.output, result)
    return result


def job_folder(output: Path, name: str, seed: int) -> Path:
    """The run folder of one job of a comparison."""
    return output / "runs" / f"{name}-seed{seed}"


def failures(comparison: Mapping[str, Any]) -> list[str]:
    """`name, seed k: why` of every job that failed."""
    return [f"{job['name']}, seed {job['seed']}: {job['error']}" for job in comparison["jobs"] if "error" in job]


def _finished_before(plan: ComparisonPlan) -> dict[int, dict[str, Any]]:
    """What earlier starts left of these jobs, by the job's place."""
    files = {index: job.folder / JOB_FILE for index, job in enumerate(plan.jobs)}
    found = {index: read_result(file) for index, file in files.items() if file.exists()}
    return {index: job for index, job in found.items() if list(job["splits"]) == list(plan.splits)}


def _configs(spec: ComparisonSpec) -> dict[str, TrainConfig]:
    """Every method's settings by name. Raises NeecoError."""
    if not spec.methods:
        raise NeecoError("--methods: none is given; name at least one")
    values = {"transforms": spec.transforms}
    methods = {name: variant_config(name, values).method for name in spec.methods}
    check_settings(spec.assignments, dict.fromkeys(methods.values()), "--seeds")
    return {name: variant_config(name, values, settings_for(methods[name], spec.assignments)) for name in spec.methods}


def _jobs(spec: ComparisonSpec, configs: Mapping[str, TrainConfig]) -> tuple[Job, ...]:
    return tuple(
        Job(
            name,
            seed,
            spec.capture,
            job_folder(spec.output, name, seed),
            config,
            spec.budget,
            spec.splits,
            spec.lpips_weights,
            spec.device,
        )
        for seed in range(spec.seeds)  # every method's first seed comes first: a look halfway sees them all
        for name, config in configs.items()
    )


def _open_capture(spec: ComparisonSpec, configs: Mapping[str, TrainConfig]) -> Capture:
    path = spec.capture
    capture = read_checked(path, spec.transforms)
    for name, config in configs.items():
        if need := unmet_need(config.method, capture):
            raise NeecoError(f"--methods: {name} needs {need}, which {path} has not; leave it out")
    return capture


def _check_output(spec: ComparisonSpec) -> None:
    """Raises NeecoError when `output` holds something else, or the comparison of another capture or budget."""
    noun, about = "comparison", "compares methods on"
    stored = check_output(spec.output, COMPARISON_FILE, COMPARISON_SCHEMA, spec.capture, noun, about)
    if stored is None:
        return
    require_like(stored, {"budget": BUDGET}, str(spec.output / COMPARISON_FILE), "give another --output")
    if stored["budget"] != asdict(spec.budget):
        before = Budget(*(stored["budget"][key] for key in BUDGET))
        told = f"budget: compares after {before}, not {spec.budget}"
        raise NeecoError(f"{spec.output / COMPARISON_FILE}: {told}; give another --output")


def _names(plan: ComparisonPlan) -> list[str]:
    return list(dict.fromkeys([*plan.spec.methods, *plan.spec.masks]))


def _document(plan: ComparisonPlan, results: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """comparison.json as far as the jobs alone tell it."""
    spec = plan.spec
    threads = threads_per_worker(spec.workers) if spec.workers > 1 else None
    methods: list[dict[str, Any]] = [
        {"name": name, "method": config, "source": "train", "folder": "runs"}
        for name, config in dict.fromkeys((job.name, job.config.method) for job in plan.jobs)
    ]
    methods += [
        {"name": name, "method": None, "source": "masks", "folder": str(path.absolute())}
        for name, path in spec.masks.items()
    ]
    return {
        "schema": COMPARISON_SCHEMA,
        "version": __version__,
        "complete": False,
        "capture": str(spec.capture.absolute()),
        "machine": machine(device_of(spec.device)) | {"workers": spec.workers, "threads_per_worker": threads},
        "budget": asdict(spec.budget),
        "transforms": spec.transforms,
        "settings": list(spec.assignments),
        "seeds": list(range(spec.seeds)),
        "splits": list(plan.splits),
        "methods": methods,
        "jobs": list(results),
        "summary": summarise(_names(plan), plan.splits, results, (), plan.given_masks),
        "curves": _curves(plan.spec, results),
        "distance": _distance(plan, results),
        "speed": {"rows": []},
        "masks": list(plan.given_masks),
        "notes": list(plan.notes)
        + [f"{job['name']}, seed {job['seed']}: failed: {job['error']}" for job in results if "error" in job],
    }


def _curves(spec: ComparisonSpec, results: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Held-out PSNR of every finished job at about ten moments; seconds on the budget's clock."""
    rows = []
    for job in (job for job in results if "error" not in job):
        for entry in read_rows(job_folder(spec.output, job["name"], job["seed"]) / CURVE_FILE):
            row = {"name": job["name"], "seed": job["seed"], "seconds": entry[TOTALS[spec.budget.clock]]}
            rows.append(row | {key: entry[key] for key in ("iteration", "split", "psnr")})
    return rows


def _distance(plan: ComparisonPlan, results: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Every held-out frame's scores beside its distance from the training states."""
    distances = distances_to_training(plan.capture)
    rows = []
    for job in (job for job in results if "error" not in job):
        folder = job_folder(plan.spec.output, job["name"], job["seed"])
        file = folder / EVALUATION_FILE
        like = {"per_frame": {"given": {split: [FRAME_SCORES] for split in plan.splits}}}
        frames = require_like(read_json(file), like, str(file), ANEW)["per_frame"]["given"]
        for split in (split for split in plan.splits if split != "train"):
            for entry in frames[split]:
                row = {"name": job["name"], "seed": job["seed"], "split": split, "frame": entry["frame"]}
                row["distance"] = distances.get(entry["frame"])
                rows.append(row | {key: entry[key] for key in ("psnr", "psnr_instrument", "mask_iou")})
    return rows


def _measure(plan: ComparisonPlan, result: dict[str, Any], report: Progress) -> None:
    """Add to comparison.json's `result` what is measured over all finished runs together: their masks, their speed."""
    folder = plan.spec.output
    done = [(job["name"], job["seed"]) for job in result["jobs"] if "error" not in job]
    runs = [(name, seed, job_folder(folder, name, seed)) for name, seed in done]
    if runs:
        told = splits_with_truth(plan.capture, plan.splits)
        device = device_of(plan.spec.device)
        scored = score_runs(runs, folder, plan.capture, told, device, partial(report, "scoring masks"))
        result["masks"] = [*plan.given_masks, *scored]
        opened = [(name, seed, load_run(path)) for name, seed, path in runs]
        result["speed"] = measure_speed(opened, plan.capture, device, partial(report, "measuring speed"))
    result["summary"] = summarise(_names(plan), plan.splits, result["jobs"], result["speed"]["rows"], result["masks"])
