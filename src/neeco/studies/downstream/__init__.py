"""Models trained on recorded and on synthetic images, tested on recorded frames; the request for it, which imports
nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import tyro

from neeco.base.errors import NeecoError
from neeco.base.settings import Device

if TYPE_CHECKING:
    from neeco.studies.downstream.samples import ImageSet


@dataclass(frozen=True, kw_only=True)
class DownstreamRequest:
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
    kept_fold: ClassVar[int] = 0  # whose weights and predictions are kept
    default_counts: ClassVar[tuple[int, ...]] = (5, 10, 20, 50)  # of labelled frames trained on, besides all
    write_every_s: ClassVar[float] = 30.0  # least s between two writings of the results so far, which are large
    parts_steps: ClassVar[float] = 2.5  # ratio of the steps for parts to the steps for one class

    @cached_property
    def image_sets(self) -> tuple[ImageSet, ...]:
        """The sets. Raises NeecoError for words that cannot be understood."""
        from neeco.studies.downstream.samples import ImageSet

        return tuple(map(ImageSet.of, self.sets))

    @cached_property
    def tests(self) -> dict[str, Path]:
        """Other captures by name; one without a name goes by that of its folder. Raises NeecoError for a name that
        stands twice or cannot be that of a file."""
        tests: dict[str, Path] = {}
        for word in self.test:
            name, equals, place = word.partition("=")
            if not equals or Path(word).exists():
                name, place = Path(word).resolve().name, word
            if name in ("", *tests) or {*name} & {"/", "\\"}:
                raise NeecoError(
                    f"--test {name}: is a split's name or no file name; choose another: --test NAME={place}"
                )
            tests[name] = Path(place)
        return tests

    @property
    def all_tests(self) -> list[str]:
        """Names of what is tested on: splits of the own capture, and other captures."""
        return [*self.splits, *self.tests]

    def job_folder(self, model: str, condition: str, real: int, fold: int) -> Path:
        """Return the folder of one job."""
        return self.output / "jobs" / f"{model}-{condition}-real{real}-fold{fold}"
