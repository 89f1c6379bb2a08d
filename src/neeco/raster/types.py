"""Inputs and outputs of `rasterize`."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, fields, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from neeco.geometry.camera import Camera

Held = TypeVar("Held", bound="Movable")


@dataclass(frozen=True)
class Movable:
    """Base class of groups of tensors that are moved to a device together."""

    def to(self: Held, device: torch.device | str) -> Held:
        """Return a copy on `device`."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return replace(self, **{name: value.to(device) for name, value in values.items() if value is not None})


@dataclass(frozen=True)
class Shadow(Movable):
    """Shadows that some Gaussians cast on the others under lamps next to the lens (see `shadow.shadowed`)."""

    casters: Tensor  # [N] bool: these cast the shadow, all others receive it
    offsets: Tensor  # [L, 3] mm, the lamps in the camera's frame (OpenCV axes)
    strengths: Tensor  # [L] in [0, 1]: share of all (linear) light that each gives, missing in its deepest shadow
    width: Tensor  # [] slope: standard deviation of a shadow's edge, viewed from the lamp


@dataclass(frozen=True)
class Headlight(Movable):
    """Light at the camera, as an endoscope's: it decreases with distance and off the optical axis.

    A Gaussian's colour is multiplied by
    `(distance / 100 mm) ** -falloff * exp(vignette[0] * t + vignette[1] * t**2)`,
    distance and t taken at its mean, in the camera frame: distance = |p|, t = (p_x / p_z)^2 + (p_y / p_z)^2, the two
    slopes clamped to the field of view and its margin (`field_slopes`), since the vignette diverges beyond it. It is
    also multiplied by `left`, the share that shadows leave.
    """

    falloff: Tensor  # [N] exponent
    vignette: Tensor  # [2]
    shadow: Shadow | None = None
    left: Tensor | None = None  # [N] of stored colours, > 0; None: all

    def select(self, rows: Tensor | slice) -> Headlight:
        """Return the light of the Gaussians `rows`."""
        shadow = None if self.shadow is None else replace(self.shadow, casters=self.shadow.casters[rows])
        left = None if self.left is None else self.left[rows]
        return Headlight(self.falloff[rows], self.vignette, shadow, left)


def _rows(chosen: Tensor) -> Tensor | slice:
    """Return the indices of True in `chosen` [N]; on the CPU as a slice if they are contiguous, as instruments are."""
    rows = chosen.nonzero()[:, 0]  # waits for the device once
    if chosen.device.type == "cpu" and len(rows) and int(rows[-1] - rows[0]) == len(rows) - 1:
        return slice(int(rows[0]), int(rows[-1]) + 1)
    return rows


@dataclass(frozen=True)
class Gaussians(Movable):
    """Posed Gaussians (world frame, lengths in mm).

    Colour is `max(0, sh . basis(direction) + 0.5)`, direction = from the camera centre to the mean, unit, turned into
    the Gaussian's SH frame when `sh_frames` is given; then the headlight. No gradient flows into `sh_frames`.
    `background` is the default colour behind all of them, such as the white of segmented images.
    """

    means: Tensor  # [N, 3] mm
    quats: Tensor  # [N, 4] wxyz, world_from_gaussian; need not be unit
    scales: Tensor  # [N, 3] mm, standard deviations, > 0
    opacities: Tensor  # [N] in (0, 1)
    sh: Tensor  # [N, K, 3], K = 1, 4, 9 or 16
    _: KW_ONLY
    sh_frames: Tensor | None = None  # [N, 4] wxyz unit, world_from_sh
    headlight: Headlight | None = None
    background: Tensor | None = None  # [3] colour; None: black

    def __len__(self) -> int:
        return self.means.shape[0]

    def select(self, chosen: Tensor | slice) -> Gaussians:
        """Return the chosen Gaussians (bool [N], or a slice, which is not copied)."""
        rows = _rows(chosen) if isinstance(chosen, Tensor) else chosen
        columns: dict[str, Any] = {
            name: getattr(self, name)[rows] for name in ("means", "quats", "scales", "opacities", "sh")
        }
        frames = None if self.sh_frames is None else self.sh_frames[rows]
        return replace(self, **columns, sh_frames=frames, headlight=self.headlight and self.headlight.select(rows))


def differentiable(
    gaussians: Gaussians, camera: Camera, channels: Tensor | None, background: Tensor | None
) -> list[Tensor | None]:
    """Return the differentiable tensors of a rendering, in the order of neeco's backends; None: absent."""
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
class Layer:
    """A subset of the Gaussians, rendered without the others; no gradient."""

    alpha: Tensor  # [H, W]
    depth: Tensor  # [H, W] mm, as that of a rendering


@dataclass(frozen=True)
class Rendering:
    """A rendered image, and statistics for density control."""

    color: Tensor  # [H, W, 3]
    alpha: Tensor  # [H, W]
    depth: Tensor  # [H, W] mm, expected depth (accumulated z / alpha; 0 where alpha is 0)
    channels: Tensor | None  # [H, W, C] composited like colour, background 0
    radii: Tensor  # [N] px, 3-sigma-like extent of the ellipse, 0 where not rendered; no gradient
    center_offsets: Tensor  # [N, 2] px, zeros added to the projected centres; `.grad` after backward: d loss / d centre
    _: KW_ONLY
    alone: tuple[Layer, ...] = ()  # of the requested subsets

    @property
    def visible(self) -> Tensor:
        """Gaussians that touch the image, [N] bool."""
        return self.radii > 0
