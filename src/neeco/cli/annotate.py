"""`neeco annotate`: label recorded frames with the learned scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from neeco.base.settings import Device
from neeco.synthesis.settings import AS_RECORDED, DEFAULT_FORMATS, MIN_TRUST, ImageSettings, formats_help


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Label the frames of a recording with the learned scene, with poses fitted to each frame. Writes the trusted
    frames as a data set, and annotate.html with all frames, worst first."""

    run: tyro.conf.Positional[Path]
    """Run folder written by `neeco train`."""
    output: Path
    """Data set folder to write; must be empty or absent unless --resume."""
    capture: Path | None = None
    """Another recording of the same instruments over the same tissue. Default: the run's own."""
    min_trust: float = MIN_TRUST
    """Minimum trust of a written frame, 0 to 1, about the IoU estimated from the image; others are only listed."""
    formats: Annotated[tuple[str, ...], tyro.conf.arg(help=formats_help())] = DEFAULT_FORMATS
    images: tyro.conf.OmitArgPrefixes[ImageSettings] = AS_RECORDED
    class_names: tuple[str, ...] = ()
    """INSTRUMENT=CLASS: class names in the data set's formats, which instruments may share. Default: the instruments'
    names."""
    resume: bool = False
    """Continue a data set begun with the same settings."""
    force: bool = False
    """Use the run although its capture has changed since training, or its labels are doubtful."""
    device: Device = "auto"


def run(arguments: Arguments) -> int:
    """Annotate, write the page, and print where both are."""
    from neeco.capture.checks import read_checked
    from neeco.cli._progress import counting, resumable
    from neeco.raster.devices import device_of
    from neeco.report.run_page import write_annotated_page
    from neeco.synthesis.annotated import annotate_capture
    from neeco.training.run import open_gaussian_run

    arguments.images.check()
    device = device_of(arguments.device)
    with open_gaussian_run(arguments.run, "annotate", device, force=arguments.force) as trained:
        trained.require_trusted("annotate")
        capture = None if arguments.capture is None else read_checked(arguments.capture)
        with counting("annotate") as advance, resumable(arguments.output):
            passed = ("min_trust", "formats", "images", "class_names", "resume")
            options = {name: getattr(arguments, name) for name in passed}
            annotated = annotate_capture(trained, arguments.output, capture=capture, on_progress=advance, **options)
        page = write_annotated_page(annotated.output, annotated.records, annotated.capture, arguments.min_trust)
    count, omitted = len(annotated.records), len(annotated.records) - annotated.written
    out = f"; {omitted} left out with a trust below {arguments.min_trust:g}" if omitted else ""
    print(f"{annotated.written} of {count} frames in {annotated.output}{out}")
    print(f"frames are renumbered; `frame` in states.jsonl is the original name; all frames, worst first: {page}")
    return 0
