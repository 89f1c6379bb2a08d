"""Captures as far as a reader could read them, and the files that they name."""

from __future__ import annotations

import os
import unicodedata
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path, PureWindowsPath

from neeco.capture.documents import Node, Problem, key_name, printable
from neeco.capture.images import EXTENSIONS
from neeco.capture.model import Frame, Instrument, InstrumentState
from neeco.capture.points import PointCloud
from neeco.errors import NeecoError
from neeco.files import placeholder
from neeco.geometry.lens import Lens
from neeco.plausible import Fault

CACHED = 16  # folders whose entries are looked through and remembered
NOWHERE = "put it there or correct the path"


@dataclass(frozen=True)
class ParsedTissue:
    """One of several tissues, as far as it could be read."""

    name: str
    points: PointCloud | None  # None: none named
    place: Node  # of the points


@dataclass
class Parsed:
    """A capture as far as it could be read.

    Frames without image, split, time or states that could be read are left out (and reported); where only the camera is
    wrong they stay, so that the rest of them can be checked. `as_source`: it is read to be converted; then distorted
    images (whose cameras say how) and absent ones (listed as `absent`) are no errors.
    """

    root: Path
    frames: list[Frame] = field(default_factory=list)
    places: list[Node] = field(default_factory=list)  # where each frame is described
    instruments: tuple[Instrument, ...] = ()
    points: PointCloud | None = None  # None: none named
    points_place: Node | None = None
    registered: bool = True
    timed: bool = True  # the recording says when each frame was taken
    says_units: bool = False  # the file names its unit of length
    lens: Lens | None = None  # through which it was recorded
    still: bool = False  # its cameras stood still
    tissues: list[ParsedTissue] = field(default_factory=list)
    over: str | None = None  # which of several tissues all of it is of
    is_endonerf: bool = False  # an EndoNeRF folder, whose masks are the tool's
    without_camera: set[int] = field(default_factory=set)  # frames with a placeholder, as their camera is wrong
    as_source: bool = False
    absent: list[Problem] = field(default_factory=list)

    def header(self, field: str) -> Node:
        """The place `field` of the file that describes the first frame."""
        field = field if self.over is None else f"{field} over {key_name(self.over)}"
        return Node(None, self.places[0].file, field, self.places[0].report)

    def with_cameras(self) -> Parsed:
        """The same without the frames whose camera is a placeholder."""
        rows = [row for row in range(len(self.frames)) if row not in self.without_camera]
        frames, places = [self.frames[row] for row in rows], [self.places[row] for row in rows]
        return replace(self, frames=frames, places=places, without_camera=set())

    def by_tissue(self) -> list[Parsed]:
        """What is of each tissue, whose world is its own, and has frames; all of it where there is one."""
        if not self.tissues:
            return [self]
        parts = []
        for tissue in self.tissues:
            rows = [row for row, frame in enumerate(self.frames) if frame.state.tissue == tissue.name]
            without = {index for index, row in enumerate(rows) if row in self.without_camera}
            frames, places = [self.frames[row] for row in rows], [self.places[row] for row in rows]
            part = replace(self, frames=frames, places=places, without_camera=without, tissues=[], over=tissue.name)
            parts += [replace(part, points=tissue.points, points_place=tissue.place)] if rows else []
        return parts

    def states_of(self, name: str) -> list[tuple[Node, InstrumentState]]:
        """(place of the state, state) of one instrument, over the frames that have it."""
        return [
            (place.child("instruments").item(list(frame.state.instruments).index(name)), frame.state.instruments[name])
            for frame, place in zip(self.frames, self.places, strict=True)
            if name in frame.state.instruments
        ]


def inside(root: Path, folder: Path, text: str) -> Path:
    """The path `text`, taken relative to `folder`, which must lie inside `root` also after following symbolic links.

    Raises NeecoError (without naming the field: the caller does) when it is absolute, leads out or is no path at all.
    """
    if os.path.isabs(text) or PureWindowsPath(text).is_absolute():
        raise NeecoError(f"{printable(text)} is absolute; give a path relative to the capture's folder")
    try:
        path = Path(os.path.normpath(folder / text))
        outside = not path.resolve().is_relative_to(root.resolve())
    except (OSError, RuntimeError, ValueError):
        raise NeecoError(f"{printable(text)} is not a usable path; repair it") from None
    if path.is_symlink() and (problem := placeholder(path)):
        raise NeecoError(f"{printable(text)} {problem}")
    if outside:
        raise NeecoError(f"{printable(text)} leaves the capture's folder; copy the file into it and name it from there")
    return path


def relative_name(file: Path, root: Path) -> str:
    """How messages call a file of the capture."""
    return file.relative_to(root).as_posix() if file.is_relative_to(root) else file.name


def missing_file(folder: Path, text: str) -> Fault:
    """What to say of a path, relative to `folder`, at which there is no file."""
    message, found = f"no such file: {printable(text)}", similar_file(folder, text)
    if found is None:
        return message, NOWHERE
    if _normal(found) == _normal(text):
        form = (
            "in another Unicode form (macOS decomposes accents)" if found.lower() != text.lower() else "in other case"
        )
        return message, f"{printable(found)} is there, {form}: correct the path"
    return message, f"{printable(found)} is there: correct the path"


def similar_file(folder: Path, text: str) -> str | None:
    """A file under `folder` that differs from a path in separators, case, Unicode form, image extension or folder.

    Relative to `folder`; None where there is none.
    """
    parts = [part for part in text.replace("\\", "/").split("/") if part not in ("", ".")]
    if not parts or ".." in parts:
        return None
    place: Path | None = folder
    for part in parts:
        place = None if place is None else _entry(place, part)
    if place is None or not place.is_file():  # the same name in another folder
        try:
            folders = _folders(folder, os.stat(folder).st_mtime_ns)
        except OSError:
            return None
        named = (_entry(other, parts[-1]) for other in folders)
        place = next((entry for entry in named if entry is not None and entry.is_file()), None)
    return None if place is None else place.relative_to(folder).as_posix()


def _entry(folder: Path, name: str) -> Path | None:
    try:
        entries = _entries(folder, os.stat(folder).st_mtime_ns)
    except OSError:
        return None
    found = entries.get(name) or entries.get(_normal(name)) or entries.get(_without_extension(_normal(name)))
    return None if found is None else folder / found


@lru_cache(maxsize=1)
def _folders(folder: Path, changed: int) -> list[Path]:
    """The folder and the first folders in it. `changed`: when, for the cache."""
    return [folder, *sorted(entry for entry in folder.iterdir() if entry.is_dir())][:CACHED]


@lru_cache(maxsize=CACHED)
def _entries(folder: Path, changed: int) -> dict[str, str]:
    """A folder's entries by their names, normalised names, and those without an image's extension. `changed`: when,
    for the cache."""
    names = sorted(os.listdir(folder))
    plain = {_without_extension(_normal(name)): name for name in names if name.endswith(EXTENSIONS)}
    return plain | {_normal(name): name for name in names} | {name: name for name in names}


def _normal(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def _without_extension(name: str) -> str:
    return os.path.splitext(name)[0] if name.endswith(EXTENSIONS) else name
