"""Posing bodies of links: the kernel is its definition, gradients and all, and the same bits every time."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parent))
from articulated_worlds import Tree, assert_same_as_definition, hinges, make_world, posed, trees

from neeco.base.errors import NeecoError
from neeco.geometry.rotations import quat_to_matrix
from neeco.raster import kernels
from neeco.raster.articulated import MAX_JOINTS, ArticulatedBody, pose_bodies
from neeco.raster.native import set_threads


@pytest.mark.parametrize("roll", [0.0, 2.1])
@pytest.mark.parametrize("joints", [(None,), (0,), (1,), (2,), (None, 1), (None, 3, 0, 2)])
def test_the_kernel_is_its_definition(simd: str, joints: tuple[int | None, ...], roll: float) -> None:
    counts = tuple(19 + 5 * k for k in range(len(joints)))
    assert_same_as_definition(make_world(counts, tuple(map(hinges, joints)), seed=len(joints), roll=roll))


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    counts=st.lists(st.sampled_from([0, 1, 2, 15, 16, 17, 40]), min_size=1, max_size=3),
    joints=st.lists(st.none() | trees(), min_size=3, max_size=3),
    seed=st.integers(0, 10_000),
    roll=st.sampled_from([0.0, -3.1, 0.4, 3.1]),
)
def test_any_trees_are_posed_as_defined(counts: list[int], joints: list[Tree | None], seed: int, roll: float) -> None:
    assert_same_as_definition(make_world(tuple(counts), tuple(joints[: len(counts)]), seed, roll), 5e-5)


def test_more_gaussians_than_one_thread_takes_at_a_time() -> None:
    assert_same_as_definition(make_world((1500, 2300), (None, hinges(1)), seed=4, roll=1.0), 1e-4)


def test_the_definition_has_the_gradients_that_differences_show() -> None:
    world = make_world((3, 4), (None, Tree((-1, 0, 0), (False, True, False))), seed=2, roll=0.7)
    _, gradients = posed(world, torch.float64)

    def loss() -> float:
        return float(sum((t * w).sum() for t, w in zip(posed(world, torch.float64)[0], world.weights, strict=False)))

    step = 1e-6
    for name in ("origins", "axes", "values"):
        tensor = world.bodies[1][name]
        before = tensor.clone()
        tensor[0] += step
        after = loss()
        tensor[0] -= 2 * step
        slope = (after - loss()) / (2 * step)
        tensor.copy_(before)
        assert slope == pytest.approx(float(gradients[f"1.{name}"][0].sum()), rel=1e-5), name


def test_the_same_bits_whatever_the_number_of_threads(simd: str) -> None:
    world = make_world((3000, 5000), (None, hinges(2)), seed=5, roll=1.0)
    results = []
    try:
        for count in (1, 2, 3):
            set_threads(count)
            out, gradients = posed(world, torch.float32)
            results.append([*out, *(gradients[name] for name in sorted(gradients))])
    finally:
        set_threads(0)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_a_body_that_stands_still_is_left_as_it_is() -> None:
    world = make_world((33,), (None,))
    means, quats, scales, frames = posed(world, torch.float32)[0]
    assert torch.equal(means, world.gaussians["means"].float())
    assert torch.equal(quats, world.gaussians["quats"].float())
    assert torch.allclose(scales, world.gaussians["log_scales"].float().exp())
    assert torch.equal(frames, torch.tensor([1.0, 0, 0, 0]).expand(33, 4))


def test_harmonics_turn_as_the_gaussian_does() -> None:
    world = make_world((30,), (hinges(2),), seed=1, roll=1.0)
    _, quats, _, frames = posed(world, torch.float32)[0]
    resting = torch.nn.functional.normalize(world.gaussians["quats"].float(), dim=-1)
    assert torch.allclose(quat_to_matrix(quats), quat_to_matrix(frames) @ quat_to_matrix(resting), atol=1e-5)


@pytest.mark.parametrize("field", ["means", "quats", "log_scales", "logits"])
def test_a_number_that_is_none_stays_with_its_gaussian(field: str) -> None:
    world = make_world((20, 20), (None, hinges(1)), roll=1.0)
    expected = posed(world, torch.float32)[0]
    world.gaussians[field][25, 1] = float("nan")
    found = posed(world, torch.float32)[0]
    rest = torch.arange(40) != 25
    assert all(torch.equal(a[rest], b[rest]) for a, b in zip(found, expected, strict=True))
    assert not all(bool(t[25].isfinite().all()) for t in found)


def test_an_input_changed_before_the_backward_pass_is_noticed() -> None:
    means = torch.zeros(4, 3, requires_grad=True)
    out = pose_bodies(means, torch.ones(4, 4), torch.zeros(4, 3), None, (4,), (None,))
    with torch.no_grad():
        means.add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        out[0].sum().backward()


def test_what_does_not_fit_is_named() -> None:
    means, quats, scales = torch.zeros(4, 3), torch.ones(4, 4), torch.zeros(4, 3)
    with pytest.raises(NeecoError, match=r"pose_bodies: counts: \(3,\) of 1 bodies must sum to 4 Gaussians"):
        pose_bodies(means, quats, scales, None, (3,), (None,))
    with pytest.raises(NeecoError, match=r"pose_bodies: shapes \(4, 3\), \(4, 3\), \(4, 3\)"):
        pose_bodies(means, scales, scales, None, (4,), (None,))
    world = make_world((4,), (hinges(2),))
    world.gaussians["logits"] = torch.zeros(4, 2).double()
    with pytest.raises(NeecoError, match=r"pose_bodies: logits: \(4, 2\); expected \[4, 3 or more\]"):
        posed(world, torch.float32)


def test_rows_that_do_not_lie_side_by_side_and_mixed_types_are_posed_alike() -> None:
    means, quats, scales = torch.randn(3, 50).T, torch.randn(50, 4), torch.randn(50, 3)
    expected = pose_bodies(means.contiguous(), quats, scales, None, (50,), (None,))
    results = []
    for pair in ((means, quats), (means, quats.double())):
        leaves = [t.clone(memory_format=torch.preserve_format).requires_grad_() for t in pair]
        out = pose_bodies(*leaves, scales, None, (50,), (None,))
        (out[0].square().sum() + out[1].square().sum()).backward()
        results.append(leaves)
        assert all(torch.allclose(a.float(), b) for a, b in zip(out, expected, strict=True))
    for leaves in results:
        assert all(torch.allclose(leaf.grad, 2 * leaf.detach()) for leaf in leaves)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_cuda_poses_the_same() -> None:
    world = make_world((700, 900), (None, hinges(2)), seed=5, roll=1.0)
    assert_same_as_definition(world, 1e-4, "cuda")


def test_a_chain_moves_what_lies_beyond_each_joint() -> None:
    """A shaft along z, a wrist that bends at 0 about x, a slide beyond it at 10: by hand."""
    body = ArticulatedBody(
        world_from_body=torch.eye(4),
        origins=torch.tensor([[0.0, 0.0, 10.0], [0.0, 0.0, 0.0]]),  # the outermost joint first
        axes=torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
        values=torch.tensor([[0.0, 3.0], [math.pi / 2, math.pi / 2]]),  # of the links wrist and slide
        shaft_origin=torch.zeros(3),
        shaft_direction=torch.tensor([0.0, 0.0, 1.0]),
        spin_end=torch.tensor(-math.inf),
        gate_start=torch.tensor(-1e9),
        gate_width=torch.tensor(1.0),
        longest=torch.tensor(1e9),
        slides=(True, False),
    )
    logits = 1e3 * torch.eye(3)  # a Gaussian of each link
    means = torch.tensor([[0.0, 0.0, -5.0], [0.0, 0.0, 5.0], [0.0, 0.0, 12.0]])
    moved = pose_bodies(means, torch.eye(4)[:1].expand(3, 4), torch.zeros(3, 3), logits, (3,), (body,))[0]
    expected = torch.tensor([[0.0, 0.0, -5.0], [0.0, -5.0, 0.0], [0.0, -15.0, 0.0]])
    assert torch.allclose(moved, expected, atol=1e-5)


def test_a_body_of_too_many_joints_is_refused() -> None:
    world = make_world((2,), (hinges(MAX_JOINTS + 1),))
    with pytest.raises(NeecoError, match="a body of 32 joints and 33 links; at most 31 and 32"):
        posed(world, torch.float32)


def test_plain_torch_takes_the_place_of_the_kernel() -> None:
    world = make_world((20, 20), (None, hinges(1)), roll=1.0)
    native = posed(world, torch.float32)
    with kernels("torch"):
        plain = posed(world, torch.float32)
    for a, b in zip(native[0], plain[0], strict=True):
        assert torch.allclose(a, b, atol=1e-5)
    assert any(not torch.equal(a, b) for a, b in zip(native[0], plain[0], strict=True))
