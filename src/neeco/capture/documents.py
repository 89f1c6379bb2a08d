"""Values of JSON and YAML files with their place, and reports of the problems found in them."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NoReturn, Self, TypeVar

import numpy as np

from neeco.base.errors import NeecoError, visible
from neeco.base.settings import Fault, Place, printable
from neeco.base.settings import key_name as key_name
from neeco.geometry.rotations import rigid_fault

T = TypeVar("T")
U = TypeVar("U")
MIN_CONDENSED = 3  # number of similar problems above which they are counted instead of listed
VARYING = re.compile(
    r"'(?:[^'\\]|\\.)*'|\S+\.(?:png|jpe?g)\b|[-+]?\d[\d.]*(?:e[-+]?\d+)?|\b(?:nan|inf)\b", re.IGNORECASE
)


@dataclass(frozen=True)
class Problem:
    """A fault of a file: its place, what is wrong there, and what to do about it."""

    severity: Literal["error", "warning"]
    file: str
    field: str
    message: str
    remedy: str
    contradicted: bool = False  # a warning: the images contradict what is recorded

    def __str__(self) -> str:
        place = f"{self.file}: {self.field}" if self.field else self.file
        return visible(f"{place}: {self.message}" + (f"; {self.remedy}" if self.remedy else ""))


def errors_only(problems: list[Problem]) -> list[Problem]:
    """The problems that make a capture unusable, in the order found."""
    return [problem for problem in problems if problem.severity == "error"]


def condensed(problems: Sequence[Problem]) -> list[Problem]:
    """Merge problems that differ only in numbers and quoted names into one with its count."""
    groups: dict[tuple[str, ...], list[Problem]] = {}
    for problem in problems:
        key = (VARYING.sub("#", part) for part in (problem.file, problem.field, problem.message, problem.remedy))
        groups.setdefault((problem.severity, *key), []).append(problem)
    merged = []
    for first, *similar in groups.values():
        many = len(similar) >= MIN_CONDENSED
        merged.append(replace(first, message=f"{first.message} (and {len(similar)} more like it)") if many else first)
        merged += [] if many else similar
    return merged


@dataclass
class ProblemReport:
    """Collects problems while a capture is read, so that all of them can be reported at once."""

    problems: list[Problem] = field(default_factory=list)

    def error(self, file: str, field: str, message: str, remedy: str = "") -> None:
        self.problems.append(Problem("error", file, field, message, remedy))

    def warning(self, file: str, field: str, message: str, remedy: str = "", contradicted: bool = False) -> None:
        self.problems.append(Problem("warning", file, field, message, remedy, contradicted))

    def raise_first(self, root: object) -> None:
        """Raise NeecoError with the first error, if there is one. `root`: the capture, named in the message."""
        errors = condensed(errors_only(self.problems))
        if not errors:
            return
        more = f" ({len(errors) - 1} more: run `neeco check {shlex.quote(str(root))}`)" if len(errors) > 1 else ""
        place = "" if errors[0].file == str(root) else f"{root}: "
        raise NeecoError(f"{place}{errors[0]}{more}")


def as_float(value: Any) -> float | None:
    """A JSON number as float (may be NaN or infinite), None for anything else; true and false are not numbers."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value)
    except OverflowError:
        return math.inf


@dataclass(frozen=True)
class Node(Place):
    """A value of a JSON or YAML file and its place. A failing reading raises Fault; within `tried` it is reported."""

    report: ProblemReport = field(default_factory=ProblemReport)

    def fail(self, message: str, remedy: str = "") -> NoReturn:
        """Raise Fault of this place."""
        raise Fault(self.field, f"{message}; {remedy}" if remedy else message)

    @contextmanager
    def blamed(self) -> Iterator[None]:
        """Convert the block's NeecoError, which names no place, to a Fault of this place."""
        try:
            yield
        except NeecoError as error:
            raise Fault(self.field, str(error)) from None

    def tried(self, read: Callable[..., T], *arguments: Any) -> T | None:
        """Return `read(self, *arguments)`; on failure, report the first fault and return None."""
        try:
            with self.blamed():
                return read(self, *arguments)
        except Fault as fault:
            self.at(None, fault.field).error(*str(fault).split("; ", 1))
            return None

    def error(self, message: str, remedy: str = "") -> None:
        """Report an error of this place."""
        self.report.error(self.file, self.field, message, remedy)

    def warning(self, message: str, remedy: str = "", contradicted: bool = False) -> None:
        """Report a warning of this place."""
        self.report.warning(self.file, self.field, message, remedy, contradicted)

    @property
    def reported(self) -> bool:
        """True if a problem of this place is reported already."""
        return any((problem.file, problem.field) == (self.file, self.field) for problem in self.report.problems)

    def has(self, key: str) -> bool:
        """Return True if the object has this key with a value other than null."""
        return isinstance(self.value, dict) and self.value.get(key) is not None

    def at(self, value: Any, field: str) -> Self:
        return type(self)(value, self.file, field, self.report)

    def items(self) -> list[Node]:
        """The elements of a list."""
        if not isinstance(self.value, list):
            self.fail(f"expected a list, found {printable(self.value)}")
        return [self.item(index) for index in range(len(self.value))]

    def members(self, *, optional: bool = False) -> dict[str, Node]:
        """The values of an object, by name. optional: none where there is nothing."""
        if optional and self.value is None:
            return {}
        if not isinstance(self.value, dict):
            self.fail(f"expected an object, found {printable(self.value)}")
        return {name: self.child(name) for name in self.value}

    def given(self, key: str, read: Callable[[Node], T], default: U) -> T | U:
        """Return `read` of the value under `key`; `default` if it is absent or null."""
        return read(self.child(key)) if self.has(key) else default

    def flag(self) -> bool:
        """True or false."""
        if not isinstance(self.value, bool):
            self.fail(f"expected true or false, found {printable(self.value)}", "correct it")
        return self.value

    def text(self, remedy: str = "") -> str:
        """A non-empty string."""
        if isinstance(self.value, str) and self.value.strip():
            return self.value
        self.fail(f"expected text, found {printable(self.value)}" if self.value != "" else "is empty", remedy)

    def number(self, above: float | None = None, least: float | None = None, below: float | None = None) -> float:
        """A finite number, within the bounds given."""
        value = as_float(self.value)
        if value is None:
            self.fail(f"expected a number, found {printable(self.value)}", "correct it")
        if not math.isfinite(value):
            self.fail(f"is {printable(self.value)}, not a finite number", "correct it")
        wrong = []
        wrong += [f"above {above:g}"] if above is not None and value <= above else []
        wrong += [f"{least:g} or more"] if least is not None and value < least else []
        wrong += [f"below {below:g}"] if below is not None and value >= below else []
        if wrong:
            self.fail(f"{value:g} is out of range", f"give a number {wrong[0]}")
        return value

    def integer(self, least: int) -> int:
        """A whole number."""
        value = self.number()
        if value != int(value) or value < least:
            self.fail(f"{value:g} is out of range", f"give a whole number, {least} or more")
        return int(value)

    def numbers(self, count: int, what: str, least: float | None = None) -> tuple[float, ...]:
        """Return a list of `count` finite numbers, none below `least`."""
        if not isinstance(self.value, list) or len(self.value) != count:
            self.fail(f"expected {count} numbers ({what}), found {printable(self.value)}", "correct it")
        return tuple(item.number(least=least) for item in self.items())

    def range(self, unit: str) -> tuple[float, float]:
        """A range: two numbers, the least first."""
        low, high = self.numbers(2, f"least and greatest, {unit}")
        if low >= high:
            self.fail(f"{low:g} is not below {high:g}", f"give the least first, in {unit}")
        return low, high

    def rigid(self) -> np.ndarray:
        """A rigid transform [4, 4] float64: a rotation in its corner and the row 0 0 0 1, which may be left out."""
        rows, wrong = self.value, ""
        if rows is None:
            wrong = "is missing"
        elif not isinstance(rows, list) or len(rows) not in (3, 4) or not all(isinstance(row, list) for row in rows):
            wrong = f"expected a 4x4 matrix, found {printable(rows)}"
        elif any(len(row) != 4 for row in rows):
            wrong = "expected a 4x4 matrix, found rows of another length"
        elif any(as_float(entry) is None for row in rows for entry in row):
            wrong = "expected a 4x4 matrix, found an entry that is not a number"
        if wrong:
            self.fail(wrong, "give four rows of four numbers")
        numbers = [[as_float(entry) for entry in row] for row in rows]
        matrix = np.array([*numbers, [0.0, 0.0, 0.0, 1.0]][:4], dtype=np.float64)
        if (fault := rigid_fault(matrix)) is not None:
            self.fail(*fault)
        return matrix
