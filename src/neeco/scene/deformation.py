"""What every deformation does: map (canonical Gaussians, state) to posed ones; hooks for training; shared pieces."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from neeco.capture.model import Instrument, InstrumentState, State
from neeco.errors import NeecoError
from neeco.geometry.camera import Camera
from neeco.raster.devices import fast_bfloat16
from neeco.raster.types import Rendering
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.drawable import ArticulatedMotion, Skeleton
from neeco.scene.method import Method
from neeco.scene.training_session import GaussianTraining

FINAL_RATE = 0.03  # of the first rate, at the end (3DGS: 0.01; runs here are shorter)
MODULE_FLOOR = 0.3  # of the first rate: joints keep learning to the end
MEMBERSHIP = "membership"  # the per-Gaussian extra [N] in {0, 1} that `mark_moving` stores
STILL_MM = 1e-6  # what moves less does not move
HALF_BY_DEFAULT: Mapping[str, Any] = {"deformation.half": None}  # decided by `half_resolved` where training starts
MARKING_STRIDE = 4  # recorded states between those that moving Gaussians are found from


@dataclass(frozen=True)
class Posed:
    """Geometry in the world frame; colour and opacity stay canonical (the paper never deforms opacity)."""

    means: Tensor  # [N, 3] mm
    quats: Tensor  # [N, 4] wxyz
    scales: Tensor  # [N, 3] mm
    sh_frames: Tensor | None = None  # [N, 4] world_from_sh


@dataclass(frozen=True)
class Perturbation:
    """What training may perturb on purpose; drawing never does. A method that perturbs more has a subclass.

    `state_noise`: standard deviation added to the encoded state, or to the encoded time of a method that knows the
    state by its time (the paper's compensation). Normal numbers come from torch's own generator.
    """

    state_noise: float = 0.0


UNPERTURBED = Perturbation()


def half_resolved(settings: Any, begun: Any | None) -> Any:
    """A network's `settings` with `half`, where left open, as the run has it that was `begun` with such settings, or as
    this processor is fast."""
    if settings.half is not None:
        return settings
    return replace(settings, half=fast_bfloat16() if begun is None else begun.half)


@dataclass(frozen=True)
class Deltas:
    """Change of each Gaussian between two states of the scene, or from canonical to posed (the paper's d_mu,
    d_r, d_s)."""

    means: Tensor  # [N, 3] mm
    quats: Tensor  # [N, 4]
    scales: Tensor  # [N, 3] mm


class Deformation(nn.Module, Method):
    """Base class of the methods that deform Gaussians; a subclass is made as `Method(instruments, settings)`.

    `label_names` lists (instrument, part) for each label column; a deformation that cannot tell parts returns one part,
    "instrument", per instrument. `extra_rates` are Adam's learning rates of the per-Gaussian parameters that the method
    adds (`initial_extras`) by name; an extra without one is not learned.

    `warm_up` is the share of the training in [0, 1) over which the deformation is off: training then keeps its
    parameters and sets `warming_up`, which lets `pose` leave out what would change nothing. Before iteration
    `start_iteration` training only keeps the parameters.

    Training calls the hooks of any method: `fit_ranges` and `initial_extras`, then `begin`, in every step `perturb`,
    `training_channels` and `regularisation`, after it `between_steps`, where density is controlled `prune_mask`, and at
    the end `finish`.

    `separates_instruments`: tissue and instruments are bodies of their own, and instruments of several scenes can be
    combined in one (`combined`, `fit_extras`).
    """

    label_names: tuple[tuple[str, str], ...] = ()
    extra_rates: ClassVar[Mapping[str, float]] = {}
    separates_instruments: ClassVar[bool] = False
    start_iteration: int = 0
    warm_up: float = 0.0
    warming_up: bool = False

    def __init__(self, instruments: tuple[Instrument, ...] = (), settings: Any = None) -> None:
        super().__init__()
        self.instruments = instruments
        self.settings = self.Settings() if settings is None else settings

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        cls.motion = vars(cls).get("motion", Deformation.motion)  # type: ignore[method-assign]

    def pose(self, canonical: CanonicalGaussians, state: State, perturbation: Perturbation = UNPERTURBED) -> Posed:
        """Posed geometry of `canonical` in `state`."""
        raise NotImplementedError

    def label_channels(self, canonical: CanonicalGaussians) -> Tensor:
        """Soft membership [N, len(label_names)] in [0, 1]; what is left to 1 is tissue."""
        return canonical.means.new_zeros(len(canonical), len(self.label_names))

    def deltas(self, canonical: CanonicalGaussians, state: State) -> Deltas:
        """Change from canonical to posed."""
        posed = self.pose(canonical, state)
        quats = nn.functional.normalize(posed.quats, dim=-1) - nn.functional.normalize(canonical.quats, dim=-1)
        return Deltas(posed.means - canonical.means, quats, posed.scales - canonical.log_scales.exp())

    def keypoints(self, state: State) -> dict[str, dict[str, Tensor]]:
        """Named points [3] mm, world frame, per instrument; empty where the deformation knows none."""
        return {}

    def skeleton(self) -> Skeleton:
        """Pairs of keypoints' names that a line joins."""
        return ()

    def motion(self, canonical: CanonicalGaussians) -> ArticulatedMotion | None:
        """How Gaussians move, where joints say all of it; None otherwise. Subclasses do not inherit it: they may pose
        otherwise."""
        return None

    @classmethod
    def combined(cls, deformations: Sequence[Deformation]) -> Deformation:
        """One deformation of the instruments of several of this method, in their order."""
        raise NotImplementedError

    def fit_extras(self, extras: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The per-Gaussian parameters of the method, of a deformation that was combined into this one, in this one's
        shapes."""
        return {}

    def fit_ranges(self, states: list[State], means: Tensor) -> None:
        """Take scales from the recorded states and the points [P, 3] mm, once before training; nothing by default."""

    def initial_extras(self, canonical: CanonicalGaussians) -> dict[str, Tensor]:
        """The per-Gaussian parameters [N, ...] of its own that the first Gaussians, the tissue's, begin with, by name;
        density control carries them along."""
        return {}

    def begin(self, training: GaussianTraining) -> None:
        """Once, before the first step of a new scene (not when a run goes on); may replace the canonical Gaussians."""

    def perturb(
        self, perturbation: Perturbation, iteration: int, progress: float, rng: np.random.Generator
    ) -> Perturbation:
        """What this training step perturbs, beside what the schedule does: `perturbation`, or a subclass."""
        return perturbation

    def training_channels(self, canonical: CanonicalGaussians, iteration: int) -> Tensor | None:
        """Extra channels [N, C] that this step draws for `regularisation`; None: none."""
        return None

    def prune_mask(self, canonical: CanonicalGaussians, cameras: Sequence[Camera]) -> Tensor | None:
        """[N] bool: Gaussians that density control removes whatever their opacity; None: none. `cameras` are the
        training frames'."""
        return None

    def regularisation(self, canonical: CanonicalGaussians, rendering: Rendering, iteration: int) -> Tensor | None:
        """A term added to the loss of every step, a scalar, or None; not asked during the warm-up."""
        return None

    def learning_rates(self, progress: float) -> dict[str, float]:
        """Adam learning rate of each of this module's parameters, by name; 0 freezes one. `progress` in [0, 1]."""
        return {}

    def between_steps(self, training: GaussianTraining, before: float) -> None:
        """After every step; `before` is the progress before it: for what is due at a share of the run. A step may be
        several iterations (`batch_size`)."""

    def finish(self, training: GaussianTraining) -> None:
        """After the last step; may replace the canonical Gaussians."""


class LabelledByMotion(Deformation):
    """One label column, "instrument", for all instruments together (none without any): the Gaussians that move
    once all is learned."""

    def __init__(self, instruments: tuple[Instrument, ...], settings: Any = None) -> None:
        super().__init__(instruments, settings)
        self.label_names = (("+".join(i.name for i in instruments), "instrument"),) if instruments else ()

    def label_channels(self, canonical: CanonicalGaussians) -> Tensor:
        """The moving Gaussians [N, len(label_names)] as found by `finish`; nothing before that."""
        if MEMBERSHIP not in canonical.extras or not self.label_names:
            return super().label_channels(canonical)
        return canonical.extras[MEMBERSHIP][:, None]

    def finish(self, training: GaussianTraining) -> None:
        scene = training.scene
        if self.instruments:
            scene.canonical = mark_moving(self, scene.canonical, list(scene.recorded.states[::MARKING_STRIDE]))


@torch.no_grad()
def mark_moving(deformation: Deformation, canonical: CanonicalGaussians, states: list[State]) -> CanonicalGaussians:
    """Store which Gaussians move over the recorded states [N] in {0, 1}: spread of d_mu above Otsu's threshold of its
    logarithm."""
    moved = torch.stack([deformation.deltas(canonical, state).means for state in states])  # [F, N, 3]
    spread = (moved - moved.mean(0)).square().sum(-1).mean(0).sqrt()
    size = spread.clamp_min(STILL_MM).log()
    evaluated = spread > STILL_MM  # those behind the gate would be a second cluster of their own
    threshold = otsu(size[evaluated]) if evaluated.any() else math.inf
    return canonical.with_extras(**{MEMBERSHIP: (size > threshold).float()})


def otsu(values: Tensor, bins: int = 256) -> float:
    """Threshold that splits `values` [N] into two classes of greatest between-class variance (Otsu 1979); the middle
    of the gap between classes that lie apart."""
    low, high = float(values.min()), float(values.max())
    if not high > low:
        return high
    counts, edges = np.histogram(values.detach().cpu().double().numpy(), bins)
    below = np.cumsum(counts)[:-1].astype(float)
    above = counts.sum() - below
    sums = np.cumsum(counts * (edges[:-1] + edges[1:]) / 2)
    mean_below, mean_above = sums[:-1] / np.maximum(below, 1), (sums[-1] - sums[:-1]) / np.maximum(above, 1)
    between = below * above * (mean_below - mean_above) ** 2
    best = np.flatnonzero(between >= between.max() * (1 - 1e-9))  # a gap is a plateau
    return float(edges[1 + round(float(best.mean()))])


class RecordedTimes(nn.Module):
    """First time and duration (s) of the training frames, and their mean interval as a share of the duration."""

    start: Tensor
    duration: Tensor
    interval: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("start", torch.zeros((), dtype=torch.float64))
        self.register_buffer("duration", torch.ones((), dtype=torch.float64))
        self.register_buffer("interval", torch.ones(()))

    def fit(self, states: list[State]) -> None:
        """Take all three from the training frames' states."""
        times = [state.time for state in states]
        self.start.fill_(min(times))
        self.duration.fill_(max(max(times) - min(times), 1e-9))
        self.interval.fill_(1 / len(times))

    def share(self, state: State) -> Tensor:
        """The time of `state`, a scalar: 0 and 1 at the first and last training frame."""
        return ((state.time - self.start) / self.duration).float()


def octave_angles(values: Tensor, count: int, unit: float = math.pi) -> Tensor:
    """Angles [..., D, L] rad, unit * 2^k * x for k < L = `count`, of values [..., D]."""
    return values[..., None] * (unit * 2.0 ** torch.arange(count, dtype=values.dtype, device=values.device))


def octave_weights(opened: Tensor, count: int) -> Tensor:
    """Weight [L] of each octave k < L = `count`: (1 - cos(pi clamp(opened - k, 0, 1))) / 2 (Nerfies eq. 5)."""
    octaves = torch.arange(count, device=opened.device)
    return (1 - torch.cos(math.pi * (opened - octaves).clamp(0, 1))) / 2


def encode(values: Tensor, count: int, unit: float = math.pi) -> Tensor:
    """gamma: [..., D] to [..., 2 D L]: the sines of every coordinate's L = `count` octaves, then the cosines."""
    angles = octave_angles(values, count, unit).flatten(-2)
    return torch.cat([angles.sin(), angles.cos()], -1)


def log_linear(first: float, last: float, progress: float) -> float:
    """From `first` to `last` along a straight line of their logarithms (3DGS's learning rates); `progress` in
    [0, 1]."""
    return first * math.exp(math.log(last / first) * min(1.0, progress))


def floored_decay(progress: float) -> float:
    """What is left of a learning rate that falls as the positions' does, but not below MODULE_FLOOR."""
    return max(log_linear(1.0, FINAL_RATE, progress), MODULE_FLOOR)


def check_warm_up(share: float) -> None:
    """Raises NeecoError when `share` is not one of the training in [0, 1)."""
    if not 0 <= share < 1:
        raise NeecoError(f"deformation.warm_up: {share} is not a share of the training in [0, 1)")


def robust_bounds(means: Tensor) -> tuple[Tensor, Tensor]:
    """Centre [3] and greatest half extent [] mm of points [P, 3], without the outermost hundredth at either end."""
    low, high = means.quantile(0.01, 0), means.quantile(0.99, 0)
    return (low + high) / 2, (high - low).max() / 2


def state_of(instrument: Instrument, state: State) -> InstrumentState:
    """What `state` says of `instrument`. Raises NeecoError when the instrument or one of its joints is missing."""
    if instrument.name not in state.instruments:
        raise NeecoError(f"state: instrument {instrument.name!r} is missing; give its pose and joints")
    given = state.instruments[instrument.name]
    missing = [joint for joint in instrument.joints if joint not in given.joints]
    if missing:
        raise NeecoError(f"state: instrument {instrument.name!r}: joint {missing[0]!r} is missing; give it in rad")
    return given
