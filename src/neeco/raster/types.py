"""What goes into `rasterize` and what comes out."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from neeco.errors import NeecoError
from neeco.plausible import camera_fault
from neeco.raster.rotations import as_pose

COEFFICIENTS = (0, 4, 5, 8, 12, 14)  # how many distortion coefficients OpenCV's models have


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


@dataclass(frozen=True)
class Camera:
    """A camera, OpenCV axes (x right, y down, z forward), pixel centres at +0.5. Gradients reach the pose.

    A pinhole, unless it is given OpenCV's distortion or a round border, black beyond, as an endoscope has. `learned_fx`
    asks that an image of another size than the learned one show the same picture, larger or smaller (see `draw_through`
    in neeco.raster.optics); `Scene.draw` sees to it. The pose may also be given as an array or nested lists, which
    become float32 (`as_pose`). Raises NeecoError when it is not 4x4, or given so and no rotation and translation, for a
    size that is not whole and positive, and for other numbers that are not finite.

        neeco.Camera(np.eye(4), fx=290, fy=290, cx=160, cy=128, width=320, height=256)
    """

    world_from_camera: Tensor  # [4, 4] rigid, mm
    fx: float  # px
    fy: float
    cx: float  # px from the image's left edge
    cy: float  # px from its upper edge
    width: int  # px
    height: int
    near: float = 0.01  # mm; Gaussians whose mean is nearer draw nothing
    distortion: tuple[float, ...] = ()  # k1, k2, p1, p2[, k3, ...]
    border: tuple[float, float, float] | None = None  # px: centre x, y and radius of what the lens shows
    learned_fx: float | None = None  # px, of the images that Gaussians were learned from; None: of ones like this
    # [4, 4] rigid, mm: the camera that the lamps are beside, where it is another: a stereo scope has lamps once
    world_from_lamps: Tensor | None = None

    if TYPE_CHECKING:  # what may be given

        def __init__(
            self,
            world_from_camera: ArrayLike | Tensor,
            fx: float,
            fy: float,
            cx: float,
            cy: float,
            width: int,
            height: int,
            near: float = ...,
            distortion: tuple[float, ...] = ...,
            border: tuple[float, float, float] | None = ...,
            learned_fx: float | None = ...,
            world_from_lamps: Tensor | None = ...,
        ) -> None: ...

    def __post_init__(self) -> None:
        pose = as_pose(self.world_from_camera, "Camera.world_from_camera", torch.float32)
        object.__setattr__(self, "world_from_camera", pose)
        try:
            fault = camera_fault(self.fx, self.fy, self.cx, self.cy, self.width, self.height, self.near)
            shown = all(math.isfinite(number) for number in (*self.distortion, *(self.border or ())))
        except (TypeError, ValueError, OverflowError):
            raise NeecoError("Camera: expected numbers of px; correct them") from None
        if fault is not None:
            raise NeecoError(f"Camera: {fault[0]}; {fault[1]}")
        if len(self.distortion) not in COEFFICIENTS:
            raise NeecoError(
                f"Camera.distortion: has {len(self.distortion)} coefficients; OpenCV has 4, 5, 8, 12 or 14"
            )
        if not shown or (self.border is not None and self.border[2] <= 0):
            raise NeecoError("Camera: distortion, border: must be finite, the radius positive; correct them")
        object.__setattr__(self, "width", int(self.width))
        object.__setattr__(self, "height", int(self.height))

    def to(self, device: torch.device | str) -> Camera:
        """The same camera, its pose and that of its lamps on `device`."""
        lamps = None if self.world_from_lamps is None else self.world_from_lamps.to(device)
        return replace(self, world_from_camera=self.world_from_camera.to(device), world_from_lamps=lamps)

    @property
    def is_pinhole(self) -> bool:
        """Whether straight lines are straight, and the image has no border."""
        return self.border is None and not any(self.distortion)

    @property
    def is_resampled(self) -> bool:
        """Whether its image is made of that of another camera (see `draw_through` in neeco.raster.optics)."""
        return self.learned_fx is not None or not self.is_pinhole

    def resized(self, width: int, height: int) -> Camera:
        """The same view in an image of width x height px; pixel centres lie at +0.5, so scaling needs no offset."""
        across, down = width / self.width, height / self.height
        border = self.border
        return replace(
            self,
            border=None if border is None else (border[0] * across, border[1] * down, border[2] * across),
            fx=self.fx * across,
            fy=self.fy * down,
            cx=self.cx * across,
            cy=self.cy * down,
            width=width,
            height=height,
        )

    def scaled(self, factor: float) -> Camera:
        """The same view with `factor` times the pixels along each side (rounded to whole pixels, at least one)."""
        return self.resized(max(1, round(self.width * factor)), max(1, round(self.height * factor)))

    def within(self, pixels: int) -> Camera:
        """The same view with at most about so many pixels."""
        factor = (pixels / (self.width * self.height)) ** 0.5
        return self if factor >= 1 else self.scaled(factor)


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
