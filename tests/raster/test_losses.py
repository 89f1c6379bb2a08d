"""The fused loss equals its definition."""

from __future__ import annotations

import pytest
import torch

from neeco.errors import NeecoError
from neeco.raster.losses import PhotometricTarget, photometric_loss, photometric_loss_reference
from neeco.raster.threads import set_threads


def images(height: int, width: int, masked: bool) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
    g = torch.Generator().manual_seed(height * 1000 + width)
    image, target = torch.rand(2, height, width, 3, generator=g)
    target[: height // 2] = image[: height // 2] * 0.9 + 0.02
    return image.requires_grad_(), target, torch.rand(height, width, generator=g) > 0.3 if masked else None


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize(("height", "width"), [(1, 1), (7, 5), (16, 11), (37, 53), (50, 129)])
@pytest.mark.parametrize("weight", [0.1, 1.0])
def test_value_and_gradient_match_the_reference(
    simd: str, height: int, width: int, masked: bool, weight: float
) -> None:
    image, target, mask = images(height, width, masked)
    exact = image.detach().double().requires_grad_()
    expected = photometric_loss_reference(exact, target.double(), mask, weight)
    expected.backward()
    actual = photometric_loss(image, target, mask, weight)
    actual.backward()
    assert actual.item() == pytest.approx(expected.item(), rel=1e-5, abs=1e-6)
    assert (image.grad - exact.grad).norm() <= 1e-4 * exact.grad.norm()


@pytest.mark.parametrize("masked", [False, True])
def test_a_prepared_target_changes_nothing(simd: str, masked: bool) -> None:
    image, target, mask = images(40, 33, masked)
    (plain,) = torch.autograd.grad(photometric_loss(image, target, mask), image)
    (prepared,) = torch.autograd.grad(photometric_loss(image, PhotometricTarget(target, mask)), image)
    assert torch.allclose(plain, prepared, rtol=1e-4, atol=1e-9)


def test_equal_images_cost_nothing() -> None:
    image, _, _ = images(20, 20, False)
    assert photometric_loss(image, image.detach()).item() == pytest.approx(0, abs=1e-6)


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


def test_a_mask_without_pixels_costs_nothing() -> None:
    image, target, _ = images(9, 9, False)
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
