"""A network over place and time (Yang et al. 2024, "Deformable 3D Gaussians"), method `deformable-3dgs`.

(d_mu, d_r, d_s) = F(gamma(mu), gamma(t)): 8 layers of 256, the input given again after the fifth (layer 4, counted from
0), gamma(x) = (x, sin 2^k x, cos 2^k x) with 10 octaves for both; means detached; rotation added to the unit quaternion
and scale to the scale itself, that is after activation; normal noise on the time of training frames, falling from a
tenth of the frame interval to none at half of the run. `synthetic` is the source's variant for D-NeRF: 6 octaves of
time through a small network 13 -> 256 -> 30, and no noise.

Departures from the source:
- Its iterations, of 40,000, are shares of the run, which is shorter here: warm-up until 3,000, density control until
  15,000, noise until 20,000, and the fall of the learning rate from 8e-4 to 1.6e-6.
- The head starts at zero, so that the end of the warm-up changes nothing. The source starts it at random.
- The points' half extent is the unit of the input and of the changes of mean and scale; it is about 1 in the source.
- The absolute value is taken of negative scales; in the source, too, the covariance squares them.
- The number of Gaussians is limited (`max_tissue_gaussians`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from neeco.capture.model import Instrument, State
from neeco.methods.networks import HALF_BY_DEFAULT, PlaceNetwork, RecordedTimes, check_warm_up, encode, robust_bounds
from neeco.raster.devices import bfloat16_products, tf32_products
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.deformation import UNPERTURBED, Perturbation, Posed, log_linear
from neeco.scene.method import PLAIN_TRAINING

DEPTH, SKIP = 8, 4  # layers; the one after which the input is given again


def octaves(values: Tensor, count: int) -> Tensor:
    """gamma: [..., D] to [..., D * (1 + 2 count)], (x, sin(2^k x), cos(2^k x)) for k < count."""
    return torch.cat([values, encode(values, count, unit=1.0)], -1)


@dataclass(frozen=True, kw_only=True)
class TimeMLPSettings:
    """Settings of the method, as published."""

    width: int = 256  # of the network
    L_mean: int = 10  # octaves of the place's encoding
    L_time: int | None = None  # octaves of the time's encoding; None: 10, or 6 where synthetic
    synthetic: bool = False  # the variant for D-NeRF's data
    warm_up: float = 0.075  # share of the training over which the network is off
    time_noise: float = 0.1  # at the start, in frame intervals
    time_noise_stop: float = 0.5  # share of the training at which that noise has fallen to none
    rate: float = 8e-4  # learning rate at the start
    final_rate: float = 1.6e-6  # learning rate at the end
    # layers multiply in bfloat16 on a CPU that has it; None: decided when training starts, by whether it is fast at it
    half: bool | None = False

    def __post_init__(self) -> None:
        check_warm_up(self.warm_up)


@dataclass(frozen=True)
class NoisyTime(Perturbation):
    """`time_noise`: standard deviation added to the time, in mean intervals between training frames."""

    time_noise: float = 0.0


class TimeMLP(PlaceNetwork):
    """A network of 8 layers over place and time."""

    method = "deformable-3dgs"
    Settings = TimeMLPSettings
    training_defaults: ClassVar[Mapping[str, Any]] = {
        **PLAIN_TRAINING,
        **HALF_BY_DEFAULT,
        "ssim_weight": 0.2,
        "density_stop": 0.375,
    }
    needs_times = True

    def __init__(self, instruments: tuple[Instrument, ...], settings: TimeMLPSettings | None = None) -> None:
        super().__init__(instruments, settings)
        sizes: TimeMLPSettings = self.settings
        width = sizes.width
        self.L_time = (6 if sizes.synthetic else 10) if sizes.L_time is None else sizes.L_time
        self.times = RecordedTimes()
        self.mean_inputs, time_inputs = 3 * (1 + 2 * sizes.L_mean), 1 + 2 * self.L_time
        if sizes.synthetic:
            self.time_net = nn.Sequential(nn.Linear(time_inputs, 256), nn.ReLU(), nn.Linear(256, 30))
            time_inputs = 30
        inputs = self.mean_inputs + time_inputs
        fans = [inputs] + [width + inputs if index == SKIP + 1 else width for index in range(1, DEPTH)]
        self.layers = nn.ModuleList(nn.Linear(fan, width) for fan in fans)
        self.head = nn.Linear(width, 10)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def fit_ranges(self, states: list[State], means: Tensor) -> None:
        """Time from 0 to 1 over the recording, mu from -1 to 1 over the points."""
        self.times.fit(states)
        self.mean_center, self.mean_halfwidth = robust_bounds(means)

    def perturb(
        self, perturbation: Perturbation, iteration: int, progress: float, rng: np.random.Generator
    ) -> Perturbation:
        noise_share = max(0.0, 1 - progress / self.settings.time_noise_stop)
        noise = 0.0 if self.settings.synthetic else self.settings.time_noise * noise_share
        return NoisyTime(perturbation.state_noise, noise) if noise else perturbation

    def pose(self, canonical: CanonicalGaussians, state: State, perturbation: Perturbation = UNPERTURBED) -> Posed:
        scales = canonical.log_scales.exp()
        if self.warming_up:
            return Posed(canonical.means, canonical.quats, scales)
        positions = (canonical.means.detach() - self.mean_center) / self.mean_halfwidth
        change = self.network(positions, self.encoded_time(state, perturbation))
        means = canonical.means + self.mean_halfwidth * change[:, :3]
        quats = nn.functional.normalize(canonical.quats, dim=-1) + change[:, 3:7]
        return Posed(means, quats, (scales + self.mean_halfwidth * change[:, 7:]).abs())

    def time_of(self, state: State, perturbation: Perturbation) -> Tensor:
        """The time of `state`, a scalar, 0 and 1 at the ends of the recording; perturbed where training asks for it."""
        time = self.times.share(state)
        if not isinstance(perturbation, NoisyTime):
            return time
        return time + perturbation.time_noise * self.times.interval * torch.randn((), device=time.device)

    def encoded_time(self, state: State, perturbation: Perturbation) -> Tensor:
        """gamma(t) [E]; the compensation of the dynamic training adjustment is added to it."""
        encoded = octaves(self.time_of(state, perturbation)[None], self.L_time)
        if perturbation.state_noise > 0:
            encoded = encoded + perturbation.state_noise * torch.randn_like(encoded)
        return self.time_net(encoded) if self.settings.synthetic else encoded

    def network(self, positions: Tensor, encoded_time: Tensor) -> Tensor:
        """F: positions [N, 3] in [-1, 1] and gamma(t) [E] to [N, 10] (mean, quaternion, scale)."""
        encoded = octaves(positions, self.settings.L_mean)
        features = encoded
        with tf32_products(positions.device):
            for index, layer in enumerate(self.layers):
                assert isinstance(layer, nn.Linear)
                if index == SKIP + 1:
                    features = torch.cat([encoded.to(features.dtype), features], 1)
                weight: Tensor = layer.weight
                bias: Tensor = layer.bias
                if index in (0, SKIP + 1):  # the time is the same for all: its columns, the last, are multiplied once
                    timeless = features.shape[1]
                    weight, bias = weight[:, :timeless], bias + weight[:, timeless:] @ encoded_time
                with bfloat16_products(positions.device, bool(self.settings.half)):  # the time, one row, is not
                    features = torch.relu(nn.functional.linear(features, weight, bias))
        return self.head(features.float())

    def learning_rates(self, progress: float) -> dict[str, float]:
        rate = log_linear(self.settings.rate, self.settings.final_rate, progress)
        return dict.fromkeys((name for name, _ in self.named_parameters()), rate)
