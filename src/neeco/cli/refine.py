"""`neeco refine`: train a run again, with frames that were tracked by it."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

import tyro

from neeco.base.errors import NeecoError
from neeco.base.settings import Device


@dataclass(frozen=True)
class Arguments:
    """Train a run again with frames whose states were tracked by it, so that sides of the instruments that only they
    show become known. Writes OUTPUT/capture, the frames of both, and OUTPUT/run."""

    run: tyro.conf.Positional[Path]
    """Run folder that `neeco train` wrote, by method kinematic."""
    tracked: tyro.conf.Positional[tuple[Path, ...]]
    """Captures that `neeco track` made with it, over its tissue."""
    output: Path
    """Folder to write; must be empty or absent unless --resume."""
    resume: bool = False
    """Continue interrupted work."""
    force: bool = False
    """Use the run although its capture has changed since training."""
    device: Device = "auto"


def run(arguments: Arguments) -> int:
    """Fit, merge and train; print where the run is."""
    from neeco.cli._progress import Bars, resumable
    from neeco.raster.devices import device_of
    from neeco.tracking.refine import refine_run
    from neeco.training.run import open_gaussian_run

    if not arguments.tracked:
        raise NeecoError("refine: give the captures that `neeco track` made, after the run")
    device = device_of(arguments.device)
    with (
        open_gaussian_run(arguments.run, "refine", device, force=arguments.force) as opened,
        Bars() as bars,
        resumable(arguments.output),
    ):
        path = refine_run(
            opened,
            arguments.tracked,
            arguments.output,
            device=device,
            resume=arguments.resume,
            on_progress=lambda done, total: bars.stage("fitting recorded states", done, total),
            on_row=bars.training,
        )
        bars.end("training")
    print(f"finished: {path}  (next: neeco evaluate {shlex.quote(str(path))})")
    return 0
