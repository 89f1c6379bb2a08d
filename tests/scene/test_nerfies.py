"""The SE(3) field, the volume rendering and the scene made of them, against what is known exactly."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from scene_worlds import make_nerf, rounding
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.capture.model import State
from neeco.geometry.rotations import skew
from neeco.methods.nerfies.field import (
    PUBLISHED,
    NerfiesSettings,
    NerfScene,
    WarpField,
    composite,
    encode_by_octave,
    importance_depths,
    move_by_screw,
    octave_weights,
    stratified_depths,
)
from neeco.methods.nerfies.session import elastic_loss, geman_mcclure
from neeco.scene.drawable import Recorded
from neeco.scene.gaussian_scene import require_gaussians


def screw_matrix(rotation: Tensor, velocity: Tensor) -> Tensor:
    """exp of the 4x4 twists, by torch's matrix exponential."""
    twist = torch.zeros(*rotation.shape[:-1], 4, 4, dtype=rotation.dtype)
    twist[..., :3, :3] = skew(rotation)
    twist[..., :3, 3] = velocity
    return torch.linalg.matrix_exp(twist)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 9.9e-3, 1.01e-2, 0.7, 3.1, 7.0])
def test_a_screw_moves_as_the_matrix_exponential(angle: float) -> None:
    random = torch.Generator().manual_seed(1)
    points, axis, velocity = (torch.randn(5, 3, generator=random, dtype=torch.float64) for _ in range(3))
    inputs = [points, angle * torch.nn.functional.normalize(axis, dim=-1), velocity]
    for tensor in inputs:
        tensor.requires_grad_(True)
    moved = move_by_screw(*inputs)
    matrix = screw_matrix(*inputs[1:])
    wanted = (matrix[..., :3, :3] @ inputs[0][..., None])[..., 0] + matrix[..., :3, 3]
    torch.testing.assert_close(moved, wanted, rtol=1e-10, atol=1e-10)
    along = torch.randn(5, 3, generator=random, dtype=torch.float64)
    ours, theirs = (torch.autograd.grad((value * along).sum(), inputs) for value in (moved, wanted))
    for ours_part, theirs_part in zip(ours, theirs, strict=True):
        torch.testing.assert_close(ours_part, theirs_part, rtol=1e-7, atol=1e-7)


def test_the_untrained_warp_is_nearly_nothing_and_a_zero_one_the_template() -> None:
    torch.manual_seed(0)
    field = WarpField(8, 4, 6, 16)
    points, codes = torch.rand(20, 3) * 2 - 1, torch.rand(20, 4)
    assert 0 < float((field(points, codes, torch.tensor(0.0)) - points).detach().abs().max()) < 0.02
    for head in (field.rotation, field.velocity):
        torch.nn.init.zeros_(head.weight)
    assert torch.equal(field(points, codes, torch.tensor(8.0)), points)


def test_a_scene_without_warp_looks_the_same_at_all_times() -> None:
    scene = make_nerf()
    camera = scene.recorded.cameras[0]
    first, last = (scene.render(State({}, time), camera).color for time in (0.0, 3.0))
    assert float((first - last).abs().max()) > 1e-4
    for head in (scene.warp.rotation, scene.warp.velocity):
        torch.nn.init.zeros_(head.weight)
    first, last = (scene.render(State({}, time), camera).color for time in (0.0, 3.0))
    assert torch.equal(first, last)


def test_frequencies_open_one_after_the_other() -> None:
    assert octave_weights(torch.tensor(0.0), 4).tolist() == [0, 0, 0, 0]
    torch.testing.assert_close(octave_weights(torch.tensor(1.5), 4), torch.tensor([1.0, 0.5, 0.0, 0.0]))
    assert octave_weights(torch.tensor(4.0), 4).tolist() == [1, 1, 1, 1]
    values = torch.tensor([[0.25, -0.5]])
    coded = encode_by_octave(values, 2, torch.tensor(1.0))
    assert coded.shape == (1, 10)
    assert torch.equal(coded[:, :2], values)
    waves = torch.tensor([[math.sin(math.pi / 4), -1.0, math.cos(math.pi / 4), 0.0]])
    torch.testing.assert_close(coded[:, 2:6], waves, atol=1e-6, rtol=1e-6)
    assert not coded[:, 6:].any()
    torch.testing.assert_close(
        encode_by_octave(values, 2)[:, 6:], torch.tensor([[1.0, 0.0, 0.0, -1.0]]), atol=1e-6, rtol=0
    )


def test_a_slab_of_known_density_absorbs_as_it_must() -> None:
    """Density 0.02 / mm from 30 to 60 mm before nothing: alpha 1 - exp(-0.6); depth by integrating it."""
    depths = stratified_depths(3000, torch.tensor([20.0, 80.0]), 1, None).double()
    inside = (depths > 30) & (depths < 60)
    colors = torch.ones(1, 3000, 3, dtype=torch.float64) * torch.tensor([1.0, 0.5, 0.0])
    drawn = composite(inside * 0.01, colors, depths, torch.tensor([2.0], dtype=torch.float64))
    alpha = 1 - math.exp(-0.6)
    depth = 30 + 1 / 0.02 - 30 * math.exp(-0.6) / alpha
    assert float(drawn.alpha) == pytest.approx(alpha, abs=1e-3)
    assert float(drawn.depth) == pytest.approx(depth, abs=0.03)
    torch.testing.assert_close(drawn.color[0], alpha * torch.tensor([1.0, 0.5, 0]).double(), atol=1e-3, rtol=0)


def test_the_last_sample_stands_for_all_behind_it_in_colour_alone() -> None:
    depths, colors = torch.tensor([[10.0, 20.0]]), torch.tensor([[[1.0, 0, 0], [0, 1.0, 0]]])
    drawn = composite(torch.tensor([[0.0, 1e-3]]), colors, depths, torch.ones(1))
    assert drawn.color.tolist() == [[0, 1, 0]]
    assert (float(drawn.alpha), float(drawn.depth)) == (0, 0)


def test_finer_samples_lie_where_the_weight_is() -> None:
    depths = stratified_depths(20, torch.tensor([0.0, 20.0]), 2, None)
    weights = torch.zeros(2, 20)
    weights[:, 7] = 1.0
    for generator in (None, torch.Generator().manual_seed(0)):
        finer = importance_depths(depths, weights, 40, generator)
        assert finer.shape == (2, 60)
        assert bool((finer.diff(dim=1) >= 0).all())
        assert int(((finer >= 7) & (finer <= 8)).sum(1).min()) >= 40


def test_a_rigid_motion_strains_nothing_and_a_stretch_does() -> None:
    turn = screw_matrix(torch.tensor([[0.3, -1.2, 0.5]]), torch.zeros(1, 3))[:, :3, :3]
    assert float(elastic_loss(turn)) < 1e-9
    stretched = torch.diag(torch.tensor([1.0, 1.0, math.exp(0.06)]))[None]
    assert float(elastic_loss(stretched)) == pytest.approx(0.03 * 2 * 0.0036 / (0.0036 + 0.0036), rel=1e-4)
    assert float(geman_mcclure(torch.tensor(1e6))) == pytest.approx(0.06, rel=1e-3)
    wanted = turn.clone().requires_grad_(True)
    elastic_loss(wanted * torch.tensor([1.0, 2.0, 1.0])).sum().backward()
    assert torch.isfinite(wanted.grad).all()


def test_the_jacobian_is_that_of_finite_differences_and_has_gradients() -> None:
    field = make_nerf().warp.double().requires_grad_(True)
    points, codes = torch.rand(4, 3, dtype=torch.float64) - 0.5, torch.rand(4, 8, dtype=torch.float64)
    opened = torch.tensor(2.5, dtype=torch.float64)
    jacobian = field.jacobian(points, codes, opened)
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[axis] = 1e-6
        change = (field(points + step, codes, opened) - field(points - step, codes, opened)) / 2e-6
        torch.testing.assert_close(jacobian[..., axis], change, atol=1e-6, rtol=1e-6)
    elastic_loss(jacobian).sum().backward()
    assert all(float(p.grad.abs().max()) > 0 for name, p in field.named_parameters() if name != "velocity.bias")


def test_codes_lie_between_their_neighbours_in_time() -> None:
    scene = make_nerf()
    codes = scene.codes_at(scene.codes, torch.tensor([-1.0, 0.0, 0.25, 2.0, 3.0, 9.0], dtype=torch.float64))
    a, b, c = scene.codes
    torch.testing.assert_close(codes, torch.stack([a, a, 0.75 * a + 0.25 * b, (b + c) / 2, c, c]))


def test_drawing_in_chunks_changes_nothing_and_says_where_things_are() -> None:
    octaves = 3  # few: the last one multiplies what the warp rounds by 2^2 pi
    scene = make_nerf(frequencies=octaves, warp_frequencies=octaves)
    state, camera = scene.recorded.states[1], scene.recorded.cameras[1]
    drawn = scene.render(state, camera, labels=True)
    assert drawn.color.shape == (6, 8, 3)
    assert drawn.channels is None
    assert bool(((drawn.depth >= 20) & (drawn.depth <= 80))[drawn.alpha > 1e-6].all())
    scene.settings = replace(scene.settings, chunk=1000)
    moved = rounding(1.0, 8 * 3 + 3 * (1 + 2 * octaves) + 8)  # places in [-1, 1], through the warp
    tolerance = math.pi * 2 ** (octaves - 1) * moved + rounding(1.0, 8 * 2 + 3 * (1 + 2 * octaves))
    whole = scene.render(state, camera).color
    torch.testing.assert_close(whole, drawn.color, atol=tolerance, rtol=0)
    assert float((whole - whole.mean((0, 1))).abs().max()) > 10 * tolerance  # pixels differ by more


def test_what_needs_gaussians_is_refused_in_one_line() -> None:
    with pytest.raises(NeecoError, match="synthesize: method nerfies has no Gaussians"):
        require_gaussians(make_nerf(), "synthesize")


@pytest.mark.parametrize(
    ("field", "value"), [("rays", 0), ("coarse_samples", 1), ("elastic_weight", -1.0), ("window", 1.5)]
)
def test_a_setting_that_cannot_be_is_refused_by_name(field: str, value: float) -> None:
    with pytest.raises(NeecoError, match=f"deformation.{field}: "):
        NerfiesSettings(**{field: value})


def test_the_published_sizes_are_settings() -> None:
    scene = NerfScene("nerfies", NerfiesSettings(**PUBLISHED), (), Recorded(states=(State({}, 0.0),)))
    assert len(scene.coarse.trunk.layers) == len(scene.fine.trunk.layers) == 8
    assert len(scene.warp.trunk.layers) == 6
    assert (scene.coarse.trunk.skip, scene.warp.trunk.skip) == (4, 4)
