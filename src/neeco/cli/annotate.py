"""`neeco annotate`: the recorded frames, labelled by the scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from neeco.base.settings import Device
from neeco.synthesis.settings import AS_RECORDED, DEFAULT_FORMATS, MIN_TRUST, ImageSettings, formats_help


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Label the frames of a recording by the scene, poses fitted to each; writes those that can be trusted as a data
    set, and annotate.html: all of them, worst first."""

    run: tyro.conf.Positional[Path]
    """Run folder that `neeco train` wrote."""
    output: Path
    """Data set folder to write; must be empty or absent unless --resume."""
    capture: Path | None = None
    """Another recording of the same instruments over the same tissue. Default: the run's own."""
    min_trust: float = MIN_TRUST
    """Frames trusted less are listed, not written: 0 to 1, about the overlap (IoU) that the image speaks for."""
    formats: Annotated[tuple[str, ...], tyro.conf.arg(help=formats_help())] = DEFAULT_FORMATS
    images: tyro.conf.OmitArgPrefixes[ImageSettings] = AS_RECORDED
    class_names: tuple[str, ...] = ()
    """INSTRUMENT=CLASS: names of classes in the data set's formats, which instruments may share. Default: those of the
    instruments."""
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
            annotated = annotate_capture(
                trained,
                arguments.output,
                capture=capture,
                min_trust=arguments.min_trust,
                formats=arguments.formats,
                images=arguments.images,
                class_names=arguments.class_names,
                resume=arguments.resume,
                on_progress=advance,
            )
        page = write_annotated_page(annotated.output, annotated.records, annotated.capture, arguments.min_trust)
    count, omitted = len(annotated.records), len(annotated.records) - annotated.written
    out = f"; {omitted} trusted less than {arguments.min_trust:g}: left out" if omitted else ""
    print(f"{annotated.written} of {count} frames in {annotated.output}{out}")
    print(f"numbered anew; field frame of states.jsonl has the capture's name; worst first: {page}")
    return 0
