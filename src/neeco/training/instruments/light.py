"""Where the lamps are that cast the instruments' shadows on the tissue: tried around the lens, then learned."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import nnls
from torch import Tensor
from torch.nn.functional import max_pool2d

from neeco.raster import rasterize
from neeco.raster.shadow import GAMMA, Casting, blocked
from neeco.raster.types import Gaussians
from neeco.scene.scene import LAMPS
from neeco.training.instruments.solid import spread
from neeco.training.session import GaussianSession

DIRECTIONS = 8
RADII = (0.04, 0.08)  # of the tissue's distance: a lamp nearer the lens would explain any dark edge
TRIED_FRAMES = 12
COVERED = 0.05  # of a pixel, by solid instrument: the tissue is not judged by more
BESIDE = 7  # px, side of the square about a pixel that must be as little covered
BRIGHT = 0.8  # of white: highlights are drawn worse than any shadow is dark
DIMMEST = 0.05  # of white: what is drawn darker is taken to be so
LARGEST = 0.1  # of white: residuals count for no more
OPAQUE = 0.5  # opacity: of the instruments, what is less may be the shadow
FAINT = 0.02  # opacity
STRONGEST = 0.9  # to begin with: nothing is learned of a lamp that gives all the light
AGREE = 0.75  # share of the frames that the first lamps found must make better
FURTHER_AGREE = 0.5  # and others, beside them
ASIDE = 0.5  # cosine, as seen from the lens: lamps nearer together than 60 degrees would share one shadow out
EXPLAINS = 0.005  # share of the squared error beside the instruments that each lamp must take away


@dataclass(frozen=True)
class _Fit:
    """Lamps chosen among those tried, and how strong they are."""

    chosen: tuple[int, ...]
    strengths: NDArray[np.float64]  # [L]
    taken: float  # squared error they take away


@dataclass(frozen=True)
class _Evidence:
    """What F frames say of C lamps that were tried, as the normal equations of a fit of their strengths."""

    power: NDArray[np.float64]  # [F, C, C]: what their shadows have in common
    along: NDArray[np.float64]  # [F, C]: with what the photographs are darker than the drawings
    total: float  # squared error

    def fit(self, chosen: tuple[int, ...]) -> _Fit:
        """The strengths, none negative, that these lamps together explain most with."""
        power, along = self.power.sum(0)[np.ix_(chosen, chosen)], self.along.sum(0)[list(chosen)]
        root = np.linalg.cholesky(power + 1e-6 * np.eye(len(chosen)))
        strengths, _ = nnls(root.T, np.linalg.solve(root, along))
        return _Fit(chosen, strengths, float(2 * strengths @ along - strengths @ power @ strengths))

    def agree(self, fit: _Fit) -> float:
        """Share of the frames that the lamps make better."""
        index = list(fit.chosen)
        common = np.einsum("i,fij,j->f", fit.strengths, self.power[:, index][:, :, index], fit.strengths)
        return float((2 * self.along[:, index] @ fit.strengths > common).mean())


@torch.no_grad()
def find_shadow(session: GaussianSession) -> None:
    """Add to the scene's lamps those that best explain what the tissue, the solid part of the instruments and the
    shadows of the lamps found before do not; none where none explains enough."""
    scene = session.scene
    free = [lamp for lamp in range(LAMPS) if float(scene.shadow_strengths[lamp]) <= 0]
    if not scene.instruments or not free:
        return
    offsets = _tried(2 * session.extent).to(scene.center)
    evidence = _ask(session, offsets)
    there = [scene.shadow_offsets[lamp] for lamp in range(LAMPS) if lamp not in free]
    fit = _choose(evidence, offsets, there)
    agree = evidence.agree(fit)
    looks = scene.diagnostics.setdefault("shadow", [])
    looks.append(
        {
            "iteration": session.iteration,
            "explains": round(fit.taken / max(evidence.total, 1e-12), 4),
            "agree": round(agree, 2),
            "found_at_mm": [],
        }
    )
    if not fit.chosen or agree < (FURTHER_AGREE if there else AGREE):
        return
    for lamp, tried, strength in zip(free, fit.chosen, fit.strengths, strict=False):
        scene.shadow_offsets[lamp] = offsets[tried]
        scene.shadow_strengths[lamp] = min(float(strength), STRONGEST)
        looks[-1]["found_at_mm"].append([round(float(v), 2) for v in offsets[tried]])
    _fade(session)


def _fade(session: GaussianSession) -> None:
    """Let what is faint of the instruments be learned anew: it may have been the shadow."""
    canonical = session.scene.canonical
    logits = canonical.opacity_logits
    faint = canonical.of_instruments & (torch.sigmoid(logits) <= OPAQUE)
    logits[faint] = logits[faint].clamp_max(math.log(FAINT / (1 - FAINT)))
    session.adam.forget("opacity_logits")


def _tried(distance: float) -> Tensor:
    """Lamps [C, 3] mm around the lens, camera frame."""
    angles = torch.arange(DIRECTIONS) * (2 * math.pi / DIRECTIONS)
    around = torch.stack([angles.cos(), angles.sin(), torch.zeros(DIRECTIONS)], 1)
    return torch.cat([radius * distance * around for radius in RADII])


def _choose(evidence: _Evidence, offsets: Tensor, there: list[Tensor]) -> _Fit:
    """One lamp of `offsets` [C, 3] after the other, always the one that brings most, as long as it brings enough and
    stands aside of those that are `there` already; at most LAMPS with them."""
    best = _Fit((), np.zeros(0), 0.0)
    while len(there) + len(best.chosen) < LAMPS:
        taken = [*there, *(offsets[k] for k in best.chosen)]
        aside = [k for k in range(len(offsets)) if all(_cosine(offsets[k], other) < ASIDE for other in taken)]
        if not aside:
            break
        more = max((evidence.fit((*best.chosen, k)) for k in aside), key=lambda fit: fit.taken)
        if more.taken - best.taken < EXPLAINS * evidence.total or not (more.strengths > 0).all():
            break
        best = more
    return best


def _cosine(a: Tensor, b: Tensor) -> float:
    return float(torch.nn.functional.cosine_similarity(a, b, dim=0))


def _ask(session: GaussianSession, offsets: Tensor) -> _Evidence:
    """What the training frames say of lamps at `offsets` [C, 3] mm."""
    power, along, total = [], [], 0.0
    for index in spread(session, TRIED_FRAMES):
        color, dark, instrument = _drawn(session, index, offsets)
        target, mask = session.views.target(index), session.views.mask(index)
        counts = _beside(instrument) & (torch.maximum(color, target).amax(-1) < BRIGHT)
        if mask is not None:
            counts &= mask
        color, target = color[counts].clamp(DIMMEST, 1), target[counts]  # [P, 3]
        # in light, where lamps add up, but counted as it is stored: divided by the slope of the stored curve
        residual = (color - target**GAMMA * color ** (1 - GAMMA)) / GAMMA
        residual = residual.clamp(-LARGEST, LARGEST)
        darkened = (color / GAMMA)[:, :, None] * dark[counts][:, None, :]  # [P, 3, C]
        total += float(residual.square().sum())
        flat = darkened.flatten(0, 1)  # [3 P, C]
        power.append((flat.T @ flat).double().cpu().numpy())
        along.append((flat.T @ residual.flatten()).double().cpu().numpy())
    return _Evidence(np.stack(power), np.stack(along), total)


def _drawn(session: GaussianSession, index: int, offsets: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Frame `index` without what is faint of the instruments: colour [H, W, 3], what of the light each lamp [H, W, C]
    would miss there, and how much of a pixel is instrument [H, W].

    What is faint may be the shadow, learned as a part that moves along.
    """
    state, camera = session.corrected(index)
    scene = session.scene
    posed: Gaussians = scene.at(state)
    instrument = scene.canonical.bodies > 0
    kept = ~instrument | (posed.opacities > OPAQUE)
    posed, instrument = posed.select(kept), instrument[kept]
    among = Casting.of(posed, instrument, camera)
    missed = blocked(among, scene.shadow_width, offsets, rasterize)  # [C, N]
    channels = torch.stack([instrument.float(), *missed], 1)  # [N, 1 + C]
    drawing = rasterize(posed, camera, channels=channels)
    assert drawing.channels is not None
    return drawing.color, drawing.channels[..., 1:], drawing.channels[..., 0]


def _beside(instrument: Tensor) -> Tensor:
    """[H, W] bool: where no instrument is near, of how much of a pixel is instrument."""
    return max_pool2d(instrument[None, None], BESIDE, 1, BESIDE // 2)[0, 0] < COVERED
