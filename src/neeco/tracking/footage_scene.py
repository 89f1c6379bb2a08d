"""A run's instruments over the tissue of footage, in its light: the scene with which such footage is tracked.

Tissue and light are learned from the footage itself (`neeco.tracking.footage_tissue`). Another camera has another
exposure, white balance and contrast. The instruments' colours therefore get one gain per channel and one gamma. Both,
and the lamps whose shadow the instruments cast, are fitted in a few frames in which the instruments are found.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.ndimage import binary_erosion
from scipy.optimize import least_squares
from torch import Tensor

from neeco.capture.model import Frame, evenly_spaced
from neeco.fitting.crop_rendering import working_size
from neeco.fitting.state_fitter import StateFit, loose_prior
from neeco.methods.kinematic.lamp_search import find_shadow
from neeco.raster.reference import SH_C0
from neeco.scene import CanonicalGaussians, GaussianScene
from neeco.scene.canonical import join_bodies
from neeco.scene.training_views import TrainingViews
from neeco.tracking.footage_tissue import Progress, foreground
from neeco.tracking.parameters import TrackingFitter, fitter_of
from neeco.tracking.search import Search
from neeco.training.config import method_defaults
from neeco.training.session import new_session

N_FRAMES = 8  # in which instruments are searched for
USED_SHARE, MAX_MISFIT = 0.5, 2.0  # of the found frames that are compared; of the best one's misfit, that they may have
N_ROUNDS = 3  # each with states fitted in the colours of the one before
ROUND_PRIOR = (10.0, 10.0, 15.0)  # deg, mm, deg of joints: standard deviations of states in these
MIN_ALPHA = 0.95  # of a pixel that shows the instruments alone
MIN_COLOR, MAX_COLOR = 0.02, 0.95  # beyond which colours are not compared
MAX_PIXELS = 20_000  # compared
HUBER = 0.05  # residual of a colour beyond which the cost is linear
N_RENDERED = 24  # recorded states whose colours are compared with those of the foreground
QUANTILES = (0.1, 0.9, 17)  # of colours that are compared: from, to, how many
MIN_PIXELS = 200  # from which they are taken
MIN_CHANGE = 0.15  # of the logarithm of gains and gamma, below which colours are the same
GAIN_RANGE, GAMMA_RANGE = (0.4, 2.5), (0.5, 2.0)
GAMMA_SD, PRIOR_WEIGHT = 0.2, 0.005  # standard deviation of gamma's logarithm; mean colour error that weighs as much
MIN_GAUSSIAN_COLOR = 0.01  # a darker Gaussian's gamma is taken at this colour


@dataclass(frozen=True)
class Colors:
    """A camera's map of the instruments' recorded colours c: gain * c ** gamma."""

    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    gamma: float = 1.0

    @property
    def differs(self) -> bool:
        """Whether instruments could not be found in their recorded colours."""
        return any(abs(math.log(value)) > MIN_CHANGE for value in (*self.gain, self.gamma))

    def of(self, scene: GaussianScene) -> GaussianScene:
        """Return the scene with recoloured instruments.

        Colours viewed head on are exact, view dependence is right to first order, and dimming with the distance as far
        as it is a power of it.
        """
        canonical, rows = scene.canonical, scene.canonical.of_instruments
        gain = canonical.sh_dc.new_tensor(self.gain)
        color = (canonical.sh_dc[:, 0] * SH_C0 + 0.5).clamp_min(MIN_GAUSSIAN_COLOR)  # [N, 3]
        slope = gain * self.gamma * color ** (self.gamma - 1)
        dc = ((gain * color**self.gamma - 0.5) / SH_C0)[:, None]
        tensors = canonical.tensors()
        tensors["sh_dc"] = torch.where(rows[:, None, None], dc, canonical.sh_dc)
        tensors["sh_rest"] = torch.where(rows[:, None, None], canonical.sh_rest * slope[:, None], canonical.sh_rest)
        made = _copy(scene, CanonicalGaussians.from_tensors(tensors, canonical.counts))
        made.falloff[1] *= self.gamma
        return made

    @classmethod
    def fitted(cls, rendered: Tensor, observed: Tensor) -> Colors:
        """Return the map from rendered colours [P, 3] to observed ones [P, 3], by least squares with Huber's loss."""
        colors = torch.stack([rendered, observed])  # [2, P, 3]
        comparable = ((colors > MIN_COLOR) & (colors < MAX_COLOR)).all(2).all(0)
        pairs = colors[:, comparable].double().numpy()
        pairs = pairs[:, evenly_spaced(pairs.shape[1], MAX_PIXELS)] if pairs.shape[1] else pairs
        if not pairs.shape[1]:
            return cls()
        weight = 1 / np.sqrt(pairs[0].size)

        def residuals(at: np.ndarray) -> np.ndarray:
            off = np.exp(at[:3]) * pairs[0] ** np.exp(at[3]) - pairs[1]
            far = np.maximum(np.abs(off), HUBER)
            bent = np.where(np.abs(off) < HUBER, off, np.sign(off) * np.sqrt(2 * HUBER * far - HUBER**2))
            return np.append(weight * bent.ravel(), PRIOR_WEIGHT * at[3] / GAMMA_SD)

        low, high = (np.log([GAIN_RANGE[k]] * 3 + [GAMMA_RANGE[k]]) for k in (0, 1))
        found = least_squares(residuals, np.zeros(4), bounds=(low, high)).x
        red, green, blue, gamma = (float(value) for value in np.exp(found))
        return cls((red, green, blue), gamma)


def over_tissue(instruments: GaussianScene, tissue: GaussianScene) -> GaussianScene:
    """Return the instruments of one scene over the tissue of another, in its light.

    Recorded are the states and cameras of the first, corrected by its registration, which is removed.
    """
    for scene in (instruments, tissue):
        scene.visibility()  # each by its own recorded frames
    own = instruments.canonical
    rest = own.map(lambda tensor: tensor[own.counts[0] :], (len(own) - own.counts[0],))
    size = tissue.canonical.counts[0]
    floor = tissue.canonical.map(lambda tensor: tensor[:size], (size,))
    extras = {
        name: floor.extras.get(name, tensor.new_zeros(len(floor), *tensor.shape[1:]))
        for name, tensor in own.extras.items()
    }
    ground = replace(floor, extras=extras)
    joined = join_bodies([ground, rest])
    joined = replace(joined, counts=(len(floor), *own.counts[1:]))
    deformation = instruments.deformation.combined([instruments.deformation])
    recorded = instruments.recorded
    recorded = replace(recorded, states=tuple(instruments.registered(state) for state in recorded.states))
    made = GaussianScene(
        instruments.method, joined, deformation, instruments.instruments, recorded, tissue.center.clone()
    )
    with torch.no_grad():
        made.falloff.copy_(torch.stack([tissue.falloff[0], instruments.falloff[1]]))
        made.vignette.copy_(tissue.vignette)
    made.sh_degree = max(instruments.sh_degree, tissue.sh_degree)
    made.background = tissue.background
    return made.to(own.means.device).requires_grad_(False)


def _copy(scene: GaussianScene, canonical: CanonicalGaussians) -> GaussianScene:
    """Return the scene with other Gaussians; tensors are not shared."""
    made = GaussianScene(
        scene.method,
        canonical.map(torch.clone),
        scene.deformation.combined([scene.deformation]),
        scene.instruments,
        scene.recorded,
        scene.center.clone(),
    )
    made.load_state_dict(scene.state_dict())
    made.sh_degree, made.background = scene.sh_degree, scene.background
    return made.to(scene.center.device).requires_grad_(False)


@dataclass(frozen=True)
class Adapted:
    """A scene in the light of footage, and the colours that it took."""

    scene: GaussianScene
    colors: Colors

    def to_json(self) -> dict[str, Any]:
        """Return plain values for files."""
        scene = self.scene
        return {
            "gain": [round(gain, 4) for gain in self.colors.gain],
            "gamma": round(self.colors.gamma, 4),
            "lamps_mm": [
                [round(value, 2) for value in offset.tolist()]
                for offset, strength in zip(scene.shadow_offsets, scene.shadow_strengths, strict=True)
                if float(strength) > 0
            ],
        }


def adapted(scene: GaussianScene, frames: Sequence[Frame], report: Progress) -> Adapted:
    """Return `scene`, of instruments over the tissue of `frames` (`over_tissue`), in their light."""
    plain = fitter_of(scene)
    chosen = [frames[k] for k in evenly_spaced(len(frames), N_FRAMES)]
    found: list[tuple[Frame, StateFit]] = []
    guess = _guessed(plain, chosen)
    for tried in (Colors(), guess) if guess.differs else (Colors(),):
        fits = _found(tried.of(scene), chosen, report)
        if sum(fit.gain for _, fit in fits) > sum(fit.gain for _, fit in found):
            found = fits
    lit, colors = scene, Colors()
    for _ in range(N_ROUNDS):
        found.sort(key=lambda pair: pair[1].misfit)
        limit = MAX_MISFIT * found[0][1].misfit if found else 0.0
        used = [pair for pair in found[: max(1, round(USED_SHARE * len(found)))] if pair[1].misfit <= limit]
        colors = _colors(plain, used)
        lit = colors.of(scene)
        fitter = fitter_of(lit)
        prior = loose_prior(fitter.parameters, *ROUND_PRIOR)
        found = [
            (frame, better)
            for frame, fit in found
            if (better := fitter.fit(fitter.view(frame, fit.state), fit.state, prior))
        ]
    return Adapted(with_lamps(lit, found), colors)


def with_lamps(scene: GaussianScene, found: Sequence[tuple[Frame, StateFit]]) -> GaussianScene:
    """Return the scene with the lamps whose shadow its instruments cast on the tissue, found as by training; without
    any where these explain too little."""
    made = _copy(scene, scene.canonical)
    if not found:
        return made
    frames = [replace(frame, split="train", state=fit.state) for frame, fit in found]
    views = TrainingViews.read(frames).to(scene.center.device)
    session = new_session(made, views, method_defaults(scene.method))
    logits = made.canonical.opacity_logits.clone()
    with session.searching():
        find_shadow(session)
    made.canonical.opacity_logits.copy_(logits)  # training lowers low opacities, such as those of a learned shadow
    return made.requires_grad_(False)


def _found(scene: GaussianScene, frames: Sequence[Frame], report: Progress) -> list[tuple[Frame, StateFit]]:
    """Return the frames in which the instruments of `scene` are found, with their states."""
    fitter, found = fitter_of(scene), []
    search = Search.of(fitter)
    for done, frame in enumerate(frames, 1):
        report("looking for the instruments' colours", done, len(frames))
        fit = search.anywhere(fitter.view(frame, None))
        if fit is not None:
            found.append((frame, fit))
    return found


def _guessed(plain: TrackingFitter, frames: Sequence[Frame]) -> Colors:
    """Estimate colours before any state is known, from quantiles of the foreground's colours and of the instruments
    rendered in recorded states."""
    rendered, observed, recorded = [], [], plain.instruments.scene.recorded
    for k in evenly_spaced(len(recorded.states), N_RENDERED):
        camera = working_size(recorded.cameras[k], recorded)
        color, alpha = plain.instruments.render(recorded.states[k], camera)
        rendered.append((color / alpha[..., None])[alpha > MIN_ALPHA])
    for frame in frames:
        shown = torch.from_numpy(foreground(frame, plain.tissue, margin=0))
        observed.append(frame.load_image()[shown])
    samples = [torch.cat(colors) for colors in (rendered, observed)]
    if any(len(sample) < MIN_PIXELS for sample in samples):
        return Colors()
    shares = torch.linspace(*QUANTILES).numpy()
    rows = [torch.from_numpy(np.quantile(sample.numpy(), shares, axis=0)) for sample in samples]
    return Colors.fitted(rows[0].float(), rows[1].float())


def _colors(plain: TrackingFitter, found: Sequence[tuple[Frame, StateFit]]) -> Colors:
    """Estimate colours from the instruments, rendered in their recorded colours, and the frames."""
    rendered, observed = [], []
    for frame, fit in found:
        view = plain.view(frame, None)
        color, alpha = plain.instruments.render(fit.state, view.camera)
        solid = torch.from_numpy(binary_erosion((alpha > MIN_ALPHA).numpy(), iterations=1)) & (view.weight > 0)
        rendered.append(color[solid] / alpha[solid][:, None])
        observed.append(view.image[solid])
    return Colors.fitted(torch.cat(rendered), torch.cat(observed)) if rendered else Colors()
