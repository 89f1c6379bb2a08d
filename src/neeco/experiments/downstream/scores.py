"""How right a model's answers are on recorded frames: masks per frame, boxes over a split (pycocotools)."""

from __future__ import annotations

import contextlib
import io
import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy import ndimage

from neeco.evaluation.mask_metrics import boundary_f, box_ious, dice, iou, mean_of
from neeco.experiments.downstream.model import Boxes, Prediction
from neeco.experiments.downstream.samples import Example

MASK_SCORES = ("iou", "dice", "precision", "recall", "boundary_f")
BOX_SCORES = ("ap", "ap50", "ap75", "box_precision", "box_recall")
CONFIDENT = 0.5  # score from which a box counts as found, for precision and recall
OVERLAP = 0.5  # IoU from which it counts as right
MOST_BOXES = 100

FrameScores = dict[str, float]


def mask_scores(predicted: np.ndarray, truth: Example, classes: Sequence[str]) -> FrameScores:
    """Scores of one frame: of the only class plainly, of several under `CLASS.score`, and their mean plainly.

    predicted: uint8 [H, W]. NaN where neither side shows the class.
    """
    counted = truth.counted if truth.counted is not None else np.ones(predicted.shape, bool)
    scores = [_of_class(predicted == k + 1, truth.classes == k + 1, counted) for k in range(len(classes))]
    if len(classes) == 1:
        return scores[0]
    named = {f"{name}.{key}": value for name, row in zip(classes, scores, strict=True) for key, value in row.items()}
    return {key: mean_of([row[key] for row in scores]) for key in MASK_SCORES} | named


def _of_class(mask: np.ndarray, truth: np.ndarray, counted: np.ndarray) -> FrameScores:
    hits, said, there = (int((pixels & counted).sum()) for pixels in (mask & truth, mask, truth))
    return {
        "iou": iou(mask, truth, counted),
        "dice": dice(mask, truth, counted),
        "precision": hits / said if said else (0.0 if there else math.nan),
        "recall": hits / there if there else math.nan,
        "boundary_f": boundary_f(mask, truth, counted),
    }


def near(pixels: np.ndarray, distance: float) -> np.ndarray:
    """bool [H, W]: within `distance` px of any of `pixels` [H, W]."""
    return ndimage.distance_transform_edt(~pixels) <= distance if pixels.any() else np.zeros_like(pixels)


def mean_scores(frames: Sequence[Mapping[str, float]]) -> dict[str, float | None]:
    """The mean over frames of every score, over those frames that have it; None where none has."""
    names = dict.fromkeys(name for frame in frames for name in frame)
    means = {name: mean_of([frame.get(name) for frame in frames]) for name in names}
    return {name: None if math.isnan(value) else value for name, value in means.items()}


def box_scores(
    predictions: Sequence[Boxes], truth: Sequence[Example], classes: Sequence[str]
) -> dict[str, float | None]:
    """AP of boxes as COCO's (mean over IoU .5 to .95, at .5, at .75), and precision and recall at a score of .5 and an
    IoU of .5; of several classes their mean, and `CLASS.ap`. None where the truth has no box."""
    boxes = [example.boxes() for example in truth]
    numbers = [k + 1 for k in range(len(classes)) if any((found == k + 1).any() for _, found in boxes)]
    if not numbers:
        return dict.fromkeys(BOX_SCORES)
    per_class = {number: _of_boxes(predictions, boxes, number) for number in numbers}
    scores: dict[str, float | None] = {
        key: float(np.mean([row[key] for row in per_class.values()])) for key in BOX_SCORES
    }
    if len(classes) > 1:
        scores |= {f"{classes[number - 1]}.ap": row["ap"] for number, row in per_class.items()}
    return scores


def _of_boxes(
    predictions: Sequence[Boxes], truth: Sequence[tuple[np.ndarray, np.ndarray]], number: int
) -> dict[str, float]:
    wanted = [boxes[classes == number] for boxes, classes in truth]
    found = [
        (answer.boxes[answer.classes == number], answer.scores[answer.classes == number]) for answer in predictions
    ]
    hits = said = 0
    for boxes, (answers, confidence) in zip(wanted, found, strict=True):
        sure = answers[confidence >= CONFIDENT]
        said += len(sure)
        hits += _matched(sure, boxes)
    there = sum(map(len, wanted))
    ap, ap50, ap75 = _coco(wanted, found)
    return {
        "ap": ap,
        "ap50": ap50,
        "ap75": ap75,
        "box_precision": hits / said if said else 0.0,
        "box_recall": hits / there,
    }


def _matched(answers: np.ndarray, wanted: np.ndarray) -> int:
    """How many true boxes are found, each answer (best first) taking the one it fits best."""
    if not len(answers) or not len(wanted):
        return 0
    ious, hits = box_ious(answers, wanted), 0
    for row in range(len(answers)):
        column = int(ious[row].argmax())
        if ious[row, column] >= OVERLAP:
            hits += 1
            ious[:, column] = -1
    return hits


def _coco(wanted: Sequence[np.ndarray], found: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[float, float, float]:
    """AP over IoU .5 to .95, at .5 and at .75, by pycocotools."""
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    annotations = [
        {"image_id": image + 1, "bbox": _corner_and_size(box), "area": _area(box), "category_id": 1, "iscrowd": 0}
        for image, boxes in enumerate(wanted)
        for box in boxes
    ]
    detections = [
        {"image_id": image + 1, "bbox": _corner_and_size(box), "category_id": 1, "score": float(score)}
        for image, (boxes, scores) in enumerate(found)
        for box, score in zip(boxes, scores, strict=True)
    ]
    if not detections:
        return 0.0, 0.0, 0.0
    with contextlib.redirect_stdout(io.StringIO()):
        truth = COCO()
        truth.dataset = {
            "info": {},
            "images": [{"id": image + 1} for image in range(len(wanted))],
            "categories": [{"id": 1, "name": "it"}],
            "annotations": [{"id": k + 1, **annotation} for k, annotation in enumerate(annotations)],
        }
        truth.createIndex()
        evaluation = COCOeval(truth, truth.loadRes(detections), "bbox")
        evaluation.params.maxDets = [1, 10, MOST_BOXES]
        evaluation.evaluate()
        evaluation.accumulate()
        evaluation.summarize()
    ap, ap50, ap75 = (float(value) for value in evaluation.stats[:3])
    return ap, ap50, ap75


def _corner_and_size(box: np.ndarray) -> list[float]:
    return [float(box[0]), float(box[1]), float(box[2] - box[0]), float(box[3] - box[1])]


def _area(box: np.ndarray) -> float:
    return float((box[2] - box[0]) * (box[3] - box[1]))


def validation_score(predictions: Sequence[Prediction], truth: Sequence[Example], classes: int) -> float:
    """One number in [0, 1] to choose weights by: mean IoU of masks, or AP of boxes."""
    names = [str(number) for number in range(classes)]
    boxes = [answer for answer in predictions if isinstance(answer, Boxes)]
    if boxes:
        return box_scores(boxes, truth, names)["ap"] or 0.0
    masks = [answer for answer in predictions if isinstance(answer, np.ndarray)]
    frames = [mask_scores(answer, example, names) for answer, example in zip(masks, truth, strict=True)]
    return mean_scores(frames)["iou"] or 0.0
