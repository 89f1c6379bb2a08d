"""Interface of deformations, which map (canonical Gaussians, state) to posed Gaussians, with their training hooks."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from neeco.base.errors import NeecoError
from neeco.capture.kinematics import KinematicTree
from neeco.capture.model import Instrument, InstrumentState, State
from neeco.geometry.camera import Camera
from neeco.raster.types import Rendering
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.drawable import ArticulatedMotion, Skeleton
from neeco.scene.method import Method


@dataclass(frozen=True, kw_only=True)
class DeformationSettings:
    """Decay of learning rates, and the threshold of motion."""

    final_rate: float = 0.03  # of the initial learning rate, at the end (3DGS: 0.01; runs here are shorter)
    min_module_rate: float = 0.3  # of the initial learning rate: joints keep learning to the end
    min_motion_mm: float = 1e-6  # maximum motion of a static Gaussian
    marking_stride: int = 4  # stride of the recorded states used for detecting moving Gaussians


DEFORMATION = DeformationSettings()
MEMBERSHIP = "membership"  # the per-Gaussian extra [N] in {0, 1} that `mark_moving` stores


@dataclass(frozen=True)
class Posed:
    """Posed geometry in the world frame; colour and opacity stay canonical (the paper never deforms opacity)."""

    means: Tensor  # [N, 3] mm
    quats: Tensor  # [N, 4] wxyz
    scales: Tensor  # [N, 3] mm
    sh_frames: Tensor | None = None  # [N, 4] world_from_sh


@dataclass(frozen=True)
class Perturbation:
    """Perturbation of a training step; rendering is never perturbed. Methods with further perturbations subclass it.

    `state_noise`: standard deviation added to the encoded state or time (the paper's compensation). Normal numbers come
    from torch's own generator.
    """

    state_noise: float = 0.0


UNPERTURBED = Perturbation()


@dataclass(frozen=True)
class Deltas:
    """Change of each Gaussian between two states of the scene, or from canonical to posed (the paper's d_mu, d_r,
    d_s)."""

    means: Tensor  # [N, 3] mm
    quats: Tensor  # [N, 4]
    scales: Tensor  # [N, 3] mm


class Deformation(nn.Module, Method):
    """Base class of the methods that deform Gaussians; a subclass is made as `Method(instruments, settings)`.

    `label_names` lists (instrument, part) for each label column; a deformation that cannot tell parts returns one part,
    "instrument", per instrument. `extra_rates` are Adam's learning rates of the per-Gaussian parameters that the method
    adds (`initial_extras`) by name; an extra without one is not learned.

    `warm_up` is the share of the training in [0, 1) over which the deformation is off: training then freezes its
    parameters and sets `warming_up`, so that `pose` can skip the network. Before iteration `start_iteration` training
    only freezes the parameters.

    Training calls the hooks of any method: `fit_ranges` and `initial_extras`, then `begin`, in every step `perturb`,
    `training_channels` and `regularisation`, after it `between_steps` and, where an event of the schedule is due,
    `act`, where density is controlled `prune_mask`, and at the end `finish`. Hooks with a `session` receive the run's
    `neeco.training.session.GaussianSession`; this room is below, so its type is not stated here.

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
        """Return the posed geometry of `canonical` in `state`."""
        raise NotImplementedError

    def poser(self, canonical: CanonicalGaussians) -> Callable[[State], Posed]:
        """Return `pose` as a function of the state alone, valid while neither `canonical` nor this module changes."""
        return partial(self.pose, canonical)

    def label_channels(self, canonical: CanonicalGaussians) -> Tensor:
        """Return the soft membership [N, len(label_names)] in [0, 1]; the remainder to 1 is tissue."""
        return canonical.means.new_zeros(len(canonical), len(self.label_names))

    def deltas(self, canonical: CanonicalGaussians, state: State) -> Deltas:
        """Return the change from canonical to posed."""
        posed = self.pose(canonical, state)
        quats = nn.functional.normalize(posed.quats, dim=-1) - nn.functional.normalize(canonical.quats, dim=-1)
        return Deltas(posed.means - canonical.means, quats, posed.scales - canonical.log_scales.exp())

    def keypoints(self, state: State) -> dict[str, dict[str, Tensor]]:
        """Return named points [3] mm, world frame, per instrument; empty where the deformation has none."""
        return {}

    def skeleton(self) -> Skeleton:
        """Return the pairs of keypoint names that a line joins."""
        return ()

    def motion(self, canonical: CanonicalGaussians) -> ArticulatedMotion | None:
        """Return the articulation if it determines all motion, else None. Not inherited, as subclasses may pose
        differently."""
        return None

    @classmethod
    def combined(cls, deformations: Sequence[Deformation]) -> Deformation:
        """Return one deformation for the instruments of several deformations of this method, in their order."""
        raise NotImplementedError

    def fit_extras(self, extras: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the method's per-Gaussian parameters, from a deformation combined into this one, in this one's
        shapes."""
        return {}

    def fit_ranges(self, states: list[State], means: Tensor) -> None:
        """Set ranges from the recorded states and the points [P, 3] mm, once before training; nothing by default."""

    def initial_extras(self, canonical: CanonicalGaussians) -> dict[str, Tensor]:
        """Return the method's per-Gaussian parameters [N, ...] of the initial (tissue) Gaussians, by name; density
        control carries them along."""
        return {}

    def begin(self, session: Any) -> Mapping[str, KinematicTree] | None:
        """Prepare a new scene, once before the first step (not on resume); may replace the canonical Gaussians. If it
        returns links of instruments, training restarts with a scene in which these are stated."""
        return None

    def perturb(
        self, perturbation: Perturbation, iteration: int, progress: float, rng: np.random.Generator
    ) -> Perturbation:
        """Return the perturbation of this training step: the schedule's `perturbation`, or a subclass with more."""
        return perturbation

    def training_channels(self, canonical: CanonicalGaussians, iteration: int) -> Tensor | None:
        """Return extra channels [N, C] that this step renders for `regularisation`; None: none."""
        return None

    def prune_mask(self, canonical: CanonicalGaussians, cameras: Sequence[Camera]) -> Tensor | None:
        """Return the Gaussians, [N] bool, that density control removes whatever their opacity; None: none. `cameras`
        are those of the training frames."""
        return None

    def regularisation(self, canonical: CanonicalGaussians, rendering: Rendering, iteration: int) -> Tensor | None:
        """Return a scalar that is added to the loss of every step, or None; not called during the warm-up."""
        return None

    def learning_rates(self, progress: float) -> dict[str, float]:
        """Return Adam's learning rate of each of this module's parameters, by name; 0 freezes one. `progress` in [0,
        1]."""
        return {}

    def between_steps(self, session: Any) -> None:
        """Run after every step, which may be several iterations (`batch_size`)."""

    def act(self, session: Any, action: str) -> None:
        """Perform `action`, one of `actions`, of an event of `schedule.events` that is due; after `between_steps`."""

    def finish(self, session: Any) -> None:
        """Run after the last step; may replace the canonical Gaussians."""


class LabelledByMotion(Deformation):
    """Deformation with one label column, "instrument", for all instruments (none without any): the Gaussians that move
    in the trained scene."""

    def __init__(self, instruments: tuple[Instrument, ...], settings: Any = None) -> None:
        super().__init__(instruments, settings)
        self.label_names = (("+".join(i.name for i in instruments), "instrument"),) if instruments else ()

    def label_channels(self, canonical: CanonicalGaussians) -> Tensor:
        """Return the moving Gaussians [N, len(label_names)] detected by `finish`; zeros before that."""
        if MEMBERSHIP not in canonical.extras or not self.label_names:
            return super().label_channels(canonical)
        return canonical.extras[MEMBERSHIP][:, None]

    def finish(self, session: Any) -> None:
        scene = session.scene
        if self.instruments:
            states = list(scene.recorded.states[:: DEFORMATION.marking_stride])
            scene.canonical = mark_moving(self, scene.canonical, states)


@torch.no_grad()
def mark_moving(deformation: Deformation, canonical: CanonicalGaussians, states: list[State]) -> CanonicalGaussians:
    """Store which Gaussians move over the recorded states, [N] in {0, 1}: those whose spread of d_mu exceeds Otsu's
    threshold of its logarithm."""
    moved = torch.stack([deformation.deltas(canonical, state).means for state in states])  # [F, N, 3]
    spread = (moved - moved.mean(0)).square().sum(-1).mean(0).sqrt()
    size = spread.clamp_min(DEFORMATION.min_motion_mm).log()
    evaluated = spread > DEFORMATION.min_motion_mm  # static Gaussians would form a separate cluster
    threshold = otsu(size[evaluated]) if evaluated.any() else math.inf
    return canonical.with_extras(**{MEMBERSHIP: (size > threshold).float()})


def otsu(values: Tensor, bins: int = 256) -> float:
    """Return the threshold that splits `values` [N] into two classes of maximum between-class variance (Otsu 1979); the
    middle of the gap between separate classes."""
    low, high = float(values.min()), float(values.max())
    if not high > low:
        return high
    counts, edges = np.histogram(values.detach().cpu().double().numpy(), bins)
    below = np.cumsum(counts)[:-1].astype(float)
    above = counts.sum() - below
    sums = np.cumsum(counts * (edges[:-1] + edges[1:]) / 2)
    mean_below, mean_above = sums[:-1] / np.maximum(below, 1), (sums[-1] - sums[:-1]) / np.maximum(above, 1)
    between = below * above * (mean_below - mean_above) ** 2
    best = np.flatnonzero(between >= between.max() * (1 - 1e-9))  # a gap between classes is a plateau
    return float(edges[1 + round(float(best.mean()))])


def log_linear(first: float, last: float, progress: float) -> float:
    """Interpolate from `first` to `last` linearly in their logarithms (3DGS's learning rates); `progress` in [0, 1]."""
    return first * math.exp(math.log(last / first) * min(1.0, progress))


def floored_decay(progress: float) -> float:
    """Return the factor of a learning rate that decays as the positions' does, but not below `min_module_rate`."""
    return max(log_linear(1.0, DEFORMATION.final_rate, progress), DEFORMATION.min_module_rate)


def state_of(instrument: Instrument, state: State) -> InstrumentState:
    """Return the state of `instrument`. Raises NeecoError when the instrument or one of its joints is missing."""
    if instrument.name not in state.instruments:
        raise NeecoError(f"state: instrument {instrument.name!r} is missing; give its pose and joints")
    instrument_state = state.instruments[instrument.name]
    missing = [joint for joint in instrument.joints if joint not in instrument_state.joints]
    if missing:
        raise NeecoError(f"state: instrument {instrument.name!r}: joint {missing[0]!r} is missing; give it in rad")
    return instrument_state
