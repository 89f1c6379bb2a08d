"""Features lie where the picture says, and match where two pictures show the same."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from neeco.errors import NeecoError
from neeco.ingest.cameras.features import find_features, in_threads, match_features

SHIFT = np.array([7.5, -4.25])  # px


@pytest.fixture(scope="module")
def images(tmp_path_factory) -> list[Path]:
    """Blobs in 320x256, and the same shifted by a part of a pixel."""
    generator = np.random.default_rng(0)
    places, sizes = generator.uniform(20, (300, 236), (150, 2)), generator.uniform(2, 5, 150)
    heights = generator.uniform(-60, 60, 150)
    down, across = np.mgrid[:256, :320] + 0.5
    files = []
    for index, shift in enumerate((np.zeros(2), SHIFT)):
        grey = np.full((256, 320), 120.0)
        for (x, y), size, height in zip(places + shift, sizes, heights, strict=True):
            grey += height * np.exp(-((across - x) ** 2 + (down - y) ** 2) / (2 * size**2))
        files.append(tmp_path_factory.mktemp("images") / f"{index}.png")
        cv2.imwrite(str(files[-1]), grey.clip(0, 255).round().astype(np.uint8))
    return files


@pytest.mark.parametrize("reduced", [False, True])
def test_matches_lie_apart_by_the_shift_of_the_picture(images, reduced):
    one, other = (find_features(image, None, 1200, 0.004, reduced) for image in images)
    pairs = match_features(one, other)
    moved = other.keypoints[pairs[:, 1], :2] - one.keypoints[pairs[:, 0], :2]
    assert len(pairs) > 30
    assert np.abs(np.median(moved, axis=0) - SHIFT).max() < 0.05
    assert (np.abs(moved - SHIFT).max(1) < 1).mean() > 0.95


@pytest.mark.parametrize("reduced", [False, True])
def test_pixel_centres_lie_at_one_half(tmp_path, reduced):
    down, across = np.mgrid[:256, :320] + 0.5
    grey = 120 + 100 * np.exp(-((across - 160) ** 2 + (down - 128) ** 2) / (2 * 6.0**2))
    cv2.imwrite(str(tmp_path / "blob.png"), grey.round().astype(np.uint8))
    (x, y, _, _) = find_features(tmp_path / "blob.png", None, 10, 0.004, reduced).keypoints[0]
    assert abs(x - 160) < 0.1
    assert abs(y - 128) < 0.1


def test_no_feature_lies_where_the_mask_is_black(images, tmp_path):
    mask = np.zeros((256, 320), np.uint8)
    mask[:, 160:] = 255
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    found = find_features(images[0], tmp_path / "mask.png", 1200, 0.004, False)
    assert len(found.keypoints) > 30
    assert found.keypoints[:, 0].min() >= 159


def test_images_without_features_match_nothing(images, tmp_path):
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((256, 320), 90, np.uint8))
    nothing = find_features(tmp_path / "grey.png", None, 1200, 0.004, False)
    assert nothing.keypoints.shape == (0, 4)
    assert match_features(nothing, find_features(images[0], None, 1200, 0.004, False)).shape == (0, 2)


def test_an_image_that_vanished_is_named(tmp_path):
    with pytest.raises(NeecoError, match=r"gone\.png: no such file"):
        list(in_threads(lambda path: find_features(path, None, 10, 0.004, False), [tmp_path / "gone.png"], 2))
