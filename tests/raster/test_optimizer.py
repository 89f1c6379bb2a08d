"""The fused Adam takes torch's steps."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from raster_scenes import adam_step

from neeco.base.errors import NeecoError
from neeco.raster import kernels
from neeco.raster.native import Family, set_threads


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


@settings(max_examples=25, deadline=None, derandomize=True)
@given(
    shape=st.lists(st.integers(0, 9), min_size=0, max_size=3).map(tuple),
    lr=st.sampled_from([1e-5, 0.01, 1.0]),
    betas=st.sampled_from([(0.9, 0.999), (0.5, 0.9)]),
    eps=st.sampled_from([1e-15, 1e-8, 0.1]),
)
def test_plain_torch_is_the_formula(shape: tuple[int, ...], lr: float, betas: tuple[float, float], eps: float) -> None:
    g = torch.Generator().manual_seed(2)
    param = torch.randn(shape, generator=g, dtype=torch.float64)
    mean, square = torch.zeros_like(param), torch.zeros_like(param)
    theta, m, v = param.numpy().copy(), 0.0, 0.0
    for step in range(1, 6):
        gradient = torch.randn(shape, generator=g, dtype=torch.float64)
        adam_step(param, gradient, mean, square, lr=lr, step=step, betas=betas, eps=eps)
        m = betas[0] * m + (1 - betas[0]) * gradient.numpy()
        v = betas[1] * v + (1 - betas[1]) * gradient.numpy() ** 2
        theta = theta - lr * (m / (1 - betas[0] ** step)) / (np.sqrt(v / (1 - betas[1] ** step)) + eps)
    np.testing.assert_allclose(param.numpy(), theta, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(mean.numpy(), np.broadcast_to(m, shape), rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(square.numpy(), np.broadcast_to(v, shape), rtol=1e-12, atol=1e-15)


def test_a_step_needs_no_numbers_of_a_device() -> None:
    tensors = torch.zeros(4, 5, 3, device="meta")
    adam_step(*tensors, lr=0.1, step=1)
    with pytest.raises(NeecoError, match=r"exp_avg: is float32 .* on cpu; expected float32 .* on meta"):
        adam_step(tensors[0], tensors[1], torch.zeros(5, 3), tensors[3], lr=0.1, step=1)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_cuda_takes_the_same_steps() -> None:
    here = list(torch.randn(2, 300, 3, generator=torch.Generator().manual_seed(4))) + [torch.zeros(300, 3)] * 2
    here = [tensor.clone() for tensor in here]
    there = [tensor.cuda() for tensor in here]
    for step in range(1, 6):
        adam_step(*here, lr=0.01, step=step)
        adam_step(*there, lr=0.01, step=step)
    assert all(torch.allclose(a, b.cpu(), rtol=1e-5, atol=1e-6) for a, b in zip(here, there, strict=True))


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


@pytest.mark.parametrize("family", get_args(Family))
def test_autograd_notices_the_change(family: Family) -> None:
    param = torch.ones(3, requires_grad=True)
    loss = (param**2).sum()
    with kernels(family):
        adam_step(param, torch.ones(3), torch.zeros(3), torch.zeros(3), lr=0.1, step=1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_tensors_that_do_not_fit_are_named() -> None:
    with pytest.raises(NeecoError, match="exp_avg"):
        adam_step(torch.zeros(3), torch.zeros(3), torch.zeros(4), torch.zeros(3), lr=0.1, step=1)
    with pytest.raises(NeecoError, match="float32"):
        adam_step(torch.zeros(3).double(), torch.zeros(3), torch.zeros(3), torch.zeros(3), lr=0.1, step=1)
