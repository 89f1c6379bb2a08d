"""The options that state a recording without a recording.yaml, for the command line and Python alike."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import tyro

from neeco.base.settings import Place, faults_in, read


@dataclass(frozen=True, kw_only=True)
class IngestRequest:
    """A recording: files that state it, or a video, logs and what is known of them."""

    source: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """recording.yaml, or several of one instrument for one capture; or a folder in another format to convert
    (nerfstudio, Blender, COLMAP, EndoNeRF); with --init, a recording's folder or file."""
    video: Path | None = None
    """Video file, or a folder of images."""
    fps: float | None = None
    """Frames per second, where the video does not say or is wrong. Default: the video's."""
    instrument: Path | None = None
    """CSV log of the instrument's tracker."""
    laparoscope: Path | None = None
    """CSV log of the laparoscope's tracker; it puts the cameras into the tracker's frame, in mm."""
    shaft_diameter: float | None = None
    """Shaft's diameter, mm, of a rigid instrument that nothing tracked: it is found in the video (instead of
    --instrument)."""
    joint: Annotated[
        tuple[tuple[str, Path, Path | None], ...],
        tyro.conf.UseAppendAction,
        tyro.conf.arg(metavar="NAME LOG CALIBRATION"),
    ] = ()
    """Joint sensor: its name, its log and its calibration (counts and angles), as CSV. May be given several times."""
    intrinsics: tuple[float, float, float, float] | None = None
    """FX FY CX CY in pixels. Default: estimated, with distortion."""
    calibration: Path | None = None
    """Intrinsics from a file instead: OpenCV/ROS YAML or nerfstudio JSON."""
    sync: Path | None = None
    """JSON with clock offsets (t_log = t_video + offset). Default: found from the images."""
    frames: int | None = None
    """How many frames to keep, spread over states and views. Default: at most 400."""

    @classmethod
    def of(cls, **values: Any) -> IngestRequest:
        """Return a request with `values` by its fields' names. Raises NeecoError for one that does not fit."""
        with faults_in(""):
            request: IngestRequest = read(cls, Place(values), "ingest")
            return request

    @property
    def options(self) -> list[str]:
        """The options that state a recording and are given, as the command line spells them."""
        names = (item.name for item in fields(IngestRequest) if getattr(self, item.name) != item.default)
        return [f"--{name.replace('_', '-')}" for name in names if name != "source"]
