"""Random recordings of robots: their logs, masks and bases belong together."""

from __future__ import annotations

import importlib
from types import ModuleType

import numpy as np
import pytest


def test_the_truth_of_a_random_recording_explains_its_masks(benchmarks: ModuleType) -> None:
    bases = importlib.import_module("bases")
    recording = bases.Recording(3, wrist=True)
    logged = recording.base @ recording.poses_at(recording.clock) @ np.linalg.inv(recording.offset)
    ends = (recording.cameras @ logged)[:, :3, 3]
    at = np.rint(ends[:, :2] / ends[:, 2:] * bases.FOCAL + (bases.WIDTH / 2 - 1, bases.HEIGHT / 2 - 1)).astype(int)
    assert np.mean([mask[y, x] for mask, (x, y) in zip(recording.masks, at, strict=True)]) > 0.9
    assert 0.01 < recording.masks.mean() < 0.3


def test_a_base_stated_roughly_is_found_and_its_error_is_stated(benchmarks: ModuleType) -> None:
    motion, raw, over_sd, told = importlib.import_module("bases").score("rough", 700)
    assert (motion < 2, raw < 6, over_sd < 2, told) == (True, True, True, False)


@pytest.mark.slow
def test_a_base_is_found_before_a_still_scope_although_the_first_guess_of_the_size_is_wrong(
    benchmarks: ModuleType,
) -> None:
    """The tube comes in near the camera, so that it is taken for one of a third of its size."""
    motion, _, over_sd, _ = importlib.import_module("bases").score("rough-wrist", 903)
    assert (motion < 4, over_sd < 3) == (True, True)
