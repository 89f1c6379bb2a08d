"""What passes before tissue is outlined by its colours, however roughly motion tells it."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np

from neeco.ingest.foreground.masks import passing_masks

WIDTH, HEIGHT, FRAMES, STEP = 160, 128, 12, 4


def made() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Images of a grey bar with a golden end before red tissue, where the bar is, and what flow makes of it: wider by
    12 px, and nothing in the even middle."""
    generator = np.random.default_rng(0)
    texture = cv2.GaussianBlur(generator.normal(0, 1, (HEIGHT, WIDTH)).astype(np.float32), (0, 0), 2)
    images, bars, evidence = [], [], []
    for number in range(FRAMES):
        image = np.clip((120 + 90 * texture)[..., None] * [1.2, 0.6, 0.55], 0, 255)
        bar = np.zeros((HEIGHT, WIDTH), np.uint8)
        top, end = 20 + 5 * number, 70 + 4 * number
        bar[top : top + 22, :end] = 1
        image[bar > 0] = (70, 75, 80)
        image[top : top + 22, end - 18 : end] = (205, 165, 80)
        wide = cv2.dilate(bar, np.ones((25, 25), np.uint8))
        wide[top + 6 : top + 16, 10 : end - 30] = 0
        images.append(np.clip(image + generator.normal(0, 2, image.shape), 0, 255).astype(np.uint8))
        bars.append(bar > 0)
        evidence.append(wide[STEP // 2 :: STEP, STEP // 2 :: STEP].astype(float))
    return np.stack(images), np.stack(bars), np.stack(evidence)


def overlap(one: np.ndarray, other: np.ndarray) -> float:
    return float((one & other).sum() / (one | other).sum())


def test_a_bars_outline_is_sharp_where_flow_bleeds_and_its_middle_is_whole() -> None:
    images, bars, evidence = made()
    flow = SimpleNamespace(moving_pixels=lambda rows, moving_px: evidence[rows])
    found = passing_masks(lambda row: images[row], flow, np.arange(FRAMES), 1.5)
    rough = np.stack([cv2.resize(share, (WIDTH, HEIGHT)) > 0.5 for share in evidence])
    assert overlap(rough, bars) < 0.6
    assert overlap(found, bars) > 0.9


def test_nothing_passes_beyond_the_border() -> None:
    images, _, evidence = made()
    visible = np.zeros((HEIGHT, WIDTH), bool)
    visible[:, 40:] = True
    evidence[:, :, :10] = np.nan
    flow = SimpleNamespace(moving_pixels=lambda rows, moving_px: evidence[rows])
    found = passing_masks(lambda row: images[row], flow, np.arange(FRAMES), 1.5, visible)
    assert found[:, :, 40:].any()
    assert not found[:, :, :40].any()
