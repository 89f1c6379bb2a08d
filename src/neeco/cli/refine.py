"""`neeco refine`: train a run again, with additional frames that it tracked."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

import tyro

from neeco.base.errors import NeecoError
from neeco.base.settings import Device


@dataclass(frozen=True)
class Arguments:
    """Train a run again with additional frames whose states it tracked, to learn sides of the instruments that only
    these frames show. Writes OUTPUT/capture, with the frames of both, and OUTPUT/run."""

    run: tyro.conf.Positional[Path]
    """Run folder written by `neeco train`, with method kinematic."""
    tracked: tyro.conf.Positional[tuple[Path, ...]]
    """Captures written by `neeco track` with this run, over its tissue."""
    output: Path
    """Folder to write; must be empty or absent unless --resume."""
    resume: bool = False
    """Continue interrupted work."""
    force: bool = False
    """Use the run although its capture has changed since training."""
    device: Device = "auto"


def run(arguments: Arguments) -> int:
    """Fit, merge and train; print the path of the run."""
    from neeco.cli._progress import Bars, resumable
    from neeco.raster.devices import device_of
    from neeco.tracking.refine import refine_run
    from neeco.training.run import open_gaussian_run

    if not arguments.tracked:
        raise NeecoError("refine: no captures given; add those written by `neeco track` after the run")
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
