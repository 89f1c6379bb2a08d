"""Values of JSON and YAML files that know their place: the one way of reading what others wrote."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from neeco.capture.poses import rigid_fault
from neeco.capture.problems import ProblemReport, key_name, shown


@dataclass(frozen=True)
class Node:
    """A value and where it lies. A reading that fails tells `report` one error and returns None.

    Whether that ends the reading is the report's choice: `ProblemReport` collects, `Refusal` raises.
    """

    value: Any
    file: str
    field: str
    report: ProblemReport

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
        """Whether this is an object; reports an error otherwise."""
        if isinstance(self.value, dict):
            return True
        self.error(f"expected an object, found {shown(self.value)}")
        return False

    def text(self, remedy: str = "") -> str | None:
        """A non-empty string."""
        if isinstance(self.value, str) and self.value.strip():
            return self.value
        self.error(f"expected text, found {shown(self.value)}" if self.value != "" else "is empty", remedy)
        return None

    def number(
        self, above: float | None = None, least: float | None = None, below: float | None = None
    ) -> float | None:
        """A finite number, within the bounds given."""
        value = as_float(self.value)
        if value is None:
            self.error(f"expected a number, found {shown(self.value)}", "correct it")
            return None
        if not math.isfinite(value):
            self.error(f"is {shown(self.value)}, not a finite number", "correct it")
            return None
        wrong = []
        wrong += [f"above {above:g}"] if above is not None and value <= above else []
        wrong += [f"{least:g} or more"] if least is not None and value < least else []
        wrong += [f"below {below:g}"] if below is not None and value >= below else []
        if wrong:
            self.error(f"{value:g} is out of range", f"give a number {wrong[0]}")
            return None
        return value

    def integer(self, least: int) -> int | None:
        """A whole number."""
        value = self.number()
        if value is not None and (value != int(value) or value < least):
            self.error(f"{value:g} is out of range", f"give a whole number, {least} or more")
            return None
        return None if value is None else int(value)

    def numbers(self, count: int, what: str) -> list[float] | None:
        """A list of so many finite numbers."""
        if not isinstance(self.value, list) or len(self.value) != count:
            self.error(f"expected {count} numbers ({what}), found {shown(self.value)}", "correct it")
            return None
        found = [number for item in self.items() if (number := item.number()) is not None]
        return found if len(found) == count else None

    def range(self, unit: str) -> tuple[float, float] | None:
        """Least and greatest of something."""
        found = self.numbers(2, f"least and greatest, {unit}")
        if found is None:
            return None
        low, high = found
        if low >= high:
            self.error(f"{low:g} is not below {high:g}", f"give the least first, in {unit}")
            return None
        return low, high

    def rigid(self) -> np.ndarray | None:
        """A rigid transform: [4, 4] float64 with a rotation in its corner and 0 0 0 1 below."""
        matrix = self.matrix()
        fault = None if matrix is None else rigid_fault(matrix)
        if fault is not None:
            self.error(*fault)
            return None
        return matrix

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


def as_float(value: Any) -> float | None:
    """A JSON number as float (may be NaN or infinite), None for anything else; true and false are not numbers."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value)
    except OverflowError:
        return math.inf
