"""The fused loss equals its definition."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neeco.base.errors import NeecoError
from neeco.raster import kernels
from neeco.raster.losses import photometric_loss, photometric_loss_reference
from neeco.raster.native import Family, set_threads


def images(height: int, width: int, masked: bool) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
    g = torch.Generator().manual_seed(height * 1000 + width)
    image, target = torch.rand(2, height, width, 3, generator=g)
    target[: height // 2] = image[: height // 2] * 0.9 + 0.02
    return image.requires_grad_(), target, torch.rand(height, width, generator=g) > 0.3 if masked else None


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize(("height", "width"), [(1, 1), (7, 5), (16, 11), (37, 53), (50, 129)])
@pytest.mark.parametrize("weight", [0.1, 1.0])
def test_value_and_gradient_match_the_reference(simd, height, width, masked, weight):
    image, target, mask = images(height, width, masked)
    exact = image.detach().double().requires_grad_()
    expected = photometric_loss_reference(exact, target.double(), mask, weight)
    expected.backward()
    actual = photometric_loss(image, target, mask, weight)
    actual.backward()
    assert actual.item() == pytest.approx(expected.item(), rel=1e-5, abs=1e-6)
    assert (image.grad - exact.grad).norm() <= 1e-4 * exact.grad.norm()


def dense_ssim(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """SSIM as published: weighted means, variances and the covariance of every window, one pixel at a time."""
    steps = torch.arange(-5.0, 6.0, dtype=x.dtype)
    window = torch.exp(-(steps[:, None] ** 2 + steps**2) / (2 * 1.5**2))
    window = (window / window.sum())[..., None]
    x, y = (torch.nn.functional.pad(image, (0, 0, 5, 5, 5, 5)) for image in (x, y))
    out = torch.empty(x.shape[0] - 10, x.shape[1] - 10, 3, dtype=x.dtype)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            a, b = x[i : i + 11, j : j + 11], y[i : i + 11, j : j + 11]
            mean_a, mean_b = (window * a).sum((0, 1)), (window * b).sum((0, 1))
            var_a, var_b = (window * (a - mean_a) ** 2).sum((0, 1)), (window * (b - mean_b) ** 2).sum((0, 1))
            both = (window * (a - mean_a) * (b - mean_b)).sum((0, 1))
            over = (2 * mean_a * mean_b + 0.01**2) * (2 * both + 0.03**2)
            out[i, j] = over / ((mean_a**2 + mean_b**2 + 0.01**2) * (var_a + var_b + 0.03**2))
    return out


@settings(max_examples=20, deadline=None, derandomize=True)
@given(height=st.integers(1, 20), width=st.integers(1, 20), masked=st.booleans())
def test_the_definition_is_the_published_formula(height: int, width: int, masked: bool) -> None:
    image, target, mask = images(height, width, masked)
    x, y = image.detach().double(), target.double()
    looked_at = torch.ones(height, width, dtype=torch.bool) if mask is None else mask
    x_seen, y_seen = x * looked_at[..., None], y * looked_at[..., None]
    expected = 0.0
    if looked_at.any():
        similar = dense_ssim(x_seen, y_seen)[looked_at].mean()
        expected = 0.8 * (x - y)[looked_at].abs().mean() + 0.2 * (1 - similar)
    assert photometric_loss_reference(x, y, mask, 0.2).item() == pytest.approx(float(expected), rel=1e-12, abs=1e-14)


@settings(max_examples=25, deadline=None, derandomize=True)
@given(
    height=st.integers(1, 70), width=st.integers(1, 70), masked=st.booleans(), weight=st.sampled_from([0.0, 0.1, 1.0])
)
def test_plain_torch_takes_the_place_of_the_kernel(height: int, width: int, masked: bool, weight: float) -> None:
    image, target, mask = images(height, width, masked)
    expected = photometric_loss(image, target, mask, weight)
    (wanted,) = torch.autograd.grad(expected, image)
    with kernels("torch"):
        actual = photometric_loss(image, target, mask, weight)
    (gradient,) = torch.autograd.grad(actual, image)
    assert actual.item() == pytest.approx(expected.item(), rel=1e-4, abs=1e-5)
    assert (gradient - wanted).norm() <= 1e-3 * wanted.norm() + 1e-9


@pytest.mark.parametrize("masked", [False, True])
def test_the_loss_needs_no_numbers_of_a_device(masked: bool) -> None:
    image, target, mask = (None if t is None else t.to("meta") for t in images(30, 20, masked))
    image = image.detach().requires_grad_()
    loss = photometric_loss(image, target, mask)
    loss.backward()
    assert (loss.shape, loss.device.type) == ((), "meta")
    assert (image.grad.shape, image.grad.device.type) == (image.shape, "meta")


def test_a_mask_left_on_another_device_is_refused() -> None:
    image, target, mask = images(30, 20, True)
    with pytest.raises(RuntimeError, match="device"):
        photometric_loss(image.to("meta"), target.to("meta"), mask)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("masked", [False, True])
def test_cuda_gives_the_same_loss(masked: bool) -> None:
    image, target, mask = images(90, 70, masked)
    there = image.detach().cuda().requires_grad_()
    loss = photometric_loss(there, target.cuda(), None if mask is None else mask.cuda())
    loss.backward()
    expected = photometric_loss(image, target, mask)
    expected.backward()
    assert loss.device == there.device
    assert loss.item() == pytest.approx(expected.item(), rel=1e-4)
    assert (there.grad.cpu() - image.grad).norm() <= 1e-3 * image.grad.norm()


def test_masked_pixels_do_not_count() -> None:
    image, target, _ = images(20, 30, False)
    mask = torch.ones(20, 30, dtype=torch.bool)
    mask[:, :10] = False
    loss = photometric_loss(image, target, mask)
    changed = target.clone()
    changed[:, :10] = 1 - changed[:, :10]
    assert torch.equal(loss, photometric_loss(image, changed, mask))
    loss.backward()
    assert not image.grad[:, :10].any()


@pytest.mark.parametrize("family", ["native", "torch"])
def test_a_mask_without_pixels_costs_nothing(family: Family) -> None:
    image, target, _ = images(9, 9, False)
    with kernels(family):
        loss = photometric_loss(image, target, torch.zeros(9, 9, dtype=torch.bool))
    loss.backward()
    assert loss.item() == 0
    assert not image.grad.any()


def test_threads_do_not_change_the_bits(simd: str) -> None:
    image, target, mask = images(90, 70, True)
    results = []
    try:
        for count in (1, 2, 3):
            set_threads(count)
            loss = photometric_loss(image, target, mask)
            results.append((loss, torch.autograd.grad(loss, image)[0]))
    finally:
        set_threads(0)
    assert all(torch.equal(a, results[0][0]) and torch.equal(b, results[0][1]) for a, b in results)


def test_shapes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(NeecoError, match="expected twice"):
        photometric_loss(torch.rand(4, 4, 3), torch.rand(4, 5, 3))
    with pytest.raises(NeecoError, match="mask"):
        photometric_loss(torch.rand(4, 4, 3), torch.rand(4, 4, 3), torch.ones(3, 4, dtype=torch.bool))
