"""`neeco synthesize`: a labelled data set of states that nobody recorded."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from neeco.cli._options import Device
from neeco.synthesis.settings import Format, LabelWay, Settings, Views


@dataclass(frozen=True)
class Arguments:
    """Draw a labelled data set of states that nobody recorded."""

    run: tyro.conf.Positional[Path]
    """Run folder that `neeco train` wrote."""
    output: Path
    """Data set folder to write; must be empty or absent unless --resume."""
    count: int
    """How many images."""
    formats: tuple[Format, ...] = ("coco", "yolo")
    """Index files beside the plain images, masks, parts and depth."""
    seed: int = Settings.seed
    """The same seed gives the same data set."""
    resume: bool = False
    """Continue a data set begun with the same settings, or make it larger."""
    states: str = Settings.states
    """inside or beyond the recorded range, grid, path:FILE.jsonl (between key states), or FILE.jsonl (as given)."""
    margin: float = Settings.margin
    """How far `beyond` goes, as a share of the recorded range at either end."""
    views: Views = Settings.views
    """Cameras: as recorded, near recorded ones, or in orbit about the tissue."""
    labels: LabelWay = Settings.labels
    """composited: what compositing says, occlusion-correct. threshold: the paper's, from what moves."""
    label_threshold: float | None = None
    """Share of a pixel that must be instrument (composited); the project's measured best when not given."""
    delta_thresholds: tuple[float, float, float] | None = None
    """Position (mm), rotation and scale (mm) above which a Gaussian has moved (threshold); found when not given."""
    speckle: float = Settings.speckle
    """Drop label pieces smaller than this share of the instrument's largest piece."""
    tissue_check: bool = Settings.tissue_check
    """Refuse states whose instrument enters the tissue, as far as the view shows it."""
    tissue_tolerance_mm: float | None = None
    """How far behind the tissue surface still counts as touching it; found from the recorded states when not given."""
    min_share: float = Settings.min_share
    """Refuse images with less than this share of instrument pixels."""
    tries: int = Settings.tries
    """How often to draw a state anew when it is refused."""
    device: Device = "auto"


def run(arguments: Arguments) -> int:
    """Make the data set and say where it lies."""
    from neeco.cli._bars import counting
    from neeco.raster.devices import device_of
    from neeco.synthesis.dataset import synthesize
    from neeco.training.run import open_run

    settings = Settings(**{name: getattr(arguments, name) for name in Settings.__dataclass_fields__})
    settings.check()
    opened = open_run(arguments.run, device_of(arguments.device))
    with opened as trained, counting("synthesize", arguments.count) as advance:
        try:
            summary = synthesize(trained, arguments.output, settings, arguments.formats, arguments.resume, advance)
        except KeyboardInterrupt:
            raise KeyboardInterrupt("what was drawn is kept; run the same command again with --resume") from None
    print(f"{summary.images} images in {summary.output} ({summary.made_now} drawn now); look at preview.png")
    for reason, times in summary.refused.items():
        print(f"refused {times} states: instrument {reason}")
    if summary.skipped:
        print(f"skipped given states {summary.skipped}: refused from every view tried")
    return 0
