"""What other bodies hide of an instrument in nearly every frame is dropped, so is what is detached from the rest of
it, and nothing else."""

from __future__ import annotations

import pytest
import torch
from ball_world import RADIUS, ball_scene
from rod_world import WALL_MM

from neeco.methods.kinematic.finish import drop_detached, drop_occluded

PLACES = [(0.0, 0.0, 60.0), (10.0, 5.0, 65.0), (-12.0, 3.0, 70.0), (4.0, -6.0, 55.0), (0.0, 9.0, 62.0)]


def test_a_ball_before_the_wall_keeps_its_inside_and_its_back() -> None:
    scene = ball_scene("ball", PLACES)
    kept = drop_occluded(scene)
    assert kept.counts == scene.canonical.counts
    assert torch.equal(kept.means, scene.canonical.means)


def test_what_lies_behind_the_wall_is_dropped_and_what_comes_out_in_some_frames_is_not() -> None:
    scene = ball_scene("ball", PLACES)
    canonical = scene.canonical
    ball = canonical.body(1)
    deep = torch.zeros(len(canonical), dtype=torch.bool)
    deep[ball.start : ball.start + 200] = True  # beside the ball, and behind the wall in every frame
    between = torch.zeros_like(deep)
    between[ball.start + 200 : ball.start + 300] = True  # behind the wall in the three frames that are farthest away
    means = canonical.means.clone()
    means[deep] += torch.tensor([30.0, 0.0, 90.0])
    means[between] = torch.stack(
        [torch.linspace(-1, 1, 100), torch.full((100,), RADIUS + 3.0), torch.full((100,), WALL_MM - 61.0)], 1
    )
    scene.canonical = canonical.map(lambda tensor: means if tensor is canonical.means else tensor)
    kept = drop_occluded(scene)
    left = kept.means[kept.body(1)]
    far = left[:, 2] > 50
    assert int(far.sum()) < 60  # those that stand behind other hidden ones even when the ball is drawn alone
    assert torch.equal(left[~far], means[ball][~deep[ball]])


def test_without_frames_nothing_is_dropped() -> None:
    scene = ball_scene("ball", [])
    assert drop_occluded(scene).counts == scene.canonical.counts


@pytest.mark.parametrize("share", [0.02, 0.3])
def test_a_cloud_apart_from_the_ball_is_dropped_however_dense(share: float) -> None:
    canonical = ball_scene("ball", PLACES).canonical
    ball = canonical.body(1)
    cloud = torch.zeros(len(canonical), dtype=torch.bool)
    cloud[ball.start : ball.start + round(share * (ball.stop - ball.start))] = True
    means = canonical.means + cloud[:, None] * torch.tensor([2 * RADIUS + 4.0, 0.0, 0.0])
    moved = canonical.map(lambda tensor: means if tensor is canonical.means else tensor)
    assert torch.equal(drop_detached(moved).means, canonical.means[~cloud])


def test_what_touches_the_ball_stays_and_so_does_what_is_transparent_within_it() -> None:
    canonical = ball_scene("ball", PLACES).canonical
    ball = canonical.body(1)
    means, opacities = canonical.means.clone(), canonical.opacity_logits.clone()
    means[ball.start : ball.start + 700] += torch.tensor([2 * RADIUS + 0.5, 0.0, 0.0])  # another ball, beside it
    opacities[ball.start : ball.start + 100] = -6.0
    changed = {id(canonical.means): means, id(canonical.opacity_logits): opacities}
    touching = canonical.map(lambda tensor: changed.get(id(tensor), tensor))
    assert drop_detached(touching).counts == canonical.counts


def test_an_instrument_of_which_nothing_is_solid_stays_as_it_is() -> None:
    canonical = ball_scene("ball", PLACES).canonical
    faint = torch.full_like(canonical.opacity_logits, -6.0)
    transparent = canonical.map(lambda tensor: faint if tensor is canonical.opacity_logits else tensor)
    assert drop_detached(transparent).counts == canonical.counts
