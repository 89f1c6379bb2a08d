"""One method trained on one seed under a budget, and scored: a job of `compare` and `ablate`, which can be resumed."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor

from neeco.capture import Capture, read_capture
from neeco.capture.checks import read_checked
from neeco.capture.model import Frame, evenly_spaced
from neeco.capture.writer import fingerprint
from neeco.errors import NeecoError
from neeco.evaluation.evaluate import evaluate_run, held_out_splits
from neeco.evaluation.image_metrics import find_lpips, psnr
from neeco.files import finite, read_json, read_json_lines, require_like, require_same, write_json, write_text
from neeco.labels.drawing import draw
from neeco.raster.devices import device_of
from neeco.scene.method_registry import current_name, method_class
from neeco.scene.training_session import UNLIMITED
from neeco.studies.machine import peak_memory_mb, reset_peak_memory
from neeco.studies.study import REMEDY, JobProgress, Result
from neeco.training.config import TrainConfig
from neeco.training.run import open_run, read_config, require_same_capture, stored_config
from neeco.training.train import ProgressRow, train

if TYPE_CHECKING:
    from neeco.scene import DrawableScene
    from neeco.scene.training_session import Session

JOB_SCHEMA = "neeco-job/1"
JOB_FILE = "job.json"  # the result of a finished job
BEGUN_FILE = "begun.json"  # what the training took so far
CURVE_FILE = "curve.jsonl"  # held-out PSNR over the training
CURVE_POINTS = (0.03, *(step / 10 for step in range(1, 11)))  # shares of the run at which held-out frames are rendered
CURVE_FRAMES = 4  # of each split, evenly spaced: the whole split is scored at the end
FIELD_CURVE_POINTS = (0.1, 0.4, 1.0)  # a field takes seconds for an image
FIELD_CURVE_FRAMES = 2
CLOCKS: dict[str, Callable[[], float]] = {"wall": time.monotonic, "processor": time.process_time}
SECONDS_ON = {"wall": "seconds", "processor": "processor_seconds"}  # fields of files, by clock
ANEW = f"{REMEDY}, or remove that run's folder"
OWN_OPTION = {"transforms": "--transforms", "iterations": "the budget's option", "minutes": "the budget's option"}
SPLIT_SCORES = ("psnr", "ssim", "lpips", "psnr_instrument", "mask_iou", "frames")
# how files must look, for `require_like`
BUDGET = {"minutes": (float, None), "iterations": (int, None), "clock": str}
IDENTITY = {"name": str, "method": str, "seed": int, "capture": str, "budget": BUDGET}
TOTALS = {"seconds": float, "processor_seconds": float, "peak_memory_mb": (float, None)}
RESULT = IDENTITY | TOTALS | {"iterations": int, "num_gaussians": (int, None), "fps": float, "lpips_networks": [str]}
RESULT |= {"splits": {str: dict.fromkeys(SPLIT_SCORES, (float, None))}}
CURVE_ROW = {"iteration": int, "seconds": float, "processor_seconds": float, "progress": float, "split": str}


@dataclass(frozen=True)
class Budget:
    """The training budget of every job: minutes on `clock`, or iterations; the other is None.

    "wall" is the time that passes; "processor" is CPU time of all threads of the process, which others' work on the
    same machine does not change. Rendering the curve is counted by neither.
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
        """Return `config` under this budget: with minutes no method is limited by its iterations."""
        return replace(config, minutes=self.minutes, iterations=self.iterations or UNLIMITED, seed=seed)

    def __str__(self) -> str:
        amount = f"{self.minutes:g} minutes" if self.iterations is None else f"{self.iterations} iterations"
        return amount + (", CPU time" if self.clock == "processor" else "")


@dataclass(frozen=True, kw_only=True)
class TrainingJob:
    """One run to train and score. `config`'s seed, minutes and iterations are replaced by the job's.

    `splits`: those to score (None: all but `train`). `folder` becomes a run folder with the job's files in it.
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
        """Name and seed."""
        return f"{self.name}, seed {self.seed}"

    @property
    def train_config(self) -> TrainConfig:
        """The settings it is trained with."""
        return self.budget.applied(self.config, self.seed)

    def identity(self) -> dict[str, Any]:
        """Return what a folder must agree with to be this job's, in addition to the settings of the training."""
        return {
            "name": self.name,
            "method": self.config.method,
            "seed": self.seed,
            "capture": str(self.capture.absolute()),
            "budget": asdict(self.budget),
        }

    def check(self) -> None:
        """Raises NeecoError when the budget is none, or the folder holds a run of other settings, another capture or
        another budget."""
        self.budget.check()
        if not (self.folder / "config.yaml").exists():
            return
        folder = self.folder
        stored = read_config(folder)
        require_same(str(folder), [("capture", stored["capture"], str(self.capture.absolute()))], REMEDY)
        identity = self.identity()
        for file in (folder / name for name in (JOB_FILE, BEGUN_FILE) if (folder / name).exists()):
            values = require_like(read_json(file), IDENTITY, str(file), ANEW)
            values = values | {"method": current_name(values["method"])}
            if values["budget"] != identity["budget"]:
                before = Budget(*(values["budget"][key] for key in BUDGET))
                try:
                    before.check()
                except NeecoError as error:
                    raise NeecoError(f"{file}: {error}; {ANEW}") from None
                raise NeecoError(f"{folder}: budget: begun with {before}, now {self.budget}; {REMEDY}")
            require_same(str(file), ((key, values[key], identity[key]) for key in identity), REMEDY)
        try:
            begun = stored_config(folder, stored)
        except NeecoError as error:  # of another version
            raise NeecoError(f"{str(error).removesuffix('; train again')}; {REMEDY}") from None
        wanted = self.train_config
        if begun.method == wanted.method:
            kind = method_class(wanted.method)
            wanted = replace(wanted, deformation=kind.resolved(wanted.deformation, begun.deformation))
        old, new = vars(begun), vars(wanted)
        require_same(str(folder), ((name, old[name], new[name]) for name in new), REMEDY)

    def run(self, progress: JobProgress | None = None, capture: Capture | None = None) -> Result:
        """Train, score, write `folder`/job.json last, and return what it holds; at once when it is there already.

        A begun training goes on from its checkpoint, and ends in the scene that it would have without the interruption
        (unless minutes end it). A finished one is only scored again when other splits or LPIPS networks are requested.
        capture: the job's, where it is read and checked already. Raises NeecoError when `folder` is another job's, and
        what `train` and `evaluate_run` raise.
        """
        report = progress or (lambda stage, share, text: None)
        self.check()
        file = self.folder / JOB_FILE
        if capture is None:
            read = read_capture if file.exists() else read_checked
            capture = read(self.capture, self.config.transforms)
        splits = held_out_splits(capture, self.splits)
        networks, device = find_lpips(self.lpips_weights), device_of(self.device)
        if file.exists():
            require_same_capture(self.folder, capture.root, fingerprint(capture))
            stored = read_result(file)
            if list(stored["splits"]) == list(splits) and stored["lpips_networks"] == sorted(networks):
                return stored
            totals = stored | {"iteration": stored["iterations"]}
        else:
            totals = _train(self, capture, splits, device, report)
        report("evaluating", 0.0, "")
        with open_run(self.folder, device) as run:
            evaluation = evaluate_run(
                run,
                capture,
                splits,
                networks=networks,
                progress=lambda what, done, total: report("evaluating", done / max(total, 1), what),
            )
        given = evaluation["given"]
        result = {"schema": JOB_SCHEMA} | self.identity() | {"iterations": totals["iteration"]}
        result |= {key: totals[key] for key in TOTALS}
        result |= {key: given[splits[0]][key] for key in ("num_gaussians", "fps")}
        result |= {"lpips_networks": sorted(networks)}
        result |= {"splits": {split: {key: given[split][key] for key in SPLIT_SCORES} for split in splits}}
        write_json(file, result)
        return result


def read_result(file: Path) -> Result:
    """Return what a finished job wrote. Raises NeecoError when the file is damaged."""
    return dict(require_like(read_json(file), RESULT, str(file), ANEW))


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a run's curve.jsonl or metrics.jsonl; none where it ended before it wrote the first. Raises
    NeecoError for a file that is damaged."""
    if not path.exists():
        return []
    like = CURVE_ROW | {"psnr": (float, None)} if path.name == CURVE_FILE else {"iteration": int}
    return read_json_lines(path, like, "one JSON object per line", ANEW)


def check_settings(assignments: Sequence[str], methods: Collection[str], seed_option: str) -> None:
    """Raises NeecoError for a NAME=VALUE of `--set` that has an option of its own, or that none of `methods` has."""
    for assignment in assignments:
        name = assignment.partition("=")[0]
        if option := (OWN_OPTION | {"seed": seed_option}).get(name):
            raise NeecoError(f"--set {name}: use {option}; all runs share it")
        if not any(settings_for(method, [assignment]) for method in methods):
            raise NeecoError(f"--set {name}: no such field in the methods {', '.join(methods)}")


def settings_for(method: str, assignments: Sequence[str]) -> list[str]:
    """Select from `assignments`, one list for several methods, those that `method` has: `deformation.FIELD` is a
    method's own, all others are everybody's."""
    kind = method_class(method).Settings
    own = {field.name for field in dataclasses.fields(kind)}
    groups = [assignment.partition("=")[0].partition(".") for assignment in assignments]
    taken = [group != "deformation" or name in own for group, _, name in groups]
    return list(itertools.compress(assignments, taken))


def _train(
    job: TrainingJob, capture: Capture, splits: tuple[str, ...], device: torch.device, report: JobProgress
) -> dict[str, Any]:
    """Train or go on training; returns what the run took."""
    reset_peak_memory()
    held_out = HeldOutFrames(capture, splits, field=not method_class(job.config.method).has_gaussians)
    recorder = TrainingRecorder(job.folder, held_out, job.budget.clock, job.identity())

    def report_row(row: ProgressRow) -> None:
        count = f"  {row.num_gaussians} Gaussians" if row.num_gaussians else ""
        report("training", row.progress, row.note or f"iteration {row.iteration}  PSNR {row.psnr:.1f} dB{count}")

    report("training", 0.0, "")
    try:
        train(
            job.capture,
            job.folder,
            job.train_config,
            capture=capture,
            device=device,
            resume=None,
            progress=report_row,
            watch=recorder.after_step,
            clock=CLOCKS[job.budget.clock],
        )
    finally:
        if recorder.started:
            recorder.save()
    if not recorder.started:
        recorder.rows = read_rows(job.folder / CURVE_FILE)
    if not recorder.rows or recorder.rows[-1]["progress"] < 1:  # stopped between its last step and its finish
        with open_run(job.folder, device) as run:
            totals = recorder.totals
            totals["iteration"] = run.scene.diagnostics.get("iterations", totals["iteration"])
            recorder.add_row(run.scene, 1.0)
    return recorder.totals


class HeldOutFrames:
    """Some held-out frames of every split with their images, read once; fewer to score a `field` by."""

    def __init__(self, capture: Capture, splits: tuple[str, ...], *, field: bool = False) -> None:
        self.shares = FIELD_CURVE_POINTS if field else CURVE_POINTS  # of the run, at which they are scored
        count = FIELD_CURVE_FRAMES if field else CURVE_FRAMES
        self.frames: dict[str, list[tuple[Frame, Tensor, Tensor | None]]] = {}
        for split in splits:
            frames = capture.split(split)
            chosen = [frames[index] for index in evenly_spaced(len(frames), count)]
            self.frames[split] = [(frame, frame.load_image(), frame.load_mask()) for frame in chosen]

    @torch.no_grad()
    def score(self, scene: DrawableScene) -> dict[str, float | None]:
        """Mean PSNR of each split, dB; None when it is no number. Random states are left as they were."""
        scores: dict[str, float | None] = {}
        with torch.random.fork_rng(devices=[]):
            for split, rows in self.frames.items():
                values = [psnr(draw(scene, f.state, f.camera).image, image, mask) for f, image, mask in rows]
                mean = sum(values) / len(values)
                scores[split] = round(mean, 4) if math.isfinite(mean) else None
        return scores


class TrainingRecorder:
    """Records the cost of a training over all its interruptions (`totals`) and its held-out PSNR (`rows`).

    `clock` is the one that the budget is counted on, by which the session counts its seconds. Seconds on the other
    clock are those of the session times the ratio of the clocks.
    """

    def __init__(self, folder: Path, held_out: HeldOutFrames, clock: str, identity: dict[str, Any]) -> None:
        self.folder, self.held_out, self.identity = folder, held_out, identity
        self.main, self.other = clock, next(name for name in CLOCKS if name != clock)
        self.totals: dict[str, Any] = {"iteration": 0, "seconds": 0.0, "processor_seconds": 0.0, "peak_memory_mb": None}
        self.rows: list[dict[str, Any]] = []
        self.due: list[float] = []
        self.started = False
        if (file := folder / BEGUN_FILE).exists():
            stored = require_like(read_json(file), {"iteration": int} | TOTALS, str(file), ANEW)
            self.totals = {key: stored[key] for key in self.totals}
        self.earlier_peak = self.totals["peak_memory_mb"]
        self.times = _read_clocks()

    def after_step(self, session: Session) -> None:
        """Count the step's time; where a point of the curve is due also render the held-out frames, uncounted."""
        self._count(session.seconds)
        self.totals["iteration"] = session.iteration
        if not self.started:
            self._resume_curve(session.iteration)
        if self.due and session.progress >= self.due[0]:
            self.due = [share for share in self.due if share > session.progress]
            self.add_row(session.scene, session.progress)
        self.times = _read_clocks()

    def add_row(self, scene: DrawableScene, progress: float) -> None:
        """Score the held-out frames, and write curve and totals."""
        for split, value in self.held_out.score(scene).items():
            row = {key: self.totals[key] for key in ("iteration", "seconds", "processor_seconds")}
            self.rows.append(row | {"progress": round(progress, 4), "split": split, "psnr": value})
        lines = [json.dumps(row, allow_nan=False) + "\n" for row in finite(self.rows)]
        write_text(self.folder / CURVE_FILE, "".join(lines))
        self.save()

    def save(self) -> None:
        """Write the totals, so that the next start of this job counts on from them."""
        peaks = [peak for peak in (self.earlier_peak, peak_memory_mb()) if peak is not None]
        self.totals["peak_memory_mb"] = max(peaks) if peaks else None
        write_json(self.folder / BEGUN_FILE, self.identity | self.totals)

    def _resume_curve(self, iteration: int) -> None:
        """Keep the rows before `iteration`: those after it belong to steps that are done again."""
        self.started = True
        rows = read_rows(self.folder / CURVE_FILE)
        self.rows = [row for row in rows if row["iteration"] < iteration]
        reached = max((row["progress"] for row in self.rows), default=0.0)
        self.due = [share for share in self.held_out.shares if share > reached]

    def _count(self, session_seconds: float) -> None:
        now = _read_clocks()
        passed = {name: now[name] - self.times[name] for name in CLOCKS}
        counted = session_seconds - self.totals[SECONDS_ON[self.main]]
        ratio = passed[self.other] / passed[self.main] if passed[self.main] > 0 else 0.0
        self.totals[SECONDS_ON[self.main]] = round(session_seconds, 3)
        self.totals[SECONDS_ON[self.other]] = round(max(0.0, self.totals[SECONDS_ON[self.other]] + counted * ratio), 6)


def _read_clocks() -> dict[str, float]:
    return {name: clock() for name, clock in CLOCKS.items()}
