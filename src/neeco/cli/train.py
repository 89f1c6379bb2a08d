"""`neeco train`: learn a scene from a capture."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import tyro

from neeco.base.settings import Device


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Learn a scene from a capture's training frames."""

    capture: tyro.conf.Positional[Path]
    """Capture folder (or a transforms file in one)."""
    output: Path
    """Run folder to write."""
    method: str | None = None
    """kinematic, nps (the paper), 3dgs, deformable-3dgs, 4dgs or nerfies; NAME+dta: with the paper's training
    adjustment. Default: kinematic."""
    iterations: int | None = None
    """Frames rendered and learned from. Default: 6,000, with fewer than 60 training frames less (kinematic)."""
    batch_size: int | None = None
    """Frames between two optimisation steps, whose mean loss is minimised; more than 1 are for a GPU. Default: 1."""
    minutes: float | None = None
    """Stop in time with a finished run. Default: no limit."""
    device: Device = "auto"
    seed: int | None = None
    """The same seed gives the same scene on the same machine (without --minutes). Default: 0."""
    resume: bool = False
    """Continue an interrupted run in --output, under the settings it was started with; others are refused."""
    transforms: str | None = None
    """Which transforms file of the capture to read. Default: transforms.json."""
    scale: float | None = None
    """Share of the recorded images' size to learn at: less for a quick run or little memory. Default: 1."""
    joints: tuple[str, ...] | None = None
    """Joints that move parts. Default: those that the pose does not already explain."""
    max_tissue_gaussians: int | None = None
    """Most Gaussians of the tissue. Default: 20,000 for images of 320x256, more for larger ones."""
    max_instrument_gaussians: int | None = None
    """Most Gaussians of each instrument. Default: 4,000 for images of 320x256, more for larger ones."""
    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Any other field of the training config, as NAME=VALUE (e.g. schedule.opacity_reset=inverse); repeatable."""


def run(args: Arguments) -> int:
    """Train with a progress bar; print where the run lies."""
    from neeco.cli._progress import train_with_progress
    from neeco.raster.devices import device_of
    from neeco.training.config import FLAGS, training_config
    from neeco.training.run import begun_config

    flags = {name: getattr(args, name) for name in FLAGS if name != "method"}
    begun = begun_config(args.output) if args.resume else None
    config = training_config(args.method, flags, args.set, begun)
    path = train_with_progress(args.capture, args.output, config, device_of(args.device), resume=args.resume)
    print(f"finished: {path}  (next: neeco evaluate {shlex.quote(str(path))})")
    return 0


def explain(words: Sequence[str]) -> None:
    """Print the settings of the method that `words` name, a table behind `--help`."""
    from neeco.cli._output import print_settings
    from neeco.scene.method_registry import DEFAULT, method_class, methods

    named = [word for before, word in pairwise(["", *words]) if before == "--method" or word.startswith("--method=")]
    method = method_class((named or [DEFAULT])[-1].removeprefix("--method=").partition("+")[0])
    other_methods = ", ".join(name for name in methods() if name != method.method)
    print_settings(
        f"settings of method {method.method}: --set deformation.NAME=VALUE",
        method.Settings,
        f"of other methods: neeco train --method NAME --help ({other_methods})",
    )
