"""Metrics between masks: intersection over union and Dice, also per part; boundary F (DAVIS)."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from scipy import ndimage
from torch import Tensor

from neeco.labels.drawing import distances_to

_LEFT = re.compile(r"(?:^|_)left(?=_|$)")
BOUNDARY_TOLERANCE = 0.008  # of the image's diagonal, as DAVIS
Pixels = TypeVar("Pixels", Tensor, np.ndarray)


def iou(mask: Pixels, truth: Pixels, counted: Pixels | None = None) -> float:
    """Return the intersection over union of bool masks [H, W] over `counted` pixels; NaN when both are empty."""
    both, either = _overlap(mask, truth, counted)
    return both / either if either else math.nan


def dice(mask: Pixels, truth: Pixels, counted: Pixels | None = None) -> float:
    """Return the Dice coefficient (F1 of the pixels) of two bool masks [H, W]; NaN when both are empty."""
    both, either = _overlap(mask, truth, counted)
    return 2 * both / (both + either) if either else math.nan


def precision(mask: Pixels, truth: Pixels, counted: Pixels | None = None) -> float:
    """Return the share of a bool mask [H, W] that is true; recall with masks swapped. NaN when `mask` is empty."""
    if counted is not None:
        mask = mask & counted
    marked = int(mask.sum())
    return int((mask & truth).sum()) / marked if marked else math.nan


def _overlap(mask: Pixels, truth: Pixels, counted: Pixels | None) -> tuple[int, int]:
    if counted is not None:
        mask, truth = mask & counted, truth & counted
    return int((mask & truth).sum()), int((mask | truth).sum())


def truth_table(names: Mapping[int, str], truth: Mapping[int, str]) -> np.ndarray:
    """Return uint8 [256]: for each id, the truth's id of the part with this name (the first of several); 0 without one.
    names, truth: part by id."""
    numbers = {part: number for number, part in reversed([*truth.items()])}
    table = np.zeros(256, np.uint8)
    for number, part in names.items():
        table[number] = numbers.get(part, 0)
    return table


def pairs_of(parts: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Return parts whose names differ by left and right, by their common name: {"jaws": ("jaw_left", "jaw_right")}.
    Images alone do not determine which of them is left."""
    names = tuple(parts)
    pairs = {}
    for left in names:
        right, count = _LEFT.subn(lambda match: match[0].replace("left", "right"), left)
        if count and right in names:
            pairs[_LEFT.sub("", left).strip("_") + "s"] = left, right
    return pairs


def part_scores(names: Mapping[int, str]) -> tuple[str, ...]:
    """Return the scored parts, where `names` are those of the truth by id, and each pair as one."""
    parts = tuple(dict.fromkeys(names.values()))
    return *parts, *pairs_of(parts)


@dataclass
class PartTally:
    """Scores per part over many images. names: part by id in the truth; scores: of masks, the IoU first.

    A scene learned from images cannot know which of a pair is left: the assignment that is better over all images is
    reported (never the better one per image).
    """

    names: Mapping[int, str]
    scores: tuple[Callable[..., float], ...] = (iou,)
    rows: list[dict[tuple[str, str], tuple[float, ...]]] = field(default_factory=list)  # by (part, part of the truth)

    def add(self, parts: Pixels, truth: Pixels, counted: Pixels | None = None) -> None:
        """Add one image: `parts` and `truth` [H, W] uint8, both in the truth's numbers."""
        ours, theirs = dict[str, Pixels](), dict[str, Pixels]()
        for masks, ids in ((ours, parts), (theirs, truth)):
            for number, part in self.names.items():  # a part may have several ids
                masks[part] = (ids == number) | masks.get(part, False)
        compared = [(part, part) for part in part_scores(self.names)]
        for pair, (left, right) in pairs_of(self.names.values()).items():
            for masks in (ours, theirs):
                masks[pair] = masks[left] | masks[right]
            compared += [(left, right), (right, left)]
        self.rows.append(
            {(a, b): tuple(score(ours[a], theirs[b], counted) for score in self.scores) for a, b in compared}
        )

    def swapped(self) -> tuple[dict[str, str], dict[str, str]]:
        """Return the parts to exchange, and the assignment of each pair: "swapped" if that fits better, else "as
        named"."""
        swap: dict[str, str] = {}
        assignment = {}
        for pair, (left, right) in pairs_of(self.names.values()).items():
            as_named, exchanged = (
                np.nansum([self.mean(ours, theirs) for ours, theirs in zip(order, (left, right), strict=True)])
                for order in ((left, right), (right, left))
            )
            assignment[pair] = "swapped" if exchanged > as_named else "as named"
            swap |= {left: right, right: left} if exchanged > as_named else {}
        return swap, assignment

    def mean(self, ours: str, theirs: str, score: int = 0) -> float:
        """Return the mean of a score of part `ours` against the truth's part `theirs`, over the images where either is
        shown; NaN where none is."""
        return mean_of([row[ours, theirs][score] for row in self.rows])

    def result(self) -> tuple[dict[str, float], dict[str, str]]:
        """Return the mean IoU per part over the images that show it (NaN when none does), and the assignment of each
        pair, "as named" or "swapped"."""
        swap, assignment = self.swapped()
        return {part: self.mean(swap.get(part, part), part) for part in part_scores(self.names)}, assignment


def mean_of(values: Sequence[float | None]) -> float:
    """Return the mean of the values that are numbers; NaN when there are none."""
    numbers = [value for value in values if value is not None and not math.isnan(value)]
    return sum(numbers) / len(numbers) if numbers else math.nan


def boundary_pixels(mask: np.ndarray) -> np.ndarray:
    """Return the contour of a bool mask [H, W]: pixels that differ from their right, lower or lower right neighbour."""
    padded = np.pad(mask, ((0, 1), (0, 1)), mode="edge")
    right, lower, diagonal = padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:]
    return (mask ^ right) | (mask ^ lower) | (mask ^ diagonal)


def boundary_f(
    mask: np.ndarray, truth: np.ndarray, counted: np.ndarray | None = None, tolerance: float = BOUNDARY_TOLERANCE
) -> float:
    """Return the F-measure of two contours: the harmonic mean of the shares of each that are near the other.

    As Perazzi et al., "A benchmark dataset and evaluation methodology for video object segmentation", CVPR 2016, 4.1.

    mask, truth [H, W] bool; near: at most ceil(tolerance * diagonal) pixels apart, centre to centre. counted [H, W]:
    contour pixels outside it need no counterpart, but may be one. NaN when neither mask has a pixel that counts; 1 when
    there are pixels but neither has a contour (both fill the image), 0 when only one has.
    """
    everywhere = np.ones(mask.shape, bool) if counted is None else counted
    present = [bool((image & everywhere).any()) for image in (mask, truth)]
    if not any(present):
        return math.nan
    contours = boundary_pixels(mask), boundary_pixels(truth)
    judged = [int((contour & everywhere).sum()) for contour in contours]
    if not judged[0] or not judged[1]:
        return float(judged[0] == judged[1] and present[0] == present[1])
    radius = math.ceil(tolerance * math.hypot(*mask.shape))
    either = contours[0] | contours[1]
    (window,) = ndimage.find_objects(either.astype(np.uint8))  # distances outside it are never needed
    first, second, inside = (image[window] for image in (*contours, everywhere))
    near_second, near_first = (distances_to(contour) <= radius for contour in (second, first))
    precision = int((first & inside & near_second).sum()) / judged[0]
    recall = int((second & inside & near_first).sum()) / judged[1]
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0
