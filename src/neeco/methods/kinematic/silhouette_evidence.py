"""Silhouettes of instruments in the training images, by the foreground that the learned tissue leaves unexplained."""

from __future__ import annotations

import torch

from neeco.capture.model import evenly_spaced
from neeco.evidence.foreground import SETTINGS, Foreground
from neeco.training.session import GaussianSession
from neeco.training.silhouettes import INSTRUMENT, UNKNOWN, Silhouettes

N_SAMPLED = 20  # frames from which densities are learned


@torch.no_grad()
def observe_silhouettes(session: GaussianSession) -> None:
    """Set the session's silhouettes from its scene as learned so far, where its tissue explains the images better than
    when they were last observed, and well enough to tell anything."""
    if not session.scene.instruments:
        return
    count = len(session.views.frames)
    sampled = {index: session.compared(index) for index in evenly_spaced(count, N_SAMPLED)}
    foreground, known = Foreground.learned(list(sampled.values())), session.silhouettes
    if foreground is None or foreground.noise > SETTINGS.max_noise:
        return
    if known is not None and foreground.noise >= known.noise:
        return
    values = []
    for index in range(count):
        view = sampled[index] if index in sampled else session.compared(index)
        certain = UNKNOWN + foreground.certainty(view, SETTINGS.reach) * (INSTRUMENT - UNKNOWN)
        values.append(torch.from_numpy(certain.round().clip(0, 255)).to(torch.uint8))
    session.silhouettes = Silhouettes(tuple(values), foreground.noise)
