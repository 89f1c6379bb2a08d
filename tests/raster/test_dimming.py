"""The dimming of harmonics is its definition, gradients and all; the window that blurs sums to one."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neeco.raster import kernels
from neeco.raster.blur import LEAST, blur
from neeco.raster.shadow import _Dimmed
from neeco.raster.threads import set_threads


@settings(max_examples=30, deadline=None, derandomize=True)
@given(height=st.integers(13, 40), width=st.integers(13, 40), sigma=st.floats(0.01, 30.0))
def test_a_blur_moves_light_and_loses_none(height: int, width: int, sigma: float) -> None:
    image = torch.zeros(height, width, dtype=torch.float64)
    image[height // 2, width // 2] = 1
    out = blur(image, torch.tensor(sigma, dtype=torch.float64))
    assert float(out.sum()) == pytest.approx(1)
    spread = (out.sum(0) * (torch.arange(width) - width // 2) ** 2).sum().sqrt()
    assert float(spread) <= max(sigma, LEAST) + 1e-9
    assert torch.equal(out, out.clamp(0, 1))


@pytest.mark.parametrize("count", [0, 1, 2500])
@pytest.mark.parametrize("harmonics", [1, 4, 9, 16])
def test_dimming_is_its_definition(simd: str, harmonics: int, count: int) -> None:
    g = torch.Generator().manual_seed(harmonics)
    sh, weights = torch.randn(2, count, harmonics, 3, generator=g)
    missing = torch.rand(count, generator=g) * 1.02  # some miss all, and a little more
    results = []
    for family, dtype in (("native", torch.float32), ("torch", torch.float64)):
        leaves = [t.detach().clone().to(dtype).requires_grad_() for t in (sh, missing)]
        with kernels(family):
            out = _Dimmed.apply(*leaves)
            (out * weights.to(dtype)).sum().backward()
        results.append([out.detach(), *(leaf.grad for leaf in leaves)])
    for native, plain in zip(*results, strict=True):
        assert torch.allclose(native.double(), plain, rtol=1e-4, atol=2e-5)


def test_the_same_bits_whatever_the_number_of_threads(simd: str) -> None:
    g = torch.Generator().manual_seed(0)
    sh, missing = torch.randn(5000, 4, 3, generator=g), torch.rand(5000, generator=g)
    results = []
    try:
        for count in (1, 3):
            set_threads(count)
            leaf = missing.clone().requires_grad_()
            dimmed = _Dimmed.apply(sh, leaf)
            dimmed.square().sum().backward()
            results.append([dimmed.detach(), leaf.grad])
    finally:
        set_threads(0)
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
