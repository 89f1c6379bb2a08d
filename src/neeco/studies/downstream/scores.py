"""Scores of predictions against labels: masks per frame, boxes over a split (by pycocotools)."""

from __future__ import annotations

import contextlib
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from neeco.evaluation.mask_metrics import boundary_f, box_ious, dice, iou, mean_of, precision
from neeco.studies.downstream.samples import Example

MASK_SCORES = ("iou", "dice", "precision", "recall", "boundary_f")
BOX_SCORES = ("ap", "ap50", "ap75")
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
    return {
        "iou": iou(mask, truth, valid),
        "dice": dice(mask, truth, valid),
        "precision": precision(mask, truth, valid),
        "recall": precision(truth, mask, valid),
        "boundary_f": boundary_f(mask, truth, valid),
    }


def mean_scores(frames: Sequence[Mapping[str, float]]) -> dict[str, float | None]:
    """The mean of every score over those frames that have it; None where none has."""
    names = dict.fromkeys(name for frame in frames for name in frame)
    means = {name: mean_of([frame.get(name) for frame in frames]) for name in names}
    return {name: None if math.isnan(value) else value for name, value in means.items()}


def box_scores(
    predictions: Sequence[Detections], truth: Sequence[Example], classes: Sequence[str]
) -> dict[str, float | None]:
    """AP of boxes as COCO's, mean over IoU .5 to .95, at .5 and at .75; of several classes their mean, and `CLASS.ap`.
    None where the truth has no box."""
    labelled = [example.boxes() for example in truth]
    per_class = {}
    for number, name in enumerate(classes, 1):
        true = [boxes[numbers == number] for boxes, numbers in labelled]
        if any(len(boxes) for boxes in true):
            per_class[name] = _coco_ap([found.of_class(number) for found in predictions], true)
    if not per_class:
        return dict.fromkeys(BOX_SCORES)
    means = np.mean(list(per_class.values()), axis=0).tolist()
    scores: dict[str, float | None] = dict(zip(BOX_SCORES, means, strict=True))
    return scores | ({f"{name}.ap": row[0] for name, row in per_class.items()} if len(classes) > 1 else {})


def box_iou(found: Detections, truth: Example) -> float:
    """Mean IoU of every true box with the most confident box of its class; NaN where the truth has none."""
    values = []
    for box, number in zip(*truth.boxes(), strict=True):
        boxes, scores = found.of_class(number)
        values.append(float(box_ious(boxes[[scores.argmax()]], box[None])[0, 0]) if len(scores) else 0.0)
    return mean_of(values)


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
