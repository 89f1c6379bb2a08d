"""`neeco render`: images, part ids and masks of a split's frames or of given states; or a video."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from neeco.base.errors import NeecoError
from neeco.base.settings import Device
from neeco.synthesis.settings import AS_RECORDED, MAX_IMAGES, ImageSettings


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Render frames of a capture, or states from a file, as images with part ids and masks, or as a video."""

    run: tyro.conf.Positional[Path]
    """Run folder written by `neeco train`."""
    output: Path | None = None
    """Folder to write to; images are written to OUTPUT/SPLIT or OUTPUT/states."""
    video: Path | None = None
    """Instead of --output: write the images as an MP4 with 25 images per second (needs the extra ingest)."""
    frames: int | None = None
    """With --video: number of images, evenly spaced along the path of states and cameras. Default: one per state."""
    capture: Path | None = None
    """Capture whose frames are rendered. Default: the run's own."""
    split: str = "test"
    """Split of the frames to render."""
    states: Path | None = None
    """Render these states (JSON lines) instead of a split."""
    images: tyro.conf.OmitArgPrefixes[ImageSettings] = AS_RECORDED
    force: bool = False
    """Use the run although its capture has changed since training."""
    device: Device = "auto"


def run(arguments: Arguments) -> int:
    """Render, and print the folder."""
    from neeco.cli._output import require_ending
    from neeco.cli._progress import counting
    from neeco.raster.devices import device_of
    from neeco.synthesis.rendered_views import (
        STATES_FOLDER,
        render,
        require_pyav,
        split_views,
        state_views,
        views_along,
        write_video,
    )
    from neeco.training.run import open_run

    arguments.images.check()
    if (arguments.output is None) == (arguments.video is None):
        raise NeecoError("render: give exactly one of --output FOLDER and --video FILE.mp4")
    if arguments.video is not None:
        require_ending("--video", arguments.video, ".mp4")
        require_pyav()
    if arguments.frames is not None and arguments.video is None:
        raise NeecoError("--frames: applies to --video only; remove it")
    if arguments.frames is not None and not 2 <= arguments.frames <= MAX_IMAGES:
        raise NeecoError(f"--frames must be 2 to {MAX_IMAGES:,} (got {arguments.frames})")
    with open_run(arguments.run, device_of(arguments.device), force=arguments.force) as trained:
        if arguments.states is not None:
            views, folder = state_views(trained.scene, arguments.states), STATES_FOLDER
        else:
            views, folder = split_views(trained, arguments.split, arguments.capture), arguments.split
        if arguments.frames is not None:
            views = views_along(views, arguments.frames)
        with counting("render", len(views)) as advance:
            if arguments.video is not None:
                write_video(trained.scene, views, arguments.video, advance, arguments.images)
                print(f"{len(views)} images in {arguments.video}")
                return 0
            assert arguments.output is not None
            render(trained.scene, views, arguments.output / folder, advance, arguments.images)
    print(f"{len(views)} images in {arguments.output / folder}")
    if not trained.scene.label_names:
        print(f"no part ids and masks: method {trained.scene.method!r} learns no labels")
    return 0
