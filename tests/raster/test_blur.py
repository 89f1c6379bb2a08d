"""The blur of shadows and the dimming of harmonics: kernels are their definitions, gradients and all."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neeco.raster import kernels
from neeco.raster.blur import blur, blur_reference
from neeco.raster.shadow import _Dimmed
from neeco.raster.threads import set_threads


def both(height: int, width: int, sigma: float) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Blurred plane and the gradient of its width, by the kernel and, in float64, by the definition."""
    g = torch.Generator().manual_seed(height + width)
    image, weights = torch.rand(2, height, width, generator=g)
    results = []
    for dtype, function in ((torch.float32, blur), (torch.float64, blur_reference)):
        wide = torch.tensor(sigma, dtype=dtype, requires_grad=True)
        out = function(image.to(dtype), wide)
        (out * weights.to(dtype)).sum().backward()
        results.append((out.detach().double(), wide.grad.double()))
    return results


@pytest.mark.parametrize("sigma", [0.1, 0.4, 1.7, 30.0])
def test_the_blur_is_its_definition(simd: str, sigma: float) -> None:
    (out, slope), (expected, expected_slope) = both(37, 53, sigma)
    assert torch.allclose(out, expected, atol=1e-6)
    assert torch.allclose(slope, expected_slope, rtol=1e-4, atol=1e-4)
    assert (expected_slope != 0) == (sigma > 0.3)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(height=st.integers(1, 40), width=st.integers(1, 40), sigma=st.floats(0.31, 5.0))
def test_planes_of_any_size_are_blurred_as_defined(height: int, width: int, sigma: float) -> None:
    (out, slope), (expected, expected_slope) = both(height, width, sigma)
    assert torch.allclose(out, expected, atol=1e-5)
    assert torch.allclose(slope, expected_slope, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("count", [0, 1, 2500])
@pytest.mark.parametrize("harmonics", [1, 4, 9, 16])
def test_dimming_is_its_definition(simd: str, harmonics: int, count: int) -> None:
    g = torch.Generator().manual_seed(harmonics)
    sh, weights = torch.randn(2, count, harmonics, 3, generator=g)
    lit = torch.rand(count, generator=g)
    results = []
    for family, dtype in (("native", torch.float32), ("torch", torch.float64)):
        leaves = [t.detach().clone().to(dtype).requires_grad_() for t in (sh, lit)]
        with kernels(family):
            out = _Dimmed.apply(*leaves)
            (out * weights.to(dtype)).sum().backward()
        results.append([out.detach(), *(leaf.grad for leaf in leaves)])
    for native, plain in zip(*results, strict=True):
        assert torch.allclose(native.double(), plain, rtol=1e-5, atol=1e-5)


def test_the_same_bits_whatever_the_number_of_threads(simd: str) -> None:
    g = torch.Generator().manual_seed(0)
    image, sh, lit = (
        torch.rand(90, 70, generator=g),
        torch.randn(5000, 4, 3, generator=g),
        torch.rand(5000, generator=g),
    )
    results = []
    try:
        for count in (1, 3):
            set_threads(count)
            wide, leaf = torch.tensor(1.3, requires_grad=True), lit.clone().requires_grad_()
            out, dimmed = blur(image, wide), _Dimmed.apply(sh, leaf)
            (out.square().sum() + dimmed.square().sum()).backward()
            results.append([out.detach(), wide.grad, dimmed.detach(), leaf.grad])
    finally:
        set_threads(0)
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
