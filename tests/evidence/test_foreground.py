"""Instruments and tissue by how images differ from the tissue: residuals and shades of pixels, drawn at random."""

from __future__ import annotations

import numpy as np

from neeco.evidence.foreground import SETTINGS, Comparison, Foreground

HEIGHT, WIDTH = 240, 160
LABEL, PENUMBRA, FAR = slice(60, 100), slice(100, 106), slice(0, 40)
NOISE = 0.05  # usual residual of lit tissue; in a shadow, noise is as much more of the brightness as there is less


def view(seed: int, shade_of_shaft: tuple[float, float], residual_of_shaft: float) -> Comparison:
    """A shaft where the label is, a shadow beside it that does not reach its umbra, and lit tissue."""
    rng = np.random.default_rng(seed)
    shade = rng.normal(1.0, 0.02, (HEIGHT, WIDTH))
    shade[:, PENUMBRA] = rng.uniform(0.62, 0.95, shade[:, PENUMBRA].shape)
    shade[:, LABEL] = rng.uniform(*shade_of_shaft, shade[:, LABEL].shape)
    residual = NOISE / shade * np.exp(rng.normal(0, 0.3, shade.shape))
    residual[:, LABEL] = residual_of_shaft * np.exp(rng.normal(0, 0.15, shade[:, LABEL].shape))
    label, everywhere = np.zeros(shade.shape), np.ones(shade.shape)
    label[:, LABEL] = 1
    return Comparison(
        shade, residual, residual, everywhere, 50 * everywhere, label, error=0.02 * everywhere, usable=everywhere > 0
    )


def test_a_black_shaft_beside_a_penumbra_is_no_shadow() -> None:
    views = [view(seed, (0.3, 0.55), residual_of_shaft=3.2 * NOISE) for seed in range(4)]
    foreground = Foreground.learned(views)
    assert foreground is not None
    certainty = foreground.certainty(views[0], SETTINGS.reach)
    assert float((certainty[:, LABEL] < 0).mean()) < 0.05
    assert float((certainty[:, LABEL] > 0.5).mean()) > 0.5
    assert float((certainty[:, PENUMBRA] < -0.5).mean()) > 0.8
    assert float((certainty[:, FAR] < -0.5).mean()) > 0.95
