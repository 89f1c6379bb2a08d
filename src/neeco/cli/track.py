"""`neeco track`: the states of instruments in footage, from its images alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from neeco.settings import Device


@dataclass(frozen=True)
class Arguments:
    """Find the run's instruments in footage whose states nobody recorded, by the run's own scene; writes a capture of
    the frames that can be trusted, and track.html: what was found in all of them."""

    run: tyro.conf.Positional[Path]
    """Run folder that `neeco train` wrote, by method kinematic."""
    footage: tyro.conf.Positional[Path]
    """Capture with cameras in the run's world; states in it are not looked at."""
    output: Path
    """Capture folder to write; must be empty or absent unless --resume."""
    start: Literal["first", "none"] = "none"
    """first: the first frame's states are about known, the footage says them. none: nothing is known."""
    min_trust: float = 0.5
    """Frames trusted less are left out of the capture: 0 to 1."""
    resume: bool = False
    """Go on with footage whose tracking was broken off."""
    device: Device = "auto"


def run(arguments: Arguments) -> int:
    """Track, write the page, and say where both lie."""
    from neeco.capture.reader import read_capture
    from neeco.cli._progress import counting, resumable
    from neeco.raster.devices import device_of
    from neeco.report.track_page import write_track_page
    from neeco.tracking.track import track_footage
    from neeco.training.run import open_run

    with open_run(arguments.run, device_of(arguments.device)) as trained:
        footage = read_capture(arguments.footage)
        with (
            counting("track") as advance,
            resumable("what was done is kept; run the same command again with --resume"),
        ):
            tracked = track_footage(
                trained,
                footage,
                arguments.output,
                start=arguments.start,
                min_trust=arguments.min_trust,
                resume=arguments.resume,
                on_progress=advance,
            )
        page = write_track_page(tracked)
    tracked.require_trusted()
    print(f"{tracked.written} of {len(tracked.records)} frames in {tracked.output}; what was found in all: {page}")
    return 0
