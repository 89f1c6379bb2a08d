"""Labels for the frames of another operation: a network proposes, the scene verifies, the network learns; here the
request, without heavy imports."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from neeco.base.errors import NeecoError
from neeco.base.settings import Device
from neeco.synthesis.settings import DEFAULT_FORMATS, formats_help


@dataclass(frozen=True, kw_only=True)
class AdaptRequest:
    """Label frames of another operation that show the run's instrument, without a label made by hand.

    A segmenter learns from rendered images and proposes masks for the frames; each proposal is cut out along the
    image's own edges, a state of the instrument is fitted to it, and the frame is accepted where image and rendering
    agree. Accepted frames are written as a data set of real images; the segmenter learns from them, too, and proposes
    again. adapt.json lists all frames, with the reasons of rejection.
    """

    run: Annotated[Path, tyro.conf.Positional]
    """Run folder written by `neeco train`, with method kinematic and a single instrument."""
    footage: Annotated[Path, tyro.conf.Positional]
    """Video, folder of images, or capture of the other operation; its states are not read."""
    output: Path
    """Data set folder to write; must be empty or absent unless --resume."""
    backgrounds: Path | None = None
    """Folder of images of the other operation without an instrument: half of the rendered images show them."""
    intrinsics: tuple[float, float, float, float] | None = None
    """FX FY CX CY of the frames, pixels. Default: the capture's, or else the run's camera."""
    masks: Path | None = None
    """Folder of masks of the frames by any other model, named as these; they replace the segmenter and its rounds."""
    model: str = "unet"
    """Segmenter that proposes: unet, or one of an installed package."""
    frames: int = 300
    """Maximum number of frames, evenly spaced over the footage."""
    count: int = 400
    """Number of rendered images to learn from."""
    rounds: int = 2
    """Number of times the segmenter is trained; from the second on, accepted frames are added."""
    steps: int | None = None
    """Optimisation steps of each training. Default: the model's."""
    min_overlap: float = 0.85
    """Minimum overlap (IoU) of rendering and image cut in an accepted frame."""
    formats: Annotated[tuple[str, ...], tyro.conf.arg(help=formats_help())] = DEFAULT_FORMATS
    seed: int = 0
    """Of the rendered images and the segmenter."""
    workers: int = 1
    """Number of processes that verify frames, here or on the cluster RAY_ADDRESS; the files do not depend on it."""
    resume: bool = False
    """Continue interrupted work with the same settings."""
    force: bool = False
    """Use the run although its capture has changed since training, or its labels are doubtful."""
    device: Device = "auto"

    def check(self) -> None:
        """Raise NeecoError naming an invalid option."""
        for name, least in (("frames", 2), ("count", 1), ("rounds", 1), ("steps", 1)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise NeecoError(f"--{name} must be at least {least} (got {value})")
        if not 0 <= self.min_overlap <= 1:
            raise NeecoError(f"--min-overlap: {self.min_overlap} is not a share; give 0 to 1")
        if self.intrinsics is not None and not (min(self.intrinsics[:2]) > 0):
            raise NeecoError("--intrinsics: FX and FY must be positive; give FX FY CX CY in pixels")
