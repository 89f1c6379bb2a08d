"""Metrics between masks: intersection over union and Dice, also per part; boundary F (DAVIS); box AP."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
import torch
from scipy import ndimage, sparse
from scipy.sparse.csgraph import maximum_bipartite_matching
from torch import Tensor

from neeco.labels.drawing import distances_to

_LEFT = re.compile(r"(?:^|_)left(?=_|$)")
BOUNDARY_TOLERANCE = 0.008  # of the image's diagonal, as DAVIS
COCO_THRESHOLDS = tuple(np.linspace(0.5, 0.95, 10).round(2))
RECALLS = np.linspace(0, 1, 101)


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


def to_truth_ids(parts: Tensor, label_names: Sequence[tuple[str, str]], names: Mapping[int, str]) -> Tensor:
    """Renumber part ids [H, W] (column index + 1) to the truth's, part by id in `names`; parts that the truth does not
    name become 0."""
    numbers = {part: number for number, part in names.items()}
    table = torch.zeros(len(label_names) + 1, dtype=torch.uint8, device=parts.device)
    for index, (_, part) in enumerate(label_names):
        table[index + 1] = numbers.get(part, 0)
    return table[parts.long()]


def pairs_of(parts: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Return parts whose names differ by left and right, by their common name: {"jaws": ("jaw_left", "jaw_right")}.
    Images alone do not determine which of them is left."""
    names = tuple(parts)
    pairs = {}
    for left in names:
        right, count = _LEFT.subn(lambda found: found[0].replace("left", "right"), left)
        if count and right in names:
            pairs[_LEFT.sub("", left).strip("_") + "s"] = left, right
    return pairs


def part_scores(names: Mapping[int, str]) -> tuple[str, ...]:
    """Return the scored parts, where `names` are those of the truth by id, and each pair as one."""
    return *names.values(), *pairs_of(names.values())


@dataclass
class PartTally:
    """IoU per part over the frames of a split. names: part by id in the truth.

    A scene learned from images cannot know which of a pair is left: the assignment that is better over the whole split
    is reported (never the better one per frame).
    """

    names: Mapping[int, str]
    rows: list[dict[tuple[str, str], float]] = field(default_factory=list)  # of frames, by (part, part of the truth)

    def add(self, parts: Tensor, truth: Tensor, counted: Tensor | None = None) -> None:
        """Add one frame: `parts` and `truth` [H, W] uint8, both in the truth's numbers."""
        ours, theirs = ({part: ids == number for number, part in self.names.items()} for ids in (parts, truth))
        compared = [(part, part) for part in part_scores(self.names)]
        for pair, (left, right) in pairs_of(self.names.values()).items():
            for masks in (ours, theirs):
                masks[pair] = masks[left] | masks[right]
            compared += [(left, right), (right, left)]
        self.rows.append({(a, b): iou(ours[a], theirs[b], counted) for a, b in compared})

    def result(self) -> tuple[dict[str, float], dict[str, str]]:
        """Return the mean IoU per part over the frames that show it (NaN when none does), and the assignment of each
        pair, "as named" or "swapped"."""

        def mean(ours: str, theirs: str) -> float:
            return mean_of([row[ours, theirs] for row in self.rows])

        swap, assignment = assigned_pairs(pairs_of(self.names.values()), mean)
        return {part: mean(swap.get(part, part), part) for part in part_scores(self.names)}, assignment


def assigned_pairs(
    pairs: Mapping[str, tuple[str, str]], mean_iou: Callable[[str, str], float]
) -> tuple[dict[str, str], dict[str, str]]:
    """Return the parts to exchange, and how each pair is assigned: "swapped" where that fits better, else "as named".

    mean_iou: of a part and a part of the truth, over all images.
    """
    swap: dict[str, str] = {}
    assignment = {}
    for pair, (left, right) in pairs.items():
        swapped, named = (
            (mean_iou(right, left), mean_iou(left, right)),
            (mean_iou(left, left), mean_iou(right, right)),
        )
        is_better = np.nansum(swapped) > np.nansum(named)
        assignment[pair] = "swapped" if is_better else "as named"
        swap |= {left: right, right: left} if is_better else {}
    return swap, assignment


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
    contour pixels outside it need no counterpart, but may be one. NaN when neither mask has a pixel; 1 when there are
    pixels but neither has a contour (both fill the image), 0 when only one has.
    """
    if not (mask.any() or truth.any()):
        return math.nan
    contours = boundary_pixels(mask), boundary_pixels(truth)
    everywhere = np.ones(mask.shape, bool) if counted is None else counted
    judged = [int((contour & everywhere).sum()) for contour in contours]
    if not judged[0] or not judged[1]:
        return float(judged[0] == judged[1] and mask.any() == truth.any())
    radius = math.ceil(tolerance * math.hypot(*mask.shape))
    either = contours[0] | contours[1]
    (window,) = ndimage.find_objects(either.astype(np.uint8))  # distances outside it are never needed
    first, second, inside = (image[window] for image in (*contours, everywhere))
    near_second, near_first = (distances_to(contour) <= radius for contour in (second, first))
    precision = int((first & inside & near_second).sum()) / judged[0]
    recall = int((second & inside & near_first).sum()) / judged[1]
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


def boxes_of(mask: np.ndarray, components: bool = False) -> np.ndarray:
    """Return boxes [n, 4] (x0, y0, x1, y1; px, x1 and y1 exclusive) about a bool mask [H, W].

    One about all its pixels, or with `components` one about each group that touches by side or corner.
    """
    labels = ndimage.label(mask, np.ones((3, 3)))[0] if components else mask.astype(np.uint8)
    found = [(x.start, y.start, x.stop, y.stop) for y, x in ndimage.find_objects(labels)]
    return np.array(found, np.float64).reshape(-1, 4)


def box_ious(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the intersection over union [n, m] of boxes [n, 4] and [m, 4]."""
    low = np.maximum(boxes[:, None, :2], others[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], others[None, :, 2:])
    both = np.clip(high - low, 0, None).prod(axis=2)
    areas = [np.prod(some[:, 2:] - some[:, :2], axis=1) for some in (boxes, others)]
    return both / (areas[0][:, None] + areas[1][None, :] - both)


def average_precision(
    predicted: Sequence[np.ndarray], truth: Sequence[np.ndarray], thresholds: Sequence[float] = COCO_THRESHOLDS
) -> float:
    """Return the average precision over recalls 0, 0.01 … 1, mean over IoU `thresholds` (Lin et al., COCO, 2014).

    predicted, truth: boxes [n, 4] of each image. Masks have no confidence, so that all boxes rank equally: there is one
    operating point, its precision holds up to its recall, and as many boxes are matched as the threshold allows. NaN
    when no image has a true box.
    """
    boxes, wanted = sum(map(len, predicted)), sum(map(len, truth))
    if not wanted:
        return math.nan
    ious = [box_ious(some, others) for some, others in zip(predicted, truth, strict=True)]
    found = [sum(_matches(table >= threshold) for table in ious) for threshold in thresholds]
    return float(np.mean([hits / boxes * np.mean(hits / wanted >= RECALLS) if hits else 0.0 for hits in found]))


def _matches(fits: np.ndarray) -> int:
    """Return the number of pairs in a maximum matching of rows and columns."""
    return int((maximum_bipartite_matching(sparse.csr_matrix(fits)) >= 0).sum()) if fits.any() else 0
