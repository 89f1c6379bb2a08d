"""The fused Adam takes torch's steps."""

from __future__ import annotations

import pytest
import torch

from neeco.errors import NeecoError
from neeco.raster.optimizer import adam_step
from neeco.raster.threads import set_threads


@pytest.mark.parametrize("shape", [(1,), (7, 3), (501, 16, 3), (0, 4)])
def test_steps_equal_torch(simd: str, shape: tuple[int, ...]) -> None:
    g = torch.Generator().manual_seed(0)
    ours = torch.randn(shape, generator=g)
    theirs = ours.clone().requires_grad_()
    optimizer = torch.optim.Adam([theirs], lr=0.01, eps=1e-15)
    mean, square = torch.zeros(shape), torch.zeros(shape)
    for step in range(1, 8):
        gradient = torch.randn(shape, generator=g) * 10.0 ** (step - 4)
        theirs.grad = gradient.clone()
        optimizer.step()
        adam_step(ours, gradient, mean, square, lr=0.01, step=step)
    assert torch.allclose(ours, theirs, rtol=1e-5, atol=1e-6)


def test_rows_can_have_their_own_rate() -> None:
    param, moments = torch.zeros(3, 2), torch.zeros(2, 3, 2)
    adam_step(param, torch.ones(3, 2), *moments, lr=0.1, step=1, row_lr=torch.tensor([0.0, 1.0, 2.0]))
    assert torch.allclose(param, torch.tensor([[0.0, 0.0], [-0.1, -0.1], [-0.2, -0.2]]))


def test_threads_and_position_do_not_change_the_bits(simd: str) -> None:
    g = torch.Generator().manual_seed(1)
    start, gradient = torch.randn(2, 40_001, 3, generator=g)
    results = []
    try:
        for count in (1, 2, 4):
            set_threads(count)
            param, moments = start.clone(), torch.zeros(2, 40_001, 3)
            adam_step(param, gradient, *moments, lr=0.01, step=1)
            results.append(param)
    finally:
        set_threads(0)
    assert all(torch.equal(results[0], r) for r in results)
    tail, moments = start[-5:].clone(), torch.zeros(2, 5, 3)
    adam_step(tail, gradient[-5:].contiguous(), *moments, lr=0.01, step=1)
    assert torch.equal(tail, results[0][-5:])


def test_autograd_notices_the_change() -> None:
    param = torch.ones(3, requires_grad=True)
    loss = (param**2).sum()
    adam_step(param, torch.ones(3), torch.zeros(3), torch.zeros(3), lr=0.1, step=1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_tensors_that_do_not_fit_are_named() -> None:
    with pytest.raises(NeecoError, match="exp_avg"):
        adam_step(torch.zeros(3), torch.zeros(3), torch.zeros(4), torch.zeros(3), lr=0.1, step=1)
    with pytest.raises(NeecoError, match="float32"):
        adam_step(torch.zeros(3).double(), torch.zeros(3), torch.zeros(3), torch.zeros(3), lr=0.1, step=1)
