"""Tissue is extrapolated beyond what frames observed, and nothing else is touched."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from neeco.capture.model import State
from neeco.geometry.camera import Camera
from neeco.scene.canonical import SH_C0, CanonicalGaussians, join_bodies, seed_gaussians
from neeco.scene.drawable import Recorded
from neeco.scene.gaussian_scene import GaussianScene
from neeco.scene.method_registry import make_deformation, method_settings
from neeco.scene.visibility import EXTRAPOLATED, count_views, extrapolate_tissue, outside_all_views

CAMERA = Camera(torch.eye(4, dtype=torch.float64), fx=80.0, fy=80.0, cx=40.0, cy=32.0, width=80, height=64)
DEPTH, COLOR = 100.0, (0.6, 0.3, 0.2)


def moved(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([x, y, z])
    return replace(CAMERA, world_from_camera=pose)


def wall() -> CanonicalGaussians:
    """A plane of one colour that fills CAMERA's image and ends there."""
    x, y = torch.meshgrid(torch.arange(-49.0, 50.0, 2.0), torch.arange(-39.0, 40.0, 2.0), indexing="ij")
    positions = torch.stack([x.flatten(), y.flatten(), torch.full((x.numel(),), DEPTH)], 1)
    return seed_gaussians(positions, torch.tensor(COLOR).repeat(len(positions), 1), torch.full((len(positions),), 1.5),
                          opacity=0.95)  # fmt: skip


def scene_of(canonical: CanonicalGaussians) -> GaussianScene:
    deformation = make_deformation("3dgs", (), method_settings("3dgs", {}))
    return GaussianScene("3dgs", canonical, deformation, (), Recorded(), torch.tensor([0.0, 0.0, DEPTH]))


def test_a_view_beyond_the_border_shows_the_extrapolated_wall() -> None:
    canonical = wall()
    beyond = moved(x=25.0)
    with torch.no_grad():
        before = scene_of(canonical).render(State(), beyond)
        after = scene_of(extrapolate_tissue(canonical, [CAMERA])).render(State(), beyond)
    assert float(before.alpha[32, 75]) < 0.05
    assert float(after.alpha[8:56, 66:].min()) > 0.9
    assert torch.allclose(after.color[32, 75], torch.tensor(COLOR), atol=0.05)
    assert float(after.depth[32, 75]) == pytest.approx(1.1 * DEPTH, rel=0.05)  # behind what was seen


def test_what_was_observed_looks_as_before() -> None:
    canonical = wall()
    cameras = [CAMERA, moved(x=3.0), moved(y=-2.0)]
    with torch.no_grad():
        for camera in cameras:
            before = scene_of(canonical).render(State(), camera)
            after = scene_of(extrapolate_tissue(canonical, cameras)).render(State(), camera)
            inner = (slice(6, -6), slice(6, -6))
            assert torch.allclose(after.color[inner], before.color[inner], atol=0.02)


def test_extrapolated_gaussians_are_tissue_and_marked_and_the_others_stay() -> None:
    body = seed_gaussians(torch.tensor([[0.0, 0.0, 50.0]]), torch.ones(1, 3), torch.ones(1))
    canonical = join_bodies([wall(), body]).with_extras(part_logits=torch.arange(2001.0)[:, None])
    extrapolated = extrapolate_tissue(canonical, [CAMERA])
    added = extrapolated.counts[0] - canonical.counts[0]
    assert added > 100
    assert extrapolated.counts[1] == 1
    marks = extrapolated.extras[EXTRAPOLATED]
    assert int(marks.sum()) == added
    assert bool((marks[canonical.counts[0] : extrapolated.counts[0]] == 1).all())
    kept = marks == 0
    for name, tensor in canonical.tensors().items():
        assert torch.equal(extrapolated.tensors()[name][kept], tensor), name
    added = extrapolated.means[marks == 1]
    assert not bool(count_views(added, [CAMERA]).any())


def test_the_colour_is_taken_from_nearby() -> None:
    canonical = wall()
    left = canonical.means[:, 0] < 0
    colors = torch.where(left[:, None], torch.tensor([0.9, 0.1, 0.1]), torch.tensor([0.1, 0.1, 0.9]))
    canonical = replace(canonical, sh_dc=((colors - 0.5) / SH_C0)[:, None])
    extrapolated = extrapolate_tissue(canonical, [CAMERA])
    new = extrapolated.extras[EXTRAPOLATED] == 1
    color = extrapolated.sh_dc[new][:, 0] * SH_C0 + 0.5
    x = extrapolated.means[new][:, 0]
    red, blue = color[x < -60], color[x > 60]
    assert float(red[:, 0].mean()) > 0.8 > 0.2 > float(red[:, 2].mean())
    assert float(blue[:, 2].mean()) > 0.8 > 0.2 > float(blue[:, 0].mean())


def test_without_anything_well_observed_nothing_is_extrapolated() -> None:
    canonical = wall()
    behind = replace(canonical, means=canonical.means * torch.tensor([1.0, 1.0, -1.0]))
    assert extrapolate_tissue(behind, [CAMERA]) is behind


def test_views_are_counted_inside_the_images_alone() -> None:
    points = torch.tensor([[0.0, 0.0, 100.0], [60.0, 0.0, 100.0], [0.0, 0.0, -100.0]])
    assert count_views(points, [CAMERA, moved(x=20.0)]).tolist() == [2, 1, 0]
    assert outside_all_views(points, [CAMERA, moved(x=20.0)]).tolist() == [False, False, True]
