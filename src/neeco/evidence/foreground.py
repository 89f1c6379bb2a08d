"""Foreground of an image: the likelihood of each pixel to show an instrument, given the tissue of a scene.

The tissue, rendered without instruments, is each image's background. A shadow scales it by one factor, so a pixel is
described by the best-fitting factor (`shade`) and by the remaining difference relative to the brightness (`residual`).
Two densities of these are learned from the images: of tissue, far from any instrument, lit or in any shade of a shadow;
of instruments, well inside their rendering. Their ratio classifies a pixel, and is undecided where both are similar: a
black shaft is distinguished from a shadow on dark cloth if its residuals differ from the cloth's. Pixels at outlines
are mixtures of both: they count as instrument only if more than half is covered, else as tissue.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from scipy.ndimage import gaussian_filter, gaussian_filter1d, uniform_filter
from torch import Tensor

from neeco.capture.model import State
from neeco.geometry.camera import Camera
from neeco.raster import rasterize
from neeco.scene.gaussian_scene import GaussianScene


@dataclass(frozen=True, kw_only=True)
class ForegroundSettings:
    """Settings of the comparison: densities, and thresholds of informative pixels."""

    window_px: int = 3  # side of the averaging window for residuals
    dark: float = 0.03  # added to the brightness [0, 1] in relative residuals: camera noise in dark areas
    shadow: tuple[float, float] = (0.2, 1.05)  # range of shades of tissue; darker pixels show an instrument
    residuals: tuple[float, float, int] = (-6.0, 1.0, 28)  # log residuals: range, bins
    shades: tuple[float, float, int] = (0.0, 1.5, 15)  # range, bins
    smoothing: float = 1.0  # standard deviation in bins
    # of the counts at the ridge of a shadow: most in the valley behind it, and where it ends in any case; rows above
    # what noise makes of it, up to which it is looked for; shades without one, within it
    valley: float = 0.6
    foot: float = 0.1
    ridge_rows: int = 2
    ridge_gap: int = 1
    # share of a uniform density in each: what was not sampled is not impossible; instruments have parts that were not
    unsampled_tissue: float = 0.02
    unsampled_instrument: float = 0.2
    # ratios of the densities up to which a pixel tells nothing and from which on it tells all: of an instrument's to
    # the tissue's, and of the tissue's to an instrument's
    instrument: tuple[float, float] = (3.0, 20.0)
    tissue: tuple[float, float] = (5.0, 30.0)
    far: float = 0.04  # share of the image width from a rendered instrument, beyond which tissue is learned
    inside_px: int = 2  # distance from the outline of a rendered instrument, inside which instruments are learned
    least_pixels: int = 200  # minimum number of pixels per class; with fewer, no result
    noise_quantile: float = 0.98  # quantile of the tissue's residuals that is its noise
    apart: float = 0.2  # share of the image width from a rendered instrument, beyond which none is visible
    # rendering errors of tissue that far away, whose quantile is their noise, and the least noise, of [0, 1]
    error_quantile: float = 0.99
    least_error: float = 0.1
    covered: float = 0.5  # covered share of a pixel, above which it may be instrument (below: tissue)
    lit: float = 0.6  # minimum shade of tissue; a darker pixel may be mixed with a black instrument
    outline_px: int = 2  # window around a pixel whose largest difference from the tissue is taken as full coverage
    reach: float = 0.075  # share of the image width: reach of instrument pixels while learning


SETTINGS = ForegroundSettings()


@dataclass(frozen=True, eq=False)
class Comparison:
    """An image compared with a scene's tissue: shade and residual [H, W], the unaveraged residual `own` [H, W], the
    share `covered` of each pixel that differs from the tissue [H, W], the tissue's depth [H, W] mm (infinite where
    absent), the rendered label [H, W] in [0, 1], the rendering error of the whole scene [H, W] (mean absolute
    difference), and the valid pixels, bool [H, W]."""

    shade: np.ndarray
    residual: np.ndarray
    own: np.ndarray
    covered: np.ndarray
    depth: np.ndarray
    label: np.ndarray
    error: np.ndarray = field(kw_only=True)
    usable: np.ndarray = field(kw_only=True)

    @staticmethod
    @torch.no_grad()
    def of(scene: GaussianScene, state: State, camera: Camera, image: Tensor, mask: Tensor | None) -> Comparison:
        """Compare an image [H, W, 3] in [0, 1] of a `camera` with the scene in `state`."""
        posed, instruments = scene.at(state), scene.canonical.of_instruments
        whole = rasterize(posed, camera, channels=instruments.float()[:, None])
        assert whole.channels is not None
        surface = rasterize(posed.select(~instruments), camera)
        tissue = surface.color.clamp(0, 1).cpu().numpy()
        depth = torch.where(surface.alpha < 0.5, torch.inf, surface.depth).cpu().numpy()
        observed, window = image.cpu().numpy(), SETTINGS.window_px
        over, under = (uniform_filter((other * tissue).sum(-1), window) for other in (observed, tissue))
        shade = over / np.maximum(under, 1e-6)
        likely = np.clip(shade, *SETTINGS.shadow)
        off = np.abs(observed - likely[..., None] * tissue).mean(-1)
        # both: a shadow may differ more than an instrument does, and a dark instrument resembles a shadow
        differences = np.stack([np.abs(observed - tissue).mean(-1), off], -1)
        around = np.ones((2 * SETTINGS.outline_px + 1,) * 2, np.uint8)
        most = cv2.dilate(uniform_filter(differences, (window, window, 1)), around)
        covered = (differences / np.maximum(most, 1e-6)).min(-1)
        brightness = SETTINGS.dark + uniform_filter(likely * tissue.mean(-1), window)
        label = whole.channels[..., 0].cpu().numpy()
        error = uniform_filter(np.abs(observed - whole.color.clamp(0, 1).cpu().numpy()).mean(-1), window)
        usable = np.ones(label.shape, bool) if mask is None else mask.cpu().numpy()
        residual = uniform_filter(off, window) / brightness
        return Comparison(shade, residual, off / brightness, covered, depth, label, error=error, usable=usable)

    def near(self, share: float = 0.0, px: int = 0) -> np.ndarray:
        """Return bool [H, W]: pixels within `share` of the width and `px` of a rendered instrument."""
        reach = 2 * (math.ceil(share * self.label.shape[1]) + px) + 1
        return cv2.dilate((self.label > 0.1).astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0

    def inside(self, margin_px: int) -> np.ndarray:
        """Return bool [H, W]: pixels at least this far inside a rendered instrument."""
        reach = 2 * margin_px + 1
        return cv2.erode((self.label > 0.7).astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0


@dataclass(frozen=True, eq=False)
class Foreground:
    """Pixel classifier of instruments and tissue: log ratio of their densities [R, S] by bins of log residual and
    shade; `noise`: upper quantile of the tissue's residuals; `error`: the same of the rendering error."""

    ratio: np.ndarray
    noise: float
    error: float
    settings: ForegroundSettings = SETTINGS

    @staticmethod
    def learned(views: Sequence[Comparison], settings: ForegroundSettings = SETTINGS) -> Foreground | None:
        """Learn both densities from views; None with too few pixels of either."""
        far = [view.usable & ~view.near(settings.far) for view in views]
        inside = [view.usable & view.inside(settings.inside_px) for view in views]
        if min(sum(int(mask.sum()) for mask in masks) for masks in (far, inside)) < settings.least_pixels:
            return None
        lit = _counts(views, far, settings)
        shaded, bound = _shaded(lit.sum(1) / lit.sum(), settings)
        about = _counts(views, [view.usable & ~mask for view, mask in zip(views, far, strict=True)], settings)
        within = _counts(views, inside, settings)
        instrument = within.copy()
        for column, row in _ridge(about, bound, settings).items():
            instrument[:row, column], shaded[:, column] = 0, 0
            shaded[:row, column] = about[:row, column] / max(1, about[:row, column].sum())
        if instrument.sum() <= within.sum() / 4:  # shadow removal leaves too little: it resembles tissue
            instrument = within
        tissue = lit / lit.sum() + shaded / max(shaded.sum(), 1e-9)  # lit and shadowed tissue are equally likely
        of_tissue = np.concatenate([view.residual[mask] for view, mask in zip(views, far, strict=True)])
        noise = float(np.quantile(of_tissue, settings.noise_quantile))
        errors = np.concatenate([view.error[view.usable & ~view.near(settings.apart)] for view in views])
        enough = len(errors) >= settings.least_pixels
        error = max(settings.least_error, float(np.quantile(errors, settings.error_quantile))) if enough else math.inf
        instrument = _density(instrument, settings.unsampled_instrument, settings.smoothing)
        tissue = _density(tissue, settings.unsampled_tissue, settings.smoothing)
        return Foreground(np.log(instrument / tissue), noise, error, settings)

    def certainty(self, view: Comparison, near: float) -> np.ndarray:
        """Return the certainty of every pixel of a view [H, W]: 1 instrument, -1 tissue, 0 unknown. No instrument is
        farther than `near` (share of the width) from a rendered one."""
        instrument, tissue = self._claims(view.residual, view.shade)
        instrument_alone, tissue_alone = self._claims(view.own, view.shade)  # averages extend beyond outlines
        covered = view.covered > self.settings.covered
        instrument = np.where(covered & view.near(near), np.minimum(instrument, instrument_alone), 0)
        tissue = np.where(~covered & (view.shade > self.settings.lit), np.maximum(tissue, tissue_alone), tissue)
        return np.asarray(np.where(view.usable, instrument - tissue, 0))

    def log_ratio(self, residuals: np.ndarray, shades: np.ndarray) -> np.ndarray:
        """Return the log ratio of the densities, instrument to tissue, at pixels [H, W]."""
        return np.asarray(self.ratio[_bins(residuals, shades, self.settings)])

    def _claims(self, residuals: np.ndarray, shades: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the certainties of instrument and of tissue at pixels [H, W], in [0, 1]."""
        log_ratio = self.log_ratio(residuals, shades)
        instrument, tissue = (
            np.clip((sign * log_ratio - math.log(least)) / math.log(most / least), 0, 1)
            for sign, (least, most) in ((1, self.settings.instrument), (-1, self.settings.tissue))
        )
        return instrument, tissue


def _bins(residuals: np.ndarray, shades: np.ndarray, settings: ForegroundSettings) -> tuple[np.ndarray, np.ndarray]:
    """Return the bins (row, column) of residuals and shades [...] in the densities."""
    log_residuals = np.log(np.maximum(residuals, 1e-6))
    rows, columns = (
        ((values - low) / (high - low) * count).astype(int).clip(0, count - 1)
        for values, (low, high, count) in ((log_residuals, settings.residuals), (shades, settings.shades))
    )
    return rows, columns


def _counts(views: Sequence[Comparison], masks: Sequence[np.ndarray], settings: ForegroundSettings) -> np.ndarray:
    """Return the histogram [R, S] of residual and shade over the pixels of views in masks [H, W]."""
    shape = settings.residuals[2], settings.shades[2]
    counts = np.zeros(shape)
    for view, mask in zip(views, masks, strict=True):
        np.add.at(counts, _bins(view.residual[mask], view.shade[mask], settings), 1)
    return counts


def _shaded(lit: np.ndarray, settings: ForegroundSettings) -> tuple[np.ndarray, np.ndarray]:
    """Return the density of the tissue's residuals at every shade of a shadow [R, S] (columns sum to 1, or 0 at other
    shades), and its upper bound; lit: that of lit tissue [R]. Relative residuals are constant in a shadow if they are
    the tissue's, and grow with its darkness if they are camera noise. The bound is of pure noise; the density is
    uniform in between."""
    (low, high, n_residuals), (dark, light, n_shades) = settings.residuals, settings.shades
    density, bound = np.zeros((2, n_residuals, n_shades))
    for column, shade in enumerate(np.linspace(dark, light, 2 * n_shades + 1)[1::2]):
        if settings.shadow[0] < shade < settings.shadow[1]:
            most = round(max(0.0, -math.log(shade)) / (high - low) * n_residuals)
            shifted = [np.concatenate([np.zeros(bins), lit[: n_residuals - bins]]) for bins in range(most + 1)]
            density[:, column], bound[:, column] = np.mean(shifted, 0), shifted[-1]
    return density, bound


def _ridge(about: np.ndarray, bound: np.ndarray, settings: ForegroundSettings) -> dict[int, int]:
    """Return by shade (column) the row of residuals below which pixels near instruments are shadowed tissue; {} without
    visible shadows. about [R, S]: counts of these pixels; bound [R, S]: of `_shaded`.

    Shadows have all degrees: in the counts they form a ridge that starts at lit tissue and rises with the noise,
    separated from an instrument by a valley. It is followed from light to dark, and ends where there is none.
    """
    share = np.cumsum(bound, 0) - bound  # cumulative up to each row
    smooth, of_noise = (gaussian_filter1d(counts, settings.smoothing, 0) for counts in (about, bound))
    highest = of_noise.argmax(0)
    columns = np.nonzero(bound.sum(0))[0][::-1].tolist()
    rows: dict[int, int] = {}
    crest, before, missed = highest[columns[0]], columns[0], 0
    for column in columns:
        counts, reach = smooth[:, column], settings.ridge_rows
        peak = row = int(counts[: crest + highest[column] - highest[before] + reach].argmax())
        last = min(int((share[:, column] < settings.noise_quantile).sum()) + reach, len(counts) - 2)
        while row < last and counts[row + 1] <= counts[row] > settings.foot * counts[peak]:
            row += 1
        deep = settings.valley if row < last else settings.foot
        if peak < row and counts[row] <= deep * counts[peak] and 4 * about[:, column].sum() >= settings.least_pixels:
            rows[column], crest, before, missed = row, peak, column, 0
        elif (missed := missed + 1) > settings.ridge_gap:
            break
    seen = sorted(rows)
    between = range(seen[0], seen[-1] + 1) if seen else ()
    return {column: round(float(np.interp(column, seen, [rows[k] for k in seen]))) for column in between}


def _density(counts: np.ndarray, unsampled: float, smoothing: float) -> np.ndarray:
    smooth: np.ndarray = gaussian_filter(counts, smoothing, mode="nearest")
    return (1 - unsampled) * smooth / smooth.sum() + unsampled / smooth.size
