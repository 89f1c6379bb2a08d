"""Draw full-size frames with fine detail: one sample a pixel where nothing changes, 3 x 3 where something does.

As `render.gather`, with the same lamps and materials, but from coarse to fine: blocks of pixels bound where rays meet
tissue and which may meet the instrument; bands of rows keep a processor's caches warm.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from rendered import instrument as tools
from rendered.detail import Detail
from rendered.render import (
    BLOOM,
    WET,
    WET_SHARPNESS,
    Drawing,
    Lens,
    Place,
    View,
    develop,
    light_instrument,
    light_tissue,
    mechanical_from_camera,
    passing,
    widened,
)
from rendered.textures import remap

BLOCK = 4  # px
BAND = 1 << 16  # rays that are rendered at a time
SAMPLES = 3  # a side of the pixels that are sampled again
RESAMPLED = 0.6  # of a pixel that each of these samples stands for, so that their mean is as sharp as its neighbours
EDGE_MM = 0.35  # of depth, beyond what a plane would do, that calls for more samples …
CONTRAST = 0.09  # … as does this between neighbours, of the square root of light
SLACK_MM = 0.3
MARCH, BISECTIONS = 4, 2


@dataclass(frozen=True)
class _Frame:
    """One frame's rays and what is known of its blocks."""

    place: Place
    detail: Detail
    view: View
    near: Tensor  # [H / B, W / B] distances between which a block's rays meet tissue
    far: Tensor
    instrument: Tensor  # [H / B, W / B] bool: a block's rays may meet the instrument
    lit: Tensor  # [L, H / S, W / S] share of each lamp that passes the instrument
    height: np.ndarray  # of the tissue


@dataclass(frozen=True)
class _Samples:
    """What rays see: linear light [M, 3], parts [M] uint8, depth [M] mm."""

    light: Tensor
    parts: Tensor
    depth: Tensor


def draw_detailed(place: Place, detail: Detail, view: View, gain: tuple[float, float, float] | None = None) -> Drawing:
    """Draw a frame. Parts are what most of a pixel's samples see; depth is that part's, mm."""
    lens = place.lens
    frame = _prepare(place, detail, view)
    shape = (lens.height, lens.width)
    v, u = torch.meshgrid(torch.arange(lens.height) + 0.5, torch.arange(lens.width) + 0.5, indexing="ij")
    middle = _sample(frame, u.reshape(-1), v.reshape(-1), 1.0)
    light, parts, depth = middle.light, middle.parts, middle.depth
    changes = _changes(light.reshape(*shape, 3), parts.reshape(shape), depth.reshape(shape))
    again = torch.nonzero(changes.reshape(-1))[:, 0]
    if len(again):
        here = _Samples(light[again], parts[again], depth[again])
        voted = _sample_again(frame, u.reshape(-1)[again], v.reshape(-1)[again], here)
        light[again], parts[again], depth[again] = voted.light, voted.parts, voted.depth
    blurred = cv2.GaussianBlur(light.reshape(*shape, 3).numpy(), (0, 0), BLOOM, borderType=cv2.BORDER_REPLICATE)
    lit = F.interpolate(frame.lit[None], size=shape, mode="bilinear", align_corners=False)[0]
    return Drawing(develop(torch.from_numpy(blurred), gain), parts.reshape(shape), depth.reshape(shape), lit)


def _sample_again(frame: _Frame, u: Tensor, v: Tensor, middle: _Samples) -> _Samples:
    """The pixels at u, v [M] px, whose middles are drawn, from SAMPLES x SAMPLES samples: the mean of the light, the
    part that most see, and of those that see it the depth: the middle's if it does, else the mean."""
    offsets = [(place - (SAMPLES - 1) / 2) / SAMPLES for place in range(SAMPLES)]
    shifts = [(x, y) for y in offsets for x in offsets if x or y]
    found = _sample(frame, torch.cat([u + x for x, _ in shifts]), torch.cat([v + y for _, y in shifts]), RESAMPLED)
    light, parts, depth = (
        torch.cat([getattr(found, name).unflatten(0, (len(shifts), -1)), getattr(middle, name)[None]])
        for name in ("light", "parts", "depth")
    )
    votes = torch.stack([(parts == part).sum(0) for part in range(tools.SECOND_JAW + 1)])
    chosen = votes.argmax(0).to(torch.uint8)
    agrees = parts == chosen
    mean = (depth * agrees).sum(0) / agrees.sum(0)
    return _Samples(light.mean(0), chosen, torch.where(agrees[-1], middle.depth, mean))


def _prepare(place: Place, detail: Detail, view: View) -> _Frame:
    """Look at the middles of blocks."""
    lens = place.lens
    if lens.width % BLOCK or lens.height % BLOCK:
        raise ValueError(f"{lens.width}x{lens.height}: sides must be multiples of {BLOCK}")
    shape = (lens.height // BLOCK, lens.width // BLOCK)
    rays = _grid(lens, BLOCK)
    rotation, origin = view.scene_from_camera[:3, :3], view.scene_from_camera[:3, 3]
    tissue = place.tissue.intersect(origin, rays @ rotation.T).reshape(shape)
    slack = SLACK_MM + tissue * (BLOCK / 2 / lens.focal)  # blocks at the border have no neighbours farther out
    far = F.max_pool2d(tissue[None, None], 3, 1, 1)[0, 0] + slack
    near = -F.max_pool2d(-tissue[None, None], 3, 1, 1)[0, 0] - slack
    transform = mechanical_from_camera(view)
    unit = F.normalize(rays @ transform[:3, :3].T, dim=-1)
    spread = 0.75 * BLOCK / lens.focal  # a little beyond a block's corners
    meets = tools.may_meet(place.design, view.opening, transform[:3, 3], unit, spread).reshape(shape)
    return _Frame(place, detail, view, near, far, meets, _lit(place, view, tissue), place.tissue.height.numpy())


def _lit(place: Place, view: View, tissue: Tensor) -> Tensor:
    """Share [L, H / S, W / S] of each lamp's light that passes the instrument, as fine in angle at every size."""
    lens = place.lens
    step = max(BLOCK, BLOCK * round(2 * lens.height / Lens.height / BLOCK))
    while lens.width % step or lens.height % step:
        step -= BLOCK
    depth = F.avg_pool2d(tissue[None], step // BLOCK)[0].reshape(-1, 1)
    transform = mechanical_from_camera(view)
    points = (depth * _grid(lens, step)) @ transform[:3, :3].T + transform[:3, 3]
    return passing(place, view, points).reshape(-1, lens.height // step, lens.width // step)


def _grid(lens: Lens, step: int) -> Tensor:
    """Rays [M, 3] through the middles of blocks of step x step pixels."""
    v, u = torch.meshgrid(torch.arange(lens.height // step), torch.arange(lens.width // step), indexing="ij")
    return lens.rays_through((u.reshape(-1) + 0.5) * step, (v.reshape(-1) + 0.5) * step)


def _sample(frame: _Frame, u: Tensor, v: Tensor, size: float) -> _Samples:
    """What rays through image positions u, v [M] px see; size: of a sample, in pixels."""
    tool_depth, parts = _meet_instrument(frame, u, v)
    bands = [slice(first, first + BAND) for first in range(0, len(u), BAND)]
    drawn = [_sample_band(frame, u[band], v[band], tool_depth[band], parts[band], size) for band in bands]
    return _Samples(*(torch.cat([getattr(band, name) for band in drawn]) for name in ("light", "parts", "depth")))


def _blocks(lens: Lens, u: Tensor, v: Tensor) -> Tensor:
    """The block [M] of image positions u, v [M] px."""
    return (v / BLOCK).long() * (lens.width // BLOCK) + (u / BLOCK).long()


def _meet_instrument(frame: _Frame, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Depth [M] mm and part [M] of the instrument at image positions u, v [M]; inf and 0 where there is none."""
    lens = frame.place.lens
    depth, parts = torch.full((len(u),), torch.inf), torch.zeros(len(u), dtype=torch.uint8)
    candidates = torch.nonzero(frame.instrument.reshape(-1)[_blocks(lens, u, v)])[:, 0]
    if len(candidates):
        transform = mechanical_from_camera(frame.view)
        directions = lens.rays_through(u[candidates], v[candidates]) @ transform[:3, :3].T
        found = tools.trace(frame.place.design, frame.view.opening, transform[:3, 3], directions)
        depth[candidates], parts[candidates] = found
    return depth, parts


def _sample_band(frame: _Frame, u: Tensor, v: Tensor, tool_depth: Tensor, parts: Tensor, size: float) -> _Samples:
    lens = frame.place.lens
    rays, blocks = lens.rays_through(u, v), _blocks(lens, u, v)
    depth = _meet_tissue(frame, rays, blocks)
    parts = parts * (tool_depth < depth)
    depth = torch.minimum(depth, tool_depth)
    light = torch.empty(len(u), 3)
    on_tissue, on_tool = torch.nonzero(parts == 0)[:, 0], torch.nonzero(parts)[:, 0]
    pixel = size / lens.focal
    if len(on_tissue):
        points = depth[on_tissue, None] * rays[on_tissue]
        scale = frame.lit.shape[-1] / lens.width
        lit = torch.stack(
            [remap(plane.numpy(), u[on_tissue] * scale - 0.5, v[on_tissue] * scale - 0.5) for plane in frame.lit]
        )
        light[on_tissue] = _light_tissue(frame, points, pixel, lit)
    if len(on_tool):
        points = depth[on_tool, None] * rays[on_tool]
        light[on_tool] = _light_instrument(frame, points, pixel, parts[on_tool])
    return _Samples(light, parts, depth)


def _meet_tissue(frame: _Frame, rays: Tensor, blocks: Tensor) -> Tensor:
    """Depth [M] mm of the tissue along rays [M, 3] of the given blocks [M]."""
    rotation, origin = frame.view.scene_from_camera[:3, :3], frame.view.scene_from_camera[:3, 3]
    x, y, z = (rays @ rotation.T).unbind(-1)
    tissue = frame.place.tissue

    def above(t: Tensor) -> Tensor:
        return origin[2] + t * z - remap(frame.height, *tissue.texels(origin[0] + t * x, origin[1] + t * y))

    low, far = frame.near.reshape(-1)[blocks], frame.far.reshape(-1)[blocks]
    step = (far - low) / MARCH
    first, going = above(low), torch.ones(len(rays), dtype=torch.bool)
    second = torch.empty_like(first)
    for index in range(1, MARCH + 1):  # the first step at whose end a ray is below
        value = above(low + step)
        second = torch.where(going, value, second)
        going = going & (value > 0) & (index < MARCH)
        first = torch.where(going, value, first)
        low = torch.where(going, low + step, low)
    for _ in range(BISECTIONS):
        step = step / 2
        value = above(low + step)
        over = value > 0
        low, first = torch.where(over, low + step, low), torch.where(over, value, first)
        second = torch.where(over, second, value)
    return low + step * (first / (first - second).clamp_min(1e-6)).clamp(0, 1)


def _light_tissue(frame: _Frame, points: Tensor, pixel: float, lit: Tensor) -> Tensor:
    """Colour [M, 3] of tissue at points [M, 3], camera frame; pixel: size of a sample, rad."""
    tissue, rotation = frame.place.tissue, frame.view.scene_from_camera[:3, :3]
    x, y, _ = (points @ rotation.T + frame.view.scene_from_camera[:3, 3]).unbind(-1)
    surface = frame.detail.tissue(tissue, x, y, points[:, 2] * pixel)
    wet, sharpness = widened(WET, WET_SHARPNESS, surface.spread)
    return light_tissue(
        frame.place.lamps, points, surface.albedo, surface.normal @ rotation, surface.gloss, surface.openness, lit,
        sharpness, wet,
    )  # fmt: skip


def _light_instrument(frame: _Frame, points: Tensor, pixel: float, parts: Tensor) -> Tensor:
    """Colour [M, 3] of the instrument at points [M, 3], camera frame, on parts [M]; pixel: size of a sample, rad."""
    design, opening = frame.place.design, frame.view.opening
    transform = mechanical_from_camera(frame.view)
    local = points @ transform[:3, :3].T + transform[:3, 3]
    normals = F.normalize(local * torch.tensor([1.0, 1.0, 0.0]), dim=-1)
    head = torch.nonzero(parts != tools.SHAFT)[:, 0]
    if len(head):
        normals[head] = tools.normals(design, opening, local[head], parts[head])
    tone, normals, spread = frame.detail.metalwork(design, opening, local, parts, normals, points[:, 2] * pixel)
    tone = tone + 0.16 * tools.grain(design, opening, local, parts)[:, None]
    return light_instrument(frame.place, points, normals @ transform[:3, :3], parts, tone, spread)


def _changes(light: Tensor, parts: Tensor, depth: Tensor) -> Tensor:
    """Which pixels [H, W] see a part's edge, a jump in depth or much contrast, or have neighbours that do."""
    planes = parts.numpy()
    ones = np.ones((3, 3), np.uint8)
    found = cv2.dilate(planes, ones) != cv2.erode(planes, ones)
    bend = np.abs(cv2.Laplacian(depth.numpy(), cv2.CV_32F, borderType=cv2.BORDER_REPLICATE))
    found |= bend > EDGE_MM
    bright = light.mean(-1).clamp(0, 1).sqrt().numpy()
    found |= cv2.dilate(bright, ones) - cv2.erode(bright, ones) > 2 * CONTRAST
    return torch.from_numpy(found)
