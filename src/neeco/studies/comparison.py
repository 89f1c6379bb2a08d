"""`compare`: several methods on the same frames under the same budget, over several seeds; its numbers and tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

from neeco import __version__
from neeco.capture import Capture
from neeco.capture.checks import read_checked
from neeco.capture.model import RecordedStates
from neeco.capture.writer import fingerprint
from neeco.errors import NeecoError, counted
from neeco.evaluation.evaluate import EVALUATION_FILE, Progress, held_out_splits
from neeco.evaluation.image_metrics import WEIGHTS_VARIABLE, find_lpips
from neeco.files import own_folder, read_json, require_like, write_json
from neeco.raster.devices import device_of
from neeco.scene.method_registry import unmet_need
from neeco.settings import plain
from neeco.studies.machine import machine, machine_words, measure_speed
from neeco.studies.masks import check_masks, score_folder, score_runs, splits_with_truth
from neeco.studies.study import REMEDY, JobEvent, Result, check_output, check_workers, run_and_record, spread
from neeco.studies.tables import (
    Column,
    ResultTable,
    SummaryRow,
    csv_text,
    latex_document,
    markdown_document,
    summary_csv,
    summary_table,
    write_files,
)
from neeco.studies.training_job import (
    ANEW,
    BUDGET,
    CURVE_FILE,
    JOB_FILE,
    SECONDS_ON,
    Budget,
    TrainingJob,
    check_settings,
    read_result,
    read_rows,
    settings_for,
)
from neeco.training.config import TrainConfig, training_config
from neeco.training.run import load_run, require_same_capture

COMPARISON_SCHEMA = "neeco-comparison/1"
COMPARISON_FILE = "comparison.json"
FRAME_SCORES = ("psnr", "psnr_instrument", "mask_iou")
SPLIT_COLUMNS = (
    Column("psnr", "PSNR", 2, "high"),
    Column("ssim", "SSIM", 3, "high"),
    Column("lpips", "LPIPS", 3, "low"),
    Column("psnr_instrument", "PSNR instrument", 2, "high"),
    Column("mask_iou", "label IoU", 3, "high"),
)
MASK_COLUMNS = (
    Column("iou", "label IoU", 3, "high"),
    Column("challenge_iou", "Challenge IoU", 3, "high"),
    Column("challenge_iou_parts", "of parts", 3, "high"),
    Column("dice", "Dice", 3, "high"),
    Column("boundary_f", "boundary F", 3, "high"),
    Column("box_ap", "box AP", 3, "high"),
)
RUN_COLUMNS = (
    Column("iterations", "iterations"),
    Column("seconds", "minutes", 2, None, 1 / 60),
    Column("processor_seconds", "CPU minutes", 2, None, 1 / 60),
    Column("fps", "FPS", 1, "high"),
    Column("num_gaussians", "Gaussians"),
    Column("peak_memory_mb", "peak MiB", 0, "low"),
)
SPLIT_METRICS = tuple(column.key for column in SPLIT_COLUMNS)
MASK_METRICS = tuple(column.key for column in MASK_COLUMNS)
RUN_METRICS = ("seconds", "processor_seconds", "fps", "num_gaussians", "peak_memory_mb", "iterations")


@dataclass(frozen=True, kw_only=True)
class ComparisonSpec:
    """The request of a comparison. `seeds`: how many, from 0. `splits` None: all but `train`. `masks`: folders of masks
    by name. `assignments`: NAME=VALUE, fields of the training config that are changed for every method."""

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
    jobs: tuple[TrainingJob, ...]
    splits: tuple[str, ...]
    notes: tuple[str, ...]
    given_masks: tuple[dict[str, Any], ...]  # scores of the folders of masks

    @property
    def names(self) -> list[str]:
        """Methods and folders of masks."""
        return list(dict.fromkeys([*self.spec.methods, *self.spec.masks]))


@dataclass(frozen=True, kw_only=True)
class ComparisonResult:
    """The contents of comparison.json, valid at every moment."""

    schema: str
    version: str
    complete: bool  # is all in it?
    capture: str
    machine: dict[str, Any]
    budget: dict[str, Any]
    transforms: str
    settings: list[str]
    seeds: list[int]
    splits: list[str]
    methods: list[dict[str, Any]]  # {name, method, source: train or masks, folder}
    jobs: list[Result]
    summary: list[dict[str, Any]]  # of `summarise`
    curves: list[dict[str, Any]]  # held-out PSNR of the finished jobs at about ten moments
    distance: list[dict[str, Any]]  # every held-out frame's scores and its distance from the training states
    speed: dict[str, Any]  # of `measure_speed`
    masks: list[dict[str, Any]]  # scores of masks by name, seed and split
    notes: list[str]

    @property
    def trained(self) -> list[str]:
        """The methods by name, without the folders of masks."""
        return [entry["name"] for entry in self.methods if entry["source"] == "train"]

    @property
    def failures(self) -> list[str]:
        """`name, seed k: why` of every job that failed."""
        return [f"{job['name']}, seed {job['seed']}: {job['error']}" for job in self.jobs if "error" in job]


def plan_comparison(spec: ComparisonSpec) -> ComparisonPlan:
    """Check everything that can be known before the work. Raises NeecoError for whatever cannot be compared."""
    spec.budget.check()
    device = device_of(spec.device)
    if spec.seeds < 1:
        raise NeecoError(f"--seeds: {spec.seeds} is none at all; give at least 1")
    check_workers(spec.workers, device)
    configs = _configs(spec)
    capture = read_checked(spec.capture, spec.transforms)
    for name, config in configs.items():
        if need := unmet_need(config.method, capture):
            raise NeecoError(f"--methods: {name} needs {need}, which {spec.capture} has not; leave it out")
    networks = find_lpips(spec.lpips_weights)
    _check_output(spec)
    jobs = tuple(
        TrainingJob(
            name=name,
            seed=seed,
            capture=spec.capture,
            folder=job_folder(spec.output, name, seed),
            config=config,
            budget=spec.budget,
            splits=spec.splits,
            lpips_weights=spec.lpips_weights,
            device=spec.device,
        )
        for seed in range(spec.seeds)  # every method's first seed comes first: half of the runs show them all
        for name, config in configs.items()
    )
    digest = fingerprint(capture)
    for job in jobs:
        job.check()
        require_same_capture(job.folder, capture.root, digest)
    splits = held_out_splits(capture, spec.splits)
    check_masks(spec.masks, capture, splits, spec.methods)
    notes = [] if networks else [f"lpips: no weights; give --lpips-weights or set {WEIGHTS_VARIABLE}"]
    scored: list[dict[str, Any]] = []
    for name, folder in spec.masks.items():
        rows, missing = score_folder(name, None, folder, capture, splits_with_truth(capture, splits))
        scored += rows
        notes += missing
    return ComparisonPlan(spec, capture, jobs, splits, tuple(notes), tuple(scored))


def compare(
    plan: ComparisonPlan, events: Callable[[JobEvent], None] | None = None, progress: Progress | None = None
) -> ComparisonResult:
    """Train and score every method on every seed, measure the speed of all, and write comparison.json and its tables.

    Given again after an interruption, it goes on where it stopped; given again with more methods or seeds, it adds
    them. A failed run has its reason in its place. comparison.json is valid at every moment; `complete` says whether
    all is in it. events: of the jobs; progress: of what follows them.
    """
    spec, file = plan.spec, plan.spec.output / COMPARISON_FILE
    with own_folder(spec.output):
        files = {index: job.folder / JOB_FILE for index, job in enumerate(plan.jobs)}
        finished = {index: read_result(path) for index, path in files.items() if path.exists()}
        finished = {index: job for index, job in finished.items() if list(job["splits"]) == list(plan.splits)}

        def record(results: Sequence[Result]) -> None:
            write_json(file, plain(_result(plan, results)))

        record([finished[index] for index in sorted(finished)])
        results = run_and_record(plan.jobs, spec.workers, record, finished, events, {spec.capture: plan.capture})
        result = _measured(plan, _result(plan, results), progress or (lambda what, done, total: None))
        write_json(file, plain(result))
        write_files(spec.output, "comparison", table_texts(result), data_files(result))
    return result


def read_comparison(folder: Path) -> ComparisonResult:
    """Read comparison.json in `folder`. Raises NeecoError when it is no comparison of this version."""
    file, names = folder / COMPARISON_FILE, [field.name for field in fields(ComparisonResult)]
    stored = read_json(file)
    if not isinstance(stored, dict) or stored.get("schema") != COMPARISON_SCHEMA or not stored.keys() >= set(names):
        raise NeecoError(f"{file}: is no {COMPARISON_SCHEMA}; compare again")
    return ComparisonResult(**{name: stored[name] for name in names})


def job_folder(output: Path, name: str, seed: int) -> Path:
    """The run folder of one job of a comparison."""
    return output / "runs" / f"{name}-seed{seed}"


def _configs(spec: ComparisonSpec) -> dict[str, TrainConfig]:
    """Every method's settings by name. Raises NeecoError."""
    if not spec.methods:
        raise NeecoError("--methods: none is given; name at least one")
    values = {"transforms": spec.transforms}
    methods = {name: training_config(name, values).method for name in spec.methods}
    check_settings(spec.assignments, dict.fromkeys(methods.values()), "--seeds")
    return {name: training_config(name, values, settings_for(methods[name], spec.assignments)) for name in spec.methods}


def _check_output(spec: ComparisonSpec) -> None:
    """Raises NeecoError when `output` holds something else, or the comparison of another capture or budget."""
    stored = check_output(spec.output, COMPARISON_FILE, COMPARISON_SCHEMA, spec.capture, "a comparison")
    if stored is None:
        return
    file = str(spec.output / COMPARISON_FILE)
    require_like(stored, {"budget": BUDGET}, file, REMEDY)
    if stored["budget"] != asdict(spec.budget):
        before = Budget(*(stored["budget"][key] for key in BUDGET))
        raise NeecoError(f"{file}: budget: begun with {before}, now {spec.budget}; {REMEDY}")


def _result(plan: ComparisonPlan, jobs: Sequence[Result]) -> ComparisonResult:
    """The comparison as far as the jobs alone give it."""
    spec = plan.spec
    methods: list[dict[str, Any]] = [
        {"name": name, "method": config, "source": "train", "folder": "runs"}
        for name, config in dict.fromkeys((job.name, job.config.method) for job in plan.jobs)
    ]
    methods += [
        {"name": name, "method": None, "source": "masks", "folder": str(path.absolute())}
        for name, path in spec.masks.items()
    ]
    failed = [f"{job['name']}, seed {job['seed']}: failed: {job['error']}" for job in jobs if "error" in job]
    curves, distance = _frame_rows(plan, [job for job in jobs if "error" not in job])
    return ComparisonResult(
        schema=COMPARISON_SCHEMA,
        version=__version__,
        complete=False,
        capture=str(spec.capture.absolute()),
        machine=machine(device_of(spec.device), spec.workers),
        budget=asdict(spec.budget),
        transforms=spec.transforms,
        settings=list(spec.assignments),
        seeds=list(range(spec.seeds)),
        splits=list(plan.splits),
        methods=methods,
        jobs=list(jobs),
        summary=summarise(plan.names, plan.splits, jobs, (), plan.given_masks),
        curves=curves,
        distance=distance,
        speed={"rows": []},
        masks=list(plan.given_masks),
        notes=[*plan.notes, *failed],
    )


def _frame_rows(plan: ComparisonPlan, done: Sequence[Result]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """The rows of `curves`, whose seconds are on the budget's clock, and of `distance`."""
    distances = distances_to_training(plan.capture)
    curves, distance = [], []
    frame = {"frame": str} | dict.fromkeys(FRAME_SCORES, (float, None))
    like = {"per_frame": {"given": {split: [frame] for split in plan.splits}}}
    for job in done:
        folder = job_folder(plan.spec.output, job["name"], job["seed"])
        names = {key: job[key] for key in ("name", "seed")}
        for row in read_rows(folder / CURVE_FILE):
            seconds = {"seconds": row[SECONDS_ON[plan.spec.budget.clock]]}
            curves.append(names | seconds | {key: row[key] for key in ("iteration", "split", "psnr")})
        file = folder / EVALUATION_FILE
        frames = require_like(read_json(file), like, str(file), ANEW)["per_frame"]["given"]
        for split in (split for split in plan.splits if split != "train"):
            for row in frames[split]:
                place = {"split": split, "frame": row["frame"], "distance": distances.get(row["frame"])}
                distance.append(names | place | {key: row[key] for key in FRAME_SCORES})
    return curves, distance


def distances_to_training(capture: Capture) -> dict[str, float]:
    """Distance of every frame outside `train` from the nearest training frame's state, by frame name.

    A state's coordinates are the instruments' positions (mm), the entries of their rotation matrices and their joints
    (rad), or the time (s) where the capture has no instruments. Each is divided by its standard deviation over the
    training frames; the distance is the root mean square over the coordinates, so it reads in standard deviations of
    the training states. Coordinates that stand still in training are left out; empty when all do.
    """
    names = [instrument.name for instrument in capture.instruments]
    recorded = RecordedStates([frame.state for frame in capture.split("train")], names)
    if recorded.still:
        return {}
    others = [frame for frame in capture.frames if frame.split != "train"]
    return {frame.name: float(recorded.distances(frame.state).min()) for frame in others}


def _measured(plan: ComparisonPlan, result: ComparisonResult, report: Progress) -> ComparisonResult:
    """`result` with what is measured over all finished runs together: their masks, their speed."""
    folder, masks, speed = plan.spec.output, result.masks, result.speed
    done = [(job["name"], job["seed"]) for job in result.jobs if "error" not in job]
    runs = [(name, seed, job_folder(folder, name, seed)) for name, seed in done]
    if runs:
        splits = splits_with_truth(plan.capture, plan.splits)
        device = device_of(plan.spec.device)
        scored = score_runs(runs, folder, plan.capture, splits, device, partial(report, "scoring masks"))
        masks = [*masks, *scored]
        opened = [(name, seed, load_run(path)) for name, seed, path in runs]
        speed = measure_speed(opened, plan.capture, device, partial(report, "measuring speed"))
    summary = summarise(plan.names, plan.splits, result.jobs, speed["rows"], masks)
    return replace(result, complete=True, summary=summary, speed=speed, masks=masks)


def summarise(
    names: Sequence[str],
    splits: Sequence[str],
    jobs: Sequence[Mapping[str, Any]],
    speeds: Sequence[Mapping[str, Any]] = (),
    masks: Sequence[Mapping[str, Any]] = (),
) -> list[dict[str, Any]]:
    """One row per name and split; every metric as {"mean", "std", "n"} over the seeds that finished.

    jobs: what `run_jobs` returns. speeds: rows of `measure_speed`; where there are some, fps is theirs on the cpu
    backend instead of the jobs' own. masks: {"name", "seed", "split", metric: value}. `failed` counts the seeds that
    did not finish.
    """
    rows = []
    for name in names:
        done = [job for job in jobs if job["name"] == name and "error" not in job]
        failed = sum(job["name"] == name and "error" in job for job in jobs)
        measured = [row["fps"] for row in speeds if row["name"] == name and row["backend"] == "cpu"]
        of_run = {metric: spread(job[metric] for job in done) for metric in RUN_METRICS}
        if measured:
            of_run["fps"] = spread(measured)
        for split in splits:
            scores = [job["splits"].get(split, {}) for job in done]
            of_masks = [entry for entry in masks if entry["name"] == name and entry["split"] == split]
            row: dict[str, Any] = {"name": name, "split": split, "failed": failed}
            row |= {metric: spread(score.get(metric) for score in scores) for metric in SPLIT_METRICS}
            row |= {metric: spread(entry.get(metric) for entry in of_masks) for metric in MASK_METRICS}
            rows.append(row | of_run)
    return rows


def tables_of(comparison: ComparisonResult) -> list[ResultTable]:
    """One table per split, then the methods' own. Columns that nobody has a number for are left out."""
    finished = {job["name"] for job in comparison.jobs if "error" not in job}
    reasons: dict[str, str] = {}  # of methods of which no seed finished
    for job in comparison.jobs:
        if "error" in job and job["name"] not in finished:
            reasons.setdefault(job["name"], job["error"])

    def table(title: str, columns: Sequence[Column], rows: Sequence[Mapping[str, Any]]) -> ResultTable:
        entries = [SummaryRow((row["name"],), row, reasons.get(row["name"])) for row in rows]
        return summary_table(title, ("method",), columns, entries)

    tables = []
    for split in comparison.splits:
        rows = [row for row in comparison.summary if row["split"] == split]
        scored = any(row["iou"]["n"] for row in rows)  # the same number, for other people's masks too
        ours = [column for column in SPLIT_COLUMNS if not (scored and column.key == "mask_iou")]
        tables.append(table(f"split {split}", (*ours, *MASK_COLUMNS), rows))
    trained, first = comparison.trained, comparison.splits[0]
    rows = [row for row in comparison.summary if row["split"] == first and row["name"] in trained]
    return [*tables, table("training and rendering", RUN_COLUMNS, rows)]


def absent_notes(comparison: ComparisonResult) -> list[str]:
    """Return notes on what the tables lack, and why."""
    notes = list(comparison.notes)
    known = {key for key in SPLIT_METRICS if any(row[key]["n"] for row in comparison.summary)}
    masked = "psnr_instrument" in known
    why = "no run finished" if not known else "no method here carries labels" if masked else "the capture has no masks"
    for key in SPLIT_METRICS:
        if key not in known and not any(note.startswith(key) for note in notes):
            notes.append(f"{key}: no run has it: {why}")
    if not any(row["seconds"]["std"] is not None for row in comparison.summary):
        notes.append("no ± is given: one seed has no standard deviation; give --seeds 2 or more")
    return notes


def budget_words(comparison: ComparisonResult) -> str:
    """Return the budget and the number of seeds, in words."""
    seeds = len(comparison.seeds)
    return f"{Budget(**comparison.budget)} each, {counted(seeds, 'seed')}"


def table_texts(comparison: ComparisonResult) -> dict[str, str]:
    """The tables and what they lack by suffix: csv (unrounded), md, and tex for the package booktabs."""
    tables, notes, name = tables_of(comparison), absent_notes(comparison), Path(comparison.capture).name
    budget, computer = budget_words(comparison), machine_words(comparison.machine)
    return {
        "csv": comparison_csv(comparison),
        "md": markdown_document(f"Comparison on {name}", f"{budget}. {computer}.", tables, "seeds", notes),
        "tex": latex_document(f"{name}, {{}}. {budget}.", tables, [computer], notes),
    }


def comparison_csv(comparison: ComparisonResult) -> str:
    """One line per method and split, unrounded; unknown numbers are empty."""
    metrics = (*SPLIT_METRICS, *MASK_METRICS, *RUN_METRICS)
    return summary_csv(["name", "split", "failed"], metrics, comparison.summary)


def data_files(comparison: ComparisonResult) -> dict[str, str]:
    """The CSV files of `data/` by name: every run's numbers, and the data of the figures."""
    job_columns = ["name", "method", "seed", "split", *SPLIT_METRICS, "frames", *RUN_METRICS, "error"]
    jobs = [
        {**job, **numbers, "split": split}
        for job in comparison.jobs
        for split, numbers in (job["splits"] or {"": {}}).items()
    ]
    speed_columns = ["name", "seed", "method", "backend", "fps", "milliseconds", "draws", "num_gaussians"]
    return {
        "jobs.csv": csv_text(job_columns, jobs),
        "curves.csv": csv_text(["name", "seed", "seconds", "iteration", "split", "psnr"], comparison.curves),
        "distance.csv": csv_text(["name", "seed", "split", "frame", "distance", *FRAME_SCORES], comparison.distance),
        "speed.csv": csv_text(speed_columns, comparison.speed["rows"]),
    }
