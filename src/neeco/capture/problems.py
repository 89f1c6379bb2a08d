"""What can be wrong with what others wrote: problems, and the reports that collect or refuse them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, NoReturn

from neeco.errors import NeecoError


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
class ProblemReport:
    """Collects problems while a capture is read, so that all of them can be told at once."""

    problems: list[Problem] = field(default_factory=list)

    def error(self, file: str, field: str, message: str, remedy: str = "") -> None:
        self.problems.append(Problem("error", file, field, message, remedy))

    def refused(self, file: str, field: str, error: NeecoError) -> None:
        """Report a refusal of the form "what is wrong; what to do" that does not say where."""
        message, _, remedy = str(error).partition("; ")
        self.error(file, field, message, remedy)

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


class Refusal(ProblemReport):
    """Raises the first error as NeecoError in one line: for files that are read as a whole or not at all."""

    def error(self, file: str, field: str, message: str, remedy: str = "") -> NoReturn:
        problem = Problem("error", file, field, message, remedy)
        raise NeecoError(" ".join(str(problem).split()))


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
