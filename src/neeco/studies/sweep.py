"""`sweep`: configurations x seeds on one capture, each trained and scored by a resumable job; a tidy table of scores,
and summary tables."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from neeco import __version__
from neeco.base.errors import NeecoError, counted
from neeco.base.files import (
    finite,
    own_folder,
    read_json,
    read_json_lines,
    require_like,
    require_same,
    write_json,
    write_text,
)
from neeco.base.settings import name_and_value, plain
from neeco.capture import Capture, read_capture
from neeco.capture.checks import read_checked
from neeco.capture.model import Frame, evenly_spaced
from neeco.capture.writer import fingerprint
from neeco.evaluation.evaluate import evaluate_run, held_out_splits
from neeco.evaluation.image_metrics import WEIGHTS_VARIABLE, find_lpips, psnr
from neeco.labels.drawing import draw
from neeco.raster.devices import device_of
from neeco.scene import DrawableScene
from neeco.scene.method_registry import method_class, unmet_need
from neeco.scene.training_session import UNLIMITED, Session
from neeco.studies.configurations import (
    COSTS,
    MEASURES,
    UNKNOWN,
    Cell,
    Column,
    ResultTable,
    Row,
    Study,
    SweepRequest,
    Table,
    csv_text,
    summary_table,
)
from neeco.studies.study import (
    REMEDY,
    Job,
    JobEvent,
    JobProgress,
    Result,
    check_output,
    check_workers,
    machine,
    run_jobs,
    spread,
)
from neeco.training.config import TrainConfig, training_config
from neeco.training.run import open_run, read_config, require_same_capture, stored_config
from neeco.training.train import ProgressRow, train

SCHEMA = "neeco-sweep/1"
SWEEP_FILE = "sweep.json"
RESULTS_FILE = "results.csv"
COLUMNS = ("configuration", "method", "seed", "split", "frames", *MEASURES, "error")
SHARED = {"seed": "seeds", "iterations": "iterations", "minutes": "minutes", "transforms": "--transforms"}
PRIMARY = "test"  # split that is compared with published numbers, if it exists
Numbers = Mapping[str, Mapping[str, Any]]  # `study.spread` by configuration and measure, of one split
Rows = Sequence[Mapping[str, Any]]  # rows of the tidy table: one per configuration, seed and split, by COLUMNS
JOB_SCHEMA = "neeco-job/2"
JOB_FILE = "job.json"  # the result of a finished job
CURVE_FILE = "curve.jsonl"  # held-out PSNR over the training
CHECKPOINTS = {"psnr_at_20": 0.2, "psnr_at_40": 0.4, "psnr_at_60": 0.6}  # shares of a run: the paper's 4k, 8k, 12k
CLOCKS: dict[str, Callable[[], float]] = {"wall": time.monotonic, "processor": time.process_time}
ANEW = f"{REMEDY}, or remove that run's folder"
SPLIT_SCORES = ("psnr", "ssim", "lpips", "psnr_instrument", "mask_iou", "mask_dice", "frames")
# expected structure of files, for `require_like`
RESULT = {"name": str, "method": str, "seed": int, "iterations": int, "seconds": (float, None), "fps": float}
RESULT |= {"num_gaussians": (int, None), "phase_1_psnr": (float, None), "lpips_networks": [str]}
RESULT |= {"splits": {str: dict.fromkeys((*SPLIT_SCORES, *CHECKPOINTS), (float, None))}}
CURVE_ROW = {"iteration": int, "seconds": float, "progress": float, "split": str, "psnr": (float, None)}


@dataclass(frozen=True, kw_only=True)
class TrainingJob(Job):
    """One run to train and score. config: with seed and length, in iterations or in minutes of `clock`: elapsed time
    ("wall") or CPU time of all threads of the process ("processor").

    splits: to score (None: all but `train`). `folder` becomes a run folder with the job's files.
    """

    name: str
    config: TrainConfig
    clock: Literal["wall", "processor"] = "wall"
    splits: tuple[str, ...] | None = None
    lpips_weights: Path | None = None

    @property
    def title(self) -> str:
        """Name and seed."""
        return f"{self.name}, seed {self.config.seed}"

    def identity(self) -> dict[str, Any]:
        """Return the description that distinguishes it from other jobs."""
        return {"name": self.name, "method": self.config.method, "seed": self.config.seed}

    def check(self) -> None:
        """Raise NeecoError if the folder has a run with other settings, capture or length."""
        if not (self.folder / "config.yaml").exists():
            return
        stored = read_config(self.folder)
        require_same(str(self.folder), [("capture", stored["capture"], str(self.capture.absolute()))], REMEDY)
        try:
            begun, requested = stored_config(self.folder, stored), self.config
        except NeecoError as error:  # of another version
            raise NeecoError(f"{str(error).removesuffix('; train again')}; {REMEDY}") from None
        if begun.method == requested.method:
            resolved = method_class(requested.method).resolved(requested.deformation, begun.deformation)
            requested = replace(requested, deformation=resolved)
        old, new = vars(begun), vars(requested)
        # minutes first, because iterations are unlimited with them
        names = sorted(new, key=lambda name: name != "minutes")
        require_same(str(self.folder), ((name, old[name], new[name]) for name in names), REMEDY)

    def run(self, progress: JobProgress | None = None, capture: Capture | None = None) -> Result:
        """Train, score, write `folder`/job.json last, and return its content; only read it if it exists already.

        An interrupted training continues from its checkpoint. A finished one is only scored again for other splits or
        LPIPS networks. capture: the job's capture, if already read and checked. Raises NeecoError.
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
        else:
            self._train(capture, splits, device, report)
        report("evaluating", 0.0, "")
        with open_run(self.folder, device) as run:
            evaluation = evaluate_run(
                run,
                capture,
                splits,
                networks=networks,
                progress=lambda what, done, total: report("evaluating", done / max(total, 1), what),
            )
            iterations = run.scene.diagnostics.get("iterations", 0)
        measured, curve = evaluation["given"], read_rows(self.folder / CURVE_FILE, CURVE_ROW)
        result = {"schema": JOB_SCHEMA} | self.identity() | {"iterations": iterations}
        result |= {"seconds": curve[-1]["seconds"] if curve else None}
        result |= {key: measured[splits[0]][key] for key in ("num_gaussians", "fps")}
        result |= {"lpips_networks": sorted(networks), "phase_1_psnr": phase_1_psnr(self.folder), "splits": {}}
        for split in splits:
            scores = {key: measured[split][key] for key in SPLIT_SCORES}
            result["splits"][split] = scores | {key: psnr_at(curve, split, at) for key, at in CHECKPOINTS.items()}
        write_json(file, result)
        return result

    def _train(self, capture: Capture, splits: Sequence[str], device: torch.device, report: JobProgress) -> None:
        """Train or continue training, and record the curve."""
        field = not method_class(self.config.method).has_gaussians
        curve = Curve(self.folder / CURVE_FILE, capture, splits, field=field)

        def report_row(row: ProgressRow) -> None:
            count = f"  {row.num_gaussians} Gaussians" if row.num_gaussians else ""
            report("training", row.progress, row.note or f"iteration {row.iteration}  PSNR {row.psnr:.1f} dB{count}")

        report("training", 0.0, "")
        train(
            self.capture,
            self.folder,
            self.config,
            capture=capture,
            device=device,
            resume=None,
            progress=report_row,
            watch=curve.after_step,
            clock=CLOCKS[self.clock],
        )


def read_result(file: Path) -> Result:
    """Return the result of a finished job. Raises NeecoError if the file is damaged."""
    return dict(require_like(read_json(file), RESULT, str(file), ANEW))


def read_rows(file: Path, like: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of a run's curve.jsonl or metrics.jsonl; [] if it does not exist. Raises NeecoError for a damaged
    file."""
    return read_json_lines(file, like, "one JSON object per line", ANEW) if file.exists() else []


def phase_1_psnr(folder: Path) -> float | None:
    """Return the mean training PSNR (dB) over the rows of metrics.jsonl in the last quarter of phase 1, at least its
    last row; None if phase 1, or the run, was shorter than a row (50 steps)."""
    rows = read_rows(folder / "metrics.jsonl", {"iteration": int, "phase": int, "psnr": float})
    rows = [row for row in rows if row["phase"] == 1]
    late = [row["psnr"] for row in rows if row["iteration"] > Curve.late * rows[-1]["iteration"]]
    return round(sum(late) / len(late), 4) if late else None


def psnr_at(curve: Sequence[Mapping[str, Any]], split: str, share: float) -> float | None:
    """Return the held-out PSNR (dB) at `share` of the run; None if the curve has no row within 5 % of it."""
    rows = [row for row in curve if row["split"] == split and abs(row["progress"] - share) < 0.05]
    return min(rows, key=lambda row: abs(row["progress"] - share))["psnr"] if rows else None


class Curve:
    """Held-out PSNR over a training, in curve.jsonl, for a few frames of every split, fewer for a `field`. Seconds are
    the session's, summed over starts, without the rendering of these frames."""

    shares_of_run: ClassVar[tuple[float, ...]] = tuple(step / 10 for step in range(1, 11))  # with a point each
    n_frames: ClassVar[int] = 4  # evenly spaced frames per split; the complete split is scored at the end
    field_shares, n_field_frames = (0.2, 0.6, 1.0), 2  # the same of a field, which renders an image in seconds
    late: ClassVar[float] = 0.75  # share of phase 1 from which its training PSNR is averaged

    def __init__(self, file: Path, capture: Capture, splits: Sequence[str], *, field: bool = False) -> None:
        self.file = file
        self.shares = self.field_shares if field else self.shares_of_run
        count = self.n_field_frames if field else self.n_frames
        self.rows: list[dict[str, Any]] | None = None  # None before the first step of this start
        self.frames: dict[str, list[tuple[Frame, Tensor, Tensor | None]]] = {}
        for split in splits:
            chosen = [capture.split(split)[at] for at in evenly_spaced(len(capture.split(split)), count)]
            self.frames[split] = [(frame, frame.load_image(), frame.load_mask()) for frame in chosen]

    def after_step(self, session: Session) -> None:
        """Score the frames if a point of the curve is due. Rows of an earlier start after its checkpoint are dropped,
        because these steps are repeated."""
        if self.rows is None:
            self.rows = [row for row in read_rows(self.file, CURVE_ROW) if row["iteration"] < session.iteration]
            reached = max((row["progress"] for row in self.rows), default=0.0)
            self.shares = tuple(share for share in self.shares if share > reached)
        if not self.shares or session.progress < self.shares[0]:
            return
        self.shares = tuple(share for share in self.shares if share > session.progress)
        seconds, progress = round(session.seconds, 3), round(session.progress, 4)
        row = {"iteration": session.iteration, "seconds": seconds, "progress": progress}
        self.rows += [row | {"split": split, "psnr": self.score(session.scene, split)} for split in self.frames]
        write_text(self.file, "".join(json.dumps(row, allow_nan=False) + "\n" for row in finite(self.rows)))

    @torch.no_grad()
    def score(self, scene: DrawableScene, split: str) -> float | None:
        """Return the mean PSNR of a split, dB; None if it is not finite. Random states are preserved."""
        with torch.random.fork_rng(devices=[]):
            frames = self.frames[split]
            values = [psnr(draw(scene, frame.state, frame.camera).image, image, mask) for frame, image, mask in frames]
        mean = sum(values) / len(values)
        return round(mean, 4) if math.isfinite(mean) else None


@dataclass(frozen=True, kw_only=True)
class SweepPlan:
    """A checked request, ready to run."""

    request: SweepRequest
    study: Study
    capture: Capture
    splits: tuple[str, ...]
    jobs: tuple[TrainingJob, ...]
    machine: dict[str, Any]
    notes: tuple[str, ...]


def plan_sweep(request: SweepRequest, study: Study, source: Path | None = None) -> SweepPlan:
    """Check a study before running it. source: the study's file, for messages. Raises NeecoError for configurations
    that cannot be trained or scored, and an output with other content."""
    device = device_of(request.device)
    check_workers(request.workers, device)
    place = f"{source}: " if source else ""
    request.check()
    try:
        study = study.prepared(request)
    except NeecoError as error:
        raise NeecoError(f"{place}{error}") from None
    methods = {}
    for name, configuration in study.configurations.items():
        try:
            methods[name] = training_config(configuration.method, {}).method
        except NeecoError as error:
            raise NeecoError(f"{place}configurations.{name}: {error}") from None
    configs = {name: config_of(request, study, name, place, methods) for name in study.configurations}
    capture = read_checked(request.capture, request.transforms)
    for name, config in configs.items():
        if need := unmet_need(config.method, capture):
            raise NeecoError(f"{place}{name}: needs {need}, missing in {request.capture}; remove this configuration")
    splits = held_out_splits(capture, request.splits)
    notes = []
    if not find_lpips(request.lpips_weights):
        notes.append(f"lpips: no weights; give --lpips-weights or set {WEIGHTS_VARIABLE}")
    if study.seeds == 1:
        notes.append("no standard deviations with one seed; give --seeds 2 or more")
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
        for seed in range(study.seeds)  # seeds in the outer loop, so that interim results include all configurations
        for name, config in configs.items()
    )
    same = {"schema": SCHEMA, "capture": str(request.capture.absolute()), "clock": jobs[0].clock}
    check_output(request.output, SWEEP_FILE, "a sweep", **same)
    digest = fingerprint(capture)
    for job in jobs:
        job.check()
        require_same_capture(job.folder, capture.root, digest)
    facts = machine(device, request.workers)
    return SweepPlan(
        request=request, study=study, capture=capture, splits=splits, jobs=jobs, machine=facts, notes=tuple(notes)
    )


def run_sweep(plan: SweepPlan, progress: Callable[[JobEvent], None] | None = None) -> Rows:
    """Train and score every configuration on every seed, except jobs finished earlier; return the rows of the tidy
    table. Writes sweep.json and, after each job, results.csv. The rows of a failed job have the reason."""
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
            made = {  # description of the study
                "schema": SCHEMA,
                "version": __version__,
                "capture": str(plan.request.capture.absolute()),
                "transforms": plan.request.transforms,
                "clock": plan.jobs[0].clock,
                "splits": list(plan.splits),
                "settings": list(plan.request.set),
                "machine": plan.machine,
                "study": plain(plan.study),
                "complete": len(results) == len(plan.jobs),
            }
            write_json(output / SWEEP_FILE, made)
            return rows

        record([finished[index] for index in sorted(finished)])
        captures = {plan.request.capture: plan.capture}
        return record(run_jobs(plan.jobs, plan.request.workers, record, finished, progress, captures))


def failures(rows: Rows) -> list[str]:
    """Return `name, seed k: reason` of every failed job."""
    failed = [f"{row['configuration']}, seed {row['seed']}: {row['error']}" for row in rows if row.get("error")]
    return list(dict.fromkeys(failed))


def config_of(request: SweepRequest, study: Study, name: str, place: str, methods: Mapping[str, str]) -> TrainConfig:
    """Return the settings of a configuration: of the study, of the configuration, then of --set. place: of the study,
    for messages; methods: by configuration. Raises NeecoError naming the field of the study, or --set."""
    configuration, where = study.configurations[name], f"{place}configurations.{name}"
    key, length = study.length_of(name)
    values: dict[str, Any] = {"transforms": request.transforms, "iterations": length}
    if key != "iterations":
        values |= {"minutes": length, "iterations": UNLIMITED}
    settings: list[str] = []
    origins: dict[str, str] = {}  # last origin of each field, for messages
    for origin, of_all, group in (
        (f"{place}settings: ", True, study.settings),
        (f"{where}.settings: ", False, configuration.settings),
        ("--set ", True, request.set),
    ):
        for setting in group:
            field, _ = name_and_value(origin.removesuffix(": ").strip(), setting, "ssim_weight=0.2")
            if field in SHARED:
                raise NeecoError(f"{origin}{field}: must be the same for all runs; use {SHARED[field]} instead")
            if of_all and not any(_has(method, field) for method in methods.values()):
                method_names = ", ".join(dict.fromkeys(methods.values()))
                raise NeecoError(f"{origin}{field}: no such field in the methods {method_names}; correct the name")
            if not of_all or _has(methods[name], field):
                settings.append(setting)
                origins[field] = origin
    try:
        return training_config(configuration.method, values, settings)
    except NeecoError as error:
        option, colon, problem = str(error).partition(":")
        field = option.removeprefix("--set ").removeprefix("--").replace("-", "_")
        raise NeecoError(f"{origins.get(field, f'{where}: ')}{field}{colon}{problem}") from None


def _has(method: str, field: str) -> bool:
    """Return whether a method has a field of its training config; `deformation.FIELD` is a method's own."""
    group, _, name = field.partition(".")
    return group != "deformation" or name in {item.name for item in dataclasses.fields(method_class(method).Settings)}


def tables_of(plan: SweepPlan, rows: Rows) -> list[tuple[str, str, ResultTable]]:
    """Return (name, split, numbers) of the study's tables: tables with published numbers for the primary split only,
    others for each split; finally ("", "", the cost of the runs)."""
    study, splits = plan.study, plan.splits
    finished = {row["configuration"] for row in rows if not row.get("error")}
    reasons = {row["configuration"]: row["error"] for row in rows if row["configuration"] not in finished}
    numbers: dict[str, Numbers] = {  # mean, standard deviation and number of the seeds that finished
        split: {
            name: {
                key: spread(row.get(key) for row in rows if (row["configuration"], row["split"]) == (name, split))
                for key in MEASURES
            }
            for name in dict.fromkeys(row["configuration"] for row in rows)
        }
        for split in splits
    }
    tables = []
    for name, table in study.tables.items():
        primary = PRIMARY if PRIMARY in splits else splits[0]
        for split in [primary] if any(row.published for row in table.rows.values()) else splits:
            title = f"{table.title}, {split}"
            if table.reference is None:
                columns = [MEASURES[key] for key in table.measures]
                rows_of = [(row.label or key, numbers[split][key], reasons.get(key)) for key, row in table.rows.items()]
                made = summary_table(title, "configuration", columns, rows_of)
            else:
                made = _differences(title, table, numbers[split], reasons, study.even_db)
            tables.append((name, split, made))
    costs = [(name, numbers[splits[0]][name], reasons.get(name)) for name in study.configurations]
    return [*tables, ("", "", summary_table("Training and rendering", "configuration", COSTS, costs))]


def direction(ours: float | None, published: float, even: float) -> str:
    """Compare the signs of two differences: "yes", "no", "even" if ours is below `even`, or UNKNOWN."""
    if ours is None:
        return UNKNOWN
    return "even" if abs(ours) < even else "yes" if (ours > 0) == (published > 0) else "no"


def _differences(title: str, table: Table, numbers: Numbers, reasons: Mapping[str, str], even: float) -> ResultTable:
    """Return means with differences to the reference; for measures with published numbers also these, and whether both
    differences have the same sign."""
    reference = str(table.reference)
    columns: list[Column] = []
    cells: dict[str, list[Cell]] = {name: [] for name in table.rows}
    for at, column in enumerate(MEASURES[key] for key in table.measures):
        published = {name: row.published[at] for name, row in table.rows.items() if len(row.published) > at}
        titles = [f"{column.title}: published", "ours", "agrees"] if published else [column.title]
        columns += [Column(column.key, text) for text in titles]
        base = numbers[reference][column.key]["mean"]
        limit = even if "psnr" in column.key else 0.0  # `even` is in dB
        for name in table.rows:
            mean, std = (numbers[name][column.key][part] for part in ("mean", "std"))
            change = None if name == reference or mean is None or base is None else mean - base
            text = UNKNOWN if mean is None else column.written(mean)
            text += "" if std is None else f" ± {column.written(std)}"
            text += "" if change is None else f" ({change * column.scale:+.{column.digits}f})"
            texts = [text]
            if published:
                both = name != reference and {name, reference} <= published.keys()
                agrees = direction(change, published[name] - published[reference], limit) if both else ""
                texts = [column.written(published[name]) if name in published else UNKNOWN, text, agrees]
            cells[name] += map(Cell, texts)
    rows = tuple(
        Row((row.label or name,), tuple(cells[name]), reasons.get(name), reference=name == reference)
        for name, row in table.rows.items()
    )
    return ResultTable(title, ("configuration",), tuple(columns), rows)


def length_words(study: Study) -> str:
    """Return the length of the runs and the number of seeds, as text."""
    lengths = dict.fromkeys(study.length_of(name) for name in study.configurations)
    each = " or ".join(f"{value:,g} {key.replace('cpu_', 'CPU ')}" for key, value in lengths)
    return f"{each} each, {counted(study.seeds, 'seed')}"
