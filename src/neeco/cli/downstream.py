"""`neeco downstream`: the benefit of synthetic images for models tested on recorded frames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from neeco.base.errors import NeecoError
from neeco.base.settings import Device, name_and_value
from neeco.cli._output import print_outcome

if TYPE_CHECKING:
    from neeco.studies.downstream.experiment import DownstreamSettings
    from neeco.studies.downstream.samples import ImageSet


@dataclass(frozen=True, kw_only=True)
class Downstream:
    """Train detectors and segmenters on recorded and on synthetic images, and test them on recorded frames.

    Each model is trained from scratch in every condition, with as many steps, on the same labelled frames of a fold;
    tests are frames of the other splits, and of other captures. Conditions are sums of words: `real`, names of sets,
    `paste` (the labelled instruments over other backgrounds), `strong` (augmentation of everything), `permuted` (sets
    with labels of other images, a control). The same command continues interrupted work; with more models, sets,
    conditions or folds it adds them. Needs the extra `downstream`.
    """

    capture: Annotated[Path, tyro.conf.Positional]
    """Capture folder, with true masks of the frames to test on."""
    output: Path
    """Folder to write; absent, empty, or of this experiment begun earlier."""
    sets: tuple[str, ...] = ()
    """NAME=DATASET, folders that `neeco synthesize` wrote; NAME=DATASET:COUNT takes its first COUNT images."""
    models: tuple[str, ...] = ("unet",)
    """unet (a residual U-Net, masks), dfine (a small D-FINE, boxes)."""
    test: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """NAME=CAPTURE or CAPTURE, another recording with masks of the same kind of instrument to test on; repeatable."""
    num_real: tuple[str, ...] = ()
    """How many recorded training frames are labelled: numbers or all; 0: sets alone. Default: 0 5 10 20 50 all."""
    folds: int = 5
    """Each takes other labelled frames and another seed; intervals are over folds and frames."""
    conditions: tuple[str, ...] = ()
    """Training data. Default: real, real+strong, real+paste, SET, SET+strong, SET+real, SET+real+permuted."""
    backgrounds: Path | None = None
    """Folder of images without an instrument to paste over. Default: the labelled frames, instruments filled in."""
    labels: Path | None = None
    """Folder of masks named as the frames, for the recorded training frames. Default: the capture's truth."""
    classes: Literal["instrument", "parts"] = "instrument"
    """One class, or shaft, wrist and jaws."""
    splits: tuple[str, ...] = ()
    """Splits to test on. Default: all but train that have true masks."""
    steps: int | None = None
    """Optimisation steps of every training. Default: the model's own."""
    size: int | None = None
    """Longer side in pixels of a model's input images; scores are at full size. Default: the model's own."""
    batch: int | None = None
    """Images in a step. Default: the model's own."""
    workers: int = 1
    """Trainings at once, which share the GPUs; RAY_ADDRESS names a Ray cluster (needs the extra `cluster`)."""
    transforms: str = "transforms.json"
    """Which transforms file of the capture to read."""
    device: Device = "auto"


def run(args: Downstream) -> int:
    """Train and test with progress bars; print tables, findings and where the files are; 1 when a training failed."""
    from neeco.cli._progress import Bars
    from neeco.report.downstream_page import write_downstream_report
    from neeco.studies.downstream.experiment import plan_downstream, run_downstream
    from neeco.studies.downstream.results import failed_jobs, tables_of

    with Bars() as bars:
        plan = plan_downstream(_settings(args))
        experiment = run_downstream(plan, bars.job)
        bars.stage("report", 0, 1)
        page = write_downstream_report(plan, experiment)
        bars.stage("report", 1, 1)
    return print_outcome(
        {"results": f"{args.output}/: downstream.csv, .json", "report": page},
        tables_of(experiment),
        sentences=experiment["findings"],
        notes=experiment["notes"],
        failed=failed_jobs(experiment),
        runs=f"{len(experiment['jobs'])} trainings",
    )


def _settings(args: Downstream) -> DownstreamSettings:
    """The study that these words describe. Raises NeecoError for sets and tests that cannot be understood."""
    from neeco.studies.downstream.experiment import DownstreamSettings

    tests: dict[str, Path] = {}
    for word in args.test:  # NAME=CAPTURE, or a capture that goes by its folder's name
        name, equals, place = word.partition("=")
        if not equals or Path(word).exists():
            name, place = Path(word).resolve().name, word
        if name in tests:
            raise NeecoError(f"--test {name}: is a split's name or no file name; choose another: --test NAME={place}")
        tests[name] = Path(place)
    values = vars(args) | {
        "sets": tuple(_data_set(word) for word in args.sets),
        "models": tuple(dict.fromkeys(args.models)),
        "num_real": tuple(dict.fromkeys(args.num_real)) or None,
        "tests": tests,
        "conditions": args.conditions or None,
    }
    del values["test"]
    return DownstreamSettings(**values)


def _data_set(word: str) -> ImageSet:
    """`NAME=DATASET` or `NAME=DATASET:COUNT`; a folder whose name ends so is the folder."""
    from neeco.studies.downstream.samples import ImageSet

    name, place = name_and_value("--sets", word, "kinematic=dataset")
    folder, colon, count = place.rpartition(":")
    if not colon or not count.isdecimal() or Path(place).exists():
        return ImageSet(name, Path(place))
    if int(count) < 1:
        raise NeecoError(f"--sets {word}: the number of images must be at least 1 (got {count})")
    return ImageSet(name, Path(folder), int(count))
