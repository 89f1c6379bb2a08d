"""Silhouettes of instruments in the training images, by the foreground that the learned tissue leaves unexplained."""

from __future__ import annotations

import torch

from neeco.capture.model import evenly_spaced
from neeco.evidence.foreground import Comparison, Foreground
from neeco.training.session import GaussianSession
from neeco.training.silhouettes import INSTRUMENT, UNKNOWN, Silhouettes

OBSERVED_AT = (0.1, 0.32, 0.6)  # shares of the run
N_SAMPLED = 20  # frames from which densities are learned
MAX_NOISE = 0.12  # of the tissue (share of its brightness), above which it is not learned well enough to tell anything
NEAR = 0.075  # of the images' width: no instrument shows farther from a rendered one


@torch.no_grad()
def observe_silhouettes(session: GaussianSession) -> None:
    """Set the session's silhouettes from its scene as learned so far, where its tissue explains the images better than
    when they were last observed, and well enough to tell anything."""
    if not session.scene.instruments:
        return
    count = len(session.views.frames)
    sampled = {index: _view(session, index) for index in evenly_spaced(count, N_SAMPLED)}
    foreground, known = Foreground.learned(list(sampled.values())), session.silhouettes
    if foreground is None or foreground.noise > MAX_NOISE or (known is not None and foreground.noise >= known.noise):
        return
    values = []
    for index in range(count):
        view = sampled[index] if index in sampled else _view(session, index)
        certain = UNKNOWN + foreground.certainty(view, NEAR) * (INSTRUMENT - UNKNOWN)
        values.append(torch.from_numpy(certain.round().clip(0, 255)).to(torch.uint8))
    session.silhouettes = Silhouettes(tuple(values), foreground.noise)


def _view(session: GaussianSession, index: int) -> Comparison:
    state, camera = session.corrected(index)
    return Comparison.of(session.scene, state, camera, session.views.target(index), session.views.mask(index))
