"""What frames observed of every Gaussian, and from where, decides what of a rendering is unobserved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scene_worlds import GRASPER, SURE, grasper_state, pose_of
from torch import Tensor

from neeco.capture.model import State
from neeco.geometry.camera import Camera
from neeco.raster import Gaussians, rasterize
from neeco.raster.native import kernels
from neeco.scene.canonical import CanonicalGaussians, join_bodies, seed_gaussians
from neeco.scene.drawable import Recorded
from neeco.scene.gaussian_scene import GaussianScene
from neeco.scene.method_registry import make_deformation, method_settings
from neeco.scene.visibility import DIRECTIONS, EXTRAPOLATED, measure_visibility, unobserved_share

CAMERA = Camera(torch.eye(4, dtype=torch.float64), fx=80.0, fy=80.0, cx=32.0, cy=24.0, width=64, height=48)
FRONT = pose_of(0, 0, 0, 0, 0, 0)  # both in the camera's frame: an instrument is moved, the camera stays
BACK = pose_of(0, np.pi, 0, 0, 0, 100)


def body(positions: Tensor, spacing: float = 1.0, opacity: float = 0.9) -> CanonicalGaussians:
    count = len(positions)
    return seed_gaussians(positions, torch.full((count, 3), 0.5), torch.full((count,), spacing), opacity=opacity)


def ball(radius: float = 8.0, depth: float = 50.0) -> CanonicalGaussians:
    """An opaque ball of Gaussians on its surface."""
    k = torch.arange(400.0)
    z, turn = 1 - (2 * k + 1) / 400, k * 2.39996
    ring = (1 - z**2).sqrt()
    unit = torch.stack([ring * turn.cos(), ring * turn.sin(), z], 1)
    return body(radius * unit + torch.tensor([0.0, 0.0, depth]))


def still(canonical: CanonicalGaussians, cameras: tuple[Camera, ...] = (CAMERA,)) -> GaussianScene:
    recorded = Recorded(
        tuple(map(str, range(len(cameras)))), ("train",) * len(cameras), (State(),) * len(cameras), cameras
    )
    deformation = make_deformation("3dgs", (), method_settings("3dgs", {}))
    return GaussianScene("3dgs", canonical, deformation, (), recorded, torch.tensor([0.0, 0.0, 50.0]))


def unobserved(scene: GaussianScene, state: State, camera: Camera) -> Tensor:
    posed = scene.at(state)
    channels = scene.unobserved(posed, camera)[:, None]
    rendering = rasterize(posed, camera, channels=channels)
    return rendering.channels[..., 0][rendering.alpha > 0.99]


def test_the_directions_are_unit_and_spread_evenly() -> None:
    directions = torch.tensor(DIRECTIONS)
    assert torch.allclose(directions.norm(dim=1), torch.ones(12))
    assert torch.allclose(directions.sum(0), torch.zeros(3), atol=1e-6)
    cosines = (directions @ directions.T).fill_diagonal_(-1)
    assert torch.allclose(cosines.max(1).values, torch.full((12,), 5**-0.5))


def test_a_gaussian_is_observed_by_as_many_pixels_as_its_share_of_them_adds_up_to() -> None:
    pair = still(body(torch.tensor([[-10.0, 0.0, 50.0], [10.0, 0.0, 50.0]]), opacity=0.5))
    canonical = pair.canonical
    pair.canonical = replace(canonical, log_scales=canonical.log_scales + torch.tensor([[0.0], [0.5]]))
    with torch.no_grad():
        alpha = rasterize(pair.at(State()), CAMERA).alpha
    left, right = float(alpha[:, :32].sum()), float(alpha[:, 32:].sum())
    directions, seen = torch.tensor(DIRECTIONS), measure_visibility(pair.canonical, pair.recorded, pair.at)
    for k, (pixels, x) in enumerate(((left, -10.0), (right, 10.0))):
        outward = torch.nn.functional.normalize(torch.tensor([-x, 0.0, -50.0]), dim=0)
        shares = (directions @ outward).clamp_min(0) ** 4 * pixels / ((left + right) / 2)
        assert torch.allclose(seen[k], shares, rtol=1e-4, atol=1e-6)


@torch.no_grad()
def test_the_other_side_of_a_ball_is_unobserved() -> None:
    scene = still(ball())
    behind = replace(CAMERA, world_from_camera=BACK)
    beside = replace(CAMERA, world_from_camera=pose_of(0, np.pi / 2, 0, -50, 0, 50))
    assert float(unobserved(scene, State(), CAMERA).mean()) < 0.2
    assert float(unobserved(scene, State(), behind).mean()) > 0.9
    half = unobserved(scene, State(), beside)
    assert 0.25 < float((half > 0.5).float().mean()) < 0.75


@torch.no_grad()
def test_sides_of_an_instrument_turn_with_it() -> None:
    tissue = body(torch.tensor([[200.0, 0.0, 50.0]]))
    canonical = join_bodies([tissue, ball()])
    logits = torch.zeros(len(canonical), 3)
    logits[:, 0] = SURE
    deformation = make_deformation("kinematic", (GRASPER,), method_settings("kinematic", {}))
    canonical = canonical.with_extras(**dict(deformation.initial_extras(canonical)) | {"part_logits": logits})
    recorded = Recorded(("0",), ("train",), (grasper_state(FRONT),), (CAMERA,))
    scene = GaussianScene("kinematic", canonical, deformation, (GRASPER,), recorded, torch.zeros(3))
    assert float(unobserved(scene, grasper_state(FRONT), CAMERA).mean()) < 0.2
    assert float(unobserved(scene, grasper_state(BACK), CAMERA).mean()) > 0.9


@torch.no_grad()
def test_what_stands_behind_is_unobserved_and_what_was_marked_stays_so() -> None:
    x, y = torch.meshgrid(torch.arange(-30.0, 31.0), torch.arange(-25.0, 26.0), indexing="ij")
    wall = torch.stack([x.flatten(), y.flatten(), torch.full((x.numel(),), 60.0)], 1)
    hidden = torch.tensor([[0.0, 0.0, 80.0]])
    scene = still(body(torch.cat([wall, hidden])))
    posed = scene.at(State())
    found = scene.unobserved(posed, CAMERA)
    middle = wall[:, :2].abs().amax(1) < 15
    assert float(found[-1]) > 0.95
    assert float(found[:-1][middle].max()) < 0.6
    marks = torch.zeros(len(scene.canonical))
    marks[:100] = 1
    marked = still(body(torch.cat([wall, hidden])).with_extras(**{EXTRAPOLATED: marks}))
    assert bool((marked.unobserved(posed, CAMERA)[:100] == 1).all())


@torch.no_grad()
def test_without_recorded_frames_everything_is_unobserved() -> None:
    scene = still(ball(), ())
    assert bool((scene.unobserved(scene.at(State()), CAMERA) == 1).all())


@pytest.mark.parametrize("count", [1, 17, 5000])
@pytest.mark.parametrize("framed", [False, True])
def test_the_kernel_finds_the_share_that_torch_defines(count: int, framed: bool) -> None:
    g = torch.Generator().manual_seed(count)
    means = 30 * torch.randn(count, 3, generator=g) + torch.tensor([0.0, 0.0, 100.0])
    frames = torch.nn.functional.normalize(torch.randn(count, 4, generator=g), dim=1) if framed else None
    ones = torch.ones(count)
    posed = Gaussians(
        means, frames if framed else means.new_ones(count, 4), means, ones, means[:, None], sh_frames=frames
    )
    visibility = torch.rand(count, 12, generator=g) ** 8
    with torch.no_grad():
        found = unobserved_share(visibility, posed, CAMERA)
        with kernels("torch"):
            defined = unobserved_share(visibility, posed, CAMERA)
    assert float(defined.min()) > 0
    assert float(defined.max()) <= 1
    torch.testing.assert_close(found, defined, rtol=1e-5, atol=1e-7)
