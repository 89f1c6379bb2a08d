"""The endoscope's round border is found wherever it lies, in bright and dim scenes, and only when there is one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from neeco.ingest.calibration.lens import find_border, visible_mask

HEIGHT, WIDTH = 120, 160
ROWS, COLUMNS = np.indices((HEIGHT, WIDTH))


def film(shade, gain=1.0, frames=14):
    """Frames [F, H, W, 3] of a mottled scene that moves, dimmed by `shade` [H, W]."""
    generator = np.random.default_rng(0)
    scene = ndimage.gaussian_filter(generator.normal(0, 1, (HEIGHT + 40, WIDTH + 40)), 6)
    scene = 90 + 60 * scene / scene.std()
    for frame in range(frames):
        view = np.clip(scene[frame : frame + HEIGHT, 2 * frame : 2 * frame + WIDTH], 5, 250) * gain
        image = view[..., None] * shade[..., None] * [1.0, 0.6, 0.5] + 3 + generator.normal(0, 1.5, (HEIGHT, WIDTH, 3))
        yield np.clip(image, 0, 255).astype(np.uint8)


def disc(x, y, radius):
    return np.hypot(COLUMNS - x, ROWS - y) < radius


@pytest.mark.parametrize("gain", [1.0, 0.3, 0.1])
@pytest.mark.parametrize("circle", [(80, 60, 57), (84, 55, 72), (80, 60, 85)])
def test_a_round_border_is_found(circle, gain):
    true = disc(*circle)
    border = find_border(film(ndimage.gaussian_filter(true.astype(float), 0.6), gain))
    assert border is not None
    assert np.allclose(border, np.add(circle, [0.5, 0.5, 0]), atol=1.0)
    mask = visible_mask(border, (WIDTH, HEIGHT))
    assert not (mask & ~true).any()
    assert (true & ~mask).sum() < 0.08 * true.sum()


@pytest.mark.parametrize("gain", [1.0, 0.3, 0.1])
@pytest.mark.parametrize(
    "shade",
    [
        np.ones((HEIGHT, WIDTH)),
        np.exp(-((np.hypot(COLUMNS - 80, ROWS - 60) / 55) ** 2)),
        (COLUMNS > 30).astype(float),
        ((COLUMNS > 12) & (COLUMNS < 148) & (ROWS > 10) & (ROWS < 110)).astype(float),
    ],
    ids=["no border", "vignette", "dark side", "letterbox"],
)
def test_other_darkness_is_no_border(shade, gain):
    assert find_border(film(shade, gain)) is None


def test_black_frames_and_no_frames():
    assert find_border([]) is None
    assert find_border([np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)] * 5) is None
