"""How well masks agree: intersection over union, Dice, and the same per part."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

TRUTH_PARTS: Mapping[str, int] = {"shaft": 1, "wrist": 2, "jaw_left": 3, "jaw_right": 4}
PART_SCORES = ("shaft", "wrist", "jaw_left", "jaw_right", "jaws")


def iou(mask: Tensor, truth: Tensor, counted: Tensor | None = None) -> float:
    """Intersection over union of bool masks [H, W]; NaN when both are empty. `counted` [H, W]: pixels that count."""
    both, either = _overlap(mask, truth, counted)
    return both / either if either else math.nan


def dice(mask: Tensor, truth: Tensor, counted: Tensor | None = None) -> float:
    """Dice coefficient (F1 of the pixels) of two bool masks [H, W]; NaN when both are empty."""
    both, either = _overlap(mask, truth, counted)
    return 2 * both / (both + either) if either else math.nan


def _overlap(mask: Tensor, truth: Tensor, counted: Tensor | None) -> tuple[int, int]:
    if counted is not None:
        mask, truth = mask & counted, truth & counted
    return int((mask & truth).sum()), int((mask | truth).sum())


def to_truth_ids(parts: Tensor, label_names: Sequence[tuple[str, str]]) -> Tensor:
    """Renumber part ids [H, W] (column index + 1) to the truth's numbers; parts the truth does not name become 0."""
    table = torch.zeros(len(label_names) + 1, dtype=torch.uint8, device=parts.device)
    for index, (_, part) in enumerate(label_names):
        table[index + 1] = TRUTH_PARTS.get(part, 0)
    return table[parts.long()]


@dataclass
class PartTally:
    """Gathers per-part IoU over the frames of a split.

    Which jaw is "left" is a name a scene learned from images cannot know, so both assignments of the two jaws are kept
    and the better one over the whole split is reported (never the better one per frame).
    """

    frames: dict[str, list[dict[str, float]]] = field(default_factory=lambda: {"as named": [], "swapped": []})

    def add(self, parts: Tensor, truth: Tensor, counted: Tensor | None = None) -> None:
        """Count one frame: `parts` and `truth` [H, W] uint8, both in the truth's numbers."""
        for assignment, rows in self.frames.items():
            names = dict(TRUTH_PARTS)
            if assignment == "swapped":
                names["jaw_left"], names["jaw_right"] = names["jaw_right"], names["jaw_left"]
            row = {part: iou(parts == names[part], truth == TRUTH_PARTS[part], counted) for part in TRUTH_PARTS}
            row["jaws"] = iou(parts >= TRUTH_PARTS["jaw_left"], truth >= TRUTH_PARTS["jaw_left"], counted)
            rows.append(row)

    def result(self) -> tuple[dict[str, float], str]:
        """Mean IoU per part over the frames that show it (NaN when none does), and the assignment used."""
        means = {
            name: {part: mean_of([row[part] for row in rows]) for part in PART_SCORES}
            for name, rows in self.frames.items()
        }
        scores = {
            name: sum(value for part in ("jaw_left", "jaw_right") if not math.isnan(value := parts[part]))
            for name, parts in means.items()
        }
        best = max(scores, key=lambda name: scores[name])  # a tie keeps the first, "as named"
        return means[best], best


def mean_of(values: Sequence[float | None]) -> float:
    """Mean of the values that are numbers; NaN when there are none."""
    numbers = [value for value in values if value is not None and not math.isnan(value)]
    return sum(numbers) / len(numbers) if numbers else math.nan
