"""Rigid instruments: Gaussians that begin on a carved instrument move with its pose; method `rigid`."""

from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from neeco.evidence.carving import CarvingSettings
from neeco.geometry.rotations import matrix_to_quat, quat_multiply
from neeco.methods.tissue_fit import carve_seeds
from neeco.scene.canonical import join_bodies, seed_instrument
from neeco.scene.deformation import UNPERTURBED, LabelledByMotion, Posed, state_of

OWNER = "owner"  # the per-Gaussian extra [N]: 0 tissue, else the instrument's number


@dataclass(frozen=True)
class RigidSettings:
    """`carving`: of the search for instruments (see `CarvingSettings`)."""

    carving: CarvingSettings = field(default_factory=CarvingSettings)


class Rigid(LabelledByMotion):
    """Canonical Gaussians stand where the recorded state `rest` has them, world frame."""

    method = "rigid"
    Settings = RigidSettings
    needs_instruments = True
    rest: Tensor  # [I, 4, 4] mm, world_from_instrument

    def __init__(self, instruments=(), settings=None) -> None:
        super().__init__(instruments, settings)
        self.register_buffer("rest", torch.eye(4).repeat(len(instruments), 1, 1))

    def poses(self, state) -> Tensor:
        return torch.stack([state_of(item, state).pose.to(self.rest) for item in self.instruments])

    def fit_ranges(self, states, means) -> None:
        self.rest = self.poses(states[len(states) // 2])

    def initial_extras(self, canonical) -> dict[str, Tensor]:
        return {OWNER: canonical.means.new_zeros(len(canonical))}

    def begin(self, session) -> None:
        bodies = [session.scene.canonical]
        with session.searching():
            carved = carve_seeds(session)
        for number, (points, radius) in enumerate(carved, start=1):
            pose = self.rest[number - 1]
            body = seed_instrument(points @ pose[:3, :3].T + pose[:3, 3], radius)
            bodies.append(body.with_extras(**{OWNER: body.means.new_full((len(body),), number)}))
        joined = join_bodies(bodies)
        session.scene.canonical = joined.map(lambda tensor: tensor, (len(joined),))

    def pose(self, canonical, state, perturbation=UNPERTURBED) -> Posed:
        moved = nn.functional.pad(self.poses(state) @ self.rest.inverse(), (0, 0, 0, 0, 1, 0))
        moved[0] = torch.eye(4).to(moved)
        own = moved[canonical.extras[OWNER].long()]  # [N, 4, 4]
        means = (own[:, :3, :3] @ canonical.means[..., None])[..., 0] + own[:, :3, 3]
        turned = quat_multiply(matrix_to_quat(own[:, :3, :3]), canonical.quats)
        return Posed(means, turned, canonical.log_scales.exp())

    def learning_rates(self, progress) -> dict[str, float]:
        return {}
