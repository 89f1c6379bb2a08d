"""Scores against masks and boxes whose right answer is known by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from neeco.studies.downstream.results import (
    BOX_SCORES,
    MASK_SCORES,
    Detections,
    box_iou,
    box_scores,
    mask_scores,
    mean_scores,
)
from neeco.studies.downstream.samples import Example

ONE = ("instrument",)
PARTS = ("shaft", "wrist", "jaws")


def truth_of(classes: np.ndarray, counted: np.ndarray | None = None) -> Example:
    ids = np.asarray(classes, np.uint8)
    return Example(np.zeros((*ids.shape, 3), np.uint8), ids, counted)


def rows(*lines: str) -> np.ndarray:
    return np.array([[int(letter) for letter in line] for line in lines], np.uint8)


# masks


def test_scores_of_a_mask_by_hand() -> None:
    truth, said = rows("1110", "1110", "0000"), rows("0111", "0110", "0000")
    scores = mask_scores(said, truth_of(truth), ONE)
    assert tuple(scores) == MASK_SCORES
    assert scores["iou"] == pytest.approx(4 / 7)
    assert scores["dice"] == pytest.approx(8 / 11)
    assert scores["precision"] == pytest.approx(4 / 5)
    assert scores["recall"] == pytest.approx(4 / 6)
    assert mask_scores(truth, truth_of(truth), ONE) == dict.fromkeys(MASK_SCORES, 1.0)


def test_empty_sides() -> None:
    some, none = rows("0110", "0000"), rows("0000", "0000")
    assert all(math.isnan(value) for value in mask_scores(none, truth_of(none), ONE).values())
    missed = mask_scores(none, truth_of(some), ONE)
    assert math.isnan(missed.pop("precision"))
    assert missed == {"iou": 0, "dice": 0, "recall": 0, "boundary_f": 0}
    invented = mask_scores(some, truth_of(none), ONE)
    assert math.isnan(invented.pop("recall"))
    assert invented == {"iou": 0, "dice": 0, "precision": 0, "boundary_f": 0}


def test_pixels_that_do_not_count_change_nothing() -> None:
    random = np.random.default_rng(0)
    truth, said = (random.random((2, 12, 16)) > 0.6).astype(np.uint8)
    counted = random.random((12, 16)) > 0.5
    scores = mask_scores(said, truth_of(truth, counted), ONE)
    other = np.where(counted, said, 1 - said)
    changed = mask_scores(other, truth_of(truth, counted), ONE)
    assert {key: scores[key] for key in MASK_SCORES[:4]} == {key: changed[key] for key in MASK_SCORES[:4]}
    kept = counted & (truth > 0)
    assert scores["recall"] == pytest.approx((kept & (said > 0)).sum() / kept.sum())
    nothing = mask_scores(said, truth_of(truth, np.zeros_like(counted)), ONE)
    assert math.isnan(nothing["iou"])
    assert math.isnan(nothing["precision"])


def test_of_several_classes_each_is_told_and_their_mean() -> None:
    truth, said = rows("1122", "1122", "0000"), rows("1122", "1111", "0000")
    scores = mask_scores(said, truth_of(truth), PARTS)
    assert scores["shaft.iou"] == pytest.approx(4 / 6)
    assert scores["wrist.iou"] == pytest.approx(2 / 4)
    assert math.isnan(scores["jaws.iou"])
    assert scores["iou"] == pytest.approx((4 / 6 + 2 / 4) / 2)  # of those that are there
    assert scores["shaft.recall"] == 1
    assert scores["wrist.precision"] == 1


def test_means_are_over_frames_that_have_the_score() -> None:
    assert mean_scores([{"a": 1.0, "b": math.nan}, {"a": 0.5, "b": math.nan}, {"c": 0.25}]) == {
        "a": 0.75,
        "b": None,
        "c": 0.25,
    }
    assert mean_scores([]) == {}


# boxes


def boxes_of(*boxes: tuple[float, ...], classes: tuple[int, ...] = ()) -> Detections:
    """Each x0, y0, x1, y1, score; best first."""
    table = np.array(sorted(boxes, key=lambda box: -box[4]), np.float64).reshape(-1, 5)
    return Detections(table[:, :4], np.array(classes or (1,) * len(table), np.int64), table[:, 4])


def boxed(*boxes: tuple[int, int, int, int], side: int = 64) -> Example:
    """An instrument in the box, if there is one."""
    classes = np.zeros((side, side), np.uint8)
    for x0, y0, x1, y1 in boxes:
        classes[y0:y1, x0:x1] = 1
    return Example(np.zeros((side, side, 3), np.uint8), classes)


HERE = (10, 10, 30, 30)
THERE = (35, 35, 60, 60)


@pytest.mark.parametrize(
    ("answers", "truth", "ap"),
    [
        ([((*HERE, 0.9),), ((*THERE, 0.6),)], [HERE, THERE], 1),
        ([(), ()], [HERE, THERE], 0),
        ([((0, 0, 5, 5, 0.9),), ((*HERE, 0.9),)], [HERE, THERE], 0),
        ([((*HERE, 0.9),), ()], [HERE, THERE], 51 / 101),  # precision 1 up to recall .5: recalls 0, .01 … .5
        ([((*HERE, 0.9), (40, 40, 50, 50, 0.3))], [HERE], 1),  # worse answers below the right ones take nothing
        ([((*HERE, 0.2), (40, 40, 50, 50, 0.8))], [HERE], 0.5),
        ([((*HERE, 0.7),), ((*HERE, 0.9),)], [HERE, None], 0.5),  # an answer where there is no instrument
        ([((*HERE, 0.9), (11, 10, 31, 30, 0.8))], [HERE], 1),  # found twice: at recall 1 already by the first
    ],
)
def test_average_precision_of_answers_by_hand(answers, truth, ap: float) -> None:
    scores = box_scores([boxes_of(*some) for some in answers], [boxed(*([box] if box else [])) for box in truth], ONE)
    assert scores == pytest.approx(dict.fromkeys(BOX_SCORES, ap))  # at every overlap: the right answers are exact


def test_without_a_true_box_there_is_nothing_to_score() -> None:
    assert box_scores([boxes_of((*HERE, 0.9))], [boxed()], ONE) == dict.fromkeys(BOX_SCORES)


def test_a_frames_score_is_of_the_most_confident_box() -> None:
    assert box_iou(boxes_of((*HERE, 0.9), (0, 0, 9, 9, 0.8)), boxed(HERE)) == 1
    assert box_iou(boxes_of((*HERE, 0.7), (0, 0, 9, 9, 0.8)), boxed(HERE)) == 0
    assert box_iou(boxes_of(), boxed(HERE)) == 0
    assert math.isnan(box_iou(boxes_of((*HERE, 0.9)), boxed()))


def test_ap_is_the_mean_over_overlaps() -> None:
    shifted = (13, 10, 33, 30, 0.9)  # 17 of 23 columns: IoU .739, right at .5 to .7
    scores = box_scores([boxes_of(shifted)], [boxed(HERE)], ONE)
    assert scores["ap"] == pytest.approx(5 / 10)
    assert scores["ap50"] == pytest.approx(1)
    assert scores["ap75"] == 0


def test_of_several_classes_those_in_the_truth_are_scored() -> None:
    classes = np.zeros((64, 64), np.uint8)
    classes[10:30, 10:30], classes[35:60, 35:60] = 1, 3
    example = truth_of(classes)
    swapped = boxes_of((*HERE, 0.9), (*THERE, 0.8), classes=(1, 1))
    scores = box_scores([swapped], [example], PARTS)
    assert scores["shaft.ap"] == pytest.approx(1)
    assert scores["jaws.ap"] == 0
    assert "wrist.ap" not in scores
    assert scores["ap"] == pytest.approx(0.5)
