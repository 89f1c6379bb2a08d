"""Triton's kernels pose bodies of links as the float64 reference defines it, gradients included.

Run by test_triton.py in a process of its own, under Triton's interpreter.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))
from articulated_worlds import Tree, assert_same_as_definition, hinges, make_world, posed, trees
from hypothesis import given, settings

from neeco.raster import articulated as posing

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numpy's, of the interpreter


@pytest.fixture(autouse=True)
def by_triton(monkeypatch: pytest.MonkeyPatch) -> None:
    """float32 on the CPU is posed by the kernels, as float32 on a CUDA device is elsewhere."""
    from neeco.raster.triton.articulated import Posing

    monkeypatch.setattr(posing, "_kernel", lambda given: Posing if given[0].dtype == torch.float32 else None)


@pytest.mark.parametrize(("joints", "roll"), [((None,), 2.1), ((1,), 0.0), ((None, 3, 0), 2.1)])
def test_the_kernels_are_their_definition(joints: tuple[int | None, ...], roll: float) -> None:
    counts = tuple(9 + 5 * k for k in range(len(joints)))
    assert_same_as_definition(make_world(counts, tuple(map(hinges, joints)), seed=len(joints), roll=roll))


@pytest.mark.parametrize("seed", range(4))
def test_poses_of_every_kind(seed: int) -> None:
    """Of all four formulas of the quaternion."""
    assert_same_as_definition(make_world((6, 0, 5), (hinges(1), hinges(2), hinges(0)), seed=seed, roll=-1.0), 5e-5)


@settings(max_examples=4, deadline=None, derandomize=True)
@given(tree=trees())
def test_any_tree(tree: Tree) -> None:
    assert_same_as_definition(make_world((7, 6), (None, tree), seed=1, roll=0.4), 5e-5)


def test_more_gaussians_than_a_program_takes() -> None:
    world = make_world((300, 290), (None, hinges(1)), seed=4, roll=1.0)
    assert_same_as_definition(world, 1e-4)
    first, second = (posed(world, torch.float32) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first[0], second[0], strict=True))
    assert all(torch.equal(first[1][name], second[1][name]) for name in first[1])
