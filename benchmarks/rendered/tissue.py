"""Organs as height fields with procedural colour: how they are made, met by rays and looked up.

Scene frame: right-handed, mm, z away from the tissue towards the camera, the organ about z = 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
import torch.nn.functional as F
from scipy.spatial import cKDTree
from torch import Tensor

HALF_SIZE = 150.0  # mm; beyond, the border repeats
MARCH = 28  # steps through the slab that holds the surface
BISECTIONS = 6


@dataclass(frozen=True)
class Tissue:
    """A height field over [-HALF_SIZE, HALF_SIZE]^2 (rows along y) with what shading needs at every texel."""

    height: Tensor  # [R, R] mm, what rays meet
    surface: Tensor  # [8, S, S]: linear albedo r g b, normal x y z (with fine relief), gloss, openness to light

    @property
    def bounds(self) -> tuple[float, float]:
        """Lowest and highest z, mm."""
        return float(self.height.min()), float(self.height.max())

    def height_at(self, x: Tensor, y: Tensor) -> Tensor:
        """Bilinear height [M] mm at positions [M]."""
        size = self.height.shape[0]
        scale = (size - 1) / (2 * HALF_SIZE)
        u = ((x + HALF_SIZE) * scale).clamp(0, size - 1.001)
        v = ((y + HALF_SIZE) * scale).clamp(0, size - 1.001)
        column, row = u.long(), v.long()
        fu, fv = u - column, v - row
        flat, index = self.height.view(-1), row * size + column
        top = flat[index] * (1 - fu) + flat[index + 1] * fu
        bottom = flat[index + size] * (1 - fu) + flat[index + size + 1] * fu
        return top * (1 - fv) + bottom * fv

    def intersect(self, origin: Tensor, directions: Tensor) -> Tensor:
        """Distance [M] mm along rays from `origin` [3] with `directions` [M, 3] (any length, z < 0) to the surface."""
        low, high = self.bounds
        if not bool((directions[:, 2] < 0).all()) or float(origin[2]) < high:
            raise ValueError("the camera must look down on the tissue from above it, with the horizon out of view")
        near, far = ((z - origin[2]) / directions[:, 2] for z in (high + 0.01, low - 0.01))
        return self.intersect_between(origin, directions, near, far, MARCH)

    def intersect_between(self, origin: Tensor, directions: Tensor, near: Tensor, far: Tensor, march: int) -> Tensor:
        """As `intersect`, looking only between distances `near` and `far` [M], in `march` steps."""
        step = far - near
        before = torch.zeros(len(directions))  # share of the way gone without meeting the surface
        active = torch.arange(len(directions))
        for index in range(1, march):
            t = near[active] + step[active] * (index / march)
            active = active[self._above(origin, directions[active], t)]
            before[active] = index / march
        width = 1.0 / march
        for _ in range(BISECTIONS):
            width /= 2
            t = near + step * (before + width)
            before += width * self._above(origin, directions, t)
        return near + step * (before + width / 2)

    def _above(self, origin: Tensor, directions: Tensor, t: Tensor) -> Tensor:
        x, y, z = (origin[axis] + t * directions[:, axis] for axis in range(3))
        return z > self.height_at(x, y)

    def look_up(self, points: Tensor) -> Tensor:
        """Surface properties [M, 8] at points [M, 3]; normals are not of unit length."""
        grid = (points[:, :2] / HALF_SIZE)[None, None]
        return F.grid_sample(self.surface[None], grid, padding_mode="border", align_corners=True)[0, :, 0].T


def finish(height: Tensor, albedo: Tensor, gloss: Tensor, relief: Tensor) -> Tissue:
    """Assemble a tissue from height [R, R] mm, albedo [3, S, S], gloss [S, S] and fine relief [S, S] mm."""
    size = albedo.shape[-1]
    texel = 2 * HALF_SIZE / (size - 1)
    fine = F.interpolate(height[None, None], size=(size, size), mode="bicubic", align_corners=True)[0, 0] + relief
    slope_y, slope_x = torch.gradient(fine, spacing=texel)
    normal = F.normalize(torch.stack([-slope_x, -slope_y, torch.ones_like(slope_x)]), dim=0)
    coarse = 2 * HALF_SIZE / (height.shape[0] - 1)
    sunk = blur(height, 5.0 / coarse) - height
    openness = torch.exp(-0.28 * sunk.clamp_min(0))  # creases are darker
    openness = F.interpolate(openness[None, None], size=(size, size), mode="bilinear", align_corners=True)[0]
    surface = torch.cat([albedo.clamp(0.005, 0.95), normal, gloss[None].clamp(0, 1), openness])
    return Tissue(height, surface.contiguous())


def bowel(seed: int, resolution: int = 2400) -> Tissue:
    """Folded small-bowel loops: pale pink tubes side by side, fine red vessels across them, fat in the creases."""
    generator = torch.Generator().manual_seed(seed)
    rows, size = max(64, resolution // 3), resolution
    height, crease = _loops(rows, generator)
    crease = F.interpolate(crease[None, None], size=(size, size), mode="bilinear", align_corners=True)[0, 0]
    patchy = octaves(size, 14, 6, generator, 0.6)
    fat = torch.sigmoid((crease - 0.83 + 0.06 * patchy) * 30)
    fine = octaves(size, 90, 4, generator, 0.7)
    albedo = _mix(_color(0.52, 0.21, 0.165), _color(0.68, 0.36, 0.275), torch.sigmoid(1.3 * patchy))
    albedo = albedo * (1 + 0.13 * fine)
    for cells, width, strength in ((9, 0.035, 0.75), (24, 0.035, 0.6), (55, 0.05, 0.45)):
        here = torch.sigmoid(2 * value_noise(size, cells / 3, generator))
        vessel = strength * here * ridges(size, cells, width, generator) * (1 - fat)
        albedo = _mix(albedo, _color(0.34, 0.05, 0.05), vessel)
    yellow = _color(0.72, 0.50, 0.20) * (1 + 0.12 * octaves(size, 120, 3, generator, 0.8))
    albedo = _mix(albedo, yellow, fat)
    spots = torch.sigmoid((octaves(size, 60, 3, generator, 0.6) - 2.2) * 8)
    albedo = _mix(albedo, _color(0.40, 0.07, 0.06), 0.6 * spots)
    relief = 0.075 * octaves(size, 60, 4, generator, 0.6) + 0.10 * fat * octaves(size, 110, 3, generator, 0.7)
    gloss = 0.75 - 0.4 * fat + 0.15 * value_noise(size, 30, generator)
    return finish(height, albedo, gloss, relief)


def _loops(size: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Height [size, size] mm of a tube folded back and forth, and the distance to its middle line in radii."""
    radius, spacing, ends = 13.0, 23.5, (-48.0, 120.0)
    line = []
    for row in range(-8, 9):
        along = np.linspace(*(ends if row % 2 else ends[::-1]), 600)
        line.append(np.stack([along, np.full_like(along, row * spacing)], -1))
        angle = np.linspace(-np.pi / 2, np.pi / 2, 80)
        bend = np.stack([np.cos(angle), np.sin(angle)], -1) * spacing / 2
        line.append(bend * [1 if row % 2 else -1, 1] + [along[-1], (row + 0.5) * spacing])
    path = np.concatenate(line)
    length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))]
    axis = np.linspace(-HALF_SIZE, HALF_SIZE, size)
    x, y = np.meshgrid(axis, axis)
    warp = [
        9.0 * value_noise(size, 5, generator).numpy() + 2.0 * value_noise(size, 14, generator).numpy() for _ in "xy"
    ]
    u, v = 0.86 * (x + warp[0]) + 0.5 * (y + warp[1]), -0.5 * (x + warp[0]) + 0.86 * (y + warp[1])
    distance, nearest = cKDTree(path).query(np.stack([u, v], -1).reshape(-1, 2))
    s = length[nearest]
    width = radius * (1 + 0.05 * np.sin(s / 5.3 + 2 * np.sin(s / 37)) + 0.07 * np.sin(s / 61))
    share = np.minimum(distance / width, 1.0)
    # a rounded profile whose sides do not stand upright, so that a height field can hold it
    height = 1.25 * width * (np.cos(share * np.pi) * 0.5 + 0.5) ** 0.8 - 6.0
    heights = torch.from_numpy(height.reshape(size, size)).float()
    shares = torch.from_numpy(share.reshape(size, size)).float()
    return blur(heights, 0.7 * (size - 1) / (2 * HALF_SIZE)), blur(shares, 0.5 * (size - 1) / (2 * HALF_SIZE))


def stomach(seed: int, resolution: int = 2400) -> Tissue:
    """The stomach's inner wall: smooth and reddish, thick soft folds (rugae) over a broad bulge, mucus, dark veins."""
    generator = torch.Generator().manual_seed(seed)
    rows, size = max(64, resolution // 3), resolution
    axis = torch.linspace(-HALF_SIZE, HALF_SIZE, rows)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    bend = 11 * value_noise(rows, 4, generator) + 3.0 * value_noise(rows, 12, generator)
    wave = torch.sin((0.35 * x + 0.94 * y + bend) * (2 * torch.pi / 21))
    strength = torch.sigmoid(1.6 * value_noise(rows, 7, generator) + 0.4)
    bulge = 9 * torch.exp(-((x - 25) ** 2 + (y + 15) ** 2) / 70**2) + 2.5 * value_noise(rows, 4, generator)
    height = bulge + 4.6 * strength * (wave * 0.5 + 0.5) ** 1.5
    patchy, fine = octaves(size, 10, 6, generator, 0.55), octaves(size, 100, 4, generator, 0.75)
    albedo = _mix(_color(0.46, 0.115, 0.09), _color(0.62, 0.225, 0.16), torch.sigmoid(1.4 * patchy)) * (1 + 0.13 * fine)
    # gastric areas: a net of pale furrows around small fields
    areas = ridges(size, 75, 0.10, generator)
    albedo = _mix(albedo, _color(0.66, 0.31, 0.23), 0.22 * areas)
    for cells, width, share in ((6, 0.04, 0.55), (17, 0.045, 0.55)):
        here = torch.sigmoid(2.5 * value_noise(size, cells / 2, generator))
        albedo = _mix(albedo, _color(0.20, 0.035, 0.06), share * here * ridges(size, cells, width, generator))
    mucus = torch.sigmoid((octaves(size, 26, 4, generator, 0.5) - 1.9) * 6)
    albedo = _mix(albedo, _color(0.74, 0.58, 0.40), 0.65 * mucus)
    bleeding = torch.sigmoid((octaves(size, 34, 3, generator, 0.6) - 2.1) * 7)
    albedo = _mix(albedo, _color(0.33, 0.025, 0.02), 0.75 * bleeding)
    relief = 0.08 * octaves(size, 55, 4, generator, 0.6) - 0.02 * areas + 0.12 * mucus
    return finish(height, albedo, 0.76 + 0.15 * value_noise(size, 22, generator), relief)


def cloth(seed: int, resolution: int = 2400, drape: bool = True) -> Tissue:
    """Surgical drapes on a bench: a blue-green cloth in soft creases, partly under a white one (`drape`); both woven,
    not wet."""
    generator = torch.Generator().manual_seed(seed)
    rows, size = max(64, resolution // 3), resolution
    creases = ridges(rows, 3, 0.12, generator) + 0.6 * ridges(rows, 6, 0.10, generator)
    border = 5 * value_noise(size, 4, generator)
    axis = torch.linspace(-HALF_SIZE, HALF_SIZE, size)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    white = torch.sigmoid((0.8 * x + 0.6 * y + border - 30) * 4) if drape else torch.zeros_like(x)
    lift = F.interpolate(white[None, None], size=(rows, rows), mode="area")[0, 0]
    waves = 2.2 * value_noise(rows, 6, generator) + 0.7 * value_noise(rows, 16, generator)
    height = waves + blur(5 * creases + 1.5 * lift, 1.5 * (rows - 1) / (2 * HALF_SIZE))
    # threads over and under each other, every 1.4 mm, no finer than the texels show
    pitch = max(1.4, 10 * HALF_SIZE / size)
    bend = value_noise(size, 20, generator)
    warp, weft = ((2 * torch.pi / pitch) * (along + 0.6 * bend) for along in (x, y))
    weave = torch.sin(warp) * torch.sin(weft)
    uneven = octaves(size, 12, 6, generator, 0.6)
    albedo = _mix(_color(0.045, 0.20, 0.26), _color(0.62, 0.61, 0.57), white)
    albedo = albedo * (1 + 0.30 * weave + 0.10 * uneven)
    stains = torch.sigmoid((octaves(size, 9, 4, generator, 0.6) - 2.0) * 9)
    albedo = _mix(albedo, _color(0.20, 0.06, 0.05), 0.5 * stains)
    return finish(height, albedo, torch.full((size, size), 0.12), 0.05 * weave)


ORGANS: dict[str, Callable[[int, int], Tissue]] = {
    "bowel": bowel,
    "stomach": stomach,
    "cloth": cloth,
    "sheet": partial(cloth, drape=False),
}


def _color(red: float, green: float, blue: float) -> Tensor:
    return torch.tensor([red, green, blue])[:, None, None]


def _mix(first: Tensor, second: Tensor, share: Tensor) -> Tensor:
    return first * (1 - share) + second * share


def value_noise(size: int, cells: float, generator: torch.Generator) -> Tensor:
    """Smooth noise [size, size], mean 0 and standard deviation 1, with about `cells` blobs along a side."""
    knots = max(4, math.ceil(cells) + 3)
    grid = torch.randn(1, 1, knots, knots, generator=generator)
    fine = F.interpolate(grid, size=(size, size), mode="bicubic", align_corners=True)[0, 0]
    return (fine - fine.mean()) / fine.std()


def octaves(size: int, cells: float, count: int, generator: torch.Generator, gain: float = 0.5) -> Tensor:
    """Fractal noise [size, size], mean 0 and standard deviation 1: `count` octaves, each `gain` times the one before.

    Octaves finer than three samples a blob are left out.
    """
    total = torch.zeros(size, size)
    for octave in range(count):
        if cells * 2**octave > size / 3:
            break
        total += gain**octave * value_noise(size, cells * 2**octave, generator)
    return (total - total.mean()) / total.std().clamp_min(1e-6)


def ridges(size: int, cells: float, width: float, generator: torch.Generator) -> Tensor:
    """Thin winding lines [size, size] in [0, 1], as vessels run: where warped noise crosses zero.

    `width`: of a line, as a share of a blob.
    """
    field = octaves(size, cells, 2, generator, 0.35)
    slope_y, slope_x = torch.gradient(field)
    # divide by the slope, or lines would swell wherever the noise is flat
    slope = (slope_x.square() + slope_y.square()).sqrt() * size / cells + 0.3
    return torch.exp(-(((field / slope) / width) ** 2))


def blur(image: Tensor, sigma: float) -> Tensor:
    """Gaussian blur of [H, W] or [C, H, W] by `sigma` samples, edges repeated."""
    if sigma <= 0:
        return image
    radius = math.ceil(3 * sigma)
    window = torch.exp(-0.5 * (torch.arange(-radius, radius + 1) / sigma) ** 2)
    window = window / window.sum()
    planes = image.reshape(-1, 1, *image.shape[-2:])
    planes = F.conv2d(F.pad(planes, (radius, radius, 0, 0), mode="replicate"), window[None, None, None, :])
    planes = F.conv2d(F.pad(planes, (0, 0, radius, radius), mode="replicate"), window[None, None, :, None])
    return planes.reshape(image.shape)
