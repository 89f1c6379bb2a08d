"""Captures as far as a reader could parse them, and the files that they name."""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path, PurePosixPath, PureWindowsPath

from neeco.base.errors import NeecoError
from neeco.base.files import follows_links
from neeco.base.plausible import Fault
from neeco.capture.documents import Node, Problem, printable
from neeco.capture.images import EXTENSIONS
from neeco.capture.model import Frame, Instrument, InstrumentState
from neeco.capture.points import PointCloud
from neeco.geometry.lens import Lens

NOWHERE = "put it there or correct the path"


@dataclass(kw_only=True)
class Parsed:
    """A partially parsed capture.

    Frames without readable image, split, time or states are left out (and reported); those with only a wrong camera are
    kept, so that the rest of them can be checked. `as_source`: parsed for conversion; then distorted images (with a
    lens model) and absent ones (listed as `absent`) are no errors.
    """

    root: Path = field(kw_only=False)
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
    is_endonerf: bool = False  # an EndoNeRF folder, whose masks are the tool's
    without_camera: set[int] = field(default_factory=set)  # frames with a placeholder, as their camera is wrong
    as_source: bool = False
    absent: list[Problem] = field(default_factory=list)

    def header(self, field: str) -> Node:
        """The place `field` of the file that describes the first frame."""
        return Node(None, self.places[0].file, field, self.places[0].report)

    def with_cameras(self) -> Parsed:
        """Return the capture without the frames that have a placeholder camera."""
        return self.of_rows([row for row in range(len(self.frames)) if row not in self.without_camera])

    def of_rows(self, rows: Sequence[int]) -> Parsed:
        """Return the same with the frames of these rows, in their order."""
        without = {index for index, row in enumerate(rows) if row in self.without_camera}
        frames, places = [self.frames[row] for row in rows], [self.places[row] for row in rows]
        return replace(self, frames=frames, places=places, without_camera=without)

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
    A link in the folder may lead out of it where the user says so (`follows_links`).
    """
    if os.path.isabs(text) or PureWindowsPath(text).is_absolute():
        raise NeecoError(f"{printable(text)} is absolute; give a path relative to the capture's folder")
    try:
        path = Path(os.path.normpath(folder / text))
        outside = not path.resolve().is_relative_to(root.resolve())
    except (OSError, RuntimeError, ValueError):
        raise NeecoError(f"{printable(text)} is not a usable path; repair it") from None
    if outside and path.is_relative_to(os.path.normpath(root)):
        if follows_links():
            return path
        raise NeecoError(
            f"{printable(text)} is a link, or lies in one, that leaves the capture's folder; copy its target "
            "there, or add --follow-links if you trust it"
        )
    if outside:
        raise NeecoError(f"{printable(text)} leaves the capture's folder; copy the file into it and name it from there")
    return path


def named_file(node: Node, folder: Path, root: Path, extensions: tuple[str, ...] = ()) -> Path:
    """The existing file inside the capture that a node names; `extensions` are tried on paths without one. Raises Fault
    and, for paths that lead out, NeecoError."""
    text = node.text()
    candidates = [inside(root, folder, text + extension) for extension in ("", *extensions)]
    if not (existing := [candidate for candidate in candidates if candidate.is_file()]):
        node.fail(*missing_file(folder, text))
    return existing[0]


def named_image(node: Node, folder: Path, parsed: Parsed, extensions: tuple[str, ...] = ()) -> Path | None:
    """`named_file` of a frame's image; None, and reported, without one. Of a source, one that is nowhere is counted,
    and no error."""
    if node.value is None:
        node.error("is missing", "name the frame's image")
        return None
    path, problems = node.tried(named_file, folder, parsed.root, extensions), node.report.problems
    if path is None and parsed.as_source and problems[-1].remedy == NOWHERE:
        parsed.absent.append(problems.pop())
    return path


def natural_order(name: str) -> list[tuple[int, int, str]]:
    """Key that sorts frame2 before frame10."""
    parts = re.split(r"(\d+)", name.lower())
    return [(1, int(part), "") if part.isdecimal() else (0, 0, part) for part in parts]


def instants(names: Sequence[str], lenses: Sequence[Hashable]) -> list[int] | None:
    """Return the rank in time of images by the numbers in their names; None if the names have different patterns.

    The same name in several folders is one instant unless two folders share a lens: cameras of a rig.
    """
    parts = [PurePosixPath(name.replace("\\", "/")) for name in names]
    folders: dict[str, set[Hashable]] = {}
    for part, lens in zip(parts, lenses, strict=True):
        folders.setdefault(str(part.parent), set()).add(lens)
    stems = {part.with_suffix("").name for part in parts}
    apart = sum(map(len, folders.values())) == len(set(lenses))
    rig = len(folders) > 1 and apart and len(stems) <= len(names) * 2 / (1 + len(folders))
    keys = [part.with_suffix("").name if rig else str(part.with_suffix("")) for part in parts]
    if len({re.sub(r"\d+", "0", key) for key in keys}) > 1:
        return None
    ranks = {key: rank for rank, key in enumerate(sorted(set(keys), key=natural_order))}
    return [ranks[key] for key in keys]


def relative_name(file: Path, root: Path) -> str:
    """Name of a file of the capture in messages."""
    return file.relative_to(root).as_posix() if file.is_relative_to(root) else file.name


def missing_file(folder: Path, text: str) -> Fault:
    """Return the fault of a path, relative to `folder`, without a file, and its remedy."""
    message, similar = f"no such file: {printable(text)}", similar_file(folder, text)
    if similar is None:
        return message, NOWHERE
    form = ", in another Unicode form or case" if _normal(similar) == _normal(text) else ""
    return message, f"{printable(similar)} is there{form}: correct the path"


def similar_file(folder: Path, text: str) -> str | None:
    """Find a file under `folder` that differs from a path in separators, case, Unicode form, image extension or folder.

    Relative to `folder`; None where there is none.
    """
    wanted = PurePosixPath(_normal(text.replace("\\", "/")))
    if not wanted.parts or ".." in wanted.parts:
        return None
    try:
        names = _names_under(folder, os.stat(folder).st_mtime_ns)
    except OSError:
        return None
    keys = (str(wanted), _without_extension(str(wanted)), wanted.name, _without_extension(wanted.name))
    return next((names[key] for key in keys if key in names), None)


@lru_cache(maxsize=1)
def _names_under(folder: Path, changed: int) -> dict[str, str]:
    """Files under `folder` by their normalised paths and names, also without an image's extension. `changed`: when,
    for the cache."""
    files = (entry.relative_to(folder) for entry in folder.rglob("*") if entry.is_file())
    names: dict[str, str] = {}
    for file in sorted(files, key=lambda file: (len(file.parts), file)):
        for name in (file.as_posix(), file.name):
            names.setdefault(_normal(name), file.as_posix())
            names.setdefault(_without_extension(_normal(name)), file.as_posix())
    return names


def _normal(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def _without_extension(name: str) -> str:
    return os.path.splitext(name)[0] if name.endswith(EXTENSIONS) else name
