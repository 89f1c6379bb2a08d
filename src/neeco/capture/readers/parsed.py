"""Partially parsed captures, and the files that they name."""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path, PurePosixPath, PureWindowsPath

from neeco.base.errors import NeecoError
from neeco.base.files import FOLLOW_LINKS
from neeco.capture.documents import Node, Problem, printable
from neeco.capture.images import EXTENSIONS
from neeco.capture.model import Frame, Instrument, InstrumentState
from neeco.capture.points import PointCloud
from neeco.geometry.lens import Lens

NOWHERE = "add the file or correct the path"


@dataclass(kw_only=True)
class Parsed:
    """A partially parsed capture.

    Frames without readable image, split, time or states are left out and reported. Frames with only an invalid camera
    are kept, so that their other data can be checked. as_source: parsed for conversion; then distorted images (with a
    lens model) and missing images (listed in `absent`) are not errors.
    """

    root: Path = field(kw_only=False)
    frames: list[Frame] = field(default_factory=list)
    places: list[Node] = field(default_factory=list)  # node of each frame
    instruments: tuple[Instrument, ...] = ()
    points: PointCloud | None = None  # None: not stated
    points_place: Node | None = None
    registered: bool = True
    timed: bool = True  # whether every frame states a time
    says_units: bool = False  # whether the file states its unit of length
    lens: Lens | None = None  # lens of the recording
    still: bool = False  # whether the cameras did not move
    is_endonerf: bool = False  # an EndoNeRF folder, whose masks show the tool
    without_camera: set[int] = field(default_factory=set)  # frames with a placeholder for an invalid camera
    as_source: bool = False
    absent: list[Problem] = field(default_factory=list)

    def header(self, field: str) -> Node:
        """Return the node `field` of the file that describes the first frame."""
        return Node(None, self.places[0].file, field, self.places[0].report)

    def with_cameras(self) -> Parsed:
        """Return the capture without the frames that have a placeholder camera."""
        return self.of_rows([row for row in range(len(self.frames)) if row not in self.without_camera])

    def of_rows(self, rows: Sequence[int]) -> Parsed:
        """Return the capture with only the frames of these rows, in their order."""
        without = {index for index, row in enumerate(rows) if row in self.without_camera}
        frames, places = [self.frames[row] for row in rows], [self.places[row] for row in rows]
        return replace(self, frames=frames, places=places, without_camera=without)

    def states_of(self, name: str) -> list[tuple[Node, InstrumentState]]:
        """Return (node of the state, state) of one instrument, for the frames that have it."""
        return [
            (place.child("instruments").item(list(frame.state.instruments).index(name)), frame.state.instruments[name])
            for frame, place in zip(self.frames, self.places, strict=True)
            if name in frame.state.instruments
        ]


def inside(root: Path, folder: Path, text: str) -> Path:
    """Return the path `text`, relative to `folder`, which must be inside `root` after resolving symbolic links.

    Raises NeecoError (the caller adds the field) if it is absolute, outside `root` or not a path. A link in the folder
    may point outside if the user allows it (`--follow-links`).
    """
    if os.path.isabs(text) or PureWindowsPath(text).is_absolute():
        raise NeecoError(f"{printable(text)} is absolute; give a path relative to the capture's folder")
    try:
        path = Path(os.path.normpath(folder / text))
        outside = not path.resolve().is_relative_to(root.resolve())
    except (OSError, RuntimeError, ValueError):
        raise NeecoError(f"{printable(text)} is not a usable path; repair it") from None
    if outside and path.is_relative_to(os.path.normpath(root)):
        if os.environ.get(FOLLOW_LINKS, "") not in ("", "0"):  # workers inherit it
            return path
        raise NeecoError(
            f"{printable(text)} is a link, or lies in one, that leaves the capture's folder; copy its target "
            "there, or add --follow-links if you trust it"
        )
    if outside:
        raise NeecoError(f"{printable(text)} leaves the capture's folder; copy the file into it and name it from there")
    return path


def named_file(node: Node, folder: Path, root: Path, extensions: tuple[str, ...] = ()) -> Path:
    """Return the existing file inside the capture that a node names; extensions: tried for paths without one. Raises
    Fault, and NeecoError for paths outside the capture."""
    text = node.text()
    candidates = [inside(root, folder, text + extension) for extension in ("", *extensions)]
    if not (existing := [candidate for candidate in candidates if candidate.is_file()]):
        message, similar = f"no such file: {printable(text)}", similar_file(folder, text)
        if similar is None:
            node.fail(message, NOWHERE)
        form = ", in another Unicode form or case" if _normal(similar) == _normal(text) else ""
        node.fail(message, f"{printable(similar)} exists{form}: correct the path")
    return existing[0]


def named_image(node: Node, folder: Path, parsed: Parsed, extensions: tuple[str, ...] = ()) -> Path | None:
    """Return `named_file` of a frame's image; None, and reported, if there is none. For `as_source`, a missing image is
    listed as absent instead of an error."""
    if node.value is None:
        node.error("is missing", "state the frame's image")
        return None
    path, problems = node.tried(named_file, folder, parsed.root, extensions), node.report.problems
    if path is None and parsed.as_source and problems[-1].remedy == NOWHERE:
        parsed.absent.append(problems.pop())
    return path


def natural_order(name: str) -> list[tuple[int, int, str]]:
    """Return a sort key that sorts frame2 before frame10."""
    parts = re.split(r"(\d+)", name.lower())
    return [(1, int(part), "") if part.isdecimal() else (0, 0, part) for part in parts]


def instants(names: Sequence[str], lenses: Sequence[Hashable]) -> list[int] | None:
    """Return the rank in time of images by the numbers in their names; None if the names have different patterns.

    Images of one name in several folders (cameras of a rig) have one rank, unless two folders share a lens.
    """
    parts = [PurePosixPath(name.replace("\\", "/")) for name in names]
    folders: dict[str, set[Hashable]] = {}
    for part, lens in zip(parts, lenses, strict=True):
        folders.setdefault(str(part.parent), set()).add(lens)
    stems = {part.with_suffix("").name for part in parts}
    distinct_lenses = sum(map(len, folders.values())) == len(set(lenses))
    rig = len(folders) > 1 and distinct_lenses and len(stems) <= len(names) * 2 / (1 + len(folders))
    keys = [part.with_suffix("").name if rig else str(part.with_suffix("")) for part in parts]
    if len({re.sub(r"\d+", "0", key) for key in keys}) > 1:
        return None
    ranks = {key: rank for rank, key in enumerate(sorted(set(keys), key=natural_order))}
    return [ranks[key] for key in keys]


def relative_name(file: Path, root: Path) -> str:
    """Return the name of a file of the capture for messages."""
    return file.relative_to(root).as_posix() if file.is_relative_to(root) else file.name


def similar_file(folder: Path, text: str) -> str | None:
    """Find a file under `folder` that differs from a path in separators, case, Unicode form, image extension or folder.

    Relative to `folder`; None if there is none.
    """
    path = PurePosixPath(_normal(text.replace("\\", "/")))
    if not path.parts or ".." in path.parts:
        return None
    try:
        names = _names_under(folder, os.stat(folder).st_mtime_ns)
    except OSError:
        return None
    keys = (str(path), _without_extension(str(path)), path.name, _without_extension(path.name))
    return next((names[key] for key in keys if key in names), None)


@lru_cache(maxsize=1)
def _names_under(folder: Path, changed: int) -> dict[str, str]:
    """Return files under `folder` by normalised path and name, also without an image's extension. changed: the folder's
    modification time, for the cache."""
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
