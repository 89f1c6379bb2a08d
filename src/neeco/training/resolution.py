"""Coarse to fine: size of the rendered images and number of Gaussians over a run.

Early steps learn from small images at a fraction of the cost. As in DashGaussian (Chen et al., CVPR 2025) the images'
spectrum determines the share of the run at each size, and the number of Gaussians follows the size.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from neeco.capture.model import REFERENCE_PIXELS, evenly_spaced
from neeco.scene.training_views import TrainingViews, mean_pixels

N_SPECTRUM_FRAMES = 12  # images whose spectra are averaged


@dataclass(frozen=True)
class ResolutionConfig:
    """Sizes of rendered images over the run, and numbers of Gaussians that follow them."""

    min_side: int = 90  # px, initial size of the shorter side; images of this size are never reduced
    step: float = 1.414  # ratio of consecutive sizes
    full_size_at: float = 0.0  # share of the run from which images have full size; 0: always
    growth_power: float = 1.0  # maximum number of Gaussians at a reduced scale: scale^growth_power times as many
    limit_power: float = 0.5  # maximum number of Gaussians: N^limit_power as many for N times the pixels of 320x256
    search_pixels: int = REFERENCE_PIXELS  # size of images for searches of instruments and shadows


class Resolution:
    """Image sizes over one run.

    A size ends at the share of the run's coarse part that equals the share of spectral amplitudes kept at that size.
    """

    def __init__(self, config: ResolutionConfig, views: TrainingViews) -> None:
        self.config = config
        self.pixels = mean_pixels(views.frames)
        self.search_scale = min(1.0, math.sqrt(config.search_pixels / self.pixels))
        shortest = min(min(image.shape[:2]) for image in views.images)
        self.scales = reduced_scales(shortest, config) if config.full_size_at > 0 else []
        retained = amplitude_shares(views, self.scales)
        self.ends = [
            config.full_size_at * share / retained[-1] for share in retained
        ]  # progress at which each scale ends

    def scale(self, progress: float) -> float:
        """Return the scale of the images at `progress` in [0, 1] of the run."""
        return next((scale for scale, end in zip(self.scales, self.ends, strict=True) if progress < end), 1.0)

    def rendered_share(self, progress: float) -> float:
        """Return the share of the run's pixels rendered by `progress`; below `progress` while images are reduced."""
        scales, ends = [*self.scales, 1.0], [*self.ends, 1.0]
        spans = list(zip(scales, [0.0, *self.ends], ends, strict=True))

        def pixels(until: float) -> float:
            return sum(scale**2 * max(0.0, min(until, end) - start) for scale, start, end in spans)

        return pixels(progress) / pixels(1.0)

    def limit_at(self, progress: float, limit: int) -> int:
        """Return the maximum number of Gaussians of a body at `progress`, for a final maximum `limit`."""
        return math.ceil(limit * self.scale(progress) ** self.config.growth_power)

    def threshold_at(self, progress: float, threshold: float) -> float:
        """Return the gradient threshold for growth at `progress`, given the `threshold` for images of 320x256.

        The gradient (NDC) of a Gaussian with constant error is proportional to its relative radius in the image, so
        that n times as many grow at thresholds of 1 / sqrt(n).
        """
        return threshold / math.sqrt(size_factor(self.pixels * self.scale(progress) ** 2, self.config))


def size_factor(pixels: float, config: ResolutionConfig) -> float:
    """Return the factor on numbers of Gaussians for images of `pixels`, relative to 320x256; at least 1."""
    return max(1.0, pixels / REFERENCE_PIXELS) ** config.limit_power


def reduced_scales(side: int, config: ResolutionConfig) -> list[float]:
    """Return ascending scales below 1, from the smallest, at which the shorter side of `side` px has `config.min_side`
    px."""
    count = max(0, math.floor(math.log(side / config.min_side) / math.log(config.step) + 1e-9))
    return [config.step**-k for k in range(count, 0, -1)]


def amplitude_shares(views: TrainingViews, scales: Sequence[float]) -> list[float]:
    """Return the share of amplitudes in the images' spectrum, without their means, that each of `scales` keeps."""
    retained = np.zeros(len(scales))
    frames = evenly_spaced(len(views), N_SPECTRUM_FRAMES) if len(scales) else []
    for index in frames:
        grey = views.target(index).mean(-1).cpu().numpy()
        amplitudes = np.abs(np.fft.rfft2(grey - grey.mean()))
        rows, columns = np.abs(np.fft.fftfreq(grey.shape[0])), np.fft.rfftfreq(grey.shape[1])
        frequencies = np.maximum(rows[:, None], columns)  # of a pixel, at most 1/2
        inside = [amplitudes[frequencies <= scale / 2].sum() for scale in scales]
        retained += np.array(inside) / max(amplitudes.sum(), 1e-12) / len(frames)
    return retained.tolist()
