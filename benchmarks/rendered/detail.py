"""What full-size images show: capillaries, pits and grain of tissue; scratches, machining lines, engraving and
serration of instruments. Each pattern fades where a pixel no longer resolves it, and then widens highlights instead.

Lengths mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from rendered import instrument as tools
from rendered.instrument import Design
from rendered.textures import Texture, kept
from rendered.tissue import HALF_SIZE, Tissue

GRAIN = ((0.36, 0.05, 0.045, 0.4), (0.20, 0.05, 0.045, 1.3), (0.115, 0.04, 0.04, 2.4))
"""Octaves of the tissue's grain: wavelength mm, rms of colour, rms of slope, turn rad."""
WAVES = 64  # of an octave in its texture
PATTERN = 29.0  # mm, after which capillaries and pits repeat
PATCHES = 8.3  # mm, size of the areas with more or fewer capillaries
CAPILLARY = torch.tensor([0.36, 0.05, 0.05])
PIT_SIZE, PIT_SLOPE = 0.56, 0.2  # mm from one to the next; rms
METAL = 25.0  # mm, after which scratches and engraving repeat
BRUSHED = 11.0  # mm, after which machining lines repeat
RING_EVERY, RING_WIDTH = 10.0, 0.32  # mm, engraved around the shaft
TOOTH = 0.85  # mm, of the serration
PATTERNS = {"bowel": (0.65, 0.04), "stomach": (0.38, 0.5), "cloth": (0.0, 0.3)}  # strength of capillaries and of pits


@dataclass(frozen=True)
class TissueSurface:
    """What shading needs of tissue at M points: unit normals [M, 3] scene frame, the rest [M, 1] or [M, 3].

    spread: variance of the slopes that are too fine to be seen.
    """

    albedo: Tensor
    normal: Tensor
    gloss: Tensor
    openness: Tensor
    spread: Tensor


@dataclass(frozen=True)
class Detail:
    """The textures of a scene."""

    color: Texture  # of the organ: albedo r g b, gloss
    shape: Texture  # normal x y z, openness
    octave: Texture  # one wave a mm: colour and slopes x, y, rms 1
    pattern: Texture  # capillaries, pits, and the pits' slopes x, y
    metal: Texture  # scratches, engraving
    brushed: Texture  # machining lines along x: brightness, slope along y; rms 1
    capillaries: float
    pits: float

    def tissue(self, tissue: Tissue, x: Tensor, y: Tensor, footprint: Tensor) -> TissueSurface:
        """The surface at x, y [M] (scene frame) where pixels cover `footprint` [M] mm."""
        place = (x, y) if tissue.displacement is None else tissue.displacement.rest(x, y)
        color, shape = self.color.look_up(*place, footprint), self.shape.look_up(*place, footprint)
        length = shape[:, :3].norm(dim=-1, keepdim=True).clamp(0.2, 1)
        spread = 1 / length.square() - 1  # shortened by averaging: the normals in the footprint differ
        slope_x, slope_y = (-shape[:, axis] / shape[:, 2].clamp_min(0.05) for axis in (0, 1))
        tint = torch.zeros_like(x)
        for wavelength, contrast, slope, turn in GRAIN:
            share = kept(wavelength, footprint)
            cosine, sine = (float(f(torch.tensor(turn))) for f in (torch.cos, torch.sin))
            u, v = place[0] * cosine + place[1] * sine, place[1] * cosine - place[0] * sine
            found = self.octave.look_up(u / wavelength, v / wavelength, torch.zeros_like(u))
            tint += contrast * share * found[:, 0]
            slope_u, slope_v = slope * share * found[:, 1], slope * share * found[:, 2]
            slope_x, slope_y = slope_x + cosine * slope_u - sine * slope_v, slope_y + sine * slope_u + cosine * slope_v
            spread += (slope**2 * (1 - share.square()))[:, None]
        found = self.pattern.look_up(*place, footprint)
        slope_x, slope_y = slope_x + self.pits * found[:, 2], slope_y + self.pits * found[:, 3]
        spread += ((self.pits * PIT_SLOPE) ** 2 * (1 - kept(PIT_SIZE, footprint).square()))[:, None]
        zero = torch.zeros_like(x)
        patches = self.octave.look_up(place[0] / PATCHES, place[1] / PATCHES, zero)[:, 0]
        vessels = (self.capillaries * torch.sigmoid(1.5 * patches) * found[:, 0])[:, None]
        albedo = color[:, :3] * (1 + tint - 0.35 * self.pits * found[:, 1])[:, None]
        albedo = albedo * (1 - vessels) + CAPILLARY * vessels
        normal_x, normal_y, normal_z = -slope_x, -slope_y, torch.ones_like(x)
        if tissue.displacement is not None:
            normal_x, normal_y = tissue.displacement.turn(*place, (normal_x, normal_y, normal_z))
        normal = F.normalize(torch.stack([normal_x, normal_y, normal_z], -1), dim=-1)
        return TissueSurface(albedo, normal, color[:, 3:4], shape[:, 3:4], spread)

    def metalwork(
        self, design: Design, opening: float, points: Tensor, parts: Tensor, normals: Tensor, footprint: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """An instrument's finish at points [M, 3] with unit normals [M, 3], mechanical frame: what multiplies its
        colour [M, 1], the normals with fine relief, and the variance [M, 1] of slopes too fine to be seen."""
        place, facing = design.on_link(opening, points, parts), design.turn_to_link(opening, normals, parts)
        shaft, wrist, jaw = (parts == tools.SHAFT), (parts == tools.WRIST), parts >= tools.FIRST_JAW
        along = place[:, 2]
        around = design.radius * torch.atan2(place[:, 1], place[:, 0])
        flat = torch.where(facing[:, 1].abs() > facing[:, 0].abs(), place[:, 0], place[:, 1])
        across = torch.where(jaw, flat, around)
        lines = self.brushed.look_up(across, along, footprint)
        worn = self.metal.look_up(across + 3.7 * parts, along, footprint)
        depth = torch.where(jaw, 0.10, 0.05)
        slope = depth * lines[:, 1]
        tone = 1 + torch.where(jaw | wrist, 0.05, 0.06) * lines[:, 0]
        tone += torch.where(shaft, 0.55, 0.25) * worn[:, 0]
        tone *= 1 - 0.6 * worn[:, 1] * shaft
        ring = _covered(torch.remainder(along + RING_EVERY / 2, RING_EVERY) - RING_EVERY / 2, RING_WIDTH, footprint)
        tone *= 1 - 0.55 * ring * (shaft & (along < -RING_EVERY / 2))
        inner = torch.where(parts == tools.FIRST_JAW, -facing[:, 1], facing[:, 1])
        toothed = ((inner - 0.6) / 0.3).clamp(0, 1) * jaw
        wave = along * (2 * torch.pi / TOOTH)
        share = kept(TOOTH, footprint)
        slope = slope + 0.6 * toothed * share * torch.cos(wave)
        tone *= 1 - toothed * (0.15 + 0.25 * share * (0.5 - 0.5 * torch.sin(wave)))
        axis = design.turn_from_link(opening, torch.tensor([0.0, 0.0, 1.0]).expand_as(points), parts)
        tilted = F.normalize(normals - slope[:, None] * axis, dim=-1)
        spread = depth.square() * (1 - kept(0.12, footprint).square()) + 0.18 * toothed * (1 - share.square())
        return tone[:, None], tilted, spread[:, None]


def make_detail(organ: str, tissue: Tissue, seed: int) -> Detail:
    """The textures of a scene whose organ is `tissue`, at rest."""
    generator = np.random.default_rng((seed, 77))
    surface = tissue.surface.permute(1, 2, 0).numpy()
    texel = 2 * HALF_SIZE / (len(surface) - 1)
    # the height was interpolated to the texels of the colour, which leaves a ripple as long as its own texels
    ripple = max(1, round(len(surface) / len(tissue.height)))
    smooth = cv2.blur(surface[..., 3:6], (ripple, ripple), borderType=cv2.BORDER_REPLICATE)
    shapes = np.concatenate([smooth / np.linalg.norm(smooth, axis=-1, keepdims=True), surface[..., 7:8]], -1)
    planes = (surface[..., [0, 1, 2, 6]], shapes)
    color, shape = (Texture.patch(plane, texel, -HALF_SIZE - texel / 2) for plane in planes)
    return Detail(
        color,
        shape,
        Texture.periodic(_octave(generator), float(WAVES)),
        Texture.periodic(_pattern(generator), PATTERN),
        Texture.periodic(_metal(generator), METAL),
        Texture.periodic(_brushed(generator), BRUSHED),
        *PATTERNS[organ],
    )


def _covered(distance: Tensor, width: float, footprint: Tensor) -> Tensor:
    """Share [M] of a footprint that a line of this width covers."""
    low, high = ((distance + side * footprint / 2).clamp(-width / 2, width / 2) for side in (-1, 1))
    return (high - low) / footprint


def _waves(size: int, low: float, high: float, generator: np.random.Generator, stretch: float = 1.0) -> np.ndarray:
    """Periodic noise [size, size], rms 1, of `low` to `high` waves a side, `stretch` times as long along x."""
    v, u = np.meshgrid(np.fft.fftfreq(size) * size, np.fft.fftfreq(size) * size, indexing="ij")
    waves = np.hypot(u * stretch, v)
    spectrum = np.fft.fft2(generator.normal(size=(size, size))) * ((waves > low) & (waves < high))
    found = np.fft.ifft2(spectrum / np.maximum(waves, 1) ** 0.5).real
    return (found - found.mean()) / found.std()


def _slopes(height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of a periodic height along x and y, per texel."""
    return (np.roll(height, -1, 1) - np.roll(height, 1, 1)) / 2, (np.roll(height, -1, 0) - np.roll(height, 1, 0)) / 2


def _octave(generator: np.random.Generator) -> np.ndarray:
    """[512, 512, 4]: colour, slopes x and y, and nothing (OpenCV is fastest with four)."""
    color = _waves(512, 0.6 * WAVES, 1.2 * WAVES, generator)
    slopes = _slopes(_waves(512, 0.5 * WAVES, 1.1 * WAVES, generator))
    return np.stack([color, *(slope / slope.std() for slope in slopes), np.zeros_like(color)], -1)


def _pattern(generator: np.random.Generator) -> np.ndarray:
    """[1024, 1024, 4]: capillaries, pits, the pits' slopes."""
    size = 1024
    vessels = np.zeros((size, size))
    for low, high, width, strength in ((3, 9, 0.11, 1.0), (8, 20, 0.075, 0.8), (22, 46, 0.05, 0.55)):
        field = _waves(size, low, high, generator)
        slope = np.hypot(*_slopes(field)) * size / PATTERN  # per mm
        line = np.exp(-((field / (slope + 0.25) / width) ** 2))
        # a vessel comes to the surface here and there
        surfacing = 1 / (1 + np.exp(-3 * _waves(size, low / 2, low, generator)))
        vessels = np.maximum(vessels, strength * surfacing * line)
    count = round(PATTERN / PIT_SIZE / 2) * 2
    grid = np.stack(np.meshgrid(np.arange(count), np.arange(count), indexing="ij"), -1).astype(float)
    grid[..., 0] += 0.5 * (np.arange(count) % 2)
    centers = (grid + generator.uniform(-0.32, 0.32, grid.shape)).reshape(-1, 2) * (size / count)
    marks = np.ones((size, size), np.uint8)
    rows, columns = (np.rint(centers).astype(int) % size).T
    marks[rows, columns] = 0
    tiled = np.pad(marks, 64, mode="wrap")
    distance = cv2.distanceTransform(tiled, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[64:-64, 64:-64] * (count / size)
    pits = np.exp(-((distance / 0.22) ** 2)) * np.clip(0.6 + 0.4 * _waves(size, 6, 16, generator), 0, 1.4)
    slopes = _slopes(-pits)
    scale = PIT_SLOPE / np.hypot(*slopes).std()
    return np.stack([vessels, pits, *(slope * scale for slope in slopes)], -1)


def _metal(generator: np.random.Generator) -> np.ndarray:
    """[512, 512, 2]: scratches (bright above 0, dull below) and engraved characters."""
    size, fine = 512, 2048
    scratches = np.zeros((fine, fine), np.float32)
    for _ in range(90):
        stroke = np.zeros_like(scratches)
        start = generator.uniform(0, fine, 2)
        turn = generator.normal(0, 0.5) + (np.pi / 2 if generator.random() < 0.7 else 0)
        thickness = int(generator.integers(2, 6))
        end = start + generator.uniform(60, 500) * np.array([np.cos(turn), np.sin(turn)])
        for shift in fine * np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)]):  # over the edges, too
            first, last = (tuple(np.rint(p + shift).astype(int).tolist()) for p in (start, end))
            if min(*first) > -600 and max(*first) < fine + 600:
                cv2.line(stroke, first, last, 1.0, thickness, cv2.LINE_AA)
        scratches += stroke * generator.uniform(-0.5, 1.0)
    engraved = np.zeros((fine, fine), np.float32)
    pixel = 24  # 0.29 mm
    for index in range(9):
        glyph = np.kron(generator.random((3, 5)) < 0.62, np.ones((pixel, pixel)))  # reads along y
        top, left = 250 + index * 4 * pixel, 900
        engraved[top : top + 3 * pixel, left : left + 5 * pixel] = glyph
    planes = [cv2.resize(plane, (size, size), interpolation=cv2.INTER_AREA) for plane in (scratches, engraved)]
    return np.stack([np.clip(planes[0], -1, 1), planes[1]], -1)


def _brushed(generator: np.random.Generator) -> np.ndarray:
    """[512, 512, 2]: lines along x: brightness and slope along y."""
    height = _waves(512, 36, 140, generator, stretch=14.0)
    slope = _slopes(height)[1]
    return np.stack([_waves(512, 24, 120, generator, stretch=14.0), slope / slope.std()], -1)
