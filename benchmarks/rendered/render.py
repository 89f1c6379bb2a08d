"""Draw one frame: rays from a laparoscope whose lamps sit beside the lens, then what a camera does to light.

Camera axes are OpenCV's (x right, y down, z forward); pixel centres at +0.5; lengths mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from rendered import instrument as tools
from rendered.instrument import Design, Material
from rendered.motion import Bend, Moment
from rendered.tissue import Tissue, blur

WET = 1.5  # strength of highlights on tissue
WET_SHARPNESS = 170.0
BLOOM = 0.5  # px, blur of the lens
SKY = 0.02  # light from everywhere
SHADOW = 0.15  # of the tissue's light: `shadowed` are pixels that lose more


@dataclass(frozen=True)
class Lamps:
    """Spot lights that move with the lens."""

    positions: tuple[tuple[float, float, float], ...]  # mm, camera frame
    power: float  # brightness of a white surface at `distance`
    distance: float
    focus: float  # how fast light falls off away from the view's middle
    sharpness: float = 11.0  # of shadows: distance from what casts them over half the penumbra's width
    contact: float = 0.0  # mm from the instrument at which it takes 1 / e of 0.6 of all light from what is below it


@dataclass(frozen=True)
class Lens:
    """A pinhole camera."""

    width: int = 320
    height: int = 256
    focal: float = 290.0

    def rays(self, shift: tuple[float, float] = (0.0, 0.0)) -> Tensor:
        """Directions [H * W, 3] with z = 1, camera frame, through pixel centres moved by `shift` px."""
        v, u = torch.meshgrid(torch.arange(self.height) + 0.5, torch.arange(self.width) + 0.5, indexing="ij")
        u, v = (u + shift[0]).reshape(-1), (v + shift[1]).reshape(-1)
        x, y = (u - self.width / 2) / self.focal, (v - self.height / 2) / self.focal
        return torch.stack([x, y, torch.ones_like(x)], -1)


@dataclass(frozen=True)
class View:
    """Where everything is in one frame."""

    scene_from_camera: Tensor  # [4, 4] float32
    scene_from_mechanical: Tensor  # [4, 4]
    opening: float | Bend  # rad, between the jaws, or how all joints stand


@dataclass(frozen=True)
class Drawing:
    """One frame: colour [H, W, 3] in [0, 1] sRGB before sensor noise, parts [H, W] uint8, depth [H, W] mm along z."""

    color: Tensor
    parts: Tensor  # numbers of `rendered.instrument`; 0 tissue
    depth: Tensor
    lit: Tensor  # [L, H, W] share of each lamp that reaches the tissue


@dataclass(frozen=True)
class Place:
    """Everything that stays the same from frame to frame."""

    tissue: Tissue
    design: Design
    lamps: Lamps
    lens: Lens


def view_of(moment: Moment) -> View:
    """What `draw` needs of a moment."""
    camera, tool = (torch.from_numpy(m).float() for m in (moment.scene_from_camera, moment.scene_from_mechanical))
    return View(camera, tool, moment.joints)


def draw(place: Place, view: View, gain: tuple[float, float, float] | None = None) -> Drawing:
    """Draw a frame; gain: what the camera multiplies red, green and blue light by."""
    light, parts, depth, lit = gather(place, view)
    light = blur(light.permute(2, 0, 1), BLOOM).permute(1, 2, 0)
    return Drawing(develop(light, gain), parts, depth, lit)


def shadowed(place: Place, view: View, drawing: Drawing) -> Tensor:
    """Which pixels [H, W] show tissue that the instrument's shadow darkens by more than SHADOW, in linear light."""
    points = (drawing.depth[..., None] * place.lens.rays().reshape(*drawing.depth.shape, 3)).reshape(-1, 3)
    lit = drawing.lit.reshape(len(drawing.lit), -1)
    dark, bright = (_shade_tissue(place, view, points, share).sum(-1) for share in (lit, torch.ones_like(lit)))
    return (dark < (1 - SHADOW) * bright).reshape(drawing.parts.shape) & (drawing.parts == 0)


def gather(place: Place, view: View) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Linear light [H, W, 3] from 2 x 2 samples a pixel; parts [H, W], depth [H, W] and the lamps' shares [L, H, W],
    exact at pixel centres."""
    truth = _truth(place, view)
    lit = _shadows(place, view, truth.tissue)
    planes = truth.tissue[None, None]
    far = F.max_pool2d(planes, 3, 1, 1).reshape(-1) + 0.3
    near = -F.max_pool2d(-planes, 3, 1, 1).reshape(-1) - 0.3
    # samples beside the pixel's centre can see the instrument only where a neighbouring centre does
    around = torch.nonzero(F.max_pool2d(truth.parts[None, None].float(), 5, 1, 2).reshape(-1) > 0)[:, 0]
    samples = [(row, column) for row in range(2) for column in range(2)]
    rays = [place.lens.rays((column / 2 - 0.25, row / 2 - 0.25)) for row, column in samples]
    t, parts = meet_instrument(place, view, torch.cat([directions[around] for directions in rays]))
    total = torch.zeros(truth.parts.numel(), 3)
    for index, ((row, column), directions) in enumerate(zip(samples, rays, strict=True)):
        hit = slice(index * len(around), (index + 1) * len(around))
        share = lit[:, row::2, column::2].reshape(len(lit), -1)
        total += _shade(place, view, directions, (near, far), (around, t[hit], parts[hit]), share) / 4
    depth = torch.minimum(truth.tissue, truth.instrument)
    return total.reshape(*depth.shape, 3), truth.parts, depth, F.avg_pool2d(lit[None], 2)[0]


@dataclass(frozen=True)
class _Truth:
    """What the pixels' centres see."""

    parts: Tensor  # [H, W] uint8
    tissue: Tensor  # [H, W] mm, depth of the tissue, also behind the instrument
    instrument: Tensor  # [H, W] mm, depth of the instrument, inf where there is none


def _truth(place: Place, view: View) -> _Truth:
    directions = place.lens.rays()  # z = 1, so distances are depths
    shape = (place.lens.height, place.lens.width)
    rotation, origin = view.scene_from_camera[:3, :3], view.scene_from_camera[:3, 3]
    tissue = place.tissue.intersect(origin, directions @ rotation.T)
    t, parts = meet_instrument(place, view, directions)
    return _Truth((parts * (t < tissue)).reshape(shape), tissue.reshape(shape), t.reshape(shape))


def mechanical_from_camera(view: View) -> Tensor:
    return torch.linalg.inv(view.scene_from_mechanical.double()).float() @ view.scene_from_camera


def meet_instrument(place: Place, view: View, directions: Tensor) -> tuple[Tensor, Tensor]:
    transform = mechanical_from_camera(view)
    return tools.trace(place.design, view.opening, transform[:3, 3], directions @ transform[:3, :3].T)


def _shadows(place: Place, view: View, tissue: Tensor) -> Tensor:
    """Share [L, 2H, 2W] of each lamp's light that passes the instrument, found between pixels and interpolated."""
    transform, lens = mechanical_from_camera(view), place.lens
    rays = lens.rays((0.5, 0.5)).reshape(lens.height, lens.width, 3)[::2, ::2]
    points = (F.avg_pool2d(tissue[None], 2)[0, ..., None] * rays).reshape(-1, 3)
    points = points @ transform[:3, :3].T + transform[:3, 3]
    lamps = place.lamps
    lit = torch.stack(
        [
            tools.shadow(
                place.design,
                view.opening,
                points,
                transform[:3, :3] @ torch.tensor(lamp) + transform[:3, 3],
                lamps.sharpness,
            )
            for lamp in lamps.positions
        ]
    )
    if lamps.contact:
        lit *= 1 - 0.6 * torch.exp(-place.design.everything(points, view.opening).clamp_min(0) / lamps.contact)
    planes = lit.reshape(1, -1, *rays.shape[:2])
    return F.interpolate(planes, scale_factor=4, mode="bilinear", align_corners=False)[0]


def _shade(
    place: Place,
    view: View,
    directions: Tensor,
    bracket: tuple[Tensor, Tensor],
    hits: tuple[Tensor, Tensor, Tensor],
    lit: Tensor,
) -> Tensor:
    """Linear colour [M, 3] along camera rays [M, 3].

    bracket: distances [M] between which the tissue lies; hits: rays [K] that may meet the instrument, where [K] and
    on which part [K] they do; lit [L, M]: share of each lamp that reaches the tissue.
    """
    rotation, origin = view.scene_from_camera[:3, :3], view.scene_from_camera[:3, 3]
    tissue_t = place.tissue.intersect_between(origin, directions @ rotation.T, *bracket, 4)
    around, t, parts = hits
    in_front = t < tissue_t[around]
    struck = around[in_front]
    color = _shade_tissue(place, view, tissue_t[:, None] * directions, lit)
    color[struck] = _shade_instrument(place, view, t[in_front, None] * directions[struck], parts[in_front])
    return color


def _shade_tissue(place: Place, view: View, points: Tensor, lit: Tensor) -> Tensor:
    """Colour [M, 3] of wet tissue at points [M, 3], camera frame; lit [L, M]: share of each lamp that reaches it."""
    rotation, origin = view.scene_from_camera[:3, :3], view.scene_from_camera[:3, 3]
    surface = place.tissue.look_up(points @ rotation.T + origin)
    albedo, gloss, openness = surface[:, :3], surface[:, 6:7], surface[:, 7:8]
    normal = F.normalize(surface[:, 3:6] @ rotation, dim=-1)
    towards_eye = F.normalize(-points, dim=-1)
    color = SKY * albedo * openness
    for lamp, share in zip(place.lamps.positions, lit, strict=True):
        strength, light = _light(place.lamps, torch.tensor(lamp), points)
        strength = strength * (0.06 + 0.94 * share[:, None])
        facing = (normal * light).sum(-1, keepdim=True)
        diffuse = ((facing + 0.15) / 1.15).clamp_min(0)  # light also comes out beside where it went in
        halfway = F.normalize(light + towards_eye, dim=-1)
        glint = (normal * halfway).sum(-1, keepdim=True).clamp_min(0) ** WET_SHARPNESS
        color += strength * openness * (albedo * diffuse + WET * gloss.square() * glint)
    return color


def _shade_instrument(place: Place, view: View, points: Tensor, parts: Tensor) -> Tensor:
    """Colour [M, 3] of the instrument at points [M, 3], camera frame, on the given parts [M]."""
    transform = mechanical_from_camera(view)
    local = points @ transform[:3, :3].T + transform[:3, 3]
    normal = tools.normals(place.design, view.opening, local, parts) @ transform[:3, :3]
    tone = 1 + 0.16 * tools.grain(place.design, view.opening, local, parts)[:, None]
    ring = tools.painted(place.design, local, parts)
    towards_eye = F.normalize(-points, dim=-1)
    shaft, wrist, jaw = (_rows(material) for material in place.design.materials)
    is_shaft, is_wrist = (parts == tools.SHAFT)[:, None], (parts == tools.WRIST)[:, None]
    rows = torch.where(is_shaft, shaft, torch.where(is_wrist, wrist, jaw))
    base, diffuse_share, shine, sharpness = rows[:, :3], rows[:, 3:4], rows[:, 4:5], rows[:, 5:6]
    base = base * tone
    base = torch.where(ring[:, None], torch.full_like(base, tools.RING_COLOR), base)
    mirrored = 2 * (normal * towards_eye).sum(-1, keepdim=True) * normal - towards_eye
    if place.design.mirrors:
        seen = _surroundings(place, points, mirrored)
    else:
        seen = torch.tensor([0.30, 0.13, 0.10]) * (0.25 + 0.75 * (mirrored[:, 2:] * 0.5 + 0.5))  # tissue in the metal
    graze = (1 - (normal * towards_eye).sum(-1, keepdim=True).clamp(0, 1)) ** 4
    color = base * SKY
    for lamp in place.lamps.positions:
        strength, light = _light(place.lamps, torch.tensor(lamp), points)
        # the camera's exposure control
        strength = strength.clamp_max(1.2 * place.lamps.power / len(place.lamps.positions))
        facing = (normal * light).sum(-1, keepdim=True).clamp_min(0)
        halfway = F.normalize(light + towards_eye, dim=-1)
        glint = (normal * halfway).sum(-1, keepdim=True).clamp_min(0) ** sharpness
        mirror = (1 - diffuse_share) * seen * (base + (1 - base) * graze)
        color += strength * (base * diffuse_share * facing + shine * glint * (0.4 + 0.6 * base) + mirror)
    return color


def _surroundings(place: Place, points: Tensor, mirrored: Tensor) -> Tensor:
    """Linear light [M, 3] that mirrored rays [M, 3] from points [M, 3] meet, camera frame: creased tissue where they
    point away from the scope, a dark room with a bright ceiling light where they come back."""
    lamps = place.lamps
    away = (lamps.distance - points[:, 2:]).clamp_min(5) / mirrored[:, 2:].clamp_min(0.1)
    x, y, _ = (points + away * mirrored).split(1, -1)
    folds = 0.6 + 0.4 * torch.sin(x / 5) * torch.sin(y / 7 + 1)
    lit = folds / (1 + (x.square() + y.square()) / 60**2)
    tissue = place.tissue.surface[:3, ::16, ::16].mean((1, 2)) * lit
    ceiling = torch.exp(-(((mirrored[:, 1:2] + 0.55) / 0.15) ** 2))
    room = torch.tensor([0.9, 0.95, 1.0]) * (0.02 + 0.7 * ceiling)
    share = torch.sigmoid(mirrored[:, 2:] * 12)
    return share * tissue + (1 - share) * room


def _rows(material: Material) -> Tensor:
    return torch.tensor([*material.color, material.diffuse, material.shine, material.sharpness])


def _light(lamps: Lamps, position: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Strength [M, 1] and unit direction [M, 3] of a lamp's light at points [M, 3], camera frame."""
    towards = position - points
    squared = towards.square().sum(-1, keepdim=True)
    light = towards * squared.rsqrt()
    cone = (-light[:, 2:]).clamp_min(0.05) ** lamps.focus
    share = lamps.power / len(lamps.positions)
    return share * cone * lamps.distance**2 / squared, light


def develop(light: Tensor, gain: tuple[float, float, float] | None = None) -> Tensor:
    """Linear light [H, W, 3] to sRGB in [0, 1]: vignette, exposure, soft shoulder, transfer curve."""
    height, width = light.shape[:2]
    v, u = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
    light = light * (1 - 0.13 * (u.square() + v.square()))[..., None]
    if gain is not None:
        light = light * torch.tensor(gain)
    shoulder = 0.7
    light = torch.where(
        light > shoulder, shoulder + (1 - shoulder) * (1 - torch.exp(-(light - shoulder) / (1 - shoulder))), light
    ).clamp(0, 1)
    return torch.where(light <= 0.0031308, 12.92 * light, 1.055 * light.clamp_min(1e-6) ** (1 / 2.4) - 0.055)
