"""The least-squares solver finds minima of states that are not vectors, with dense and with sparse equations."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy import sparse
from scipy.spatial.transform import Rotation

from neeco.geometry.least_squares import Linearisation, levenberg_marquardt

TRUTH = Rotation.from_rotvec([0.7, -1.9, 0.4])
POINTS = np.random.default_rng(0).normal(size=(30, 3))


def _misfit(rotation: Rotation) -> np.ndarray:
    return (rotation.apply(POINTS) - TRUTH.apply(POINTS)).ravel()


def _turned(rotation: Rotation, step: np.ndarray) -> Rotation:
    return Rotation.from_rotvec(step) * rotation


def _linearise(rotation: Rotation, kind: Callable[[np.ndarray], object]) -> Linearisation[Rotation]:
    off = _misfit(rotation)
    slopes = np.stack([(_misfit(_turned(rotation, step)) - off) / 1e-6 for step in 1e-6 * np.eye(3)], -1)
    return Linearisation(
        kind(slopes.T @ slopes), slopes.T @ off, float(off @ off), lambda to: float(_misfit(to) @ _misfit(to))
    )


@pytest.mark.parametrize("kind", [np.asarray, sparse.csc_matrix])
def test_a_rotation_is_found_from_afar(kind):
    found = levenberg_marquardt(
        Rotation.identity(), lambda at: _linearise(at, kind), _turned, max_steps=40, damping=1e-2, tolerance=1e-12
    )
    assert (found * TRUTH.inv()).magnitude() < 1e-6


def test_a_state_from_which_no_step_helps_stays():
    flat = Linearisation(np.eye(1), np.ones(1), 1.0, lambda state: 1.0)
    assert (
        levenberg_marquardt(5.0, lambda at: flat, lambda at, step: at + step[0], max_steps=9, damping=1, tolerance=0)
        == 5
    )
