"""Models trained on recorded and on synthetic images, tested on recorded frames; here the request, without heavy
imports."""

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

    Each model is trained from scratch in every condition, with the same number of steps, on the same labelled frames of
    a fold; test frames are from the other splits, and from other captures. Conditions are sums of: `real`, names of
    sets, `paste` (labelled instruments over other backgrounds), `strong` (augmentation of all images), `permuted` (sets
    with labels of other images, a control). The same command continues interrupted work; additional models, sets,
    conditions or folds are added. Needs the extra `downstream`.
    """

    capture: Annotated[Path, tyro.conf.Positional]
    """Capture folder, with true masks of the test frames."""
    output: Path
    """Folder to write; absent, empty, or of this experiment started earlier."""
    sets: tuple[str, ...] = ()
    """NAME=DATASET, folders written by `neeco synthesize`; NAME=DATASET:COUNT uses the first COUNT images."""
    models: tuple[str, ...] = ("unet",)
    """unet (a residual U-Net, masks), dfine (a small D-FINE, boxes)."""
    test: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """NAME=CAPTURE or CAPTURE, another recording with masks of the same kind of instrument to test on; repeatable."""
    num_real: tuple[str, ...] = ()
    """Numbers of labelled recorded training frames, or all; 0: sets alone. Default: 0 5 10 20 50 all."""
    folds: int = 5
    """Number of folds, each with different labelled frames and seed; intervals are over folds and frames."""
    conditions: tuple[str, ...] = ()
    """Training data. Default: real, real+strong, real+paste, SET, SET+strong, SET+real, SET+real+permuted."""
    backgrounds: Path | None = None
    """Folder of images without instruments to paste over. Default: the labelled frames, instruments inpainted."""
    labels: Path | None = None
    """Folder of masks of the recorded training frames, named as these. Default: the capture's ground truth."""
    classes: Literal["instrument", "parts"] = "instrument"
    """One class, or shaft, wrist and jaws."""
    splits: tuple[str, ...] = ()
    """Splits to test on. Default: all but train that have true masks."""
    steps: int | None = None
    """Optimisation steps of every training. Default: the model's."""
    size: int | None = None
    """Longer side of a model's input images in pixels; scores are at full resolution. Default: the model's."""
    batch: int | None = None
    """Images per step. Default: the model's."""
    workers: int = 1
    """Parallel trainings, which share the GPUs; RAY_ADDRESS names a Ray cluster (needs the extra `cluster`)."""
    transforms: str = "transforms.json"
    """Transforms file of the capture to read."""
    device: Device = "auto"
    kept_fold: ClassVar[int] = 0  # fold whose weights and predictions are stored
    default_counts: ClassVar[tuple[int, ...]] = (5, 10, 20, 50)  # of labelled frames trained on, besides all
    write_every_s: ClassVar[float] = 30.0  # minimum s between writing interim results, which are large
    parts_steps: ClassVar[float] = 2.5  # ratio of the steps for parts to the steps for one class

    @cached_property
    def image_sets(self) -> tuple[ImageSet, ...]:
        """The image sets. Raises NeecoError for invalid arguments."""
        from neeco.studies.downstream.samples import ImageSet

        return tuple(map(ImageSet.of, self.sets))

    @cached_property
    def tests(self) -> dict[str, Path]:
        """Other captures by name, by default the folder's name. Raises NeecoError for a duplicate name, or one that
        cannot be a file name."""
        tests: dict[str, Path] = {}
        for word in self.test:
            name, equals, place = word.partition("=")
            if not equals or Path(word).exists():
                name, place = Path(word).resolve().name, word
            if name in ("", *tests) or {*name} & {"/", "\\"}:
                raise NeecoError(
                    f"--test {name}: duplicate, or not a valid file name; choose another: --test NAME={place}"
                )
            tests[name] = Path(place)
        return tests

    @property
    def all_tests(self) -> list[str]:
        """Names of all tests: splits of the capture, and other captures."""
        return [*self.splits, *self.tests]

    def job_folder(self, model: str, condition: str, real: int, fold: int) -> Path:
        """Return the folder of one job."""
        return self.output / "jobs" / f"{model}-{condition}-real{real}-fold{fold}"
