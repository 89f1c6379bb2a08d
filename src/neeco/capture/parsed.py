"""What the readers share: what they hand on, where each frame was described, and paths inside the capture's folder."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path, PureWindowsPath

from neeco.capture.model import Frame, Instrument, PointCloud
from neeco.capture.problems import shown
from neeco.errors import NeecoError


@dataclass(frozen=True)
class Place:
    """Where a frame is described: file and field, for messages."""

    file: str
    field: str


@dataclass
class Parsed:
    """A capture as far as it could be read.

    Frames without image, split, time or states that could be read are left out (and reported); where only the camera is
    wrong they are kept, so that the rest of them can be checked.
    """

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
    without_camera: set[int] = field(default_factory=set)  # frames whose camera is wrong (reported) and a stand-in

    def with_cameras(self) -> Parsed:
        """The same without the frames whose camera is a stand-in."""
        rows = [row for row in range(len(self.frames)) if row not in self.without_camera]
        frames, places = [self.frames[row] for row in rows], [self.places[row] for row in rows]
        return replace(self, frames=frames, places=places, without_camera=set())


def inside(root: Path, folder: Path, text: str) -> Path:
    """The path `text`, taken relative to `folder`, which must lie inside `root` also after following symbolic links.

    Raises NeecoError (without naming the field: the caller does) when it is absolute, leads out or is no path at all.
    """
    if os.path.isabs(text) or PureWindowsPath(text).is_absolute():
        raise NeecoError(f"{shown(text)} is absolute; give a path relative to the capture's folder")
    try:
        path = Path(os.path.normpath(folder / text))
        outside = not path.resolve().is_relative_to(root.resolve())
    except (OSError, RuntimeError, ValueError):
        raise NeecoError(f"{shown(text)} is not a usable path; repair it") from None
    if outside:
        raise NeecoError(f"{shown(text)} leaves the capture's folder; copy the file into it and name it from there")
    return path


def relative_name(file: Path, root: Path) -> str:
    """How messages call a file of the capture."""
    return file.relative_to(root).as_posix() if file.is_relative_to(root) else file.name
