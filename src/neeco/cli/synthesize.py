"""`neeco synthesize`: a labelled data set of states that nobody recorded."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from neeco.errors import NeecoError
from neeco.settings import Device
from neeco.synthesis.settings import DEFAULT_FORMATS, Settings, formats_help

# what is drawn of a scene that was seen from one place
VIEWS_OF_STILL = {
    "recorded": "the recorded ones",
    "perturbed": "within about a degree and a millimetre of the recorded ones",
}


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Draw a labelled data set of states that nobody recorded: of one run, or of one run's tissue under the instruments
    of others (--tissue, --instruments)."""

    run: Annotated[Path | None, tyro.conf.arg(metavar="RUN"), tyro.conf.Positional] = None
    """Run folder that `neeco train` wrote."""
    tissue: Path | None = None
    """Instead of RUN: the run whose tissue and light are drawn."""
    instruments: tuple[Path, ...] = ()
    """With --tissue: the runs whose instruments stand before it."""
    output: Path
    """Data set folder to write; must be empty or absent unless --resume."""
    settings: tyro.conf.OmitArgPrefixes[Settings]
    formats: Annotated[tuple[str, ...], tyro.conf.arg(help=formats_help())] = DEFAULT_FORMATS
    resume: bool = False
    """Continue a data set begun with the same settings, or make it larger."""
    workers: int = 1
    """Processes that share the work, here or on RAY_ADDRESS's cluster; the files are the same for any number."""
    device: Device = "auto"


def run(arguments: Arguments) -> int:
    """Make the data set and say where it lies."""
    from neeco.cli._progress import counting, resumable
    from neeco.raster.devices import device_of
    from neeco.synthesis.dataset import synthesize
    from neeco.training.run import load_run, open_gaussian_run

    settings = arguments.settings
    settings.check()
    run_path, instrument_runs = _runs(arguments)
    device = device_of(arguments.device)
    with (
        open_gaussian_run(run_path, "synthesize", device) as trained,
        counting("synthesize", settings.count) as advance,
    ):
        if trained.scene.recorded.still and settings.views in VIEWS_OF_STILL:
            print(f"the scope stood still: views are {VIEWS_OF_STILL[settings.views]}")
        others = [load_run(path, device).gaussians("synthesize") for path in instrument_runs]
        with resumable("what was drawn is kept; run the same command again with --resume"):
            summary = synthesize(
                trained,
                arguments.output,
                settings,
                arguments.formats,
                arguments.resume,
                on_progress=advance,
                workers=arguments.workers,
                instrument_runs=others,
            )
    print(f"{summary.images} images in {summary.output} ({summary.made_now} drawn now); look at preview.png")
    for reason, times in summary.refused.items():
        print(f"refused {times} states: instrument {reason}")
    if summary.skipped:
        print(f"skipped given states {summary.skipped}: refused from every view tried")
    return 0


def _runs(arguments: Arguments) -> tuple[Path, tuple[Path, ...]]:
    """The run that is drawn, and those whose instruments are drawn over its tissue."""
    if (arguments.run is None) == (arguments.tissue is None):
        raise NeecoError("synthesize: give a RUN, or --tissue RUN with --instruments RUN ...; one of the two")
    if (arguments.tissue is None) != (not arguments.instruments):
        raise NeecoError("--instruments: goes with --tissue RUN, and that with it; give both or neither")
    if arguments.run is not None:
        return arguments.run, ()
    assert arguments.tissue is not None
    return arguments.tissue, arguments.instruments
