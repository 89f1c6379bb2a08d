"""Trust in tracked states: in their pose, roll and joints, not in their outline alone.

Trust is a product of five factors, each 1 where nothing speaks against the state:

- `overlap`: the overlap (IoU) of its label that the image supports (`neeco.evaluation.trust`). An instrument turned by
  25 degrees still explains most of its pixels, so that the outline alone does not determine roll and joints;
- `explained`: the misfit compared with that of training frames. The farther the view is from all recorded directions,
  the smaller it must be;
- `observed`: the share of the visible instrument that some training frame observed from a similar direction. Sides that
  none observed are arbitrary in a scene, and images of them fit wrong rolls as well;
- `single`: whether another state, with another roll or other joints, explains the image as well;
- `determined`: the probability that rotation and joints err by less than 10 degrees, given images and motion: jaws
  outside the image may be open or closed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.capture.model import Frame, State, evenly_spaced
from neeco.evaluation.trust import SETTINGS, TypicalErrors, estimate_trust, typical_errors_of
from neeco.geometry.camera import Camera
from neeco.labels.labellers import CompositedLabels, composited_labels
from neeco.raster import rasterize
from neeco.states.crop_rendering import composite
from neeco.states.fitter import StateFit, loose_prior
from neeco.states.parameters import DEG
from neeco.tracking.parameters import TrackedInstrument, TrackingFitter
from neeco.tracking.search import Search, differ


@dataclass(frozen=True, kw_only=True)
class TrackTrustSettings:
    """Settings of the trust in tracked states."""

    n_reference_frames: int = 16  # number of training frames from which usual misfits are estimated
    usual_quantile: float = 0.9  # quantile of these misfits that counts as usual
    min_misfit: float = 0.08  # minimum usual misfit: about 4 of 255 grey levels
    min_error: float = 0.012  # minimum usual error of a pixel's colour in [0, 1]
    half_trust_misfit: float = 4.0  # ratio to the usual misfit, at which `explained` is 1/2
    steepness: float = 4.0  # exponent of the fall of `explained`
    # angle from the nearest recorded direction, at which the misfit must be half as large, since the scene is a guess
    halving_deg: float = 8.0
    min_observed: float = 0.9  # ratio to the share in the worst reference frame, that counts as fully observed
    confident: float = 0.9  # product of the other factors below which another state is searched for
    n_others_fitted: int = 2  # number of these states that are fitted
    # deg, mm, deg of joints: standard deviations of the other state
    other_prior: tuple[float, float, float] = (20.0, 5.0, 20.0)
    # sizes of the images compared, and steps at each
    other_levels: tuple[tuple[float, int], tuple[float, int]] = ((0.25, 4), (0.5, 2))
    max_other_misfit: float = 2.0  # maximum ratio of another state's misfit to the fit's, for it to be fitted further
    other_deg: float = 10.0  # minimum rotation between two different states
    other_joint_deg: float = 8.0  # the same, of joints
    misfit_ratios: tuple[float, float] = (1.3, 1.0)  # of another state's misfit: where `single` is 1, and lowest
    ambiguous: float = 0.6  # reduction of `single` at the second
    wrong_deg: float = 10.0  # error of rotation or a joint with which a state is wrong


TRUST = TrackTrustSettings()


@dataclass(frozen=True)
class TrackTrust:
    """Factors of the trust in a state (see the module)."""

    overlap: float
    explained: float
    observed: float
    single: float
    determined: float = 1.0  # known once the motion is

    @property
    def value(self) -> float:
        """The trust, in [0, 1]."""
        return math.prod(astuple(self))

    def to_json(self) -> dict[str, float]:
        """Return plain values for files."""
        return {"value": round(self.value, 4)} | {name: round(factor, 4) for name, factor in asdict(self).items()}


NO_TRUST = TrackTrust(0.0, 0.0, 0.0, 0.0, 0.0)  # where no state was found


@dataclass(frozen=True)
class LabelledView:
    """Instruments rendered over tissue, with what `neeco.evaluation.trust` needs."""

    image: Tensor  # [h, w, 3] in [0, 1]
    parts: Tensor  # [h, w] uint8
    tissue_image: Tensor  # [h, w, 3]
    alpha: Tensor  # [h, w]
    unobserved: Tensor  # [h, w] share of a pixel that no training frame observed from a similar direction

    @property
    def observed_share(self) -> float:
        """Share of the label's pixels that training frames observed; 0 without a label."""
        label = self.parts > 0
        if not label.any():
            return 0.0
        return float(1 - (self.unobserved[label] / self.alpha[label].clamp_min(1e-6)).clamp(0, 1).mean())


class LabelRenderer:
    """Renders fits of instruments with the scene's own labels."""

    def __init__(self, fitter: TrackingFitter) -> None:
        """Raises NeecoError for a scene without labels."""
        scene = fitter.instruments.scene
        labels = CompositedLabels(scene)
        self.fitter, self.threshold = fitter, labels.threshold
        self.channels = labels.channels[scene.canonical.counts[0] :].contiguous()  # [N, L] of the instruments

    @torch.no_grad()
    def render(self, fit: StateFit) -> LabelledView:
        """Render the fit's instruments over the tissue of its view, with their parts."""
        view, posed = fit.view, self.fitter.instruments.pose(fit.state)
        unobserved = self.fitter.instruments.alone.unobserved(posed, view.camera)
        channels = torch.cat([self.channels, unobserved[:, None]], 1)
        rendering = rasterize(posed, view.camera, channels=channels, background=posed.means.new_zeros(3))
        assert rendering.channels is not None
        parts, _ = composited_labels(replace(rendering, channels=rendering.channels[..., :-1]), self.threshold)
        color, alpha = rendering.color.cpu(), rendering.alpha.cpu()
        image = composite(color, alpha, view.tissue).clamp(0, 1)
        return LabelledView(image, parts.cpu(), view.tissue, alpha, rendering.channels[..., -1].cpu())


@dataclass(frozen=True)
class Reference:
    """Typical misfit and errors of the scene in frames that it was learned from."""

    errors: TypicalErrors
    misfit: float  # the usual_quantile of theirs
    observed: float  # share of the label's pixels, in the worst of them

    @classmethod
    def of(cls, fitter: TrackingFitter, frames: Sequence[Frame]) -> Reference:
        """Measure it on some of the training frames, states fitted to each. Raises NeecoError when an image cannot be
        read."""
        recorded, renderer = fitter.instruments.scene.recorded, LabelRenderer(fitter)
        states = dict(zip(recorded.names, recorded.states, strict=True))
        prior = loose_prior(fitter.parameters, 2.0, 2.0, 4.0)
        judged, misfits, shares = [], [], []
        for k in evenly_spaced(len(frames), TRUST.n_reference_frames):
            start = states.get(frames[k].name, frames[k].state)
            fit = fitter.fit(fitter.view(frames[k], start), start, prior)
            if fit is None:
                continue
            drawing = renderer.render(fit)
            judged.append((drawing, fit.view.image, fit.view.weight > 0))
            misfits.append(fit.misfit)
            shares.append(drawing.observed_share)
        if not misfits:
            raise NeecoError("track: no training frame of the run shows an instrument; train it again")
        typical = typical_errors_of(judged)
        errors = TypicalErrors(max(TRUST.min_error, typical.inside), max(TRUST.min_error, typical.nearby))
        return cls(errors, max(TRUST.min_misfit, float(np.quantile(misfits, TRUST.usual_quantile))), min(shares))

    def to_json(self) -> dict[str, float]:
        """Return plain values for files."""
        return {**asdict(self.errors), "misfit": round(self.misfit, 5), "observed": round(self.observed, 5)}


def _direction(item: TrackedInstrument, state: State, camera: Camera) -> Tensor:
    """Return the unit direction [3] float64 from an instrument's pivot to the camera, instrument frame."""
    pose, centre = state.instruments[item.name].pose.double().cpu(), camera.world_from_camera[:3, 3].double().cpu()
    return torch.nn.functional.normalize(pose[:3, :3].T @ (centre - pose[:3, 3]) - item.pivot, dim=0)


@dataclass(frozen=True)
class Judge:
    """Estimates the trust in tracked states."""

    fitter: TrackingFitter
    search: Search
    reference: Reference
    allowance: float = 1.0  # times the reference's misfit that is usual: light and tissue may be learned less well

    @cached_property
    def directions(self) -> list[Tensor]:
        """Directions from which training frames observed every instrument, [M, 3] unit, instrument frame."""
        recorded = list(zip(self.search.recorded.states, self.search.recorded.cameras, strict=True))
        instruments = self.fitter.parameters.instruments
        return [torch.stack([_direction(item, state, camera) for state, camera in recorded]) for item in instruments]

    def beyond(self, state: State, camera: Camera) -> float:
        """Return the angle (deg) to the nearest recorded direction, of the instrument for which it is largest."""
        return max(
            float((recorded @ _direction(item, state, camera)).amax().clamp(-1, 1).arccos()) / DEG
            for item, recorded in zip(self.fitter.parameters.instruments, self.directions, strict=True)
        )

    @cached_property
    def renderer(self) -> LabelRenderer:
        """The renderer of fits with their labels."""
        return LabelRenderer(self.fitter)

    def judge(self, fit: StateFit, search_rolls: bool = False) -> tuple[TrackTrust, StateFit | None]:
        """Return the trust in a fitted state, and the best other state where one was searched for: with
        `search_rolls`, or where the trust is low."""
        drawing, view = self.renderer.render(fit), fit.view
        neighbourhood = SETTINGS.neighbourhood * view.diagonal / math.hypot(view.camera.width, view.camera.height)
        overlap = estimate_trust(drawing, view.image, view.weight > 0, self.reference.errors, neighbourhood).value
        beyond = self.beyond(fit.state, view.camera)
        half = TRUST.half_trust_misfit * self.allowance * self.reference.misfit / (1 + beyond / TRUST.halving_deg)
        explained = 1 / (1 + (fit.misfit / half) ** TRUST.steepness)
        observed = min(1.0, drawing.observed_share / (TRUST.min_observed * self.reference.observed))
        trust = TrackTrust(overlap, explained, observed, 1.0)
        if not search_rolls and trust.value >= TRUST.confident:
            return trust, None
        other = self._other(fit)
        highest, lowest = TRUST.misfit_ratios
        ratio = highest if other is None else other.misfit / max(fit.misfit, 1e-9)
        taken = min(1.0, max(0.0, (ratio - highest) / (lowest - highest)))
        return replace(trust, single=1 - TRUST.ambiguous * taken), other

    def _other(self, fit: StateFit) -> StateFit | None:
        """Return the best fit, at half size, of a state that differs."""
        parameters, best, view = self.fitter.parameters, None, fit.view
        prior = loose_prior(parameters, *TRUST.other_prior)
        for state in self.fitter.ranked(view, self.search.turned(fit.state), 0.25)[: TRUST.n_others_fitted]:
            trial: StateFit | None = None
            for level, steps in TRUST.other_levels:
                start = state if trial is None else trial.state
                trial = self.fitter.fit(view, state, prior, start, levels=(level,), steps=(steps,))
                if (
                    trial is None
                    or trial.misfit > TRUST.max_other_misfit * fit.misfit
                    or not differ(parameters, trial.state, fit.state, TRUST.other_deg, TRUST.other_joint_deg)
                ):
                    trial = None
                    break
            if trial is not None and (best is None or trial.gain > best.gain):
                best = trial
        return best
