"""`neeco track`: estimate instrument states in footage, from its images alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from neeco.base.settings import Device


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Estimate the states of a run's instruments in footage without recorded states, with the run's scene. Writes a
    capture of the trusted frames, and track.html with the results of all frames."""

    run: tyro.conf.Positional[Path]
    """Run folder written by `neeco train`, with method kinematic."""
    footage: tyro.conf.Positional[Path]
    """Capture with cameras; its states are not read."""
    output: Path
    """Capture folder to write; must be empty or absent unless --resume."""
    start: Literal["first", "none"] = "none"
    """first: start from the footage's approximate states of the first frame. none: no prior."""
    tissue: str = "run"
    """run: the footage shows the run's tissue, with cameras in the run's world. Otherwise the path of a run of method
    3dgs that learned the footage's tissue; OUTPUT/run then combines it with the instruments."""
    min_trust: float = 0.5
    """Minimum trust of a frame in the capture, 0 to 1. With --resume another value selects again."""
    resume: bool = False
    """Continue interrupted tracking."""
    force: bool = False
    """Use the run although its capture has changed since training."""
    device: Device = "auto"


def run(arguments: Arguments) -> int:
    """Track, and print the paths of the capture and the page."""
    from neeco.api import track
    from neeco.cli._progress import Bars, resumable

    with Bars() as bars, resumable(arguments.output):
        tracked = track(**vars(arguments), progress=bars.stage)
    print(f"{tracked.written} of {len(tracked.records)} frames in {tracked.output}; all of them: {tracked.page}")
    print(f"verdict: {tracked.verdict}")
    return 0
