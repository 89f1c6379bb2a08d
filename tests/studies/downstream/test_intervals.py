"""Intervals hold the truth about as often as they say, and a difference is taken on the same seeds and frames."""

from __future__ import annotations

import numpy as np
import pytest

from neeco.studies.downstream.results import Arm, Estimate, Scores, block_weights, seed_weights

ARMS = {name: Arm("unet", name, 10) for name in ("a", "b")}


def jobs(values: dict[str, np.ndarray]) -> list[dict]:
    """Finished jobs whose frames have these scores [seeds, frames]."""
    return [
        {
            "model": "unet", "condition": name, "real": 10, "fold": fold,
            "splits": {"test": {"iou": float(row.mean()), "per_frame": [{"iou": value} for value in row.tolist()]}},
        }
        for name, rows in values.items()
        for fold, row in enumerate(rows)
    ]  # fmt: skip


def test_seeds_are_resampled_to_the_variance_of_their_mean() -> None:
    scores = np.random.default_rng(0).normal(size=5)
    weights = seed_weights(5)
    assert (weights.sum(1) == 4).all()
    assert (weights @ scores / 4).std() == pytest.approx(scores.std(ddof=1) / 5**0.5, rel=0.05)


def test_blocks_are_of_neighbours_and_no_frame_is_drawn_more_than_others() -> None:
    weights = block_weights(45)
    assert (weights.sum(1) == 45).all()  # nine blocks of five
    assert weights.mean(0) == pytest.approx(np.ones(45), abs=0.15)
    together = np.corrcoef(weights.T)
    assert together[10, 11] > 0.6
    assert abs(together[10, 30]) < 0.2
    assert block_weights(3).sum(1).tolist() == [3] * len(weights)


def test_intervals_hold_the_truth_about_as_often_as_they_say() -> None:
    held, rng = 0, np.random.default_rng(3)
    for _ in range(200):
        seeds, blocks = rng.normal(0, 0.02, (5, 1)), np.repeat(rng.normal(0, 0.05, (1, 20)), 5, 1)
        values = 0.7 + seeds + blocks + rng.normal(0, 0.02, (5, 100))
        _, _, low, high = Scores(jobs({"a": values})).estimate(ARMS["a"], "test", "iou")
        held += low <= 0.7 <= high
    assert 0.85 < held / 200 < 0.99  # 95 % of many seeds and blocks, fewer of five seeds


def test_a_difference_on_the_same_frames_is_surer_than_its_sides() -> None:
    hard = np.random.default_rng(1).normal(0.6, 0.2, (4, 50))
    scores = Scores(jobs({"a": hard + 0.01, "b": hard}))
    _, _, low, high = scores.estimate(ARMS["a"], "test", "iou")
    folds, mean, first, last = scores.estimate(ARMS["a"], "test", "iou", ARMS["b"])
    assert high - low > 0.05
    assert (folds, mean) == (4, pytest.approx(0.01))
    assert (first, last) == (pytest.approx(0.01), pytest.approx(0.01))


def test_only_folds_that_both_have_are_compared() -> None:
    found = jobs({"a": np.full((3, 4), 0.9), "b": np.full((3, 4), 0.5)})
    found[0] = found[0] | {"error": "lost", "splits": {}}
    found[1]["splits"]["test"]["iou"] = 0.8
    scores = Scores(found)
    folds, mean, *_ = scores.estimate(ARMS["a"], "test", "iou", ARMS["b"])
    assert (folds, mean) == (2, pytest.approx(0.35))
    assert scores.estimate(ARMS["a"], "test", "iou", Arm("unet", "c", 10)) is None
    assert scores.estimate(Arm("unet", "c", 10), "test", "iou") is None


def test_frames_without_the_class_are_left_out() -> None:
    found = jobs({"a": np.array([[0.5, 0.5, 0.9, 0.5]])})
    found[0]["splits"]["test"]["per_frame"][2]["iou"] = None
    assert Scores(found).estimate(ARMS["a"], "test", "iou")[2:] == (0.5, 0.5)


def test_scores_of_no_frames_are_resampled_over_seeds_alone() -> None:
    def boxes(*values: float) -> list[dict]:
        return [
            {"model": "unet", "condition": "a", "real": 10, "fold": fold, "splits": {"test": {"ap": value}}}
            for fold, value in enumerate(values)
        ]

    _, _, low, high = Scores(boxes(0.4, 0.5, 0.6)).estimate(ARMS["a"], "test", "ap")
    assert 0.4 <= low < 0.5 < high <= 0.6
    assert Scores(boxes(0.4)).estimate(ARMS["a"], "test", "ap") == Estimate(1, 0.4, None, None)
