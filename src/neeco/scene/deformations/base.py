"""What every deformation does: map (canonical Gaussians, state) to posed ones."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from neeco.capture.model import Instrument, InstrumentState, State
from neeco.errors import NeecoError
from neeco.raster.threads import torch_threads
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.deformations._hinges import Hinged
from neeco.scene.swept import SweptVolume

# Plain 3DGS: no part of the paper's dynamic training adjustment acts.
PLAIN_TRAINING: Mapping[str, Any] = {
    "schedule.density_interval": "off",
    "schedule.opacity_reset": "off",
    "schedule.gradient_threshold": "off",
    "schedule.sh_order": "off",
    "schedule.frame_order": "off",
    "schedule.compensation": "off",
}

MODULE_FLOOR = 0.3  # of the first rate: joints keep learning to the end


@dataclass(frozen=True)
class Posed:
    """Geometry in the world frame; colour and opacity stay canonical (the paper never deforms opacity)."""

    means: Tensor  # [N, 3] mm
    quats: Tensor  # [N, 4] wxyz
    scales: Tensor  # [N, 3] mm
    sh_frames: Tensor | None = None  # [N, 4] world_from_sh


@dataclass(frozen=True)
class Perturbation:
    """What training may disturb on purpose; drawing never does.

    `shaft_roll`: angle in rad by which everything behind the wrist is spun about the shaft (a surface of revolution
    looks the same). `state_noise`: standard deviation added to the encoded state, or the encoded time of a method that
    knows the state by its time (the paper's compensation). `time_noise`: standard deviation added to the time, in mean
    intervals between training frames (Deformable-3DGS). Normal numbers come from torch's own generator.
    """

    shaft_roll: float = 0.0
    state_noise: float = 0.0
    time_noise: float = 0.0


UNPERTURBED = Perturbation()


@dataclass(frozen=True)
class Deltas:
    """Change of each Gaussian between two states of the scene, or from canonical to posed (the paper's d_mu,
    d_r, d_s)."""

    means: Tensor  # [N, 3] mm
    quats: Tensor  # [N, 4]
    scales: Tensor  # [N, 3] mm


class Deformation(nn.Module):
    """Base class. A method is one subclass in one file, with its own small config; `method` is its name.

    It is made as `Method(instruments, **config)`. What training must know of a method, it asks here:
    `label_names` lists (instrument, part) for each label column; a deformation that cannot tell parts returns one part,
    "instrument", per instrument. `training_defaults` are fields of the training config that differ from the paper's,
    dotted names as in `neeco train --set`. `extra_rates` are Adam's learning rates of the per-Gaussian parameters that
    the method adds (`CanonicalGaussians.extras`) by name; an extra without one is not learned.

    `warm_up` is the share of the training in [0, 1) over which the deformation rests: training then holds its
    parameters still and sets `resting`, which lets `pose` leave out what would change nothing. Before iteration
    `learns_from` it only holds them still.
    """

    method: ClassVar[str]
    label_names: tuple[tuple[str, str], ...] = ()
    training_defaults: ClassVar[Mapping[str, Any]] = PLAIN_TRAINING
    extra_rates: ClassVar[Mapping[str, float]] = {}
    needs_instruments: ClassVar[bool] = False  # without recorded states there is nothing to learn
    needs_times: ClassVar[bool] = False  # without recorded times there is nothing to learn
    learns_from: ClassVar[int] = 0
    warm_up: float = 0.0
    resting: bool = False
    large_operations: ClassVar[bool] = False  # torch's own operations are large enough to gain from several threads

    @classmethod
    def torch_threads(cls) -> AbstractContextManager[None]:
        """As many of torch's threads as pay where scenes are posed and drawn: one, unless the operations are large."""
        return nullcontext() if cls.large_operations else torch_threads(1)

    def pose(self, canonical: CanonicalGaussians, state: State, perturbation: Perturbation = UNPERTURBED) -> Posed:
        """Posed geometry of `canonical` in `state`."""
        raise NotImplementedError

    def config(self) -> dict[str, Any]:
        """JSON-able keyword arguments that make an equal deformation."""
        return {}

    @property
    def hinged(self) -> Hinged | None:
        """The shafts and hinges whose place training is to look for; None: the scene starts from the tissue alone."""
        return None

    @property
    def gate_volume(self) -> SweptVolume | None:
        """The volume that bounds where Gaussians can move; covered before training. None: anywhere."""
        return None

    def fit_ranges(self, states: list[State], means: Tensor) -> None:
        """Take scales from the recorded states and the points [P, 3] mm, once before training; nothing by default."""

    def finished(self, canonical: CanonicalGaussians, states: list[State]) -> CanonicalGaussians:
        """`canonical` with whatever the method finds out once learning has ended, from the recorded states."""
        return canonical

    def label_channels(self, canonical: CanonicalGaussians) -> Tensor:
        """Soft membership [N, len(label_names)] in [0, 1]; what is left to 1 is tissue."""
        return torch.zeros(len(canonical), len(self.label_names))

    def deltas(self, canonical: CanonicalGaussians, state: State) -> Deltas:
        """Change from canonical to posed."""
        posed = self.pose(canonical, state)
        quats = nn.functional.normalize(posed.quats, dim=-1) - nn.functional.normalize(canonical.quats, dim=-1)
        return Deltas(posed.means - canonical.means, quats, posed.scales - canonical.log_scales.exp())

    def keypoints(self, state: State) -> dict[str, dict[str, Tensor]]:
        """Named points [3] mm, world frame, per instrument; empty where the deformation knows none."""
        return {}

    def learning_rates(self, progress: float) -> dict[str, float]:
        """Adam learning rate of each of this module's parameters, by name; 0 holds one still. `progress` in [0, 1]."""
        return {}

    def regularisation(self, canonical: CanonicalGaussians) -> Tensor | None:
        """A term added to the loss of every step, a scalar, or None; not asked while the deformation rests."""
        return None

    def time_noise(self, progress: float) -> float:
        """`Perturbation.time_noise` of a training step; `progress` in [0, 1]."""
        return 0.0


def log_linear(first: float, last: float, progress: float) -> float:
    """From `first` to `last` along a straight line of their logarithms (3DGS's learning rates); `progress` in
    [0, 1]."""
    return first * math.exp(math.log(last / first) * min(1.0, progress))


def floored_decay(progress: float) -> float:
    """What is left of a learning rate that falls to 3 % as the positions' does, but not below MODULE_FLOOR."""
    return max(math.exp(math.log(0.03) * min(1.0, progress)), MODULE_FLOOR)


def checked_warm_up(share: float) -> float:
    """`share` itself. Raises NeecoError when it is not one of the training in [0, 1)."""
    if not 0 <= share < 1:
        raise NeecoError(f"deformation.warm_up: {share} is not a share of the training in [0, 1)")
    return share


def state_of(instrument: Instrument, state: State) -> InstrumentState:
    """What `state` says of `instrument`. Raises NeecoError when the instrument or one of its joints is missing."""
    if instrument.name not in state.instruments:
        raise NeecoError(f"state: instrument {instrument.name!r} is missing; give its pose and joints")
    given = state.instruments[instrument.name]
    missing = [joint for joint in instrument.joints if joint not in given.joints]
    if missing:
        raise NeecoError(f"state: instrument {instrument.name!r}: joint {missing[0]!r} is missing; give it in rad")
    return given
