"""`neeco check`: report all problems of a capture."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro
from rich.console import Console
from rich.text import Text

from neeco.base.errors import counted
from neeco.cli._output import JsonTarget, ready_for_json, write_numbers

if TYPE_CHECKING:
    from neeco.capture.checks import CaptureSummary
    from neeco.capture.documents import Problem


@dataclass(frozen=True)
class Arguments:
    """Report all problems of a capture. Exit status 1 if it has errors, which prevent training."""

    capture: tyro.conf.Positional[Path]
    """The capture's folder, or a transforms file in it."""
    transforms: str = "transforms.json"
    """Transforms file of the folder to check."""
    json: JsonTarget = None


def run(arguments: Arguments) -> int:
    """Print the problems of a capture; 1 when there are errors, else 0."""
    from neeco.capture.checks import inspect_capture
    from neeco.capture.documents import errors_only

    with ready_for_json(arguments.json):
        checked = inspect_capture(arguments.capture, arguments.transforms)
        problems, summary = checked.problems, checked.summary
        errors = len(errors_only(problems))
        report = {"capture": str(arguments.capture), "errors": errors, "warnings": len(problems) - errors}
        report |= {"problems": [asdict(problem) for problem in problems], "summary": asdict(summary)}
        if not write_numbers(arguments.json, report):
            _print(problems, errors, summary)
    return 1 if errors else 0


def _print(problems: list[Problem], errors: int, summary: CaptureSummary) -> None:
    console = Console(soft_wrap=True, highlight=False)
    for problem in problems:
        style = "bold red" if problem.severity == "error" else "bold yellow" if problem.contradicted else "yellow"
        label = problem.severity.upper() if problem.contradicted else problem.severity
        console.print(Text.assemble((f"{label:<8}", style), str(problem)))
    warnings = len(problems) - errors
    if problems:
        console.print(f"{counted(errors, 'error')}, {counted(warnings, 'warning')}")
    else:
        console.print(Text("no problems found", "bold green"))
    if not summary.splits:
        return
    console.print(Text("frames: " + ", ".join(f"{count} {name!r}" for name, count in summary.splits.items())))
    console.print(Text(f"sparse points: {summary.points}"))
    if summary.still:
        console.print("scope: still; other viewpoints were not observed, so render views near the recorded ones")
    for name, travel in summary.travel_mm.items():
        joints = [
            f"{joint.removeprefix(name + '.')} {low:.3g} .. {high:.3g}"
            for joint, (low, high) in summary.joints.items()
            if joint.startswith(name + ".")
        ]
        console.print(Text(f"instrument {name!r}: " + ", ".join([f"moves {travel:.1f} mm", *joints])))
