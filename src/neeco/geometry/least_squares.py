"""Nonlinear least squares over states that are not plain vectors (rotations, poses, shapes)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

State = TypeVar("State")


@dataclass(frozen=True, kw_only=True)
class DampingSettings:
    """Settings of the damping."""

    max_trials: int = 6  # maximum number of ever shorter steps, after which a state counts as the minimum
    damping_factor: float = 4.0  # factor on the damping after a failed trial, and its inverse after a step
    min_damping: float = 1e-6  # minimum damping
    free_damping: float = 1e-5  # maximum damping of an undamped step


DAMPING = DampingSettings()


@dataclass(frozen=True, eq=False)
class Linearisation(Generic[State]):
    """A cost about one state: Gauss-Newton information [P, P] (dense or sparse), gradient [P], value, and function."""

    information: np.ndarray | sparse.spmatrix
    gradient: np.ndarray
    value: float
    cost: Callable[[State], float]

    def step(self, damping: float) -> np.ndarray:
        """The damped step [P]: the information's diagonal counts `1 + damping` times (Marquardt 1963)."""
        diagonal = self.information.diagonal()
        if isinstance(self.information, np.ndarray):
            return np.asarray(np.linalg.solve(self.information + damping * np.diag(diagonal), -self.gradient))
        damped = self.information + damping * sparse.diags(diagonal + 1e-9)
        return np.asarray(splu(damped.tocsc()).solve(-self.gradient))


def levenberg_marquardt(
    state: State,
    linearise: Callable[[State], Linearisation[State]],
    move: Callable[[State, np.ndarray], State],
    *,
    max_steps: int,
    damping: float,
    tolerance: float,
) -> State:
    """Minimise a cost from an initial state.

    move(state, step [P]): the state after a step in its own parameters; tolerance: minimum relative decrease of the
    cost by an undamped step for another one to follow. Robust losses are the caller's: weights in the linearisation,
    values in its cost.
    """
    for _ in range(max_steps):
        at = linearise(state)
        for _ in range(DAMPING.max_trials):
            trial = move(state, at.step(damping))
            value = at.cost(trial)
            if value < at.value:
                break
            damping *= DAMPING.damping_factor
        else:
            return state
        state, damping = trial, max(damping / DAMPING.damping_factor, DAMPING.min_damping)
        if at.value - value < tolerance * at.value and damping <= DAMPING.free_damping:
            return state
    return state
