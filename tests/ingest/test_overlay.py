"""What a console draws over a video is told from the scene behind it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy import ndimage

from neeco.ingest.frames.images import find_overlay

HEIGHT, WIDTH = 144, 192


def scene(step: float, *, images: int = 20, noise: float = 2.0) -> list[np.ndarray]:
    """A textured scene that moves by `step` px an image, with a shaft that comes in at the right."""
    generator = np.random.default_rng(0)
    texture = ndimage.gaussian_filter(generator.normal(size=(3 * HEIGHT, 3 * WIDTH)), 3.0)
    texture = 110 + 45 * texture / texture.std()
    pictures = []
    for index in range(images):
        row, column = HEIGHT + int(step * index), WIDTH + int(2 * step * np.sin(index))
        picture = texture[row : row + HEIGHT, column : column + WIDTH].copy()
        cv2.line(picture, (WIDTH, 90), (120 + int(step * np.sin(2 * index)), 70 + int(step * index)), 40.0, 16)
        picture = picture + generator.normal(0, noise, picture.shape)
        pictures.append(np.repeat(picture.clip(0, 255).astype(np.uint8)[..., None], 3, 2))
    return pictures


def with_console(pictures: list[np.ndarray]) -> tuple[list[np.ndarray], np.ndarray]:
    """The pictures with a name and a bar over them, stored as JPEG, and where these are."""
    drawn, layer = [], np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.putText(layer, "PSM1", (10, 30), cv2.FONT_HERSHEY_SIMPLEX, 0.7, 255, 2)
    where = layer > 0
    where[-12:] = True
    for picture in pictures:
        picture = picture.copy()
        picture[-12:] = 25
        picture[layer > 0] = 245
        stored = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 92])[1]
        drawn.append(cv2.imdecode(stored, cv2.IMREAD_COLOR))
    return drawn, where


def test_text_and_bars_over_a_scene_that_moves_are_found() -> None:
    pictures, where = with_console(scene(3.0))
    found = find_overlay(pictures, None)
    assert found is not None
    assert (found & where).sum() > 0.95 * where.sum()
    assert (found & ~ndimage.binary_dilation(where, iterations=6)).sum() == 0


@pytest.mark.parametrize("step", [0.0, 3.0])
def test_there_is_none_where_nothing_is_drawn_or_the_scene_stands_still(step: float) -> None:
    assert find_overlay(scene(step), None) is None


def test_nothing_is_said_of_a_scene_that_stands_still_behind_a_console() -> None:
    assert find_overlay(with_console(scene(0.0))[0], None) is None


def test_what_the_border_hides_anyway_does_not_count() -> None:
    pictures, where = with_console(scene(3.0))
    visible = ~ndimage.binary_dilation(where, iterations=6)
    assert find_overlay(pictures, visible) is None


def test_few_images_decide_nothing() -> None:
    assert find_overlay(with_console(scene(3.0))[0][:5], None) is None
