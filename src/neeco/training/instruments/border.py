"""Where the photographs' colour along an instrument's shaft changes: the border of shaft and wrist."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neeco.raster import rasterize
from neeco.raster.pinhole import pixel_centers, unproject_world
from neeco.raster.types import Camera
from neeco.scene.instruments import HingedInstruments, Hinges
from neeco.training.instruments.solid import solid_extent, spread
from neeco.training.session import GaussianSession

LOOKED_AT = 40  # frames
BINS_PER_RADIUS = 6  # of the colour profile along the shaft
SURELY = 0.95  # share of a pixel that is body
FACING = 0.6  # cosine between a line of sight and the shaft's normal, across the shaft: nearer the rim is not looked at
DARKEST = 0.02  # added to colours before the logarithm
FEWEST_PIXELS = 6  # on either side of a step, in one frame
SEEN_OFTEN = 0.2  # of the frames looked at must show both sides of a step
CLEAR = 8.0  # times the median of steps along the shaft


def color_boundary(session: GaussianSession, hinged: HingedInstruments, index: int) -> float | None:
    """Position mm along the shaft where the photographs' colour along it changes most; None without a clear step."""
    hinges = hinged.hinges_of(index)
    radius = float(hinges.radius)
    rear = float(solid_extent(session.scene.canonical, index, hinges)[0])
    count = int((float(hinges.hinge_depth[0].detach()) - rear) / (radius / BINS_PER_RADIUS))
    if not count > 2 * BINS_PER_RADIUS:
        return None
    edges = rear + torch.arange(count + 1, device=session.views.device) * (radius / BINS_PER_RADIUS)
    steps = torch.stack(
        [_steps(*_profile(session, hinged, index, frame, edges)) for frame in spread(session, LOOKED_AT)]
    )
    seen = steps.isfinite().all(2).sum(0)  # [count + 1] frames
    enough = seen >= SEEN_OFTEN * len(steps)
    if int(enough.sum()) < BINS_PER_RADIUS:
        return None
    mean = torch.nanmean(steps[:, enough], 0).abs()  # [candidates, 3]
    clearness = (mean / mean.median(0).values.clamp_min(1e-4)).norm(dim=1)
    inner = clearness[1:-1]  # still rising at the last edge is the jaws' beginning, not a border
    inner = torch.where((inner >= clearness[:-2]) & (inner >= clearness[2:]), inner, 0.0)
    best = int(inner.argmax())
    return float(edges[enough][best + 1]) if inner[best] > CLEAR else None


def _steps(profile: Tensor, pixels: Tensor) -> Tensor:
    """[B + 1, 3] at every edge between bins: mean of a radius' bins after it less that of the ones before; nan where
    either is hardly seen. profile [B, 3] sums of colour over pixels [B]."""
    window = BINS_PER_RADIUS
    total = torch.cat([profile.new_zeros(1, 3), profile.cumsum(0)])  # [B + 1, 3]
    number = torch.cat([pixels.new_zeros(1), pixels.cumsum(0)])[:, None]
    steps = torch.full_like(total, math.nan)
    middle = slice(window, len(total) - window)
    after, before = slice(2 * window, None), slice(0, len(total) - 2 * window)
    counts = number[after] - number[middle], number[middle] - number[before]
    means = (total[after] - total[middle]) / counts[0], (total[middle] - total[before]) / counts[1]
    steps[middle] = torch.where(torch.minimum(*counts) >= FEWEST_PIXELS, means[0] - means[1], math.nan)
    return steps


def _profile(
    session: GaussianSession, hinged: HingedInstruments, index: int, frame_index: int, edges: Tensor
) -> tuple[Tensor, Tensor]:
    """A photograph's colour along the shaft: sums [B, 3] over the pixels [B] of each bin, as log brightness and two
    log ratios, which the light's colour and distance change alike everywhere."""
    scene = session.scene
    state, camera = session.corrected(frame_index)
    body = scene.canonical.means.new_zeros(len(scene.canonical), 1)
    body[scene.canonical.body(index + 1), 0] = hinged.part_weights(scene.canonical, index)[:, 0]
    drawn = rasterize(scene.at(state), camera, channels=body).channels
    assert drawn is not None
    pose = scene.registered(state).instruments[scene.instruments[index].name].pose
    along = _along_shaft(camera, pose.to(body), hinged.hinges_of(index))  # [H, W]
    chosen = (drawn[..., 0] > SURELY) & along.isfinite()
    mask = session.views.mask(frame_index)
    if mask is not None:
        chosen &= mask
    logs = (session.views.target(frame_index)[chosen] + DARKEST).log()  # [P, 3]
    colors = torch.stack([logs.mean(1), logs[:, 0] - logs[:, 1], logs[:, 2] - logs[:, 1]], 1)
    bins = torch.bucketize(along[chosen], edges) - 1
    held = (bins >= 0) & (bins < len(edges) - 1)
    sums, pixels = colors.new_zeros(len(edges) - 1, 3), colors.new_zeros(len(edges) - 1)
    sums.index_add_(0, bins[held], colors[held])
    pixels.index_add_(0, bins[held], torch.ones_like(colors[held, 0]))
    return sums, pixels


def _along_shaft(camera: Camera, pose: Tensor, hinges: Hinges) -> Tensor:
    """[H, W] mm along the shaft where the lines of sight meet its cylinder; nan where they miss or graze it.

    The Gaussians are no use here: they lie in a cloud about the surface. pose [4, 4] world_from_instrument.
    """
    origin, direction = hinges.shaft()
    rotation = pose[:3, :3]
    centers = pixel_centers(camera.height, camera.width).to(pose)
    eye = camera.world_from_camera.to(pose)[:3, 3]
    rays = (unproject_world(centers, torch.ones_like(centers[..., 0]), camera) - eye) @ rotation  # [H, W, 3]
    start = (eye - pose[:3, 3]) @ rotation - origin  # [3]
    ray_along, start_along = rays @ direction, start @ direction
    across, aside = rays - ray_along[..., None] * direction, start - start_along * direction
    square, radius = across.square().sum(-1), hinges.radius
    half = across @ aside
    discriminant = half.square() - square * (aside.square().sum() - radius.square())
    depth = (-half - discriminant.clamp_min(0).sqrt()) / square
    meets = (discriminant > (FACING * radius).square() * square) & (depth > 0)
    return torch.where(meets, start_along + depth * ray_along, math.nan)
