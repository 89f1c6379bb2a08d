"""Run the ablations: one job per distinct variant, whatever tables it stands in; then the tables from the jobs."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neeco import __version__
from neeco.capture.checks import read_checked
from neeco.capture.checks.truth import MASK_FOLDERS
from neeco.capture.model import Capture, Frame, InstrumentState, State, evenly_spaced
from neeco.capture.writer import write_capture
from neeco.errors import NeecoError
from neeco.evaluation.evaluate import held_out_splits
from neeco.files import own_folder, read_begun, read_json, require_same, write_atomically, write_json
from neeco.geometry.rotations import rotation_from_vector
from neeco.raster.devices import device_of
from neeco.scene.method_registry import method_settings
from neeco.settings import plain
from neeco.studies.ablation_tables import AblationRow, AblationTable, Values, write_tables
from neeco.studies.ablations import (
    CHECKPOINTS,
    NOISE_DEGREES_PER_MM,
    PHASE_1_SHARE,
    PHASE_1_STEPS,
    PUBLISHED_STEPS,
    Ablation,
    AblationPlan,
    Comparison,
    Derived,
    Entry,
    Variant,
    all_ablations,
)
from neeco.studies.machine import machine
from neeco.studies.masks import LabelScores, score_label_ways
from neeco.studies.study import REMEDY, JobEvent, Result, check_output, check_workers, run_jobs
from neeco.studies.training_job import (
    CURVE_FILE,
    Budget,
    TrainingJob,
    check_settings,
    read_rows,
    settings_for,
)
from neeco.training.config import TISSUE_GAUSSIANS, TrainConfig, training_config
from neeco.training.run import open_gaussian_run
from neeco.training.schedule import MIN_RESET_INTERVAL

SCHEMA = "neeco-ablation/1"
FILE = "ablation.json"
LABELS_FILE = "label_ways.json"
MIN_WARM_UP_STEPS = 100  # with the network off: trained on a nearly empty image it moves Gaussians out of sight
MAX_WARM_UP = 0.25  # share of the run
INITIAL_SHARE = 0.25  # of the tissue's budget: density control can only differ where it has room to grow
MIN_KINEMATIC_STEPS = 1_000  # steps: the shaft starts to spin and joints to learn after 600
EVEN_DB = 0.1  # smaller differences do not count as a direction
FINAL_SCORES = ("psnr", "psnr_instrument", "mask_iou")


@dataclass(frozen=True, kw_only=True)
class AblationResult:
    """The contents of ablation.json."""

    schema: str
    version: str
    capture: str
    seed: int
    iterations: dict[str, int]  # by method
    machine: dict[str, Any]
    settings: list[str]
    splits: list[str]
    tables: list[AblationTable]
    runs: list[Result]
    failures: list[dict[str, str]]  # {run, error}
    notes: list[str]


def run_ablations(plan: AblationPlan, progress: Callable[[JobEvent], None] | None = None) -> AblationResult:
    """Train and score every variant of the chosen tables, write DIR/ablation.json and DIR/tables/, return the first.

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
    begun = check_output(plan.output, FILE, SCHEMA, plan.capture, "an ablation")
    jobs = [_job(plan, variant) for variant in variants]
    for job in jobs:
        job.check()
    with own_folder(plan.output):
        if begun is None:
            write_json(plan.output / FILE, {"schema": SCHEMA, "capture": str(plan.capture.absolute())})
        for job, variant in zip(jobs, variants, strict=True):
            if variant.derived is not None:
                derive_capture(capture, plan.transforms, variant.derived, plan.seed, job.capture)
        results = run_jobs(jobs, plan.workers, progress, {plan.capture: capture})
    finished = {job.name: result for job, result in zip(jobs, results, strict=True) if "error" not in result}
    failures = [{"run": result["name"], "error": result["error"]} for result in results if "error" in result]
    folders = {job.name: job.folder for job in jobs if job.name in finished}
    methods = [method for method in ("nps", "kinematic") if any(v.method == method for v in variants)]
    log_intervals = {job.config.method: job.config.log_interval for job in jobs}
    labels, unscored = _label_scores(chosen, folders, capture, splits, device)
    result = AblationResult(
        schema=SCHEMA,
        version=__version__,
        capture=str(plan.capture.absolute()),
        seed=plan.seed,
        iterations={method: _steps(plan, method) for method in sorted(methods)},
        machine=machine(device),
        settings=list(plan.settings),
        splits=list(splits),
        tables=[table_of(table, folders, finished, labels, splits) for table in chosen],
        runs=list(finished.values()),
        failures=failures + unscored,
        notes=[
            note for method in methods for note in _shortcomings(method, _steps(plan, method), log_intervals[method])
        ],
    )
    write_json(plan.output / FILE, plain(result))
    write_tables(plan.output, result.tables)
    return result


def chosen_ablations(names: Sequence[str]) -> tuple[Ablation, ...]:
    """The tables behind `paper`, `ours` or their own names, each once. Raises NeecoError for an unknown name."""
    known = all_ablations()
    groups = {group: [table for table in known.values() if table.group == group] for group in ("paper", "ours")}
    chosen: dict[str, Ablation] = {}
    for name in names:
        if name not in groups and name not in known:
            raise NeecoError(f"--tables: {name!r} is unknown; choose of paper, ours, {', '.join(known)}")
        chosen |= {table.name: table for table in groups.get(name) or [known[name]]}
    if not chosen:
        raise NeecoError("--tables: names none; leave it out for all of them")
    return tuple(chosen.values())


def distinct_variants(chosen: Sequence[Ablation]) -> list[Variant]:
    """Every run that the tables need, once."""
    return list(dict.fromkeys(entry.variant for table in chosen for entry in table.entries))


def _open_capture(plan: AblationPlan, variants: Sequence[Variant]) -> Capture:
    """Return the capture. Raises NeecoError where no run could train on it."""
    for name, value in (("iterations", plan.iterations), ("kinematic-iterations", plan.kinematic_iterations)):
        if value is not None and value < 1:
            raise NeecoError(f"--{name}: {value} is no training; give at least 1")
    check_settings(plan.settings, dict.fromkeys(variant.method for variant in variants), "--seed")
    capture = read_checked(plan.capture, plan.transforms)
    if not capture.instruments:
        raise NeecoError(f"{plan.capture}: instruments: no states are recorded; every ablation needs them")
    return capture


def _steps(plan: AblationPlan, method: str) -> int:
    """Iterations of a run of `method`."""
    if method == "nps":
        return plan.iterations
    return plan.kinematic_iterations or max(MIN_KINEMATIC_STEPS, plan.iterations)


def _job(plan: AblationPlan, variant: Variant) -> TrainingJob:
    """The job of one variant. Settings: its method's, then the user's, then what the variant is about."""
    steps, capture = _steps(plan, variant.method), plan.capture
    values = {"iterations": steps, "seed": plan.seed, "transforms": plan.transforms}
    given = settings_for(variant.method, plan.settings)
    common = _paper_settings(steps) if variant.method == "nps" else ()
    config = training_config(variant.method, values, [*common, *given, *variant.settings])
    if variant.method == "nps":
        config = _with_room_to_grow(config)
    if variant.derived is not None:
        capture = plan.output / "captures" / variant.derived.name
        config = replace(config, transforms="transforms.json")
    folder = plan.output / "runs" / variant.name
    return TrainingJob(
        name=variant.name,
        seed=plan.seed,
        capture=capture,
        folder=folder,
        config=config,
        budget=Budget(None, steps),
        device=plan.device,
    )


def _paper_settings(iterations: int) -> tuple[str, ...]:
    """The paper's schedule is stated for its own 20,000 steps and scaled to the run. The network is off for its
    usual share of the run or MIN_WARM_UP_STEPS, whichever is longer."""
    warm_up = max(method_settings("nps", {}).warm_up, min(MAX_WARM_UP, MIN_WARM_UP_STEPS / iterations))
    return (
        f"schedule.published_steps={PUBLISHED_STEPS}",
        f"schedule.earliest={PHASE_1_STEPS}",
        f"deformation.warm_up={round(warm_up, 4)}",
    )


def _with_room_to_grow(config: TrainConfig) -> TrainConfig:
    """Start with INITIAL_SHARE of the tissue's budget: density control cannot change a tissue full of sparse points."""
    if config.initial_points is not None:
        return config
    return replace(
        config, initial_points=max(1, round(INITIAL_SHARE * (config.max_tissue_gaussians or TISSUE_GAUSSIANS)))
    )


def _shortcomings(method: str, steps: int, log_interval: int) -> list[str]:
    """Return notes on what runs of so many steps are too short to show."""
    notes = []
    if method == "nps" and PHASE_1_SHARE * steps < log_interval:
        notes.append(
            f"phase-1 PSNR: not known, phase 1 of {steps} steps ends before the first row of metrics.jsonl "
            f"({log_interval} steps); give --iterations {math.ceil(log_interval / PHASE_1_SHARE)} or more"
        )
    if method == "nps" and TrainConfig().growth_stop * steps <= MIN_RESET_INTERVAL:
        notes.append(
            f"opacity reset: none comes in {steps} steps (intervals do not scale below {MIN_RESET_INTERVAL}, and "
            "density control ends half-way), so P_oi changes nothing here"
        )
    if method == "kinematic" and steps < MIN_KINEMATIC_STEPS:
        notes.append(
            f"kinematic: {steps} steps are few: joints begin to learn and the shaft to spin after 600, labels to "
            f"sharpen after 1,000; give --kinematic-iterations {MIN_KINEMATIC_STEPS} or more"
        )
    return notes


def _label_scores(
    chosen: Sequence[Ablation],
    folders: Mapping[str, Path],
    capture: Capture,
    splits: tuple[str, ...],
    device: torch.device,
) -> tuple[dict[str, LabelScores], list[dict[str, str]]]:
    """Scores by run of both ways to label it, for the runs whose table asks; and what could not be scored."""
    scores: dict[str, LabelScores] = {}
    failures = []
    wanted = (entry.variant.name for table in chosen for entry in table.entries if entry.label_way)
    for name in dict.fromkeys(wanted):
        if name not in folders:
            continue
        file = folders[name] / LABELS_FILE
        stored = read_json(file) if file.exists() else None
        if stored is None or stored["splits"] != list(splits):
            try:
                with open_gaussian_run(folders[name], "label ways", device) as run:
                    scored = score_label_ways(run, capture, splits)
            except NeecoError as error:
                failures.append({"run": name, "error": f"label ways: {error}"})
                continue
            stored = {"splits": list(splits), "mask_iou": scored}
            write_json(file, stored)
        scores[name] = stored["mask_iou"]
    return scores, failures


def table_of(
    table: Ablation,
    folders: Mapping[str, Path],
    results: Mapping[str, Result],
    labels: Mapping[str, LabelScores],
    splits: Sequence[str],
) -> AblationTable:
    """A table from the runs that finished (`folders`, `results`) and those that are labelled both ways (`labels`)."""
    primary = primary_split(splits)
    judged = [measure.format(split=primary) for measure in table.judged]
    rows, curves = [], []
    for comparison in table.comparisons:
        values = {entry.label: _values(entry, folders, results, labels, splits) for entry in comparison.entries}
        for entry in comparison.entries:
            rows.append(_row(comparison, entry, values, judged, primary))
            folder = folders.get(entry.variant.name)
            if table.group == "paper" and folder is not None:
                names = {"comparison": comparison.title, "label": entry.label}
                points = [row for row in read_rows(folder / CURVE_FILE) if row["split"] == primary]
                curves += [names | {key: row[key] for key in ("iteration", "progress", "psnr")} for row in points]
    final = ("psnr",) if table.group == "paper" else FINAL_SCORES
    known = dict.fromkeys(key for row in rows for key, value in row.values.items() if value is not None)
    shown = [key for key in known if key not in judged and key.partition(".")[0] in final]
    return AblationTable(
        name=table.name,
        group=table.group,
        title=table.title,
        question=table.question,
        judged=judged,
        measures=[*judged, *shown],
        rows=rows,
        curves=curves,
    )


def primary_split(splits: Sequence[str]) -> str:
    """Return the held-out split that the paper's test numbers are compared with."""
    return "test" if "test" in splits else splits[0]


def _row(
    comparison: Comparison, entry: Entry, values: Mapping[str, Values], judged: Sequence[str], primary: str
) -> AblationRow:
    reference = next(item for item in comparison.entries if item.label == comparison.reference)
    ours, base = values[entry.label], values[reference.label]
    paper, paper_base = (dict(zip(judged, item.paper, strict=False)) for item in (entry, reference))
    difference: Values = {}
    agrees: dict[str, str | None] = {}
    if entry is not reference:
        for key, value in ours.items():
            other = base.get(key)
            difference[key] = None if value is None or other is None else round(value - other, 4)
        for key in judged:
            expected = paper[key] - paper_base[key] if key in paper else float(entry.expected)
            agrees[key] = direction(difference.get(key), expected)
    return AblationRow(
        comparison=comparison.title,
        label=entry.label,
        reference=entry is reference,
        run=entry.variant.name,
        values=ours,
        paper=paper,
        paper_direction="worse" if entry.expected and entry is not reference else "",
        difference=difference,
        agrees=agrees,
    )


def direction(ours: float | None, paper: float) -> str | None:
    """Compare the signs of two differences: "yes", "no", "even" when ours is below EVEN_DB, None unknown."""
    if ours is None:
        return None
    if abs(ours) < EVEN_DB:
        return "even"
    return "yes" if (ours > 0) == (paper > 0) else "no"


def _values(
    entry: Entry,
    folders: Mapping[str, Path],
    results: Mapping[str, Result],
    labels: Mapping[str, LabelScores],
    splits: Sequence[str],
) -> Values:
    """Every number of one entry by measure; empty when its run failed."""
    name = entry.variant.name
    if entry.label_way is not None:
        ways = labels.get(name, {})
        return {f"mask_iou.{split}": ways[entry.label_way][split] for split in splits} if ways else {}
    if name not in results:
        return {}
    folder, result = folders[name], results[name]
    values: Values = {}
    if entry.variant.method == "nps":  # trained in phases: how good it was in the first and on the way
        values["phase_1_psnr"] = phase_1_psnr(folder, int(result["iterations"]))
        curve, split = read_rows(folder / CURVE_FILE), primary_split(splits)
        for percent in CHECKPOINTS:
            values[f"psnr_at_{percent}.{split}"] = psnr_at(curve, split, percent / 100)
    return values | {f"{score}.{split}": result["splits"][split][score] for score in FINAL_SCORES for split in splits}


def phase_1_psnr(folder: Path, iterations: int) -> float | None:
    """Mean training PSNR (dB) over the rows of metrics.jsonl in the last quarter of phase 1, its last row at least.

    A row averages 50 steps; None when phase 1, or the whole run, was shorter than that.
    """
    end = PHASE_1_SHARE * iterations
    rows = [row for row in read_rows(folder / "metrics.jsonl") if row["iteration"] <= end]
    late = [row["psnr"] for row in rows if row["iteration"] > 0.75 * end or row is rows[-1]]
    return round(sum(late) / len(late), 4) if late else None


def psnr_at(curve: Sequence[Mapping[str, Any]], split: str, share: float) -> float | None:
    """Held-out PSNR (dB) when `share` of the run was done; None where the curve has no row so near as 5 % of it."""
    rows = [row for row in curve if row["split"] == split and abs(row["progress"] - share) < 0.05]
    return min(rows, key=lambda row: abs(row["progress"] - share))["psnr"] if rows else None


RECIPE_FILE = "derived.json"


def derive_capture(capture: Capture, transforms: str, derived: Derived, seed: int, output: Path) -> Path:
    """Write the capture that `derived` makes of `capture`, read from its file `transforms`, to folder `output`, true
    masks included; at once when it is there.

    The same seed gives the same noise, and the noise of one level is that of another times a number. Raises NeecoError
    when `output` holds something else, and what writing captures raises.
    """
    recipe: dict[str, Any] = {"source": str(capture.root.absolute()), "transforms": transforms}
    recipe |= {"states_sha256": _digest(capture), "seed": seed, **asdict(derived)}
    if (begun := read_begun(output, RECIPE_FILE, resume=None, work="a capture made by ablate")) is not None:
        begun = asdict(Derived(derived.name)) | begun  # it may lack fields that are newer
        require_same(str(output / RECIPE_FILE), ((key, begun.get(key), recipe[key]) for key in recipe), REMEDY)
        if (output / "transforms.json").exists():
            return output
    changed = replace(capture, frames=_frames(capture, derived, seed))
    write_json(output / RECIPE_FILE, recipe)
    scored = [frame.name for frame in changed.frames if frame.split != "train"]
    for mask in (Path(folder) / f"{name}.png" for name in scored for folder in MASK_FOLDERS):
        if (capture.root / mask).is_file():
            write_atomically(output / mask, partial(shutil.copyfile, capture.root / mask))
    write_capture(changed, output)  # transforms.json comes last: that it exists says that all is there
    return output


def _digest(capture: Capture) -> str:
    """Tells recordings with other frames, splits or instrument states apart."""

    def states(frame: Frame) -> list[Any]:
        return [(name, s.pose.tolist(), dict(s.joints)) for name, s in frame.state.instruments.items()]

    rows = [[frame.name, frame.split, *states(frame)] for frame in capture.frames]
    return hashlib.sha256(json.dumps(rows).encode()).hexdigest()


def _frames(capture: Capture, derived: Derived, seed: int) -> tuple[Frame, ...]:
    """The frames of the derived capture, in recorded order."""
    train = [index for index, frame in enumerate(capture.frames) if frame.split == "train"]
    count = max(1, round(derived.train_share * len(train)))
    used = {train[place] for place in evenly_spaced(len(train), count)}
    rng = np.random.default_rng(seed)
    frames = []
    for index, frame in enumerate(capture.frames):
        if frame.split != "train":
            frames.append(frame)
        elif index in used:
            state = _with_noise(frame.state, derived.noise_mm, rng) if derived.noise_mm > 0 else frame.state
            frames.append(replace(frame, state=state))
    return tuple(_seen_from(frames[0], frame) for frame in frames) if derived.from_camera else tuple(frames)


def _seen_from(first: Frame, frame: Frame) -> Frame:
    """Return `frame` with the poses of its instruments relative to its camera, stated in the camera pose of `first`."""
    moved = first.camera.world_from_camera.double() @ frame.camera.world_from_camera.double().inverse()
    moved_poses = {
        name: InstrumentState(moved @ given.pose.double(), given.joints)
        for name, given in frame.state.instruments.items()
    }
    return replace(frame, state=replace(frame.state, instruments=moved_poses))


def _with_noise(state: State, level: float, rng: np.random.Generator) -> State:
    """Every instrument's pose off by about `level` mm and as much times NOISE_DEGREES_PER_MM, joints as they were."""
    moved = {}
    for name, given in state.instruments.items():
        turn, shift = rng.standard_normal(3), rng.standard_normal(3)
        pose = given.pose.double().clone()
        turned = rotation_from_vector(torch.from_numpy(np.radians(level * NOISE_DEGREES_PER_MM) * turn))
        pose[:3, :3] = turned @ pose[:3, :3]
        pose[:3, 3] += torch.from_numpy(level * shift)
        moved[name] = InstrumentState(pose, given.joints)
    return replace(state, instruments=moved)
