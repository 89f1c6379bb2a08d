"""Jobs: one method trained on one seed under a budget, and scored. Each stands on its own and can be resumed."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch

from neeco.capture import Capture, read_capture
from neeco.capture.check import read_checked
from neeco.errors import NeecoError
from neeco.evaluation.evaluate import evaluate_run, held_out_splits
from neeco.evaluation.lpips import find_lpips
from neeco.experiments.machine import reset_peak_memory
from neeco.experiments.watching import ANEW, BEGUN_FILE, CLOCKS, HeldOut, Watcher
from neeco.experiments.work import JobProgress
from neeco.files import read_json, require_like, write_json
from neeco.raster.devices import device_of
from neeco.scene.methods import method_class
from neeco.training.config import TrainConfig
from neeco.training.run import open_run, read_config, stored_config
from neeco.training.train import ProgressRow, train

JOB_SCHEMA = "neeco-job/1"
JOB_FILE = "job.json"
UNLIMITED = 1_000_000_000  # iterations: minutes end the run long before
OWN_OPTION = {"transforms": "--transforms", "iterations": "the budget's option", "minutes": "the budget's option"}
SPLIT_SCORES = ("psnr", "ssim", "lpips", "psnr_instrument", "mask_iou", "frames")
BUDGET = {"minutes": (float, None), "iterations": (int, None), "clock": str}
IDENTITY = {"name": str, "method": str, "seed": int, "capture": str, "budget": BUDGET}
RESULT = IDENTITY | {
    "iterations": int,
    "seconds": float,
    "processor_seconds": float,
    "peak_memory_mb": (float, None),
    "num_gaussians": (int, None),
    "fps": float,
    "lpips_networks": [str],
    "splits": {str: dict.fromkeys(SPLIT_SCORES, (float, None))},
}


@dataclass(frozen=True)
class Budget:
    """How long every job may train: minutes on `clock`, or iterations; the other is None.

    "wall" is the time that passes; "processor" is what all threads of the process spend, which others' work on the same
    machine does not change. Drawing the curve is counted by neither.
    """

    minutes: float | None
    iterations: int | None
    clock: Literal["wall", "processor"] = "wall"

    def check(self) -> None:
        """Raises NeecoError unless exactly one of the two is given and can be spent."""
        if (self.minutes is None) == (self.iterations is None):
            raise NeecoError("budget: give minutes or iterations, one of them (e.g. --minutes 5)")
        if self.minutes is not None and not 0 < self.minutes < float("inf"):
            raise NeecoError(f"budget: {self.minutes} minutes is no time to train; give more than 0")
        if self.iterations is not None and self.iterations < 1:
            raise NeecoError(f"budget: {self.iterations} iterations is none at all; give at least 1")
        if self.clock not in CLOCKS:
            raise NeecoError(f"budget: clock {self.clock!r} is unknown; choose one of {', '.join(CLOCKS)}")

    def applied(self, config: TrainConfig, seed: int) -> TrainConfig:
        """`config` under this budget: with minutes no method is held back by its iterations."""
        return replace(config, minutes=self.minutes, iterations=self.iterations or UNLIMITED, seed=seed)

    def __str__(self) -> str:
        if self.iterations is not None:
            amount = f"{self.iterations} iterations"
        else:
            amount = f"{self.minutes:g} minutes"
        return amount + (", processor time" if self.clock == "processor" else "")


@dataclass(frozen=True)
class Job:
    """One run to train and score. `config`'s seed, minutes and iterations are replaced by the job's.

    `splits`: those to score (None: all but `train`). `folder` becomes a run folder with the job's files beside.
    """

    name: str
    seed: int
    capture: Path
    folder: Path
    config: TrainConfig
    budget: Budget
    splits: tuple[str, ...] | None = None
    lpips_weights: Path | None = None
    device: str = "auto"  # a word for `device_of`, opened where the job runs

    @property
    def title(self) -> str:
        """Name and seed, as a person reads it."""
        return f"{self.name}, seed {self.seed}"

    @property
    def train_config(self) -> TrainConfig:
        """The settings it is trained with."""
        return self.budget.applied(self.config, self.seed)

    def identity(self) -> dict[str, Any]:
        """What a folder must agree with to be this job's, besides the settings of the training."""
        return {
            "name": self.name,
            "method": self.config.method,
            "seed": self.seed,
            "capture": str(self.capture.absolute()),
            "budget": asdict(self.budget),
        }

    def check(self) -> None:
        """Raises NeecoError when the budget is none, or the folder holds another job's run."""
        self.budget.check()
        check_folder(self)

    def run(self, progress: JobProgress | None = None, capture: Capture | None = None) -> dict[str, Any]:
        """`run_job`."""
        return run_job(self, progress, capture)


def run_job(job: Job, progress: JobProgress | None = None, capture: Capture | None = None) -> dict[str, Any]:
    """Train, score, write `folder`/job.json last, and return what it holds; at once when it is there already.

    A begun training goes on from its checkpoint, and ends in the scene that it would have without the interruption
    (unless minutes end it). A finished one is only scored again when other splits or LPIPS networks are asked for.
    capture: the job's, where it is read and checked already. Raises NeecoError when `folder` is another job's, and what
    `train` and `evaluate_run` raise.
    """
    report = progress or (lambda stage, share, text: None)
    job.check()
    file = job.folder / JOB_FILE
    if capture is None:
        read = read_capture if file.exists() else read_checked
        capture = read(job.capture, job.config.transforms)
    splits = held_out_splits(capture, job.splits)
    networks, device = find_lpips(job.lpips_weights), device_of(job.device)
    if file.exists():
        stored = read_result(file)
        if list(stored["splits"]) == list(splits) and stored["lpips_networks"] == sorted(networks):
            return dict(stored)
        totals = {key: stored[key] for key in ("seconds", "processor_seconds", "peak_memory_mb")}
        totals["iteration"] = stored["iterations"]
    else:
        totals = _train(job, capture, splits, device, report)
    report("evaluating", 0.0, "")
    with open_run(job.folder, device) as run:
        evaluation = evaluate_run(
            run,
            capture,
            splits,
            networks=networks,
            progress=lambda what, done, total: report("evaluating", done / max(total, 1), what),
        )
    given = evaluation["given"]
    first = given[splits[0]]
    result = {"schema": JOB_SCHEMA} | job.identity()
    result |= {"iterations": totals["iteration"]}
    result |= {key: totals[key] for key in ("seconds", "processor_seconds", "peak_memory_mb")}
    result |= {"num_gaussians": first["num_gaussians"], "fps": first["fps"], "lpips_networks": sorted(networks)}
    result |= {"splits": {split: {key: given[split][key] for key in SPLIT_SCORES} for split in splits}}
    write_json(file, result)
    return result


def read_result(file: Path) -> dict[str, Any]:
    """What a finished job wrote. Raises NeecoError when the file is damaged."""
    result: dict[str, Any] = require_like(read_json(file), RESULT, str(file), ANEW)
    return result


def check_folder(job: Job) -> None:
    """Raises NeecoError when `job.folder` holds a run of other settings, another capture or another budget."""
    folder, differs = job.folder, "give another --output"
    if not (folder / "config.yaml").exists():
        return
    stored = read_config(folder)
    if stored["capture"] != str(job.capture.absolute()):
        raise NeecoError(f"{folder}: capture: this run was trained on {stored['capture']}; {differs}")
    identity = job.identity()
    for name in (JOB_FILE, BEGUN_FILE):
        file = folder / name
        values = require_like(read_json(file), IDENTITY, str(file), ANEW) if file.exists() else identity
        if values["budget"] != identity["budget"]:
            before = Budget(*(values["budget"][key] for key in BUDGET))
            try:
                before.check()
            except NeecoError as error:
                raise NeecoError(f"{file}: {error}; {ANEW}") from None
            raise NeecoError(f"{folder}: budget: this run has {before}, not {job.budget}; {differs}")
        for key in (key for key in identity if values[key] != identity[key]):
            raise NeecoError(f"{folder / name}: {key}: is {values[key]}, not {identity[key]}; {differs}")
    try:
        old, new = vars(stored_config(folder, stored)), vars(job.train_config)
    except NeecoError as error:  # of another version
        raise NeecoError(f"{str(error).removesuffix('; train again')}; {differs}") from None
    for field in (name for name in new if old[name] != new[name]):
        raise NeecoError(f"{folder}: {field}: this run has {old[field]}, not {new[field]}; {differs}")


def _train(
    job: Job, capture: Capture, splits: tuple[str, ...], device: torch.device, report: JobProgress
) -> dict[str, Any]:
    """Train or go on training; returns what the run took."""
    reset_peak_memory()
    held_out = HeldOut(capture, splits, field=not method_class(job.config.method).has_gaussians)
    watcher = Watcher(job.folder, held_out, job.budget.clock, job.identity())

    def tell(row: ProgressRow) -> None:
        count = f"  {row.num_gaussians} Gaussians" if row.num_gaussians else ""
        report("training", row.progress, row.note or f"iteration {row.iteration}  PSNR {row.psnr:.1f} dB{count}")

    report("training", 0.0, "")
    config, clock = job.train_config, CLOCKS[job.budget.clock]
    resume = (job.folder / "config.yaml").exists()
    try:
        train(
            job.capture,
            job.folder,
            config,
            capture=capture,
            device=device,
            resume=resume,
            progress=tell,
            watch=watcher.watch,
            clock=clock,
        )
    finally:
        if watcher.started:
            watcher.save()
    _complete(job, watcher, device)
    return watcher.totals


def _complete(job: Job, watcher: Watcher, device: torch.device) -> None:
    """Add the curve's last row where the run was stopped between its last step and its finish."""
    if not watcher.started:
        watcher.read_curve()
    if not watcher.rows or watcher.rows[-1]["progress"] < 1:
        with open_run(job.folder, device) as run:
            watcher.totals["iteration"] = run.scene.diagnostics.get("iterations", watcher.totals["iteration"])
            watcher.add_row(run.scene, 1.0)


def check_settings(assignments: Sequence[str], methods: Collection[str], seed_option: str) -> None:
    """Raises NeecoError for a NAME=VALUE of `--set` that has an option of its own, or that none of `methods` has."""
    for assignment in assignments:
        name = assignment.partition("=")[0]
        if option := (OWN_OPTION | {"seed": seed_option}).get(name):
            raise NeecoError(f"--set {name}: use {option}; all runs share it")
        if not any(_takes(method, name) for method in methods):
            raise NeecoError(f"--set {name}: no such field in the methods {', '.join(methods)}")


def settings_for(method: str, assignments: Sequence[str]) -> list[str]:
    """Those of `assignments`, one list for several methods, that `method` has: `deformation.FIELD` is a method's own,
    all others are everybody's."""
    return [assignment for assignment in assignments if _takes(method, assignment.partition("=")[0])]


def _takes(method: str, name: str) -> bool:
    group, _, field = name.partition(".")
    return group != "deformation" or field in {own.name for own in dataclasses.fields(method_class(method).Settings)}
