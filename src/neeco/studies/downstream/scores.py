"""Scores of predictions against labels: masks per frame, boxes over a split (by pycocotools)."""

from __future__ import annotations

import contextlib
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from neeco.evaluation.mask_metrics import boundary_f, box_ious, dice, distances_to, iou, mean_of
from neeco.studies.downstream.samples import Example

MASK_SCORES = ("iou", "dice", "precision", "recall", "boundary_f")
BOX_SCORES = ("ap", "ap50", "ap75", "box_precision", "box_recall")
MIN_SCORE = 0.5  # confidence from which a box counts as a detection, for precision and recall
MIN_OVERLAP = 0.5  # IoU from which a detection is correct
MAX_DETECTIONS = 100  # per image, as COCO


@dataclass(frozen=True)
class Detections:
    """The detections in one image, best first."""

    boxes: np.ndarray  # [n, 4] x0, y0, x1, y1 px
    classes: np.ndarray  # [n] int64, from 1
    scores: np.ndarray  # [n] in [0, 1]

    def of_class(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Boxes [m, 4] and scores [m] of one class."""
        return self.boxes[self.classes == number], self.scores[self.classes == number]


Prediction = np.ndarray | Detections  # classes of pixels uint8 [H, W], 0 tissue; or boxes


def mask_scores(predicted: np.ndarray, truth: Example, classes: Sequence[str]) -> dict[str, float]:
    """Scores of one frame: of a single class by name of the score; of several as `CLASS.score`, and their means.

    predicted: uint8 [H, W]. NaN where neither side shows the class.
    """
    valid = truth.valid if truth.valid is not None else np.ones(predicted.shape, bool)
    scores = [_class_scores(predicted == k + 1, truth.classes == k + 1, valid) for k in range(len(classes))]
    if len(classes) == 1:
        return scores[0]
    named = {f"{name}.{key}": value for name, row in zip(classes, scores, strict=True) for key, value in row.items()}
    return {key: mean_of([row[key] for row in scores]) for key in MASK_SCORES} | named


def _class_scores(mask: np.ndarray, truth: np.ndarray, valid: np.ndarray) -> dict[str, float]:
    hits, predicted, labelled = (int((pixels & valid).sum()) for pixels in (mask & truth, mask, truth))
    return {
        "iou": iou(mask, truth, valid),
        "dice": dice(mask, truth, valid),
        "precision": hits / predicted if predicted else (0.0 if labelled else math.nan),
        "recall": hits / labelled if labelled else math.nan,
        "boundary_f": boundary_f(mask, truth, valid),
    }


def near(pixels: np.ndarray, distance: float) -> np.ndarray:
    """bool [H, W]: within `distance` px of any of `pixels` [H, W]."""
    return distances_to(pixels) <= distance if pixels.any() else np.zeros_like(pixels)


def mean_scores(frames: Sequence[Mapping[str, float]]) -> dict[str, float | None]:
    """The mean of every score over those frames that have it; None where none has."""
    names = dict.fromkeys(name for frame in frames for name in frame)
    means = {name: mean_of([frame.get(name) for frame in frames]) for name in names}
    return {name: None if math.isnan(value) else value for name, value in means.items()}


def box_scores(
    predictions: Sequence[Detections], truth: Sequence[Example], classes: Sequence[str]
) -> dict[str, float | None]:
    """AP of boxes as COCO's (mean over IoU .5 to .95, at .5, at .75), and precision and recall at a score of .5 and an
    IoU of .5; of several classes their mean, and `CLASS.ap`. None where the truth has no box."""
    labelled = [example.boxes() for example in truth]
    per_class = {}
    for number, name in enumerate(classes, 1):
        true = [boxes[numbers == number] for boxes, numbers in labelled]
        if any(len(boxes) for boxes in true):
            per_class[name] = _detection_scores([found.of_class(number) for found in predictions], true)
    if not per_class:
        return dict.fromkeys(BOX_SCORES)
    scores: dict[str, float | None] = {
        key: float(np.mean([row[key] for row in per_class.values()])) for key in BOX_SCORES
    }
    return scores | ({f"{name}.ap": row["ap"] for name, row in per_class.items()} if len(classes) > 1 else {})


def _detection_scores(found: Sequence[tuple[np.ndarray, np.ndarray]], true: Sequence[np.ndarray]) -> dict[str, float]:
    """BOX_SCORES of one class; found: boxes and scores of each image."""
    confident = [boxes[scores >= MIN_SCORE] for boxes, scores in found]
    correct = sum(_matches(boxes, others) for boxes, others in zip(confident, true, strict=True))
    detections = sum(map(len, confident))
    precision, recall = correct / detections if detections else 0.0, correct / sum(map(len, true))
    return dict(zip(BOX_SCORES, (*_coco_ap(found, true), precision, recall), strict=True))


def _matches(found: np.ndarray, true: np.ndarray) -> int:
    """Count the true boxes that are found; each detection (best first) takes the one it fits best."""
    if not len(found) or not len(true):
        return 0
    ious, matches = box_ious(found, true), 0
    for row in range(len(found)):
        column = int(ious[row].argmax())
        if ious[row, column] >= MIN_OVERLAP:
            matches += 1
            ious[:, column] = -1
    return matches


def _coco_ap(found: Sequence[tuple[np.ndarray, np.ndarray]], true: Sequence[np.ndarray]) -> tuple[float, float, float]:
    """AP over IoU .5 to .95, at .5 and at .75, by pycocotools."""
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    labelled = [_coco_box(image, box) for image, boxes in enumerate(true, 1) for box in boxes]
    detections = [
        _coco_box(image, box) | {"score": float(score)}
        for image, (boxes, scores) in enumerate(found, 1)
        for box, score in zip(boxes, scores, strict=True)
    ]
    if not detections:
        return 0.0, 0.0, 0.0
    with contextlib.redirect_stdout(io.StringIO()):
        truth = COCO()
        truth.dataset = {
            "info": {},
            "images": [{"id": image} for image in range(1, len(true) + 1)],
            "categories": [{"id": 1, "name": "instrument"}],
            "annotations": [box | {"id": number, "iscrowd": 0} for number, box in enumerate(labelled, 1)],
        }
        truth.createIndex()
        evaluation = COCOeval(truth, truth.loadRes(detections), "bbox")
        evaluation.params.maxDets = [1, 10, MAX_DETECTIONS]
        evaluation.evaluate()
        evaluation.accumulate()
        evaluation.summarize()
    ap, ap50, ap75 = (float(value) for value in evaluation.stats[:3])
    return ap, ap50, ap75


def _coco_box(image: int, box: np.ndarray) -> dict[str, object]:
    x0, y0, x1, y1 = map(float, box)
    bbox = [x0, y0, x1 - x0, y1 - y0]
    return {"image_id": image, "bbox": bbox, "area": bbox[2] * bbox[3], "category_id": 1}
