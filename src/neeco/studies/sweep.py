"""`sweep`: configurations x seeds on one capture, each a job; a tidy table of scores, and summary tables."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neeco import __version__
from neeco.base.errors import NeecoError, counted
from neeco.base.files import own_folder, write_json, write_text
from neeco.base.settings import name_and_value, plain
from neeco.capture import Capture
from neeco.capture.checks import read_checked
from neeco.capture.writer import fingerprint
from neeco.evaluation.evaluate import held_out_splits
from neeco.evaluation.image_metrics import WEIGHTS_VARIABLE, find_lpips
from neeco.raster.devices import device_of
from neeco.scene.method_registry import method_class, unmet_need
from neeco.scene.training_session import UNLIMITED
from neeco.studies.configurations import COSTS, MEASURES, Study, SweepRequest, Table
from neeco.studies.study import JobEvent, Result, check_output, check_workers, machine, run_jobs, spread
from neeco.studies.tables import UNKNOWN, Cell, Column, ResultTable, Row, csv_text, summary_table
from neeco.studies.training_job import JOB_FILE, TrainingJob, read_result
from neeco.training.config import TrainConfig, training_config
from neeco.training.run import require_same_capture

SCHEMA = "neeco-sweep/1"
SWEEP_FILE = "sweep.json"
RESULTS_FILE = "results.csv"
COLUMNS = ("configuration", "method", "seed", "split", "frames", *MEASURES, "error")
SHARED = {"seed": "seeds", "iterations": "iterations", "minutes": "minutes", "transforms": "--transforms"}
PRIMARY = "test"  # split that is compared with published numbers, if it exists
Numbers = Mapping[str, Mapping[str, Any]]  # `study.spread` by configuration and measure, of one split
Rows = Sequence[Mapping[str, Any]]  # rows of the tidy table: one per configuration, seed and split, by COLUMNS


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
