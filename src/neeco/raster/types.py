"""What goes into `rasterize` and what comes out."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from neeco.geometry.camera import Camera


@dataclass(frozen=True)
class Shadow:
    """What lamps miss behind some of the Gaussians, since they sit beside the lens (see `shadow.shadowed`)."""

    casters: Tensor  # [N] bool: these cast it, all others receive it
    offsets: Tensor  # [L, 3] mm, the lamps in the camera's frame (OpenCV axes)
    strengths: Tensor  # [L] in [0, 1]: share of all (linear) light that each gives, missing in its deepest shadow
    width: Tensor  # [] slope: standard deviation of a shadow's edge, as seen from the lamp

    def to(self, device: torch.device | str) -> Shadow:
        """The same shadow on `device`."""
        return Shadow(*(getattr(self, field.name).to(device) for field in fields(self)))


@dataclass(frozen=True)
class Headlight:
    """A light that sits at the camera, as an endoscope's does: it dims with distance and off the optical axis.

    A Gaussian's colour is multiplied by
    `(distance / 100 mm) ** -falloff * exp(vignette[0] * t + vignette[1] * t**2)`,
    distance and t taken at its mean, in the camera frame: distance = |p|, t = (p_x / p_z)^2 + (p_y / p_z)^2, the two
    slopes brought into the field of view and its margin (`field_slopes`): beyond it the vignette means nothing, and its
    powers would blind the image. What shadows leave of it, `left`, multiplies, too.
    """

    falloff: Tensor  # [N] exponent
    vignette: Tensor  # [2]
    shadow: Shadow | None = None
    left: Tensor | None = None  # [N] of stored colours, > 0; None: all

    def to(self, device: torch.device | str) -> Headlight:
        """The same light on `device`."""
        shadow = None if self.shadow is None else self.shadow.to(device)
        left = None if self.left is None else self.left.to(device)
        return Headlight(self.falloff.to(device), self.vignette.to(device), shadow, left)


@dataclass(frozen=True)
class Gaussians:
    """Posed Gaussians, ready to draw (world frame, lengths in mm).

    Colour is `max(0, sh . basis(direction) + 0.5)`, direction = from the camera centre to the mean, unit, turned into
    the Gaussian's SH frame when `sh_frames` is given; then the headlight. No gradient flows into `sh_frames`.
    `background` lies behind all of them where nothing else is asked for, e.g. the white of images cut out of their
    surroundings.
    """

    means: Tensor  # [N, 3] mm
    quats: Tensor  # [N, 4] wxyz, world_from_gaussian; need not be unit
    scales: Tensor  # [N, 3] mm, standard deviations, > 0
    opacities: Tensor  # [N] in (0, 1)
    sh: Tensor  # [N, K, 3], K = 1, 4, 9 or 16
    sh_frames: Tensor | None = None  # [N, 4] wxyz unit, world_from_sh
    headlight: Headlight | None = None
    background: Tensor | None = None  # [3] colour; None: black

    def __len__(self) -> int:
        return self.means.shape[0]

    def select(self, chosen: Tensor | slice) -> Gaussians:
        """The chosen ones (bool [N], or rows that follow each other, which are not copied)."""
        if isinstance(chosen, Tensor):
            chosen = chosen.nonzero()[:, 0]  # asked for once: how many there are, a device has to say
        light = self.headlight
        if light is not None:
            shadow = None if light.shadow is None else replace(light.shadow, casters=light.shadow.casters[chosen])
            left = None if light.left is None else light.left[chosen]
            light = Headlight(light.falloff[chosen], light.vignette, shadow, left)
        return Gaussians(
            means=self.means[chosen],
            quats=self.quats[chosen],
            scales=self.scales[chosen],
            opacities=self.opacities[chosen],
            sh=self.sh[chosen],
            sh_frames=None if self.sh_frames is None else self.sh_frames[chosen],
            headlight=light,
            background=self.background,
        )

    def to(self, device: torch.device | str) -> Gaussians:
        """The same Gaussians on `device`."""
        held = {field.name: getattr(self, field.name) for field in fields(self)}
        return replace(self, **{name: value.to(device) for name, value in held.items() if value is not None})


def differentiable(
    gaussians: Gaussians, camera: Camera, channels: Tensor | None, background: Tensor | None
) -> list[Tensor | None]:
    """What gradients of a drawing reach, in the order in which neeco's own backends take it; None: not there."""
    light = gaussians.headlight
    return [
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
        None if light is None else light.falloff,
        channels,
        None if light is None else light.left,
        None if light is None else light.vignette,
        camera.world_from_camera,
        background,
    ]


@dataclass(frozen=True)
class Rendering:
    """One drawn image, and what density control wants to know of it."""

    color: Tensor  # [H, W, 3]
    alpha: Tensor  # [H, W]
    depth: Tensor  # [H, W] mm, expected depth (accumulated z / alpha; 0 where nothing was drawn)
    channels: Tensor | None  # [H, W, C] composited like colour, background 0
    radii: Tensor  # [N] px, 3-sigma-like extent of the drawn ellipse, 0 where not drawn; no gradient
    center_offsets: Tensor  # [N, 2] px, zeros added to the projected centres; `.grad` after backward: d loss / d centre

    @property
    def visible(self) -> Tensor:
        """[N] bool: which Gaussians touched the image."""
        return self.radii > 0
