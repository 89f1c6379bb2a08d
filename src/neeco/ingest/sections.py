"""Keys of recording.yaml, each read with its file and place so that mistakes are told exactly."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from neeco.capture.documents import Node, RaisingReport, printable
from neeco.errors import NeecoError
from neeco.ingest.columns import EULER, FORMS, MATRIX, JointColumns, PoseColumns, Units, quaternion_form
from neeco.ingest.units import KINDS, canonical_unit

_EULER = re.compile(r"^(?!.?(.)\1)(?:[xyz]{3}|[XYZ]{3})$")  # no axis twice in a row
LARGEST = 1e12  # number that any key may hold: more is a slip, and overflows what is computed of it


def close_match(name: str, names: Iterable[str]) -> str | None:
    """The name that a misspelt one probably means."""
    matches = difflib.get_close_matches(name, list(names), n=1, cutoff=0.6)
    return matches[0] if matches else None


class Section:
    """A mapping in a file: what is absent reads as None, what is wrong raises NeecoError, as keys other than `keys`
    do."""

    def __init__(self, file: Path, place: str, value: Any, keys: tuple[str, ...]) -> None:
        self.file, self.place = file, place
        self.node = Node(value, str(file), place, RaisingReport())
        if not isinstance(value, dict):
            self.node.error(f"expected keys such as `{keys[0]}:`, found {printable(value)}", "write them as key: value")
        self.value: dict[str, Any] = value
        for key in value:
            if key not in keys:
                likely = close_match(str(key), keys)
                hint = f"did you mean {likely}?" if likely else f"the keys here are {', '.join(keys)}"
                raise self.error(printable(key) if not isinstance(key, str) else key, f"unknown key; {hint}")

    def error(self, key: str, message: str) -> NeecoError:
        return NeecoError(" ".join(f"{self.file}: {self.at(key)}: {message}".split()))

    def at(self, key: str) -> str:
        """Where a key of this section stands in its file."""
        return ".".join(part for part in (self.place, key) if part)

    def section(self, key: str, keys: tuple[str, ...]) -> Section:
        """The mapping under a key; empty when absent."""
        value = self.value.get(key)
        return Section(self.file, self.at(key), {} if value is None else value, keys)

    def text(self, key: str, required: bool = False) -> str | None:
        """A name; YAML makes whole numbers of some."""
        if not self.node.has(key):
            if required:
                raise self.error(key, "missing; give it")
            return None
        value = self.value[key]
        if isinstance(value, int) and not isinstance(value, bool):
            return str(value)
        return self.node.child(key).text("put it in quotes if it is a name")

    def path(self, key: str, required: bool = False) -> Path | None:
        """An existing file or folder, relative to this file."""
        text = self.text(key, required)
        if text is None:
            return None
        try:
            path = self.file.parent / Path(text).expanduser()
            found = path.exists()
        except (OSError, ValueError, RuntimeError):
            found = False
        if not found:
            raise self.error(
                key, f"no such file: {printable(text, 120)}; correct the path (relative to {self.file.name})"
            )
        return path

    def number(
        self, key: str, above: float | None = None, least: float | None = None, below: float = LARGEST
    ) -> float | None:
        return self.node.child(key).number(above, least, below) if self.node.has(key) else None

    def integer(self, key: str, least: int) -> int | None:
        return self.node.child(key).integer(least) if self.node.has(key) else None

    def range(self, key: str, unit: str) -> tuple[float, float] | None:
        """Least and greatest of something."""
        return self.node.child(key).range(unit) if self.node.has(key) else None

    def names(self, key: str, counts: tuple[int, ...]) -> tuple[str, ...] | None:
        """Names of columns, as a list or, for one, alone."""
        value = self.value.get(key)
        if value is None:
            return None
        items = value if isinstance(value, list) else [value]
        good = all(isinstance(item, str | int) and not isinstance(item, bool) for item in items)
        if not good or len(items) not in counts:
            wanted = "the name of a column" if counts == (1,) else f"{' or '.join(map(str, counts))} names of columns"
            raise self.error(key, f"expected {wanted}, found {printable(value)}; list them")
        if len({str(item) for item in items}) < len(items):
            raise self.error(key, "names a column twice; list different columns")
        return tuple(str(item) for item in items)

    def ranges(self, key: str) -> tuple[tuple[int, int], ...]:
        """Frame numbers and ranges such as "30-40", as (first, last)."""
        value = self.value.get(key)
        if value is None:
            return ()
        found = []
        for item in value if isinstance(value, list) else [value]:
            match = re.fullmatch(r"\s*(\d{1,9})(?:\s*-\s*(\d{1,9}))?\s*", str(item))
            if match is None or int(match[2] or match[1]) < int(match[1]):
                raise self.error(key, f"{printable(item)} is no range of frames; write 12 or 30-40")
            found.append((int(match[1]), int(match[2] or match[1])))
        return tuple(found)


def pose_columns(parent: Section, key: str, value: Any, clock: str) -> PoseColumns:
    """A log of poses: a file's name, or a mapping. Raises NeecoError."""
    section, file = _log(parent, key, value)
    keys = ("time", "position", "quaternion", *FORMS, "euler_convention", "state", "good")
    columns = section.section("columns", keys)
    forms = [form for form in ("quaternion", *FORMS) if columns.value.get(form) is not None]
    if len(forms) > 1:
        raise columns.error(forms[1], f"the rotation is already given by {forms[0]}; keep one of them")
    form, rotation = None, None
    if forms:
        rotation = columns.names(forms[0], FORMS.get(forms[0], (4,)))
        assert rotation is not None
        form = forms[0] if forms[0] in FORMS else quaternion_form(rotation)
        if form is None:
            raise columns.error("quaternion", "the names do not say the order; use quaternion_wxyz or quaternion_xyzw")
    if form == MATRIX and columns.value.get("position") is not None:
        raise columns.error("position", "the 4x4 matrix holds the position already; remove it (or use rotation_matrix)")
    convention = columns.text("euler_convention")
    if convention is not None and (
        not _EULER.match(convention) or convention[0] == convention[1] or convention[1] == convention[2]
    ):
        raise columns.error(
            "euler_convention", f"{printable(convention)} is none; three axes: XYZ intrinsic, xyz extrinsic"
        )
    if form == EULER and convention is None:
        raise columns.error("euler_convention", "missing; name the axes in order: ZYX intrinsic, zyx extrinsic, ...")
    good = columns.value.get("good")
    goods = tuple(str(item) for item in (good if isinstance(good, list) else [good])) if good is not None else ("OK",)
    return PoseColumns(
        file, section.text("clock") or clock, columns.names("time", (1, 2)), columns.names("position", (3,)), rotation,
        form, convention, columns.text("state"), goods, _units(section), section.number("rate_hz", above=0.0),
    )  # fmt: skip


def joint_columns(parent: Section, key: str, value: Any, clock: str, poses: PoseColumns | None) -> JointColumns:
    """A log of a joint: a file's name, or a mapping. In the file of the poses it shares their clock. Raises
    NeecoError."""
    section, file = _log(parent, key, value, ("calibration", "limits"))
    if poses is not None and file == poses.path:
        clock = poses.clock
    columns = section.section("columns", ("time", "value"))
    names = columns.names("value", (1,))
    return JointColumns(
        file, section.text("clock") or clock, columns.names("time", (1, 2)), names[0] if names else None,
        _units(section), section.number("rate_hz", above=0.0), section.path("calibration"),
        section.range("limits", "rad"),
    )  # fmt: skip


def _log(parent: Section, key: str, value: Any, more: tuple[str, ...] = ()) -> tuple[Section, Path]:
    """What the recording says of one log, and the log's file. more: keys that only this kind of log has."""
    value = value if isinstance(value, dict) else {"file": value}
    section = Section(parent.file, parent.at(key), value, ("file", "clock", "columns", "units", "rate_hz", *more))
    file = section.path("file", required=True)
    assert file is not None
    return section, file


def _units(section: Section) -> Units:
    given = section.section("units", tuple(KINDS))
    found: dict[str, str | None] = {}
    for kind, units in KINDS.items():
        text = given.text(kind)
        found[kind] = None if text is None else canonical_unit(text)
        if found[kind] is not None and found[kind] not in units:
            raise given.error(kind, f"{printable(text)} is no unit of {kind}; use {', '.join(units)}")
    return Units(found["time"], found["length"], found["angle"])
