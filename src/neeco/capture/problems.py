"""What can be wrong with a capture: problems, the report that collects them, and JSON nodes that know their place."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from neeco.errors import NeecoError

RIGID_TOLERANCE = 2e-3  # of R^T R - I; JSON with three decimals passes, a scale of 1.001 passes, a shear does not


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong: which file and field, what is wrong there, and what to do about it."""

    severity: Literal["error", "warning"]
    file: str
    field: str
    message: str
    remedy: str

    def __str__(self) -> str:
        place = f"{self.file}: {self.field}" if self.field else self.file
        return f"{place}: {self.message}" + (f"; {self.remedy}" if self.remedy else "")


def errors_only(problems: list[Problem]) -> list[Problem]:
    """The problems that make a capture unusable, in the order found."""
    return [problem for problem in problems if problem.severity == "error"]


@dataclass
class Report:
    """Collects problems while a capture is read, so that all of them can be told at once."""

    problems: list[Problem] = field(default_factory=list)

    def error(self, file: str, field: str, message: str, remedy: str = "") -> None:
        self.problems.append(Problem("error", file, field, message, remedy))

    def warning(self, file: str, field: str, message: str, remedy: str = "") -> None:
        self.problems.append(Problem("warning", file, field, message, remedy))

    def raise_first(self, root: object) -> None:
        """Raise NeecoError with the first error, if there is one. `root`: the capture, named in the message."""
        errors = errors_only(self.problems)
        if not errors:
            return
        more = f" ({len(errors) - 1} more: run `neeco check {root}`)" if len(errors) > 1 else ""
        place = "" if errors[0].file == str(root) else f"{root}: "
        raise NeecoError(f"{place}{errors[0]}{more}")


def shown(value: Any, limit: int = 60) -> str:
    """A value from a file, as one short printable piece of text."""
    if isinstance(value, dict | list):
        return f"{'an object' if isinstance(value, dict) else 'a list'} of {len(value)}"
    if isinstance(value, int) and abs(value) >= 10**20:
        return "a huge integer"
    text = repr(value)
    return text if len(text) <= limit else text[: limit - 3] + "..."


def key_name(key: str) -> str:
    """A JSON key as messages write it."""
    return key if key.isidentifier() else f"[{shown(key)}]"


@dataclass(frozen=True)
class Node:
    """A JSON value and where it lies. Readings that fail report one error and return None."""

    value: Any
    file: str
    field: str
    report: Report

    def error(self, message: str, remedy: str = "") -> None:
        self.report.error(self.file, self.field, message, remedy)

    def warning(self, message: str, remedy: str = "") -> None:
        self.report.warning(self.file, self.field, message, remedy)

    def has(self, key: str) -> bool:
        """Whether the object has this key with a value other than null."""
        return isinstance(self.value, dict) and self.value.get(key) is not None

    def child(self, key: str) -> Node:
        """The value under `key` (None when absent)."""
        path = f"{self.field}.{key_name(key)}" if self.field else key_name(key)
        value = self.value.get(key) if isinstance(self.value, dict) else None
        return Node(value, self.file, path, self.report)

    def items(self) -> Iterator[Node]:
        """The elements of a list; reports an error and yields nothing when this is not a list."""
        if not isinstance(self.value, list):
            self.error(f"expected a list, found {shown(self.value)}")
            return
        for index, value in enumerate(self.value):
            yield Node(value, self.file, f"{self.field}[{index}]", self.report)

    def is_object(self) -> bool:
        """Whether this is a JSON object; reports an error otherwise."""
        if isinstance(self.value, dict):
            return True
        self.error(f"expected an object, found {shown(self.value)}")
        return False

    def text(self) -> str | None:
        """A non-empty string."""
        if isinstance(self.value, str) and self.value.strip():
            return self.value
        self.error(f"expected text, found {shown(self.value)}" if self.value != "" else "is empty")
        return None

    def number(self) -> float | None:
        """A finite number."""
        value = as_float(self.value)
        if value is None:
            self.error(f"expected a number, found {shown(self.value)}")
        elif not math.isfinite(value):
            self.error(f"is {value}, not a finite number")
            value = None
        return value

    def rigid(self) -> np.ndarray | None:
        """A rigid transform: [4, 4] float64 with a rotation in its corner and 0 0 0 1 below."""
        matrix = self.matrix()
        if matrix is None:
            return None
        if not np.isfinite(matrix).all():
            self.error("contains NaN or infinity", "drop the frame or repair its pose")
            return None
        if np.abs(matrix).max() > 1e9:
            self.error("has entries beyond 1e9", "repair the pose; lengths are millimetres")
            return None
        return self._check_rigid(matrix)

    def matrix(self) -> np.ndarray | None:
        """Any 4x4 matrix of numbers (a 3x4 one gets the row 0 0 0 1), as float64 [4, 4]; may hold NaN."""
        rows = self.value
        if not isinstance(rows, list) or len(rows) not in (3, 4) or not all(isinstance(row, list) for row in rows):
            found = "is missing" if rows is None else f"expected a 4x4 matrix, found {shown(rows)}"
            self.error(found, "give four rows of four numbers")
            return None
        if any(len(row) != 4 for row in rows):
            self.error("expected a 4x4 matrix, found rows of another length", "give four rows of four numbers")
            return None
        numbers = [[as_float(entry) for entry in row] for row in rows]
        if any(entry is None for row in numbers for entry in row):
            self.error("expected a 4x4 matrix, found an entry that is not a number", "give four rows of four numbers")
            return None
        if len(numbers) == 3:
            numbers.append([0.0, 0.0, 0.0, 1.0])
        return np.array(numbers, dtype=np.float64)

    def _check_rigid(self, matrix: np.ndarray) -> np.ndarray | None:
        if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
            transposed = np.abs(matrix[:, 3] - [0, 0, 0, 1]).max() <= 1e-6
            remedy = "transpose it: the translation is the last column" if transposed else "repair the matrix"
            self.error("is not rigid: the last row is not 0 0 0 1", remedy)
            return None
        rotation = matrix[:3, :3]
        if np.abs(rotation.T @ rotation - np.eye(3)).max() > RIGID_TOLERANCE:
            scale = float(np.cbrt(abs(np.linalg.det(rotation))))
            if scale > 0 and np.abs(rotation.T @ rotation / scale**2 - np.eye(3)).max() <= RIGID_TOLERANCE:
                self.error(f"is not rigid: its rotation is scaled by {scale:.4g}", "divide the 3x3 corner by that")
            else:
                self.error("is not rigid: its 3x3 corner is not a rotation", "repair the matrix (unit quaternion?)")
            return None
        if np.linalg.det(rotation) < 0:
            self.error("is a reflection, not a rotation (determinant -1)", "repair the handedness of the axes")
            return None
        return matrix


def as_float(value: Any) -> float | None:
    """A JSON number as float (may be NaN or infinite), None for anything else; true and false are not numbers."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value)
    except OverflowError:
        return math.inf
