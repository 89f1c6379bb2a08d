"""How alike states are: each as a point, in standard deviations of the recorded ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from neeco.capture.model import State

STILL = 1e-9  # a coordinate that varies less than this in the recording tells nothing apart


class RecordedStates:
    """Recorded states to hold others against.

    A state's coordinates are the instruments' positions (mm), the entries of their rotation matrices and their joints
    (rad), or the time (s) where no instrument is asked for. Each is divided by its standard deviation over the recorded
    states; coordinates that stand still there are left out. joints: whether they are to count.
    """

    def __init__(self, states: Sequence[State], instruments: Sequence[str], joints: bool = True) -> None:
        self.instruments, self.joints = tuple(instruments), joints
        points = np.array([self._coordinates(state) for state in states], np.float64)
        deviation = points.std(0) if len(points) else np.zeros(0)
        self._moving = deviation > STILL
        self._deviation = deviation[self._moving]
        self._points = points[:, self._moving] / self._deviation if len(points) else points

    @property
    def still(self) -> bool:
        """Whether nothing moved, so that no state is nearer than another."""
        return not self._moving.any()

    def distances(self, state: State) -> np.ndarray:
        """[R] root mean square over the coordinates, in standard deviations, to every recorded state."""
        point = np.array(self._coordinates(state))[self._moving] / self._deviation
        return np.sqrt(((self._points - point) ** 2).mean(-1))

    def _coordinates(self, state: State) -> list[float]:
        if not self.instruments:
            return [state.time]
        values: list[float] = []
        for name in self.instruments:
            given = state.instruments[name]
            values += given.pose[:3].detach().cpu().double().numpy().ravel().tolist()
            values += [given.joints[joint] for joint in sorted(given.joints)] if self.joints else []
        return values
