"""The paper's network (NeeCo, "neural pose-state" field F), method `nps`.

G' = C + F(gamma(mu), gamma(p)): an MLP of depth 12 and width 256 maps each canonical mean and the instrument state to
changes of mean, rotation and scale. Where the paper is silent: an input skip at the middle layer, a zero-initialised
head (the untrained scene is the canonical one), rotation added to the unit quaternion and scale to its logarithm, means
detached and the network off for the first 7.5 % of the training (Deformable-3DGS: 3,000 of 40,000 iterations).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from neeco.base.errors import NeecoError
from neeco.capture.model import Instrument, State
from neeco.evidence.carving import CarvingSettings
from neeco.geometry.rotations import matrix_to_quat, quat_multiply
from neeco.methods.networks import HALF_BY_DEFAULT, PlaceNetwork, check_warm_up, encode, octave_weights, robust_bounds
from neeco.methods.tissue_fit import carve_seeds
from neeco.raster.devices import bfloat16_products, tf32_products
from neeco.scene.canonical import CanonicalGaussians, join_bodies, seed_instrument
from neeco.scene.deformation import UNPERTURBED, Perturbation, Posed, floored_decay, state_of
from neeco.training.session import GaussianSession

# Units of the head's output. With unit features the first Adam step moves every output by about width * rate = 0.2;
# without these units the first steps would move Gaussians across the scene.
MEAN_UNIT = 0.05  # of the points' half extent
SHAPE_UNIT = 0.1  # of quaternion and log scale
MEMBER_LOGITS = "member_logits"  # the per-Gaussian extra [N, I] of learned membership
INITIAL_LOGIT = 6.0  # its magnitude at the start: 0.2 % of a motion affects Gaussians that do not take part


@dataclass(frozen=True, kw_only=True)
class NPSSettings:
    """Settings of the method."""

    # what the fields below were set to before each was set for itself; "practical" departs from the paper
    preset: Literal["published", "practical"] = "published"
    depth: int = 12  # layers of the network, as published
    width: int = 256  # of the network, as published
    L_mean: int = 10  # octaves of the place's encoding, as published
    L_state: int = 10  # octaves of the state's encoding, as published
    identity: bool = False  # keep the raw inputs in addition to their encodings
    # "full": position, quaternion, joints; "rotation_jaw": quaternion and joints (the 2024 drafts); "joints": with
    # `membership`, which carries what poses move
    state: Literal["full", "rotation_jaw", "joints"] = "full"
    # hidden layers multiply in bfloat16 on a CPU that has it; None: decided when training starts, by whether it is fast
    # at it
    half: bool | None = False
    chunk: int = 65536  # Gaussians per evaluation without gradients
    # share of the training over which the network is off; without it the first steps, whose gradients all ask to fill a
    # half-empty image, may move the Gaussians out of sight for good
    warm_up: float = 0.075
    rate: float = 8e-4  # learning rate at the start
    anneal: float = 0.0  # not in the paper: share of the training over which the octaves open, coarse to fine
    seeds: bool = False  # not in the paper: Gaussians begin on the carved instruments, too
    # not in the paper: each Gaussian learns its share of each instrument's recorded motion, by which what the network
    # deformed is carried, and which is its label
    membership: bool = False
    # of the search for instruments, for `seeds`
    carving: CarvingSettings = field(default_factory=CarvingSettings)

    def __post_init__(self) -> None:
        check_warm_up(self.warm_up)
        if self.state == "joints" and not self.membership:
            raise NeecoError(
                "deformation.state: joints do not tell where an instrument is; set deformation.membership=true, too"
            )
        if not 0 <= self.anneal <= 1:
            raise NeecoError(f"deformation.anneal: {self.anneal} is not a share of the training in [0, 1]")


class NPS(PlaceNetwork):
    """The network F."""

    method = "nps"
    former_names = ("neeco",)
    Settings = NPSSettings
    training_defaults: ClassVar[Mapping[str, Any]] = HALF_BY_DEFAULT  # the rest is the paper's
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "published": {},
        "practical": {
            "deformation.seeds": True,
            "deformation.membership": True,
            "deformation.state": "joints",
            "deformation.L_state": 0,
            "deformation.identity": True,
            "deformation.depth": 6,
            "deformation.width": 128,
        },
    }
    needs_instruments = True

    extra_rates: ClassVar[Mapping[str, float]] = {MEMBER_LOGITS: 1e-2}

    state_center: Tensor
    state_halfwidth: Tensor
    first_quats: Tensor
    rest: Tensor  # [I, 4, 4] mm: the instruments' poses in the state in which the canonical Gaussians are placed
    opened: Tensor  # share of the octaves that are open

    def __init__(self, instruments: tuple[Instrument, ...], settings: NPSSettings | None = None) -> None:
        super().__init__(instruments, settings)
        sizes: NPSSettings = self.settings
        depth, width = sizes.depth, sizes.width
        size = self.state_size()
        self.register_buffer("state_center", torch.zeros(size))
        self.register_buffer("state_halfwidth", torch.ones(size))
        self.register_buffer("first_quats", torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(max(len(instruments), 1), 1))
        if sizes.seeds or sizes.membership:
            self.register_buffer("rest", torch.eye(4).repeat(len(instruments), 1, 1))
        if sizes.anneal > 0:
            self.register_buffer("opened", torch.zeros(()))
        if sizes.membership:
            self.label_names = tuple((instrument.name, "instrument") for instrument in instruments)
        mean_inputs = 3 * (2 * sizes.L_mean + sizes.identity)
        state_inputs = size * (2 * sizes.L_state + sizes.identity)
        # gamma(mu) and gamma(p) enter through separate weights of one linear layer: the state's share is computed once
        self.skip = depth // 2 if depth >= 8 else -1
        self.mean_in = nn.Linear(mean_inputs, width)
        self.state_in = nn.Linear(state_inputs, width, bias=False)
        self.hidden = nn.ModuleList(nn.Linear(width, width) for _ in range(depth - 1))
        if self.skip > 0:
            self.mean_skip = nn.Linear(mean_inputs, width, bias=False)
            self.state_skip = nn.Linear(state_inputs, width, bias=False)
        self.head = nn.Linear(width, 10)
        self._initialise()

    def _initialise(self) -> None:
        """He initialisation throughout, so that twelve layers carry gradient; the head starts at zero."""
        layers = [*self.hidden, self.mean_in, self.state_in]
        layers += [self.mean_skip, self.state_skip] if self.skip > 0 else []
        for layer in layers:
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
        with torch.no_grad():
            for layer in layers[-4:] if self.skip > 0 else layers[-2:]:
                layer.weight.mul_(math.sqrt(0.5))  # two inputs are summed
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def state_size(self) -> int:
        """Return the size of the state vector p, at least one: 0 where no joint is recorded and poses are not
        encoded."""
        per_instrument = {"full": 7, "rotation_jaw": 4, "joints": 0}[self.settings.state]
        return max(1, sum(per_instrument + len(instrument.joints) for instrument in self.instruments))

    def fit_ranges(self, states: list[State], means: Tensor) -> None:
        """Normalise p by the recorded range and mu by the points' extent, both to [-1, 1]."""
        if self.instruments:
            first = states[0].instruments
            self.first_quats = torch.stack(
                [matrix_to_quat(first[i.name].pose[:3, :3]) for i in self.instruments]
            ).float()
            vectors = torch.stack([self._raw_state(state) for state in states])
            self.state_center, self.state_halfwidth = _ranges(vectors)
            if hasattr(self, "rest"):
                whole = torch.stack([self._raw_state(state, "full") for state in states])
                center, halfwidth = _ranges(whole)
                middle = int(((whole - center) / halfwidth).square().sum(1).argmin())
                self.rest = self._poses(states[middle])
        self.mean_center, self.mean_halfwidth = robust_bounds(means)

    def _poses(self, state: State) -> Tensor:
        """Return world_from_instrument [I, 4, 4] mm."""
        return torch.stack([state_of(instrument, state).pose.to(self.state_center) for instrument in self.instruments])

    def initial_extras(self, canonical: CanonicalGaussians) -> dict[str, Tensor]:
        if not self.settings.membership:
            return {}
        return {MEMBER_LOGITS: canonical.means.new_full((len(canonical), len(self.instruments)), -INITIAL_LOGIT)}

    def begin(self, session: GaussianSession) -> None:
        if self.settings.seeds:
            with session.searching():
                carved = carve_seeds(session)
            session.scene.canonical = self._with_seeds(session.scene.canonical, carved)

    def _with_seeds(self, canonical: CanonicalGaussians, found: Sequence[tuple[Tensor, float]]) -> CanonicalGaussians:
        """Return `canonical` with Gaussians on the carved instruments, given as points [P, 3] mm in each one's frame
        and the radius of its shaft, at the state of rest: at most half as many as there are."""
        most = max(1, len(canonical) // (2 * len(found)))
        bodies = [canonical]
        for index, (points, radius) in enumerate(found):
            points = points[:: -(-len(points) // most)]
            pose = self.rest[index].to(points)
            body = seed_instrument(points @ pose[:3, :3].T + pose[:3, 3], radius)
            extras = self.initial_extras(body)
            if extras:
                extras[MEMBER_LOGITS][:, index] = INITIAL_LOGIT
            bodies.append(body.with_extras(**extras))
        joined = join_bodies(bodies)
        return joined.map(lambda tensor: tensor, (len(joined),))

    def between_steps(self, session: GaussianSession) -> None:
        if self.settings.anneal > 0:
            self.opened.fill_(min(1.0, session.progress / self.settings.anneal))

    def _raw_state(self, state: State, kind: str | None = None) -> Tensor:
        """Return p before normalisation [S], or that of another `kind`: position mm, sign-continuous quaternion, joints
        rad."""
        kind, parts = kind or self.settings.state, []
        for index, instrument in enumerate(self.instruments):
            instrument_state = state_of(instrument, state)
            pose = instrument_state.pose.to(self.first_quats)
            quat = matrix_to_quat(pose[:3, :3])
            quat = torch.where((quat * self.first_quats[index]).sum() < 0, -quat, quat)
            parts += {"full": [pose[:3, 3], quat], "rotation_jaw": [quat], "joints": []}[kind]
            parts += [pose.new_full((1,), instrument_state.joints[name]) for name in instrument.joints]
        return torch.cat(parts) if parts else self.first_quats.new_zeros(1)

    def state_vector(self, state: State) -> Tensor:
        """Return p [S], each component in [-1, 1] over the recording."""
        return (self._raw_state(state) - self.state_center) / self.state_halfwidth

    def pose(self, canonical: CanonicalGaussians, state: State, perturbation: Perturbation = UNPERTURBED) -> Posed:
        if not self.instruments or self.warming_up:
            deformed = Posed(canonical.means, canonical.quats, canonical.log_scales.exp())
        else:
            change = self.network(canonical.means.detach(), self._encoded_state(state, perturbation.state_noise))
            means = canonical.means + change[:, :3] * (MEAN_UNIT * self.mean_halfwidth)
            quats = nn.functional.normalize(canonical.quats, dim=-1) + SHAPE_UNIT * change[:, 3:7]
            deformed = Posed(means, quats, (canonical.log_scales + SHAPE_UNIT * change[:, 7:]).exp())
        return self._carried(deformed, members(canonical), state) if self.settings.membership else deformed

    def _carried(self, deformed: Posed, shares: Tensor, state: State) -> Posed:
        """Return the static geometry and that moved with each instrument, blended by shares [N, 1 + I]."""
        means, quats = deformed.means, deformed.quats
        carried = self._poses(state) @ self.rest.inverse()  # [I, 4, 4] mm, motions from the state of rest, world frame
        turns = matrix_to_quat(carried[:, :3, :3])  # [I, 4]
        turns = torch.where(turns[:, :1] < 0, -turns, turns)
        frames = [turns.new_tensor([1.0, 0.0, 0.0, 0.0]), *turns]
        placed = [means, *(means @ moved[:3, :3].T + moved[:3, 3] for moved in carried)]
        turned = [quats, *(quat_multiply(turn, quats) for turn in turns)]
        blended = [
            sum(share[:, None] * value for share, value in zip(shares.unbind(1), values, strict=True))
            for values in (placed, turned, frames)
        ]
        return Posed(blended[0], blended[1], deformed.scales, nn.functional.normalize(blended[2], dim=-1).detach())

    def label_channels(self, canonical: CanonicalGaussians) -> Tensor:
        """The learned membership [N, I], or the moving Gaussians."""
        return members(canonical)[:, 1:] if self.settings.membership else super().label_channels(canonical)

    def finish(self, session: GaussianSession) -> None:
        if not self.settings.membership:
            super().finish(session)

    def _encoded_state(self, state: State, noise: float) -> Tensor:
        """gamma(p) + Delta, Delta = N(0, noise^2) (the paper's compensation)."""
        encoded = self._encode(self.state_vector(state), self.settings.L_state)
        return encoded + noise * torch.randn_like(encoded) if noise > 0 else encoded

    def _encode(self, values: Tensor, octaves: int) -> Tensor:
        """gamma of values [..., D], with the values themselves behind where `identity` asks for them."""
        encoded = encode(values, octaves)
        if self.settings.anneal > 0:
            encoded = encoded * octave_weights(self.opened * octaves, octaves).repeat(2 * values.shape[-1])
        return torch.cat([encoded, values], -1) if self.settings.identity else encoded

    def network(self, means: Tensor, encoded_state: Tensor) -> Tensor:
        """F: means [N, 3] mm and gamma(p) [E] to [N, 10] (mean, quaternion, log scale; units above)."""
        chunk = self.settings.chunk
        if not torch.is_grad_enabled() and means.shape[0] > chunk:
            return torch.cat([self.network(part, encoded_state) for part in means.split(chunk)])
        encoded = self._encode((means - self.mean_center) / self.mean_halfwidth, self.settings.L_mean)
        state = encoded_state[None]
        with tf32_products(means.device):
            # one row, and what tells states apart: in float32, as low octaves alone have no place in eight bits
            begin, again = self.state_in(state), self.state_skip(state) if self.skip > 0 else None
            with bfloat16_products(means.device, bool(self.settings.half)):
                summed = self.mean_in(encoded)
                features = torch.relu(summed + begin.to(summed.dtype))
                for index, layer in enumerate(self.hidden, start=1):
                    summed = layer(features)
                    if again is not None and index == self.skip:
                        summed = summed + self.mean_skip(encoded) + again.to(summed.dtype)
                    features = torch.relu(summed)
        return nn.functional.linear(features.float(), self.head.weight, self.head.bias)

    def learning_rates(self, progress: float) -> dict[str, float]:
        return dict.fromkeys(
            (name for name, _ in self.named_parameters()), self.settings.rate * floored_decay(progress)
        )


def _ranges(vectors: Tensor) -> tuple[Tensor, Tensor]:
    """Centre and half width [S] of what vectors [F, S] cover."""
    low, high = vectors.min(0).values, vectors.max(0).values
    return (low + high) / 2, ((high - low) / 2).clamp_min(1e-4)


def members(canonical: CanonicalGaussians) -> Tensor:
    """[N, 1 + I] in [0, 1]: how far each Gaussian belongs to the tissue and to each instrument; rows sum to 1."""
    return nn.functional.pad(canonical.extras[MEMBER_LOGITS], (1, 0)).softmax(1)
