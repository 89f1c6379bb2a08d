"""PSNR and SSIM against arithmetic and against an independent convolution; pictures of errors."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate

from neeco.evaluation.image_metrics import (
    PART_COLORS,
    difference_map,
    outline,
    overlay_outline,
    overlay_parts,
    part_color,
    psnr,
    ssim,
)


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


def test_equal_images_are_black_and_larger_differences_brighter():
    target = np.zeros((3, 40, 3))
    image = target.copy()
    image[1, 1], image[2, 2], image[2, 3] = 0.05, 0.25, 0.9
    drawn = difference_map(image, target, legend=False)
    assert drawn[0, 0].sum() < 10
    assert drawn[0, 0].sum() < drawn[1, 1].sum() < drawn[2, 2].sum()
    assert (drawn[2, 2] == drawn[2, 3]).all()  # full scale is fixed, not the image's own


def test_the_scale_is_drawn_below_the_map_with_both_ends_labelled():
    drawn = difference_map(np.zeros((6, 60, 3)), np.zeros((6, 60, 3)))
    assert drawn.shape == (20, 60, 3)
    labels = drawn[14:19] > 128
    assert labels[:, 2:12].any()
    assert labels[:, -20:-2].any()
    assert not labels[:, :2].any()  # pages round the corners of pictures
    assert not labels[:, -2:].any()
    assert not difference_map(np.zeros((6, 60, 3)), np.zeros((6, 60, 3)), legend=False).max() > 10


def test_an_outline_is_the_masks_own_border_but_not_the_images():
    mask = np.zeros((5, 5), bool)
    mask[1:4, 0:4] = True
    expected = mask.copy()
    expected[2, 0:3] = False
    assert (outline(mask) == expected).all()


def test_overlays_leave_tissue_alone_and_tint_each_part_differently():
    image = np.full((7, 12, 3), 0.5)
    parts = np.zeros((7, 12), np.uint8)
    parts[1:6, 1:6], parts[1:6, 6:11] = 1, 2
    drawn = overlay_parts(image, parts)
    assert (drawn[0] == 128).all()
    assert (drawn[1, 1] == 255).all()
    assert (drawn[3, 3] != drawn[3, 8]).any()
    truth = overlay_outline(drawn, parts == 1)
    assert (truth[1, 1] == (255, 255, 0)).all()
    assert (drawn[1, 1] == 255).all()  # the input stays as it was


def test_parts_have_the_same_colours_in_python_in_the_exported_page_and_in_its_rasteriser():
    root = Path(__file__).parents[2]
    page = (root / "src/neeco/viewer/page/panel.js").read_text()
    native = (root / "native/web/viewer.cpp").read_text()
    colors = [part_color(part) for part in range(1, 9)]
    assert len(set(colors)) == 8
    assert re.search(r"const TINTS = (\[.*?\])", page)[1] == str(colors).replace("'", '"')
    tints = re.search(r"tints\[8\]\[3\] = \{(.*)\};", native)[1]
    assert [int(value) for value in re.findall(r"\d+", tints)] == PART_COLORS.astype(int).ravel().tolist()
