"""How far each held-out frame is from the nearest state that was trained on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from neeco.capture.model import Capture, Frame

STILL = 1e-9  # a coordinate that varies less than this in training tells nothing apart


def distances_to_training(capture: Capture) -> dict[str, float]:
    """Distance of every frame outside `train` from the nearest training frame's state, by frame name.

    A state's coordinates are the instruments' positions (mm), the entries of their rotation matrices and their joints
    (rad), or the time (s) where the capture has no instruments. Each is divided by its standard deviation over the
    training frames; the distance is the root mean square over the coordinates, so it reads in standard deviations of
    the training states. Coordinates that stand still in training are left out; empty when all do.
    """
    training = capture.split("train")
    others = [frame for frame in capture.frames if frame.split != "train"]
    if not training or not others:
        return {}
    names = tuple(instrument.name for instrument in capture.instruments)
    known, asked = _coordinates(training, names), _coordinates(others, names)
    spread = known.std(0)
    moving = spread > STILL
    if not moving.any():
        return {}
    known, asked = known[:, moving] / spread[moving], asked[:, moving] / spread[moving]
    squared = ((asked[:, None] - known[None]) ** 2).mean(-1)  # [others, training]
    return {frame.name: float(value) for frame, value in zip(others, np.sqrt(squared.min(1)), strict=True)}


def _coordinates(frames: Sequence[Frame], instruments: tuple[str, ...]) -> np.ndarray:
    """[F, S] float64."""
    return np.array([_coordinates_of(frame, instruments) for frame in frames], np.float64)


def _coordinates_of(frame: Frame, instruments: tuple[str, ...]) -> list[float]:
    if not instruments:
        return [frame.state.time]
    values: list[float] = []
    for name in instruments:
        state = frame.state.instruments[name]
        values += state.pose[:3].double().numpy().ravel().tolist()
        values += [state.joints[joint] for joint in sorted(state.joints)]
    return values
