"""`neeco track`: the states of instruments in footage, from its images alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from neeco.base.settings import Device


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Find the run's instruments in footage whose states nobody recorded, by the run's own scene; writes a capture of
    the frames that can be trusted, and track.html: what was found in all of them."""

    run: tyro.conf.Positional[Path]
    """Run folder that `neeco train` wrote, by method kinematic."""
    footage: tyro.conf.Positional[Path]
    """Capture with cameras, whose states are not read."""
    output: Path
    """Capture folder to write; must be empty or absent unless --resume."""
    start: Literal["first", "none"] = "none"
    """first: the footage states the first frame's states roughly. none: nothing is known."""
    tissue: str = "run"
    """run: the footage shows the run's tissue, its cameras in the run's world. The path of a run of method 3dgs that
    learned the footage's tissue, where that is another; OUTPUT/run becomes a run of the instruments over it."""
    min_trust: float = 0.5
    """Frames trusted less are left out of the capture: 0 to 1. With --resume another value chooses anew."""
    resume: bool = False
    """Continue interrupted tracking."""
    force: bool = False
    """Use the run although its capture has changed since training."""
    device: Device = "auto"


def run(arguments: Arguments) -> int:
    """Track, and print where the capture and the page are."""
    from neeco.api import track
    from neeco.cli._progress import Bars, resumable

    with Bars() as bars, resumable(arguments.output):
        tracked = track(**vars(arguments), progress=bars.stage)
    print(f"{tracked.written} of {len(tracked.records)} frames in {tracked.output}; all of them: {tracked.page}")
    print(f"verdict: {tracked.verdict}")
    return 0
