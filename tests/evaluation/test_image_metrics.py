"""PSNR and SSIM against arithmetic and against an independent convolution."""

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate

from neeco.evaluation.image_metrics import psnr, ssim


def pair(seed=0, height=30, width=26):
    random = torch.Generator().manual_seed(seed)
    target = torch.rand(height, width, 3, generator=random)
    return (target + 0.1 * torch.randn(height, width, 3, generator=random)).clamp(0, 1), target


def test_a_constant_error_of_a_tenth_is_twenty_decibels():
    target = torch.full((4, 5, 3), 0.5)
    assert psnr(target + 0.1, target) == pytest.approx(20.0, abs=1e-4)


def test_equal_images_have_no_finite_psnr_and_ssim_one():
    _, target = pair()
    assert psnr(target, target) == math.inf
    assert ssim(target, target) == pytest.approx(1.0, abs=1e-6)


def test_psnr_counts_only_masked_pixels():
    target = torch.zeros(4, 4, 3)
    image = target.clone()
    image[0] = 1.0
    image[1:] = 0.1
    mask = torch.ones(4, 4, dtype=torch.bool)
    mask[0] = False
    assert psnr(image, target, mask) == pytest.approx(20.0, abs=1e-4)
    assert math.isnan(psnr(image, target, torch.zeros(4, 4, dtype=torch.bool)))


def test_ssim_equals_a_direct_convolution_with_the_two_dimensional_window():
    image, target = pair()
    offsets = np.arange(11) - 5
    window = np.exp(-(offsets[:, None] ** 2 + offsets[None] ** 2) / (2 * 1.5**2))
    window = (window / window.sum())[..., None]

    def blur(values):
        return correlate(values, window, mode="constant")

    x, y = image.double().numpy(), target.double().numpy()
    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    expected = ((2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))).mean()
    assert ssim(image, target) == pytest.approx(expected, abs=1e-5)


def test_what_lies_outside_the_mask_does_not_change_ssim():
    image, target = pair()
    mask = torch.ones(image.shape[:2], dtype=torch.bool)
    mask[:, :9] = False
    other = image.clone()
    other[:, :9] = 1 - other[:, :9]
    assert ssim(image, target, mask) == ssim(other, target, mask)
    assert ssim(image, target) != pytest.approx(ssim(other, target), abs=1e-3)
