"""What a downstream experiment is to find out, checked before the work: everything that can be known to fail."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from neeco.capture import Capture
from neeco.capture.check import read_checked
from neeco.errors import NeecoError
from neeco.experiments.downstream.conditions import (
    DEFAULT_EDGES,
    HELD_BACK_FROM,
    RESERVED,
    Condition,
    default_conditions,
    labelled_count,
    parse_condition,
)
from neeco.experiments.downstream.job import DownstreamJob, Teaching
from neeco.experiments.downstream.model import model_class
from neeco.experiments.downstream.samples import (
    drawn_samples,
    frame_size,
    has_labels,
    recorded_samples,
)
from neeco.experiments.study import check_output, check_workers
from neeco.raster.devices import device_of

SCHEMA = "neeco-downstream/1"
FILE = "downstream.json"
JOBS = "jobs"


@dataclass(frozen=True)
class DownstreamSpec:
    """What to find out. `conditions` None: the usual ones. `real`: counts of labelled frames as words, 0 for none.
    `weights`: files to begin from, by model."""

    teaching: Teaching  # its splits empty: all held-out ones with truth
    output: Path
    models: tuple[str, ...]
    real: tuple[str, ...]
    folds: int = 5
    conditions: tuple[str, ...] | None = None
    weights: Mapping[str, Path] = field(default_factory=dict)
    workers: int = 1


@dataclass(frozen=True)
class DownstreamPlan:
    """A checked specification, ready to work on."""

    spec: DownstreamSpec
    teaching: Teaching
    capture: Capture
    jobs: tuple[DownstreamJob, ...]
    images: Mapping[str, int]  # of each set
    labelled: int  # recorded training frames with a label
    size: tuple[int, int]  # width, height of the frames
    notes: tuple[str, ...]


def plan_downstream(spec: DownstreamSpec) -> DownstreamPlan:
    """Check everything that can be known before the work. Raises NeecoError for whatever cannot be taught or tested."""
    if spec.folds < 1:
        raise NeecoError(f"--folds: {spec.folds} is none at all; give at least 1")
    check_workers(spec.workers, device_of(spec.teaching.device, drawing=False))
    _check_models(spec)
    conditions = _conditions(spec)
    capture = read_checked(spec.teaching.capture, spec.teaching.transforms)
    teaching = replace(spec.teaching, splits=_splits(capture, spec.teaching.splits))
    size = frame_size(recorded_samples(capture, teaching.splits[0], teaching.classes))
    images = {}
    for data in teaching.sets:
        edges = {condition.edges for condition in conditions if data.name in condition.sets}
        for edge in sorted(edges) or [DEFAULT_EDGES]:
            images[data.name] = len(drawn_samples(data, teaching.classes, edge, size))
    counts, labelled = _counts(spec, teaching, capture, conditions)
    _check_models_for(spec, capture, size)
    _check_output(spec)
    jobs = _jobs(spec, teaching, conditions, counts)
    if not jobs:
        raise NeecoError("--real: leaves nothing to teach; add 0 for sets alone, or a number of labelled frames")
    for job in jobs:
        job.check()
    notes = tuple(_notes(spec, teaching, counts))
    return DownstreamPlan(spec, teaching, capture, jobs, images, labelled, size, notes)


def job_folder(output: Path, model: str, condition: str, real: int, fold: int) -> Path:
    """Where one job lies."""
    return output / JOBS / f"{model}-{condition}-real{real}-fold{fold}"


def _check_models(spec: DownstreamSpec) -> None:
    if not spec.models:
        raise NeecoError("--models: none is given; name at least one")
    for name in spec.models:
        kind = model_class(name)
        if need := kind.unmet():
            raise NeecoError(f"--models {name}: {need}")
        if name in spec.weights and not kind.accepts_weights:
            raise NeecoError(f"--weights {name}: this model takes none")
    for name, file in spec.weights.items():
        if name not in spec.models:
            raise NeecoError(f"--weights: {name!r} is not among --models {' '.join(spec.models)}")
        if not file.is_file():
            raise NeecoError(f"--weights {name}: {file}: no such file")
    teaching = spec.teaching
    for option, value in (("--steps", teaching.steps), ("--size", teaching.side), ("--batch", teaching.batch)):
        if value is not None and value < 1:
            raise NeecoError(f"{option}: {value} is none at all; give at least 1")


def _conditions(spec: DownstreamSpec) -> list[Condition]:
    names = [data.name for data in spec.teaching.sets]
    for name in names:
        if name in RESERVED or "+" in name or not name:
            raise NeecoError(f"--sets {name}: this name has a meaning of its own; call the set otherwise")
        if "/" in name or "\\" in name:
            raise NeecoError(f"--sets {name}: folders are named by it; call the set without / or \\")
    if len(set(names)) < len(names):
        raise NeecoError(f"--sets: a name stands twice in {' '.join(names)}; name each set differently")
    words = default_conditions(names) if spec.conditions is None else spec.conditions
    conditions = [parse_condition(word, names) for word in dict.fromkeys(words)]
    for condition in conditions:
        if condition.edges == "soft" and spec.teaching.classes == "parts":
            raise NeecoError(
                f"--conditions {condition.name}: soft/ says how much of a pixel is instrument, not of which part; "
                "use --classes instrument"
            )
    return conditions


def _splits(capture: Capture, asked: Sequence[str]) -> tuple[str, ...]:
    for split in asked:
        if split not in capture.splits:
            raise NeecoError(f"--splits: {capture.root} has no split {split!r}; it has {', '.join(capture.splits)}")
        if split == "train":
            raise NeecoError("--splits: train: what is taught is not tested; choose other splits")
        if not has_labels(capture, split):
            raise NeecoError(f"--splits: {split}: no frame of it has a true mask in {capture.root}; nothing to test on")
    held_out = [split for split in capture.splits if split != "train"]
    found = tuple(asked) or tuple(split for split in held_out if has_labels(capture, split))
    if not found:
        raise NeecoError(
            f"{capture.root}: no frame outside of split train has a true mask (truth/masks or reference_masks); "
            "nothing to test on"
        )
    return found


def _counts(
    spec: DownstreamSpec, teaching: Teaching, capture: Capture, conditions: Sequence[Condition]
) -> tuple[list[int], int]:
    """The counts of labelled frames, and how many there are."""
    for word in spec.real:
        labelled_count(word, 10**9)
    if not any(condition.real for condition in conditions) or set(spec.real) <= {"0"}:
        return [0] if "0" in spec.real else [], 0
    labelled = len(recorded_samples(capture, "train", teaching.classes, teaching.labels))
    return sorted({labelled_count(word, labelled) for word in spec.real}), labelled


def _check_models_for(spec: DownstreamSpec, capture: Capture, frame: tuple[int, int]) -> None:
    for name in spec.models:
        kind = model_class(name)
        size = spec.teaching.input_of(kind, frame)
        if kind.sees_too_little(size):
            raise NeecoError(
                f"--models {name}: it would see images of {size[0]}x{size[1]} px, too small for it; give a larger "
                "--size, or leave it out"
            )
        if kind.answers == "boxes" and len(capture.instruments) > 1:
            raise NeecoError(
                f"--models {name}: {capture.root}: labels do not tell the {len(capture.instruments)} "
                "instruments apart, so there is no box of each; use a model that answers with masks"
            )


def _check_output(spec: DownstreamSpec) -> None:
    """Raises NeecoError when `output` holds something else, or another capture's experiment."""
    output = spec.output
    if output.is_dir() and [entry.name for entry in output.iterdir() if not entry.name.startswith(".")] == [JOBS]:
        return  # stopped before its first result
    check_output(output, FILE, SCHEMA, spec.teaching.capture, "downstream experiment", "is about")


def _jobs(
    spec: DownstreamSpec, teaching: Teaching, conditions: Sequence[Condition], counts: Sequence[int]
) -> tuple[DownstreamJob, ...]:
    jobs = []
    for fold in range(spec.folds):  # the first fold of everything comes first: a look halfway sees all
        for model in spec.models:
            for condition in conditions:
                if condition.edges != DEFAULT_EDGES and model_class(model).answers == "boxes":
                    continue  # boxes have no soft edge: it would be the plain condition again
                for real in [count for count in counts if bool(count) == condition.real]:
                    folder = job_folder(spec.output, model, condition.name, real, fold)
                    jobs.append(DownstreamJob(teaching, model, condition, real, fold, folder, spec.weights.get(model)))
    return tuple(jobs)


def _notes(spec: DownstreamSpec, teaching: Teaching, counts: Sequence[int]) -> list[str]:
    notes = []
    if spec.folds < 3:
        notes.append("intervals of fewer than three folds are wide or absent; give --folds 5 before concluding")
    if few := [count for count in counts if 0 < count < HELD_BACK_FROM]:
        notes.append(
            f"{', '.join(map(str, few))} labelled frames: too few to hold some back; taught with them alone the last "
            "weights are taken, beside a set those that do best on drawn images"
        )
    if teaching.labels is not None:
        notes.append(f"labels of recorded training frames: {teaching.labels}; tests are scored by the capture's truth")
    return notes
