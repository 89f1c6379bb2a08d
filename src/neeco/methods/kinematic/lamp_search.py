"""Search for the lamps that cast the instruments' shadows, among candidates around the lens; training refines them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import cosine_similarity, max_pool2d

from neeco.raster import depth_maps, rasterize
from neeco.raster.shadow import GAMMA, Casting, blocked
from neeco.raster.types import Gaussians
from neeco.scene.gaussian_scene import MAX_LAMPS
from neeco.training.session import GaussianSession


@dataclass(frozen=True, kw_only=True)
class LampSearchSettings:
    """Settings of the search for lamps."""

    # as a share of the tissue's distance: a lamp closer to the lens would explain any dark edge
    candidate_radii: tuple[float, float] = (0.04, 0.08)
    max_coverage: float = 0.05  # share of a pixel covered by solid instrument, above which it is not compared
    n_lamp_frames: int = 12  # frames used to score lamps
    n_lamp_directions: int = 8  # candidate directions around the lens
    # minimum share of the frames' changes in error, in sum, that are reductions; frames without a visible shadow have
    # hardly any change
    min_agreement: float = 0.75
    min_explained: float = 0.005  # minimum share of the squared error near the instruments explained by each lamp
    margin_px: int = 3  # px of search images, around compared pixels, that must show no instrument
    max_brightness: float = 0.8  # of white: errors at highlights exceed those of any shadow
    min_brightness: float = 0.05  # of white, to which rendered colours are clamped
    max_residual: float = 0.1  # of white, to which residuals are clamped
    faint_opacity: float = 0.5  # maximum opacity of an instrument's Gaussian that may model the shadow
    faded_opacity: float = 0.02  # opacity to which these Gaussians are reset
    max_strength: float = 0.9  # initial maximum: a lamp that provides all the light has no gradient
    max_cosine: float = 0.5  # between directions from the lens: lamps within 60 degrees would cast one shadow


LAMPS = LampSearchSettings()


@dataclass(frozen=True)
class _Fit:
    """Chosen candidate lamps and their strengths."""

    chosen: tuple[int, ...]
    strengths: NDArray[np.float64]  # [L]
    explained: float  # squared error that they explain


@dataclass(frozen=True)
class _NormalEquations:
    """Normal equations, per frame, of a least-squares fit of the strengths of C candidate lamps to F frames."""

    gram: NDArray[np.float64]  # [F, C, C]: products of the candidates' shadows
    moment: NDArray[np.float64]  # [F, C]: products of the shadows and the residual, rendered minus recorded
    total: float  # squared residual

    def fit(self, chosen: tuple[int, ...]) -> _Fit:
        """Return the non-negative least-squares strengths of these lamps."""
        from scipy.optimize import nnls  # slow to import

        gram, moment = self.gram.sum(0)[np.ix_(chosen, chosen)], self.moment.sum(0)[list(chosen)]
        root = np.linalg.cholesky(gram + 1e-6 * np.eye(len(chosen)))
        strengths, _ = nnls(root.T, np.linalg.solve(root, moment))
        return _Fit(chosen, strengths, float(2 * strengths @ moment - strengths @ gram @ strengths))

    def agreement(self, fit: _Fit) -> float:
        """Return the sum of the reductions of error over frames, as a share of all frames' changes in error."""
        index = list(fit.chosen)
        common = np.einsum("i,fij,j->f", fit.strengths, self.gram[:, index][:, :, index], fit.strengths)
        reductions = 2 * self.moment[:, index] @ fit.strengths - common  # [F]
        return float(reductions.clip(0).sum() / max(np.abs(reductions).sum(), 1e-12))


@torch.no_grad()
def find_shadow(session: GaussianSession) -> None:
    """Add to the scene's lamps those that best explain the residual of tissue, solid instruments and known shadows;
    none if none explains enough."""
    scene = session.scene
    free = [lamp for lamp in range(MAX_LAMPS) if float(scene.shadow_strengths[lamp]) <= 0]
    if not scene.instruments or not free:
        return
    angles = torch.arange(LAMPS.n_lamp_directions) * (2 * math.pi / LAMPS.n_lamp_directions)
    around = torch.stack([angles.cos(), angles.sin(), torch.zeros_like(angles)], 1)
    # candidate lamps [C, 3] mm around the lens, camera frame
    offsets = torch.cat([radius * (2 * session.extent) * around for radius in LAMPS.candidate_radii]).to(scene.center)
    equations = _normal_equations(session, offsets)
    fixed_lamps = [scene.shadow_offsets[lamp] for lamp in range(MAX_LAMPS) if lamp not in free]
    fit = _choose(equations, offsets, fixed_lamps, LAMPS.min_explained)
    agree = equations.agreement(fit)
    searches = scene.diagnostics.setdefault("shadow", [])
    searches.append(
        {
            "iteration": session.iteration,
            "explains": round(fit.explained / max(equations.total, 1e-12), 4),
            "agree": round(agree, 2),
            "found_at_mm": [],
        }
    )
    if not fit.chosen or agree < LAMPS.min_agreement:
        return
    for lamp, candidate, strength in zip(free, fit.chosen, fit.strengths, strict=False):
        scene.shadow_offsets[lamp] = offsets[candidate]
        scene.shadow_strengths[lamp] = min(float(strength), LAMPS.max_strength)
        searches[-1]["found_at_mm"].append([round(float(v), 2) for v in offsets[candidate]])
    logits = scene.canonical.opacity_logits  # faint Gaussians of instruments may have modelled the shadow
    faint = scene.canonical.of_instruments & (torch.sigmoid(logits) <= LAMPS.faint_opacity)
    logits[faint] = logits[faint].clamp_max(math.log(LAMPS.faded_opacity / (1 - LAMPS.faded_opacity)))
    session.adam.forget("opacity_logits")


def _choose(equations: _NormalEquations, offsets: Tensor, known: list[Tensor], min_explained: float) -> _Fit:
    """Choose greedily among lamps at `offsets` [C, 3]: repeatedly the one that explains most, while it explains
    `min_explained` of the error and is far enough from those chosen and `known`; at most MAX_LAMPS including these."""
    best = _Fit((), np.zeros(0), 0.0)
    while len(known) + len(best.chosen) < MAX_LAMPS:
        taken = [*known, *(offsets[k] for k in best.chosen)]
        apart = [
            k
            for k in range(len(offsets))
            if all(float(cosine_similarity(offsets[k], other, dim=0)) < LAMPS.max_cosine for other in taken)
        ]
        if not apart:
            break
        more = max((equations.fit((*best.chosen, k)) for k in apart), key=lambda fit: fit.explained)
        if more.explained - best.explained < min_explained * equations.total or not (more.strengths > 0).all():
            break
        best = more
    return best


def _normal_equations(session: GaussianSession, offsets: Tensor) -> _NormalEquations:
    """Return the normal equations of candidate lamps at `offsets` [C, 3] mm, from some of the training frames."""
    gram, moment, total = [], [], 0.0
    margin = max(1, round(LAMPS.margin_px * session.scale / session.resolution.search_scale))
    for index in session.frames_along_poses(LAMPS.n_lamp_frames):
        color, shade, instrument = _render_candidates(session, index, offsets)
        target, mask = session.views.target(index), session.views.mask(index)
        near = max_pool2d(instrument[None, None], 2 * margin + 1, 1, margin)[0, 0]  # an instrument within `margin` px
        counts = (near < LAMPS.max_coverage) & (torch.maximum(color, target).amax(-1) < LAMPS.max_brightness)
        if mask is not None:
            counts &= mask
        color, target = color[counts].clamp(LAMPS.min_brightness, 1), target[counts]  # [P, 3]
        # in linear light, where lamps add up, divided by the slope of the stored curve to weight errors as stored
        residual = (color - target**GAMMA * color ** (1 - GAMMA)) / GAMMA
        residual = residual.clamp(-LAMPS.max_residual, LAMPS.max_residual)
        darkened = (color / GAMMA)[:, :, None] * shade[counts][:, None, :]  # [P, 3, C]
        total += float(residual.square().sum())
        flat = darkened.flatten(0, 1)  # [3 P, C]
        gram.append((flat.T @ flat).double().cpu().numpy())
        moment.append((flat.T @ residual.flatten()).double().cpu().numpy())
    return _NormalEquations(np.stack(gram), np.stack(moment), total)


def _render_candidates(session: GaussianSession, index: int, offsets: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Render frame `index` without the instruments' faint Gaussians, which may model the shadow: colour [H, W, 3], the
    occluded share of each candidate's light [H, W, C], and the instruments' coverage [H, W]."""
    state, camera = session.corrected(index)
    scene = session.scene
    posed: Gaussians = scene.at(state)
    instrument = scene.canonical.bodies > 0
    casting = ~instrument | (posed.opacities > LAMPS.faint_opacity)
    posed, instrument = posed.select(casting), instrument[casting]
    among = Casting.of(posed, instrument, camera)
    missed = blocked(among, scene.shadow_width, offsets, depth_maps)  # [C, N]
    channels = torch.stack([instrument.float(), *missed], 1)  # [N, 1 + C]
    rendering = rasterize(posed, camera, channels=channels)
    assert rendering.channels is not None
    return rendering.color, rendering.channels[..., 1:], rendering.channels[..., 0]
