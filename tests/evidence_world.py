"""Masks of instruments of random points, as evidence, seen in random poses."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from neeco.capture.model import Camera, Frame, InstrumentState, State
from neeco.evidence.carving import Evidence
from neeco.geometry.rotations import rigid, rigid_from_vector, rotate_about

PIVOT_MM, TIP_MM, RADIUS_MM = 8.0, 24.0, 3.0
HINGE_ANGLE = 0.9  # rad about the shaft, in the true shaft frame
# readings and points [P, 3] mm, in the shaft's frame, of an instrument in a random state
Instrument = Callable[[np.random.Generator], tuple[dict[str, float], Tensor]]


def instrument_points(reading: float) -> Tensor:
    """[P, 3] mm: a cylinder along z up to the pivot and two blades that share the opening."""
    generator = torch.Generator().manual_seed(1)
    turn, along = torch.rand(2, 6000, generator=generator)
    radius = RADIUS_MM * torch.rand(6000, generator=generator).sqrt()
    turn = 2 * math.pi * turn
    shaft = torch.stack([radius * turn.cos(), radius * turn.sin(), -40 + along * (40 + PIVOT_MM)], -1)
    axis = torch.tensor([math.cos(HINGE_ANGLE), math.sin(HINGE_ANGLE), 0.0])
    blade = torch.randn(2500, 3, generator=generator) * 0.7
    blade[:, 2] = PIVOT_MM + (TIP_MM - PIVOT_MM) * torch.rand(2500, generator=generator)
    pivot = torch.tensor([0.0, 0.0, PIVOT_MM])
    jaws = [rotate_about(blade, axis, pivot, torch.full((2500,), sign * reading / 2)) for sign in (1, -1)]
    return torch.cat([shaft, *jaws])


def scissors(rng: np.random.Generator) -> tuple[dict[str, float], Tensor]:
    reading = float(rng.uniform(0.0, 1.0))
    return {"jaw": reading}, instrument_points(reading)


def make_evidence(
    shaft_from_sensor: Tensor,
    frames: int = 40,
    motion: float = 1.0,
    thickness: float = 1.0,
    instrument: Instrument = scissors,
) -> Evidence:
    """Silhouettes of the instrument in random poses before a still camera; `shaft_from_sensor`: how the sensor sits,
    `motion`: how far the poses range, `thickness`: of the instrument, as a share of the usual one."""
    rng = np.random.default_rng(0)
    camera = Camera(torch.eye(4), 200.0, 200.0, 80.0, 64.0, 160, 128)
    hits, taken = [], []
    for number in range(frames):
        readings, shape = instrument(rng)
        roll, tilt, pan = rng.uniform(-1, 1), motion * rng.uniform(-0.5, 0.5), motion * rng.uniform(-0.5, 0.5)
        lean = rigid_from_vector(torch.tensor([1.0, 0.6, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64))
        spin = rigid_from_vector(torch.tensor([tilt, pan, roll, 0.0, 0.0, 0.0], dtype=torch.float64))
        place = torch.tensor([rng.uniform(-15, 15), rng.uniform(-12, 12), rng.uniform(-10, 10)], dtype=torch.float64)
        place = motion * place + torch.tensor([0.0, 0.0, 85.0], dtype=torch.float64)
        world_from_shaft = rigid(lean[:3, :3] @ spin[:3, :3], place)
        points = shape.double() * torch.tensor([thickness, thickness, 1.0])
        world = points @ world_from_shaft[:3, :3].T + world_from_shaft[:3, 3]
        u = (world[:, 0] / world[:, 2] * camera.fx + camera.cx).long()
        v = (world[:, 1] / world[:, 2] * camera.fy + camera.cy).long()
        inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height) & (world[:, 2] > 1)
        mask = torch.zeros(camera.height, camera.width)
        mask[v[inside], u[inside]] = 1
        hits.append(torch.nn.functional.max_pool2d(mask[None], 3, 1, 1)[0])
        state = InstrumentState(world_from_shaft @ shaft_from_sensor, readings)
        taken.append(Frame(Path(f"{number}.png"), camera, State({"tool": state}), "train"))
    return Evidence(
        torch.stack(hits),
        torch.full((frames, camera.height, camera.width), 130.0),
        torch.eye(4).repeat(frames, 1, 1),
        torch.tensor([[camera.fx, camera.fy, camera.cx, camera.cy]]).repeat(frames, 1),
        tuple(taken),
    )
