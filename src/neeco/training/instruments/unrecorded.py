"""Joints that nobody recorded: every instant is drawn with several values of the joint, and compared."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import torch
from torch import Tensor

from neeco.capture.model import Instrument
from neeco.raster import rasterize
from neeco.scene.articulation import ArticulatedInstruments
from neeco.training.instruments.finish import moving_weight, with_reading
from neeco.training.session import GaussianSession

VALUES = 13  # drawn, between the joint's limits
MOST_FRAMES = 2  # drawn of an instant that several cameras saw
COVERED = 0.3  # share of a pixel from which what moves is in it
CONTRAST = 30.0  # times the usual range of an instant's errors, against squared steps from instant to instant


@torch.no_grad()
def find_unrecorded(session: GaussianSession, articulated: ArticulatedInstruments) -> None:
    """Put every joint that nobody recorded to the values that explain the images best, smooth in time (Viterbi 1967);
    gradients move them on from there."""
    for index, instrument in enumerate(session.scene.instruments):
        for reading in instrument.unrecorded:
            limits = instrument.joints[reading]
            assert limits is not None
            values = np.linspace(*limits, VALUES)
            by_instant: dict[int, list[int]] = defaultdict(list)
            for frame, instant in enumerate(session.refinement.instants):
                by_instant[instant].append(frame)
            moving = moving_weight(session.scene.canonical, articulated, index, reading)
            errors = np.stack(
                [
                    sum(_errors(session, frame, instrument, reading, values, moving) for frame in frames[:MOST_FRAMES])
                    for _, frames in sorted(by_instant.items())
                ]
            )  # [instants, VALUES]
            usual = float(np.median(np.ptp(errors, axis=1)))
            if usual > 0:
                path = smooth_path(CONTRAST * errors / usual, values, values[1] - values[0])
                session.refinement.set_unrecorded(instrument, reading, path)


def _errors(
    session: GaussianSession, frame: int, instrument: Instrument, reading: str, values: np.ndarray, moving: Tensor
) -> np.ndarray:
    """[V] summed error of a frame's image with every value of the joint, where what it moves is with any of them."""
    state, camera = session.corrected(frame)
    target, mask = session.views.target(frame), session.views.mask(frame)
    renderings = []
    for value in values.tolist():
        variant = with_reading(state, instrument.name, reading, value)
        renderings.append(rasterize(session.scene.at(variant), camera, channels=moving))
    covered = torch.stack([one.channels[..., 0] for one in renderings if one.channels is not None]).amax(0) > COVERED
    if mask is not None:
        covered &= mask
    return np.array([float((one.color - target).abs().mean(-1)[covered].sum()) for one in renderings])


def smooth_path(costs: np.ndarray, values: np.ndarray, sigma: float) -> list[float]:
    """The values [T] of least `costs` [T, V], which move by about `sigma` from one to the next."""
    steps = ((values[:, None] - values[None]) / sigma) ** 2  # [to, from]
    best, came = costs[0], []
    for own in costs[1:]:
        through = best[None] + steps
        came.append(through.argmin(1))
        best = own + through.min(1)
    place = int(best.argmin())
    path = [place]
    for before in reversed(came):
        place = int(before[place])
        path.append(place)
    return [float(values[k]) for k in reversed(path)]
