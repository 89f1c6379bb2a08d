"""`neeco synthesize`: render a labelled data set of unrecorded instrument states."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from neeco.base.errors import NeecoError, counted
from neeco.base.settings import Device
from neeco.synthesis.settings import DEFAULT_FORMATS, Settings, formats_help

# by `views`, for a scene that was recorded from one viewpoint
VIEWS_OF_STILL = {
    "recorded": "the recorded ones",
    "perturbed": "within about a degree and a millimetre of the recorded ones",
    "rolled": "the recorded ones, rolled about the optical axis; tissue beyond the recorded images is in ignore/",
}


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Render a labelled data set of unrecorded instrument states: of one run, or of one run's tissue with instruments
    of other runs (--tissue, --instruments)."""

    run: Annotated[Path | None, tyro.conf.arg(metavar="RUN"), tyro.conf.Positional] = None
    """Run folder written by `neeco train`."""
    tissue: Path | None = None
    """Instead of RUN: the run whose tissue and light are rendered."""
    instruments: tuple[Path, ...] = ()
    """With --tissue: the runs whose instruments are rendered."""
    output: Path
    """Data set folder to write; must be empty or absent unless --resume."""
    settings: tyro.conf.OmitArgPrefixes[Settings]
    formats: Annotated[tuple[str, ...], tyro.conf.arg(help=formats_help())] = DEFAULT_FORMATS
    resume: bool = False
    """Continue or extend a data set begun with the same settings."""
    workers: int = 1
    """Number of processes, here or on the cluster RAY_ADDRESS; the files do not depend on it."""
    push_to_hub: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Upload the complete data set with its card to this repository (owner/name) of the Hugging Face Hub, private when
    new; needs the extra hub, and an account (`hf auth login`)."""
    force: bool = False
    """Use the run although its labels are doubtful."""
    device: Device = "auto"


def run(arguments: Arguments) -> int:
    """Write the data set and print its path."""
    from neeco.api import synthesize
    from neeco.cli._progress import Bars, resumable
    from neeco.synthesis.writers.hub import check_hub, push_to_hub

    if arguments.push_to_hub is not None:
        check_hub(arguments.push_to_hub)
    if (arguments.run is None) == (arguments.tissue is None):
        raise NeecoError("synthesize: give either a RUN, or --tissue RUN with --instruments RUN ...")
    if (arguments.tissue is None) != (not arguments.instruments):
        raise NeecoError("--instruments: requires --tissue RUN and vice versa; give both or neither")
    settings, first = arguments.settings, arguments.run or arguments.tissue
    assert first is not None
    passed = ("instruments", "formats", "resume", "workers", "device", "force")
    options = {name: getattr(arguments, name) for name in passed} | vars(settings)
    with Bars() as bars, resumable(arguments.output):
        made = synthesize(first, arguments.output, progress=bars.stage, **options)
    if made.still and settings.views in VIEWS_OF_STILL:
        print(f"the scope was still: views are {VIEWS_OF_STILL[settings.views]}")
    print(f"{made.images} images in {made.output} ({made.made_now} rendered now); see {made.output / 'preview.png'}")
    for reason, times in made.refused.items():
        print(f"refused {counted(times, 'state')}: instrument {reason}")
    if made.skipped:
        print(f"skipped given states {made.skipped}: refused from every view tried")
    if arguments.push_to_hub is not None:
        print(f"uploaded to {push_to_hub(made.output, arguments.push_to_hub)}")
    return 0
