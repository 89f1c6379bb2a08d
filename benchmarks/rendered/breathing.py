"""Tissue that moves as a patient breathes and as the heart beats. Scene frame, mm, s."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

STEPS = 3  # of the fixed point that undoes a displacement; each leaves about a tenth of the error


@dataclass(frozen=True)
class Mode:
    """u(x, y, t) = amplitude * sin(2 pi t / period + phase) * weight(x, y) * direction, at the rest position (x, y).

    weight = still + (1 - still) * exp(-((x - cx) / rx)^2 - ((y - cy) / ry)^2): 1 where the tissue moves most.
    """

    amplitude: float  # mm about the mean
    period: float
    phase: float
    direction: tuple[float, float, float]  # of unit length
    center: tuple[float, float]
    reach: tuple[float, float]
    still: float

    def extent(self, time: float) -> float:
        """How far the tissue has moved at `time` where it moves most, mm."""
        return self.amplitude * math.sin(2 * math.pi * time / self.period + self.phase)

    def weight(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The weight and its derivatives along x and y."""
        u, v = (x - self.center[0]) / self.reach[0], (y - self.center[1]) / self.reach[1]
        bump = (1 - self.still) * torch.exp(-u.square() - v.square())
        return self.still + bump, bump * u * (-2 / self.reach[0]), bump * v * (-2 / self.reach[1])


@dataclass(frozen=True)
class Displacement:
    """Modes, each with how far it has gone (mm): the tissue's displacement at one time."""

    modes: tuple[tuple[Mode, float], ...]

    def rest(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Where the tissue that is now above (x, y) rests."""
        rest_x, rest_y = x, y
        for _ in range(STEPS):
            shift = self.at(rest_x, rest_y)
            rest_x, rest_y = x - shift[0], y - shift[1]
        return rest_x, rest_y

    def at(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Displacement along x, y and z of tissue that rests at (x, y)."""
        total = [torch.zeros_like(x) for _ in "xyz"]
        for mode, extent in self.modes:
            weight = mode.weight(x, y)[0] * extent
            total = [sum_ + part * weight for sum_, part in zip(total, mode.direction, strict=True)]
        return total[0], total[1], total[2]

    def turn(self, x: Tensor, y: Tensor, normals: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """x and y of normals (x, y, z) of tissue resting at (x, y), turned to first order in the displacement."""
        nx, ny, nz = normals
        turned_x, turned_y = nx, ny
        for mode, extent in self.modes:
            _, slope_x, slope_y = mode.weight(x, y)
            along = extent * (mode.direction[0] * nx + mode.direction[1] * ny + mode.direction[2] * nz)
            turned_x, turned_y = turned_x - along * slope_x, turned_y - along * slope_y
        return turned_x, turned_y


def breathing_modes(breathing_mm: float, pulse_mm: float, seed: int) -> tuple[Mode, ...]:
    """The modes of a patient: breath of 4 s, mostly towards and away from the camera, and a pulse of 0.85 s."""
    phase, beat = (math.fmod(seed * step, 2 * math.pi) for step in (0.7, 1.9))
    length = math.sqrt(0.25**2 + 0.4**2 + 1)
    breath = Mode(breathing_mm, 4.0, phase, (0.25 / length, 0.4 / length, 1 / length), (20, 15), (80, 95), 0.35)
    pulse = Mode(pulse_mm, 0.85, beat, (0.0, 0.0, 1.0), (-12, -14), (32, 26), 0.1)
    return tuple(mode for mode in (breath, pulse) if mode.amplitude)


def displacement_at(modes: tuple[Mode, ...], time: float) -> Displacement | None:
    """Where the modes are at `time`; None for tissue that keeps still."""
    return Displacement(tuple((mode, mode.extent(time)) for mode in modes)) if modes else None


def describe(modes: tuple[Mode, ...], world_from_scene: list[list[float]]) -> dict[str, Any]:
    """truth/breathing.json."""
    return {
        "meaning": "tissue resting at p moves to p + sum over modes of amplitude_mm * sin(2 pi time / period_s + "
        "phase_rad) * weight * direction; weight = still + (1 - still) * exp(-((x - cx) / rx)^2 - ((y - cy) / ry)^2), "
        "x and y of p in the scene frame; sparse.ply shows the tissue at rest",
        "world_from_scene": world_from_scene,
        "modes": [
            {
                "amplitude_mm": mode.amplitude,
                "period_s": mode.period,
                "phase_rad": mode.phase,
                "direction": list(mode.direction),
                "center_mm": list(mode.center),
                "reach_mm": list(mode.reach),
                "still": mode.still,
            }
            for mode in modes
        ],
    }
