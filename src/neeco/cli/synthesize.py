"""`neeco synthesize`: a labelled data set of states that nobody recorded."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from neeco.settings import Device
from neeco.synthesis.settings import Format, Settings


@dataclass(frozen=True)
class Arguments:
    """Draw a labelled data set of states that nobody recorded."""

    run: tyro.conf.Positional[Path]
    """Run folder that `neeco train` wrote."""
    output: Path
    """Data set folder to write; must be empty or absent unless --resume."""
    settings: tyro.conf.OmitArgPrefixes[Settings]
    formats: tuple[Format, ...] = ("coco", "yolo")
    """Index files beside the plain images, masks, parts and depth."""
    resume: bool = False
    """Continue a data set begun with the same settings, or make it larger."""
    workers: int = 1
    """Processes that share the work; the files are the same for any number."""
    device: Device = "auto"


def run(arguments: Arguments) -> int:
    """Make the data set and say where it lies."""
    from neeco.cli._bars import counting
    from neeco.raster.devices import device_of
    from neeco.synthesis.dataset import synthesize
    from neeco.training.run import open_run

    settings = arguments.settings
    settings.check()
    opened = open_run(arguments.run, device_of(arguments.device))
    with opened as trained, counting("synthesize", settings.count) as advance:
        try:
            summary = synthesize(
                trained, arguments.output, settings, arguments.formats, arguments.resume, advance, arguments.workers
            )
        except KeyboardInterrupt:
            raise KeyboardInterrupt("what was drawn is kept; run the same command again with --resume") from None
    print(f"{summary.images} images in {summary.output} ({summary.made_now} drawn now); look at preview.png")
    for reason, times in summary.refused.items():
        print(f"refused {times} states: instrument {reason}")
    if summary.skipped:
        print(f"skipped given states {summary.skipped}: refused from every view tried")
    return 0
