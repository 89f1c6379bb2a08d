"""What the readers hand on: frames and where each was described."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from neeco.capture.model import Frame, Instrument, PointCloud


@dataclass(frozen=True)
class Place:
    """Where a frame is described: file and field, for messages."""

    file: str
    field: str


@dataclass
class Parsed:
    """A capture as far as it could be read. Frames that could not be read are left out (and reported)."""

    root: Path
    frames: list[Frame] = field(default_factory=list)
    places: list[Place] = field(default_factory=list)  # of each frame
    instruments: tuple[Instrument, ...] = ()
    points: PointCloud | None = None  # None: none named
    points_place: Place = Place("", "")
    registered: bool = True
    timed: bool = True  # the recording says when each frame was taken
    says_units: bool = False  # the file names its unit of length
    is_endonerf: bool = False  # an EndoNeRF folder, whose masks are the tool's
