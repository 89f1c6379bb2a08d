"""How far a tracked state is trusted: by its place, roll and joints, not by its outline alone.

Trust is a product of five shares, each 1 where nothing speaks against the state:

- `overlap`: the overlap (IoU) of its label that the image supports (`neeco.evaluation.trust`). An instrument turned by
  25 degrees still explains most of its pixels, so the outline alone says nothing of roll and joints;
- `explained`: how badly pixels are explained, against what is usual for the frames that the scene was learned from;
  the farther from where it was ever seen, the better they have to be;
- `observed`: how much of what is seen of the instrument some training frame saw, and from about there. Of sides that
  nobody saw, a scene draws what it likes, and images of them fit wrong rolls as well;
- `single`: whether another state, turned or opened otherwise, explains the image about as well;
- `determined`: how likely rotation and joints are within 10 degrees, as images and motion determine them: jaws outside
  the image may be open or closed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from neeco.capture.model import Frame, State, evenly_spaced
from neeco.errors import NeecoError
from neeco.evaluation.trust import BESIDE, TypicalErrors, estimate_trust, typical_errors_of
from neeco.fitting.fitter import StateFit, loose_prior
from neeco.fitting.layers import over
from neeco.fitting.parameters import DEG
from neeco.geometry.camera import Camera
from neeco.labels.labellers import CompositedLabels, composited_labels
from neeco.raster import rasterize
from neeco.scene import Recorded
from neeco.tracking.parameters import TrackedInstrument, TrackedParameters, TrackingFitter
from neeco.tracking.search import Search, differ

REFERENCE_FRAMES = 16  # training frames that tell what is usual
USUAL = 0.9  # of them have a smaller misfit
LEAST_MISFIT = 0.08  # about 4 of 255 grey levels: what explains images better is not held against them
LEAST_ERROR = 0.012  # of a pixel's colour, of 1: the same
HALF_TRUSTED = 4.0  # times the usual misfit: where `explained` is 1/2
STEEPNESS = 4.0
STRANGE_DEG = 8.0  # so far from where it was ever seen, an instrument has to be explained twice as well: its scene is
# a guess there, and wrong rolls fit guesses
LEAST_OBSERVED = 0.9  # of what the worst of the reference frames has, is as good as all
DOUBTED = 0.9  # of trust otherwise, below which another state is looked for
OTHERS_FITTED = 2
NEARBY = (20.0, 5.0, 20.0)  # deg, mm, deg of joints: prior of the other state
OTHER_DEG, OTHER_JOINT_DEG = 10.0, 8.0  # nearer than this a state is the same
AS_GOOD = (1.3, 1.0)  # times the misfit: another state takes no trust, or AMBIGUOUS of it
AMBIGUOUS = 0.6
WRONG_DEG = 10.0  # of rotation or a joint (or as many quarters of a mm): what is as far off is wrong


@dataclass(frozen=True)
class TrackTrust:
    """Shares of which the product is how far a state is trusted."""

    overlap: float
    explained: float
    observed: float
    single: float
    determined: float = 1.0  # known once the motion is

    @property
    def value(self) -> float:
        """In [0, 1]."""
        return math.prod(astuple(self))

    def to_json(self) -> dict[str, float]:
        """As plain values, for files."""
        return {"value": round(self.value, 4)} | {name: round(share, 4) for name, share in asdict(self).items()}


NONE = TrackTrust(0.0, 0.0, 0.0, 0.0, 0.0)  # where no state was found


@dataclass(frozen=True)
class Reference:
    """How the scene explains frames that it was learned from."""

    errors: TypicalErrors
    misfit: float  # USUAL of them have a smaller one
    observed: float  # share of the label's pixels, at the worst of them

    @classmethod
    def of(cls, fitter: TrackingFitter, frames: Sequence[Frame]) -> Reference:
        """Of a few of the frames trained on, states fitted to each. Raises NeecoError when an image cannot be read."""
        parameters, scene = fitter.parameters, fitter.instruments.scene
        chosen = [frames[k] for k in evenly_spaced(len(frames), REFERENCE_FRAMES)]
        states = dict(zip(scene.recorded.names, scene.recorded.states, strict=True))
        near = loose_prior(parameters, 2.0, 2.0, 4.0)
        renderer, judged, misfits, shares = LabelRenderer.of(fitter), [], [], []
        for frame in chosen:
            start = states.get(frame.name, frame.state)
            fit = fitter.fit(fitter.view(frame, start), start, near)
            if fit is None:
                continue
            drawing = renderer.render(fit)
            judged.append((drawing, fit.view.image, fit.view.weight > 0))
            misfits.append(fit.misfit)
            shares.append(observed_share(drawing))
        if not misfits:
            raise NeecoError("track: no training frame of the run shows an instrument; train it again")
        misfit = max(LEAST_MISFIT, float(np.quantile(misfits, USUAL)))
        typical = typical_errors_of(judged)
        errors = TypicalErrors(max(LEAST_ERROR, typical.inside), max(LEAST_ERROR, typical.beside))
        return cls(errors, misfit, min(shares))

    def to_json(self) -> dict[str, float]:
        """As plain values, for files."""
        return {**asdict(self.errors), "misfit": round(self.misfit, 5), "observed": round(self.observed, 5)}


@dataclass(frozen=True)
class LabelledView:
    """Instruments rendered over tissue, with what `neeco.evaluation.trust` needs."""

    image: Tensor  # [h, w, 3] in [0, 1]
    parts: Tensor  # [h, w] uint8
    tissue_image: Tensor  # [h, w, 3]
    alpha: Tensor  # [h, w]
    unobserved: Tensor  # [h, w] share of a pixel that no training frame observed, or not from a similar direction


@dataclass(frozen=True)
class LabelRenderer:
    """Renders fits of instruments with their labels."""

    fitter: TrackingFitter
    channels: Tensor  # [N, L] label channels of the instruments' Gaussians
    threshold: float

    @classmethod
    def of(cls, fitter: TrackingFitter) -> LabelRenderer:
        """With the scene's own labels. Raises NeecoError for a scene without."""
        scene = fitter.instruments.scene
        labels = CompositedLabels(scene)
        return cls(fitter, labels.channels[scene.canonical.counts[0] :].contiguous(), labels.threshold)

    @torch.no_grad()
    def render(self, fit: StateFit) -> LabelledView:
        """Return the fit's instruments over the tissue of its view, with their parts."""
        alone, view = self.fitter.instruments.alone, fit.view
        posed = self.fitter.instruments.pose(fit.state)
        unobserved = alone.unobserved(posed, view.camera)
        channels = torch.cat([self.channels, unobserved[:, None]], 1)
        rendering = rasterize(posed, view.camera, channels=channels, background=posed.means.new_zeros(3))
        assert rendering.channels is not None
        parts, _ = composited_labels(replace(rendering, channels=rendering.channels[..., :-1]), self.threshold)
        color, alpha = rendering.color.cpu(), rendering.alpha.cpu()
        image = over(color, alpha, view.tissue).clamp(0, 1)
        return LabelledView(image, parts.cpu(), view.tissue, alpha, rendering.channels[..., -1].cpu())


def observed_share(drawing: LabelledView) -> float:
    """Of the label's pixels, as far as training frames observed what they show; 0 without a label."""
    label = drawing.parts > 0
    if not label.any():
        return 0.0
    return float(1 - (drawing.unobserved[label] / drawing.alpha[label].clamp_min(1e-6)).clamp(0, 1).mean())


@dataclass(frozen=True)
class RecordedRange:
    """From where the instruments were seen in the frames that were learned from."""

    parameters: TrackedParameters
    directions: tuple[Tensor, ...]  # of every instrument [M, 3] unit, instrument frame: from its pivot to the camera

    @classmethod
    def of(cls, parameters: TrackedParameters, recorded: Recorded) -> RecordedRange:
        """Of all recorded frames."""
        pairs = list(zip(recorded.states, recorded.cameras, strict=True))
        directions = [
            torch.stack([_direction(item, state, camera) for state, camera in pairs]) for item in parameters.instruments
        ]
        return cls(parameters, tuple(directions))

    def beyond(self, state: State, camera: Camera) -> float:
        """deg from the nearest direction from which it was seen, of the instrument for which it is farthest."""
        angles = [
            float((recorded @ _direction(item, state, camera)).amax().clamp(-1, 1).arccos()) / DEG
            for item, recorded in zip(self.parameters.instruments, self.directions, strict=True)
        ]
        return max(angles)


def _direction(item: TrackedInstrument, state: State, camera: Camera) -> Tensor:
    """[3] unit, instrument frame, float64."""
    pose, centre = state.instruments[item.name].pose.double().cpu(), camera.world_from_camera[:3, 3].double().cpu()
    return torch.nn.functional.normalize(pose[:3, :3].T @ (centre - pose[:3, 3]) - item.pivot, dim=0)


@dataclass(frozen=True)
class Judge:
    """Says how far tracked states are trusted."""

    fitter: TrackingFitter
    search: Search
    reference: Reference
    allowance: float = 1.0  # times the usual misfit that is usual here: light and tissue may be learned less well

    @cached_property
    def range(self) -> RecordedRange:
        """Of the frames that the scene was learned from."""
        return RecordedRange.of(self.fitter.parameters, self.search.recorded)

    @cached_property
    def renderer(self) -> LabelRenderer:
        """Renders fits with their labels."""
        return LabelRenderer.of(self.fitter)

    def judge(self, fit: StateFit, look: bool = False) -> tuple[TrackTrust, StateFit | None]:
        """Of a fitted state; and, where another was looked for (with `look`, or where the state is
        doubted), the best one found that differs."""
        drawing, about = self.renderer.render(fit), fit.view
        beside = BESIDE * about.diagonal / math.hypot(about.camera.width, about.camera.height)
        overlap = estimate_trust(drawing, about.image, about.weight > 0, self.reference.errors, beside).value
        beyond = self.range.beyond(fit.state, about.camera)
        half = HALF_TRUSTED * self.allowance * self.reference.misfit / (1 + beyond / STRANGE_DEG)
        explained = 1 / (1 + (fit.misfit / half) ** STEEPNESS)
        observed = min(1.0, observed_share(drawing) / (LEAST_OBSERVED * self.reference.observed))
        trust = TrackTrust(overlap, explained, observed, 1.0)
        if not look and trust.value >= DOUBTED:
            return trust, None
        other = self._second(fit)
        none, all_of_it = AS_GOOD
        ratio = none if other is None else other.misfit / max(fit.misfit, 1e-9)
        taken = min(1.0, max(0.0, (ratio - none) / (all_of_it - none)))
        return replace(trust, single=1 - AMBIGUOUS * taken), other

    def _second(self, fit: StateFit) -> StateFit | None:
        """The best fit found, at half size, of a state that differs."""
        parameters, best, view = self.fitter.parameters, None, fit.view
        loose = loose_prior(parameters, *NEARBY)
        for state in self.fitter.ranked(view, self.search.turned(fit.state), 0.25)[:OTHERS_FITTED]:
            found = self.fitter.fit(view, state, loose, levels=(0.25, 0.5), steps=(4, 2))
            if found is None or not differ(parameters, found.state, fit.state, OTHER_DEG, OTHER_JOINT_DEG):
                continue
            if best is None or found.gain > best.gain:
                best = found
        return best
