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
    """Capture with cameras, whose states are not looked at, or a video file; its cameras are found first, as by
    `neeco ingest`."""
    output: Path
    """Capture folder to write; must be empty or absent unless --resume."""
    start: Literal["first", "none"] = "none"
    """first: the first frame's states are about known, the footage says them. none: nothing is known."""
    tissue: Literal["run", "footage"] | None = None
    """run: the footage shows the run's tissue, its cameras in the run's world (default for a capture). footage: any
    tissue, cameras in any world; it is learned from the footage first, and OUTPUT/run becomes a run of the instruments
    over it (default for a video)."""
    min_trust: float = 0.5
    """Frames trusted less are left out of the capture: 0 to 1."""
    resume: bool = False
    """Go on with footage whose tracking was broken off."""
    device: Device = "auto"


def run(arguments: Arguments) -> int:
    """Track, write the page, and say where both lie."""
    from neeco.cli._progress import Bars, resumable
    from neeco.errors import NeecoError
    from neeco.ingest.footage_video import read_footage
    from neeco.raster.devices import device_of
    from neeco.report.track_page import write_track_page
    from neeco.tracking.track import track_footage
    from neeco.training.run import open_gaussian_run

    is_video = arguments.footage.is_file()
    if is_video and arguments.tissue == "run":
        raise NeecoError(
            f"--tissue: run: {arguments.footage} is a video, whose cameras are in no run's world; leave it out"
        )
    with open_gaussian_run(arguments.run, "track", device_of(arguments.device)) as trained:
        with (
            Bars() as bars,
            resumable("what was done is kept; run the same command again with --resume"),
        ):
            footage = read_footage(arguments.footage, arguments.output, trained.scene, arguments.resume, bars.stage)
            tracked = track_footage(
                trained,
                footage,
                arguments.output,
                start=arguments.start,
                tissue=arguments.tissue or ("footage" if is_video else "run"),
                min_trust=arguments.min_trust,
                resume=arguments.resume,
                on_progress=lambda done, total: bars.stage("track", done, total),
                on_stage=bars.stage,
            )
        page = write_track_page(tracked)
    tracked.require_trusted()
    print(f"{tracked.written} of {len(tracked.records)} frames in {tracked.output}; what was found in all: {page}")
    print(f"how good it is: {tracked.verdict}")
    return 0
