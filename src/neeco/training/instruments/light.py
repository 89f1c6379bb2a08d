"""Where the light is that casts the instruments' shadow on the tissue: tried around the lens, then learned."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from neeco.raster import rasterize
from neeco.raster.types import Gaussians, Rendering
from neeco.training.instruments.solid import SOLID, spread
from neeco.training.session import GaussianSession

DIRECTIONS = 8
RADII = (0.04, 0.02, 0.08)  # of the tissue's distance; the first is tried all around, the others where that was best
TRIED_FRAMES = 12
COVERED = 0.05  # of a pixel, by solid instrument: the tissue is not judged by more
BESIDE = 7  # px, side of the square about a pixel that must be as little covered
AGREE = 0.75  # share of the frames that a shadow must make better
EXPLAINS = 0.01  # share of the squared error beside the instruments that it must take away
STRONGEST = 0.9


@dataclass(frozen=True)
class _Trial:
    """A light tried: the squared error it takes away, the share of frames it makes better, and what it is."""

    taken: float
    agree: float
    strength: float
    offset: Tensor  # [3] mm, camera frame


@torch.no_grad()
def find_shadow(session: GaussianSession) -> None:
    """Set the scene's shadow to the light that best explains what the tissue and the solid part of the instruments do
    not; leave it off where none explains enough."""
    scene, views = session.scene, session.views
    frames = spread(session, TRIED_FRAMES)
    plain = [_drawn(session, index) for index in frames]
    beside = [_beside(views.masks[index], drawing) for index, drawing in zip(frames, plain, strict=True)]
    residuals = [
        (drawing.color - views.target(index)) * pixels
        for index, drawing, pixels in zip(frames, plain, beside, strict=True)
    ]
    total = sum(float(residual.square().sum()) for residual in residuals)

    def tried(radius: float, angle: float) -> _Trial:
        offset = scene.center.new_tensor([math.cos(angle), math.sin(angle), 0.0]) * radius * 2 * session.extent
        scene.shadow_offset.copy_(offset)
        scene.shadow_strength.fill_(1.0)
        darkened = [
            (drawing.color - _drawn(session, index).color) * pixels
            for index, drawing, pixels in zip(frames, plain, beside, strict=True)
        ]
        along = [float((dark * residual).sum()) for dark, residual in zip(darkened, residuals, strict=True)]
        power = sum(float(dark.square().sum()) for dark in darkened)
        strength = min(STRONGEST, max(0.0, sum(along) / max(power, 1e-12)))
        taken = 2 * strength * sum(along) - strength**2 * power
        return _Trial(taken, sum(value > 0 for value in along) / len(along), strength, offset)

    angles = [2 * math.pi * k / DIRECTIONS for k in range(DIRECTIONS)]
    trials = [tried(RADII[0], angle) for angle in angles]
    angle = angles[max(range(DIRECTIONS), key=lambda k: trials[k].taken)]
    best = max([*trials, *(tried(radius, angle) for radius in RADII[1:])], key=lambda trial: trial.taken)
    found = best.taken > EXPLAINS * total and best.agree >= AGREE
    scene.shadow_offset.copy_(best.offset if found else torch.zeros_like(best.offset))
    scene.shadow_strength.fill_(best.strength if found else 0.0)
    scene.diagnostics["shadow"] = {
        "found": found,
        "explains": round(best.taken / max(total, 1e-12), 4),
        "agree": round(best.agree, 2),
        "started_from_mm": [round(float(v), 2) for v in best.offset],
        "strength": round(best.strength, 3),
    }


def _drawn(session: GaussianSession, index: int) -> Rendering:
    """Frame `index` without what is faint of the instruments, with one channel: how much of a pixel is instrument.

    What is faint may be the shadow, learned as a part that moves along.
    """
    state, camera = session.corrected(index)
    posed: Gaussians = session.scene.at(state)
    instrument = session.scene.canonical.bodies > 0
    kept = ~instrument | (posed.opacities > SOLID)
    return rasterize(posed.select(kept), camera, channels=instrument[kept].float()[:, None])


def _beside(mask: Tensor | None, drawing: Rendering) -> Tensor:
    """[H, W, 1] 1 where the frame counts and no instrument is near."""
    assert drawing.channels is not None
    near = max_pool2d(drawing.channels[..., 0][None, None], BESIDE, 1, BESIDE // 2)[0, 0]
    beside = near < COVERED
    return (beside if mask is None else beside & mask)[..., None].float()
