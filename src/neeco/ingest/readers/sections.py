"""Logs as recording.yaml states them, and the parsers of its values: types of fields of frozen dataclasses, which
`neeco.base.settings.read` reads."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

from neeco.base.settings import Fault, printable
from neeco.capture.documents import Node
from neeco.ingest.readers.names import FORMS, FRAMES, UNITS, canonical_unit, quaternion_form

Parser = Callable[[Node], Any]
_EULER = re.compile(r"(?!.?(.)\1)(?:[xyz]{3}|[XYZ]{3})")  # no axis twice in a row
MAX_NUMBER = 1e12  # of any key: more is a slip, and overflows what is computed from it


def text(node: Node) -> str:
    """Return a name, which YAML may have read as a whole number."""
    if isinstance(node.value, int) and not isinstance(node.value, bool):
        return str(node.value)
    return node.text("put it in quotes if it is a name")


def existing_file(node: Node) -> Path:
    """Return the path of an existing file or folder, relative to the file that names it."""
    name, file = text(node), Path(node.file)
    try:
        path = file.parent / Path(name).expanduser()
        exists = path.exists()
    except (OSError, ValueError, RuntimeError):
        exists = False
    if not exists:
        raise Fault(node.field, f"no such file: {printable(name, 120)}; correct it (relative to {file.name})")
    return path


def number(above: float | None = None, least: float | None = None, below: float = MAX_NUMBER) -> Parser:
    """Return the parser of a number within bounds."""
    return lambda node: node.number(above, least, below)


def integer(least: int) -> Parser:
    """Return the parser of a whole number."""
    return lambda node: node.integer(least)


def word(*names: str) -> Parser:
    """Return the parser of one of some names, in small letters."""

    def parse(node: Node) -> str:
        if text(node).lower() not in names:
            raise Fault(node.field, f"{printable(node.value)} is not known here; write one of {', '.join(names)}")
        return text(node).lower()

    return parse


def columns(*counts: int) -> Parser:
    """Return the parser of so many names of columns: a list or, for one, a name."""

    def parse(node: Node) -> tuple[str, ...]:
        items = node.value if isinstance(node.value, list) else [node.value]
        good = all(isinstance(item, str | int) and not isinstance(item, bool) for item in items)
        if not good or len(items) not in counts:
            wanted = "the name of a column" if counts == (1,) else f"{' or '.join(map(str, counts))} names of columns"
            raise Fault(node.field, f"expected {wanted}, found {printable(node.value)}; list them")
        if len({str(item) for item in items}) < len(items):
            raise Fault(node.field, "names a column twice; list different columns")
        return tuple(str(item) for item in items)

    return parse


def ranges(node: Node) -> tuple[tuple[int, int], ...]:
    """Return frame numbers and ranges such as "30-40", as (first, last)."""
    spans = []
    for item in node.value if isinstance(node.value, list) else [node.value]:
        match = re.fullmatch(r"\s*(\d{1,9})(?:\s*-\s*(\d{1,9}))?\s*", str(item))
        if match is None or int(match[2] or match[1]) < int(match[1]):
            raise Fault(node.field, f"{printable(item)} is no range of frames; write 12 or 30-40")
        spans.append((int(match[1]), int(match[2] or match[1])))
    return tuple(spans)


Name = Annotated[str, text]
File = Annotated[Path, existing_file]
Positive = Annotated[float, number(above=0.0)]
Count = Annotated[int, integer(1)]
Names = tuple[str, ...]


def _words(node: Node) -> Names:
    return tuple(str(item) for item in (node.value if isinstance(node.value, list) else [node.value]))


@dataclass(frozen=True, kw_only=True)
class NamedPoseColumns:
    """Columns of a log of poses, with at most one form of rotation."""

    time: Annotated[Names, columns(1, 2)] | None = None
    position: Annotated[Names, columns(3)] | None = None
    quaternion: Annotated[Names, columns(4)] | None = None
    quaternion_wxyz: Annotated[Names, columns(4)] | None = None
    quaternion_xyzw: Annotated[Names, columns(4)] | None = None
    rotation_vector: Annotated[Names, columns(3)] | None = None
    euler: Annotated[Names, columns(3)] | None = None
    rotation_matrix: Annotated[Names, columns(9)] | None = None
    matrix: Annotated[Names, columns(12, 16)] | None = None
    euler_convention: Name | None = None
    state: Name | None = None
    good: Annotated[Names, _words] = ("OK",)

    def __post_init__(self) -> None:
        forms = [form for form in ("quaternion", *FORMS) if getattr(self, form) is not None]
        if len(forms) > 1:
            raise Fault(forms[1], f"the rotation is already given by {forms[0]}; keep one of them")
        if forms and self.rotation[1] is None:
            raise Fault("quaternion", "the names do not say the order; use quaternion_wxyz or quaternion_xyzw")
        if self.matrix and self.position:
            raise Fault("position", "the 4x4 matrix holds the position already; remove it (or use rotation_matrix)")
        if (self.euler or self.euler_convention is not None) and not _EULER.fullmatch(self.euler_convention or ""):
            problem = "missing" if self.euler_convention is None else f"{printable(self.euler_convention)} is none"
            raise Fault("euler_convention", f"{problem}; name three axes in order: ZYX intrinsic, zyx extrinsic")

    @property
    def rotation(self) -> tuple[Names | None, str | None]:
        """The columns of the rotation, and their form."""
        if self.quaternion:
            return self.quaternion, quaternion_form(self.quaternion)
        return next(((getattr(self, form), form) for form in FORMS if getattr(self, form)), (None, None))


@dataclass(frozen=True, kw_only=True)
class NamedJointColumns:
    """Columns of a log of a joint."""

    time: Annotated[Names, columns(1, 2)] | None = None
    value: Annotated[Names, columns(1)] | None = None


def _unit(kind: str) -> Parser:
    """Return the parser of a unit."""

    def parse(node: Node) -> str:
        unit = canonical_unit(str(node.value))
        if unit not in UNITS[kind]:
            node.fail(f"{printable(node.value)} is not a unit of {kind}", f"use one of: {', '.join(UNITS[kind])}")
        return unit

    return parse


@dataclass(frozen=True)
class Units:
    """Units stated in a recording; None: the column names state the unit."""

    time: Annotated[str, _unit("time")] | None = None
    length: Annotated[str, _unit("length")] | None = None
    angle: Annotated[str, _unit("angle")] | None = None


@dataclass(frozen=True)
class LogColumns:
    """A log, or its file alone. clock: "" where the recording names none; stream: name, if the file has several;
    rate_hz: frame rate if the column of times counts frames, or of rows without times."""

    shorthand: ClassVar[str] = "file"
    file: File
    clock: Name = ""
    _: KW_ONLY
    stream: Name | None = None
    units: Units = field(default_factory=Units)
    rate_hz: Positive | None = None


@dataclass(frozen=True)
class PoseColumns(LogColumns):
    """A log of poses (tracker_from_sensor). columns: those that are None are recognised from the header; tool: another
    word for `stream`; frame: of the poses, one of `names.FRAMES` (CAMERA, BASE: a robot's base or a tracker's
    frame); None: as stated by the file, else BASE."""

    _: KW_ONLY
    columns: NamedPoseColumns = field(default_factory=NamedPoseColumns)
    tool: Name | None = None
    frame: Annotated[str, word(*FRAMES)] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "stream", self.stream or self.tool)


@dataclass(frozen=True)
class JointColumns(LogColumns):
    """A log of a joint. calibration: table from counts to angles (None: the column holds angles); limits: joint limits
    for the capture, rad."""

    _: KW_ONLY
    columns: NamedJointColumns = field(default_factory=NamedJointColumns)
    calibration: File | None = None
    limits: Annotated[tuple[float, float], lambda node: node.range("rad")] | None = None
