"""The background of a still scope: what each pixel shows most often, once exposures are equalised."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from neeco.capture.model import evenly_spaced


@dataclass(frozen=True, kw_only=True)
class BackgroundSettings:
    """Settings of the background of a still scope."""

    n_frames: int = 64  # maximum number of images for one background
    max_bytes: int = 2**28  # maximum bytes of these images
    n_candidates: int = 7  # number of a pixel's samples about which half of the others may lie
    normal_quartile: float = 0.6745  # standard deviations of a normal distribution, within which its half lies
    noise_floor: float = 11.0  # noise of sensor and compression, of 255
    max_deviations: float = 4.0  # maximum deviation from the background, in standard deviations of the pixel
    shadow_share: tuple[float, float] = (0.35, 0.97)  # range of the share of light that is left in a shadow
    shadow_tint: float = 0.08  # maximum change of the ratio of two colours by a shadow
    min_saturation: float = 0.2  # minimum saturation of a background on which a shadow differs from a dark instrument


BACKGROUND = BackgroundSettings()

NEIGHBOURS = np.ones((3, 3), np.uint8)  # edges move by a pixel


@dataclass(frozen=True)
class Background:
    """The background of a still scope.

    colors: float32 [H, W, 3], of 255; spread: float32 [H, W], of 255, standard deviation of its brightness while
    visible; seen: [H, W] share of the frames in which it is not known to be hidden.
    """

    colors: np.ndarray
    spread: np.ndarray
    seen: np.ndarray

    def differs(self, image: np.ndarray) -> np.ndarray:
        """Pixels bool [H, W] at which an image uint8 [H, W, 3] shows something else.

        It differs by more than that pixel's own spread (tissue breathes and shines), by more than compression makes of
        a neighbour, and is not merely darker, as in the instrument's shadow.
        """
        even = (image / exposure(image, self.colors)).astype(np.float32)
        low, high = cv2.erode(self.colors, NEIGHBOURS), cv2.dilate(self.colors, NEIGHBOURS)
        off = np.maximum(even - high, low - even).max(-1)
        return (off > np.maximum(BACKGROUND.noise_floor, BACKGROUND.max_deviations * self.spread)) & ~self._shadows(
            even
        )

    def _shadows(self, even: np.ndarray) -> np.ndarray:
        """Pixels bool [H, W] at which all colours are darker by one share, where the background has colour."""
        shares = even / np.maximum(self.colors, 1)
        share = even.sum(-1) / np.maximum(self.colors.sum(-1), 1)
        saturation = 1 - self.colors.min(-1) / np.maximum(self.colors.max(-1), 1)
        similar = (np.ptp(shares, axis=-1) < 2 * BACKGROUND.shadow_tint) & (saturation > BACKGROUND.min_saturation)
        return np.asarray(similar & (share > BACKGROUND.shadow_share[0]) & (share < BACKGROUND.shadow_share[1]))


def find_background(
    load: Callable[[int], np.ndarray], count: int, hidden: Callable[[int], np.ndarray] | None = None
) -> Background:
    """Estimate the background of `count` images (load: one of them, uint8 [H, W, 3]).

    hidden: bool [H, W] of one of them, True where an instrument is known to hide the background; a pixel that it hides
    in all frames has the colours of all of them, and is visible in none.
    """
    first = load(0)
    rows = evenly_spaced(count, max(8, min(BACKGROUND.n_frames, BACKGROUND.max_bytes // first.nbytes)))
    frames = np.stack([load(row) for row in rows])  # [N, H, W, 3]
    covered = np.zeros(frames.shape[:3], bool) if hidden is None else np.stack([hidden(row) for row in rows])
    seen = 1 - covered.mean(0)
    covered[:, covered.all(0)] = False  # nothing better is known
    colors, spread = _modes(frames, covered)
    gains = np.stack([exposure(image, colors) for image in frames])  # [N, 3]
    if np.abs(gains - 1).max() > 0.01:
        frames = np.clip(np.rint(frames / gains[:, None, None]), 0, 255).astype(np.uint8)
        colors, spread = _modes(frames, covered)
    return Background(colors, spread, seen.astype(np.float32))


def _modes(frames: np.ndarray, covered: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Modes [H, W, 3] and spread [H, W], float32, of frames uint8 [N, H, W, 3] where they are not covered, bool
    [N, H, W]: the mean of that half of a pixel's samples nearest to one of them (least median of distances). An
    instrument at a pixel in less than half of the frames leaves no trace there; it would shift a median."""
    colors, spread = np.empty(frames.shape[1:], np.float32), np.empty(frames.shape[1:3], np.float32)
    for row in range(frames.shape[1]):  # all at once takes several times the frames' memory
        order = np.argsort(covered[:, row], axis=0, kind="stable")  # [N, W] samples first that can be used
        samples = np.take_along_axis(frames[:, row].astype(np.float32), order[..., None], 0)
        count = (~covered[:, row]).sum(0)
        unusable = np.arange(len(frames))[:, None] >= count
        half = np.maximum((count + 1) // 2, 1)

        def half_about(
            center: np.ndarray, samples: np.ndarray = samples, out: np.ndarray = unusable, half: np.ndarray = half
        ) -> tuple[np.ndarray, np.ndarray]:
            """Distances [N, W] of samples from `center` [W, 3], and that [W] within which half of them lie."""
            distances = np.where(out, np.inf, np.abs(samples - center).mean(-1))
            return distances, np.take_along_axis(np.sort(distances, axis=0), half[None] - 1, 0)[0]

        best, mode = np.full(len(count), np.inf, np.float32), samples[0]
        for place in np.linspace(0, 1, BACKGROUND.n_candidates):
            center = np.take_along_axis(samples, np.rint(place * (count - 1)).astype(int)[None, :, None], 0)[0]
            reach = half_about(center)[1]
            mode = np.where((reach < best)[:, None], center, mode)
            best = np.minimum(best, reach)
        for _ in range(2):  # from one sample to the mean of its half
            distances, reach = half_about(mode)
            near = distances <= reach
            mode = (samples * near[..., None]).sum(0) / near.sum(0)[:, None]
        colors[row], spread[row] = mode, reach / BACKGROUND.normal_quartile
    return colors, spread


def exposure(image: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """Gains [3] of the colours of an image uint8 [H, W, 3] over a background [H, W, 3] of 255."""
    usable = (colors > 25).all(-1) & (colors < 235).all(-1) & (image < 250).all(-1)
    if usable.sum() < 100:
        return np.ones(3)
    ratios = image[usable].astype(np.float32) / colors[usable]
    return np.asarray(np.median(ratios, axis=0), np.float64)
