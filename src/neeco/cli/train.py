"""`neeco train`: learn a scene from a capture."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import tyro

from neeco.base.settings import Device


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Learn a scene from a capture's training frames."""

    capture: tyro.conf.Positional[Path]
    """Capture folder, or a transforms file in it."""
    output: Path
    """Run folder to write."""
    method: str | None = None
    """kinematic, nps (the paper), 3dgs, deformable-3dgs, 4dgs or nerfies; NAME+dta: with the paper's training
    adjustment. Default: kinematic."""
    iterations: int | None = None
    """Number of rendered training frames. Default: 6,000; less for fewer than 60 training frames (kinematic)."""
    batch_size: int | None = None
    """Frames per optimisation step, whose mean loss is minimised; values above 1 suit a GPU. Default: 1."""
    minutes: float | None = None
    """Time limit; the run is finished within it. Default: no limit."""
    device: Device = "auto"
    seed: int | None = None
    """The same seed gives the same scene on the same machine (without --minutes). Default: 0."""
    resume: bool = False
    """Continue an interrupted run in --output, with its original settings; other settings are rejected."""
    transforms: str | None = None
    """Transforms file of the capture to read. Default: transforms.json."""
    scale: float | None = None
    """Training resolution relative to the recorded images; smaller is faster and needs less memory. Default: 1."""
    joints: tuple[str, ...] | None = None
    """Joints that move parts. Default: those not determined by the pose."""
    max_tissue_gaussians: int | None = None
    """Maximum number of tissue Gaussians. Default: 20,000 for images of 320x256, more for larger ones."""
    max_instrument_gaussians: int | None = None
    """Maximum number of Gaussians per instrument. Default: 4,000 for images of 320x256, more for larger ones."""
    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Any other field of the training config, as NAME=VALUE (e.g. schedule.opacity_reset=inverse); repeatable."""


def run(args: Arguments) -> int:
    """Train with a progress bar; print the path of the run."""
    from neeco.cli._progress import Bars, duration, resumable
    from neeco.raster.devices import device_of
    from neeco.training.config import FLAGS, training_config
    from neeco.training.run import begun_config, resume_command
    from neeco.training.train import ProgressRow, train

    flags = {name: getattr(args, name) for name in FLAGS if name != "method"}
    begun = begun_config(args.output) if args.resume else None
    config = training_config(args.method, flags, args.set, begun)
    device, started = device_of(args.device), list[int]()  # the iteration of the first row

    def show(row: ProgressRow) -> None:
        if not row.note and not started:
            started.append(row.iteration)
            slow = " (a CUDA device is faster)" if device.type == "cpu" else ""
            remaining = row.seconds_left
            whole = "" if remaining is None else f", estimated total time {duration(row.seconds + remaining)}"
            view = f"view it: neeco view {shlex.quote(str(args.output))}"
            bars.training(replace(row, note=f"training on {device.type}{slow}{whole}; {view}"))
        bars.training(row)

    hint = f"continue with: {resume_command(args.capture, args.output)}"
    with Bars() as bars, resumable(args.output, hint):
        path = train(args.capture, args.output, config, device=device, resume=args.resume, progress=show)
        bars.end("training")
    print(f"finished: {path}  (next: neeco evaluate {shlex.quote(str(path))})")
    return 0


def explain(words: Sequence[str]) -> None:
    """Print the settings of the method named in `words`, as a table after the help text."""
    from rich.box import ROUNDED
    from rich.console import Console
    from rich.table import Column, Table
    from rich.text import Text

    from neeco.base.settings import described
    from neeco.scene.method_registry import DEFAULT, method_class, methods

    named = [word for before, word in pairwise(["", *words]) if before == "--method" or word.startswith("--method=")]
    method = method_class((named or [DEFAULT])[-1].removeprefix("--method=").partition("+")[0])
    title = f"settings of method {method.method}: --set deformation.NAME=VALUE"
    table = Table(Column(no_wrap=True), Column("default"), Column(), title=title, title_justify="left", box=ROUNDED)
    for row in described(method.Settings):
        table.add_row(*map(Text, row))
    console = Console(highlight=False, markup=False)
    console.print(table if table.rows else f"{title}: none")
    other_methods = ", ".join(name for name in methods() if name != method.method)
    console.print(f"of other methods: neeco train --method NAME --help ({other_methods})")
