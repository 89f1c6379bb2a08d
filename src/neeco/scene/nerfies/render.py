"""Volume rendering: samples along rays, and what they look like together (Mildenhall et al. 2020)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from neeco.capture.model import Camera

BEYOND = 1e10  # the last sample stands for everything behind it


@dataclass(frozen=True)
class Rays:
    """Rays and when each was seen. A sample at depth z (mm along the camera's axis) lies at origin + z direction."""

    origins: Tensor  # [R, 3] mm
    directions: Tensor  # [R, 3] per mm of depth, so not unit
    times: Tensor  # [R] s, float64

    def __len__(self) -> int:
        return len(self.origins)

    def part(self, rows: slice) -> Rays:
        return Rays(self.origins[rows], self.directions[rows], self.times[rows])


@dataclass(frozen=True)
class Composite:
    """What R rays of S samples look like."""

    color: Tensor  # [R, 3]
    alpha: Tensor  # [R], without the sample at infinity
    depth: Tensor  # [R] mm, expected depth over alpha; 0 where nothing is
    weights: Tensor  # [R, S]


def directions_of(columns: Tensor, rows: Tensor, intrinsics: Tensor, rotation: Tensor) -> Tensor:
    """World directions [R, 3] per mm of depth through pixel positions [R] (centres at +0.5).

    intrinsics [R, 4] fx, fy, cx, cy in px; rotation [R, 3, 3] world_from_camera (broadcastable).
    """
    fx, fy, cx, cy = intrinsics.unbind(-1)
    local = torch.stack([(columns - cx) / fx, (rows - cy) / fy, torch.ones_like(columns)], -1)
    return (rotation @ local[..., None])[..., 0]


def camera_rays(camera: Camera, time: float, device: torch.device) -> Rays:
    """One ray through the centre of every pixel, row by row, on `device`."""
    pose = camera.world_from_camera.detach().float().to(device)
    down, across = torch.arange(camera.height, device=device) + 0.5, torch.arange(camera.width, device=device) + 0.5
    rows, columns = torch.meshgrid(down, across, indexing="ij")
    intrinsics = pose.new_tensor([camera.fx, camera.fy, camera.cx, camera.cy])
    directions = directions_of(columns.flatten(), rows.flatten(), intrinsics, pose[:3, :3])
    times = torch.full((len(directions),), time, dtype=torch.float64, device=device)
    return Rays(pose[:3, 3].expand_as(directions), directions, times)


def even_depths(count: int, bounds: Tensor, rays: int, generator: torch.Generator | None) -> Tensor:
    """Depths [R, S] mm, one in each of `count` equal stretches between `bounds` [2]: anywhere by `generator`, without
    one in the middle."""
    device = bounds.device
    edges = torch.lerp(bounds[0], bounds[1], torch.linspace(0, 1, count + 1, device=device))
    if generator is None:
        place = torch.full((rays, count), 0.5, device=device)
    else:
        place = torch.rand(rays, count, generator=generator, device=device)
    return edges[:-1] + (edges[1:] - edges[:-1]) * place


def finer_depths(depths: Tensor, weights: Tensor, count: int, generator: torch.Generator | None) -> Tensor:
    """`count` more depths where the weights [R, S] of the coarse ones lie, by inverting their distribution, joined with
    those and sorted [R, S + count]. No gradient."""
    with torch.no_grad():
        middles = (depths[:, 1:] + depths[:, :-1]) / 2  # [R, S-1] edges of the inner samples
        share = weights[:, 1:-1] + 1e-5
        reached = torch.cat([share.new_zeros(len(depths), 1), (share / share.sum(-1, keepdim=True)).cumsum(-1)], -1)
        even = (torch.arange(count, device=depths.device) + 0.5) / count
        if generator is None:
            wanted = even.expand(len(depths), count)
        else:
            wanted = torch.rand(len(depths), count, generator=generator, device=depths.device)
        above = torch.searchsorted(reached, wanted.contiguous(), right=True).clamp(1, reached.shape[1] - 1)
        low, high = reached.gather(1, above - 1), reached.gather(1, above)
        start, end = middles.gather(1, above - 1), middles.gather(1, above)
        between = ((wanted - low) / (high - low).clamp_min(1e-5)).clamp(0, 1)
        return torch.cat([depths, start + between * (end - start)], -1).sort(-1).values


def composite(densities: Tensor, colors: Tensor, depths: Tensor, unit: Tensor) -> Composite:
    """Weigh colours [R, S, 3] by how much light of each sample arrives.

    densities [R, S] per unit of length; depths [R, S] mm; `unit` [R]: such units of length per mm of depth. The last
    sample stands for all that is behind it, and counts for colour alone.
    """
    beyond = torch.full_like(depths[:, :1], BEYOND)
    lengths = torch.cat([(depths[:, 1:] - depths[:, :-1]) * unit[:, None], beyond], -1)
    absorbed = densities * lengths
    before = torch.cat([torch.zeros_like(depths[:, :1]), absorbed[:, :-1].cumsum(-1)], -1)
    weights = torch.exp(-before) * (1 - torch.exp(-absorbed))
    alpha = weights[:, :-1].sum(-1)
    depth = (weights[:, :-1] * depths[:, :-1]).sum(-1) / alpha.clamp_min(1e-6)
    return Composite((weights[..., None] * colors).sum(1), alpha, torch.where(alpha > 1e-6, depth, 0.0), weights)
