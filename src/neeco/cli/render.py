"""`neeco render`: images, part ids and masks of a split's frames or of given states."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from neeco.settings import Device
from neeco.synthesis.settings import AS_RECORDED, ImageSettings


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Render frames of a capture, or states from a file, with part ids and masks."""

    run: tyro.conf.Positional[Path]
    """Run folder that `neeco train` wrote."""
    output: Path
    """Folder to write to; pictures go into OUTPUT/SPLIT or OUTPUT/states."""
    capture: Path | None = None
    """Capture whose frames are rendered. Default: the run's own."""
    split: str = "test"
    """Which frames."""
    states: Path | None = None
    """Render these states (JSON lines) instead of a split."""
    images: tyro.conf.OmitArgPrefixes[ImageSettings] = AS_RECORDED
    device: Device = "auto"


def run(arguments: Arguments) -> int:
    """Render, and print the folder."""
    from neeco.cli._progress import counting
    from neeco.raster.devices import device_of
    from neeco.synthesis.rendered_views import STATES_FOLDER, render, split_views, state_views
    from neeco.training.run import open_run

    arguments.images.check()
    with open_run(arguments.run, device_of(arguments.device)) as trained:
        if arguments.states is not None:
            views, folder = state_views(trained.scene, arguments.states), arguments.output / STATES_FOLDER
        else:
            views, folder = split_views(trained, arguments.split, arguments.capture), arguments.output / arguments.split
        with counting("render", len(views)) as advance:
            rendered = render(trained.scene, views, folder, advance, arguments.images)
    print(f"{rendered.images} images in {rendered.folder}")
    if not rendered.labelled:
        print(f"no part ids and masks: method {trained.scene.method!r} learns no labels")
    return 0
