"""`neeco score-masks`: the quality of a folder of masks from any source."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.table import Column, Table

from neeco.cli._output import JsonTarget, ready_for_json, whole_lines, write_numbers

COLUMNS = (("IoU", "iou"), ("Dice", "dice"), ("boundary F", "boundary_f"))


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Score a folder of masks against the truth: IoU, Challenge IoU, Dice and boundary F, per part."""

    predicted: Annotated[Path, tyro.conf.Positional]
    """Folder of masks: PNG with part ids or 0/255, or the output of `neeco render`."""
    truth: Annotated[Path, tyro.conf.Positional]
    """A capture (its truth/masks or reference_masks), or a folder of masks. Files are matched by name."""
    splits: tuple[str, ...] | None = None
    """Splits of the capture. Default: all splits with an image in PREDICTED."""
    classes: tuple[str, ...] = ()
    """Parts of PREDICTED's ids, such as shaft=10 wrist=20. Default: 1 shaft, 2 wrist, 3 jaw_left, 4 jaw_right."""
    truth_classes: tuple[str, ...] = ()
    """Parts of TRUTH's ids. Default: as above."""
    json: JsonTarget = None


def run(arguments: Arguments) -> int:
    """Score, print a table."""
    from neeco.cli._progress import counting
    from neeco.evaluation.masks import parse_classes, score_masks

    with ready_for_json(arguments.json), counting("score masks") as advance:
        scores = score_masks(
            arguments.predicted,
            arguments.truth,
            splits=arguments.splits,
            classes=parse_classes(arguments.classes, "--classes"),
            truth_classes=parse_classes(arguments.truth_classes, "--truth-classes"),
            progress=advance,
        )
        if write_numbers(arguments.json, scores):
            return 0
    console = whole_lines()
    table = Table("part", *(Column(title, justify="right") for title, _ in COLUMNS), Column("images", justify="right"))
    for part, numbers in {"instrument": scores["instrument"], **(scores["parts"] or {})}.items():
        images = "-" if numbers["images"] is None else str(numbers["images"])
        table.add_row(part, *(_formatted(numbers[key]) for _, key in COLUMNS), images)
    console.print(table)
    splits = f" of {', '.join(scores['splits'])}" if scores["splits"] else ""
    challenge = _formatted(scores["instrument"]["challenge_iou"])
    line = f"{scores['images']} images{splits}; Challenge IoU of the instrument {challenge}"
    if scores["classes"] is not None:
        line += f", of its parts {_formatted(scores['classes']['challenge_iou'])}"
    console.print(line, markup=False, highlight=False)
    for pair, way in scores["pair_assignment"].items():
        if way == "swapped":
            line = f"{pair}: left and right are swapped, which matches this folder better"
            console.print(line, markup=False, highlight=False)
    for note in scores["notes"]:
        console.print(f"note: {note}", style="dim", markup=False, highlight=False)
    return 0


def _formatted(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
