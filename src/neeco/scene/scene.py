"""The learned model: canonical Gaussians, the deformation that poses them, and the light they are seen in."""

from __future__ import annotations

import dataclasses
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from neeco.capture.model import Camera, Instrument, InstrumentState, State
from neeco.raster import rasterize
from neeco.raster.types import Gaussians, Headlight, Rendering
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.deformations.base import UNPERTURBED, Deformation, Deltas, Perturbation
from neeco.scene.rotations import rigid_from_vector


@dataclass(frozen=True)
class Recording:
    """What the scene was learned from: every training frame's name, split, state and camera."""

    names: tuple[str, ...] = ()
    splits: tuple[str, ...] = ()
    states: tuple[State, ...] = ()
    cameras: tuple[Camera, ...] = ()


class Scene(nn.Module):
    """`scene.at(state)` is the one way from canonical to posed Gaussians, for every method; `draw` shows them.

    `registration` [7] is one constant tracker-to-world correction (rotation vector in rad about `center`, translation
    in mm, log scale about `center`), applied to every instrument pose; zero unless refined. `falloff` (tissue,
    instruments) and `vignette` are the headlight (see `Headlight`). `backdrop` in [0, 1] is the grey behind everything.
    """

    center: Tensor
    registration: Tensor

    def __init__(
        self,
        method: str,
        canonical: CanonicalGaussians,
        deformation: Deformation,
        instruments: tuple[Instrument, ...],
        recorded: Recording,
        center: Tensor,
    ) -> None:
        super().__init__()
        self.method = method
        self.canonical = canonical
        self.deformation = deformation
        self.instruments = instruments
        self.recorded = recorded
        self.sh_degree = 0
        self.backdrop = 0.0
        self.diagnostics: dict[str, Any] = {}
        self.register_buffer("center", center.float())  # [3] mm, middle of the tissue
        self.registration = nn.Parameter(torch.zeros(7))
        self.falloff = nn.Parameter(torch.zeros(2))
        self.vignette = nn.Parameter(torch.zeros(2))

    def at(self, state: State, perturbation: Perturbation = UNPERTURBED) -> Gaussians:
        """Gaussians posed in `state`, float32. Gradients reach instrument poses that require them.

        Raises NeecoError when the state lacks an instrument or joint that the scene has.
        """
        canonical = self.canonical
        posed = self.deformation.pose(canonical, self.registered(state), perturbation)
        falloff = self.falloff[(canonical.bodies > 0).long()]
        return Gaussians(
            means=posed.means,
            quats=posed.quats,
            scales=posed.scales,
            opacities=torch.sigmoid(canonical.opacity_logits),
            sh=canonical.spherical_harmonics(self.sh_degree),
            sh_frames=posed.sh_frames,
            headlight=Headlight(falloff, self.vignette),
            backdrop=torch.full((3,), self.backdrop) if self.backdrop else None,
        )

    def registered(self, state: State) -> State:
        """`state` with the learned tracker-to-world correction applied to its poses."""
        if not state.instruments or not (self.registration.requires_grad or bool(self.registration.any())):
            return state
        correction = rigid_from_vector(self.registration[:6])
        scale = self.registration[6].exp()
        moved = {}
        for name, given in state.instruments.items():
            pose = given.pose.to(correction.dtype)
            arm = (pose[:3, 3] - self.center) * scale
            rotation = correction[:3, :3] @ pose[:3, :3]
            translation = correction[:3, :3] @ arm + self.center + correction[:3, 3]
            top = torch.cat([rotation, translation[:, None]], 1)
            moved[name] = InstrumentState(torch.cat([top, pose[3:]]), given.joints)
        return dataclasses.replace(state, instruments=moved)

    def camera(self, camera: Camera) -> Camera:
        """The camera to draw with. The recorded one: the correction is carried by the instruments."""
        return camera

    def draw(self, state: State, camera: Camera, labels: bool = False) -> Rendering:
        """Draw `state` as the recorded `camera` sees it; `labels`: with label channels, where the method learns any."""
        channels = self.label_channels() if labels and self.label_names else None
        return rasterize(self.at(state), self.camera(camera), channels=channels)

    def torch_threads(self) -> AbstractContextManager[None]:
        """As many of torch's threads as pay where the scene is drawn."""
        return self.deformation.torch_threads()

    @property
    def num_gaussians(self) -> int:
        """How many Gaussians one drawing uses."""
        return len(self.canonical)

    @property
    def label_names(self) -> tuple[tuple[str, str], ...]:
        """(instrument, part) of each label column; mask id = index + 1, 0 is tissue."""
        return self.deformation.label_names

    def label_channels(self) -> Tensor:
        """Soft membership [N, L] in [0, 1] of each Gaussian; what is left to 1 is tissue."""
        return self.deformation.label_channels(self.canonical)

    def deltas(self, state: State) -> Deltas:
        """How each Gaussian changes from canonical to `state`."""
        return self.deformation.deltas(self.canonical, self.registered(state))

    def keypoints(self, state: State) -> dict[str, dict[str, Tensor]]:
        """Named 3D points [3] mm, world frame, per instrument."""
        return self.deformation.keypoints(self.registered(state))
