"""Silhouettes of instruments by what the learned tissue does not explain in the training images.

The scene's own tissue, rendered without instruments, is each image's background. A shadow only dims it: a pixel that no
shade of the tissue explains shows an instrument, near where one is rendered; one that a shade explains shows tissue,
unless much of an instrument has its colour. Wrong states and fringes learned from them do not change what the
images show. Only a tissue learned well enough tells: elsewhere nothing is said.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from scipy.ndimage import gaussian_filter, uniform_filter

from neeco.capture.model import evenly_spaced
from neeco.raster import rasterize
from neeco.training.session import GaussianSession
from neeco.training.silhouettes import INSTRUMENT, UNKNOWN, Silhouettes

OBSERVED_AT = (0.1, 0.32, 0.6)  # shares of the run
N_SAMPLED = 20  # frames by which the tissue's noise and the instruments' colours are known
MAX_NOISE = 0.02  # residual that nearly all of the tissue is below, above which nothing is said
NOISE_QUANTILE = 0.98
TISSUE, NOT_TISSUE = (0.02, 1.5), (0.05, 3.0)  # residuals (images in [0, 1]), and times the noise: the larger counts
WINDOW_PX = 3  # over which residuals and probabilities are averaged
LEAST_LABEL, LABEL = 0.1, 0.7  # rendered shares of a pixel from which an instrument may be near, and is there
FAR = 0.04  # of the images' width: tissue within it of an instrument does not count for noise
NEAR = 0.075  # of the images' width: no instrument shows farther from a rendered one
N_BINS = 12  # of each colour in the histogram of the instruments' colours
SMOOTHING = 0.7  # bins, standard deviation
SHADES = 0.5, 1.05  # range of shades of the rendered tissue in contact shadows; a dark shaft is darker
ALIKE = 0.05  # share of the instruments' colours that are a pixel's, from which it may show one like its tissue


@torch.no_grad()
def observe_silhouettes(session: GaussianSession) -> None:
    """Set the session's silhouettes from its scene as learned so far, where its tissue explains the images better than
    when they were last observed, and well enough."""
    scene = session.scene
    if not scene.instruments:
        return
    count = len(session.views.frames)
    sampled = {index: _View(session, index) for index in evenly_spaced(count, N_SAMPLED)}
    sample = list(sampled.values())
    noise, known = _noise(sample), session.silhouettes
    if noise > MAX_NOISE or (known is not None and noise >= known.noise):
        return
    lower, upper = (max(least, factor * noise) for least, factor in (TISSUE, NOT_TISSUE))
    shown = [view.image[view.usable & (view.residual > upper) & (view.label > LABEL)] for view in sample]
    colors = _color_shares(np.concatenate(shown))
    views = (sampled[index] if index in sampled else _View(session, index) for index in range(count))
    session.silhouettes = Silhouettes(tuple(view.silhouette(lower, upper, colors) for view in views), noise)


class _View:
    """A training image beside the scene's tissue: residual [H, W] after the best shade, label [H, W] as rendered."""

    def __init__(self, session: GaussianSession, index: int) -> None:
        scene = session.scene
        state, camera = session.corrected(index)
        posed, instruments = scene.at(state), scene.canonical.of_instruments
        channels = rasterize(posed, camera, channels=instruments.float()[:, None]).channels
        assert channels is not None
        tissue = rasterize(posed.select(~instruments), camera).color.clamp(0, 1).cpu().numpy()
        self.label = channels[..., 0].cpu().numpy()
        self.image = session.views.target(index).cpu().numpy()
        mask = session.views.mask(index)
        self.usable = np.ones(self.label.shape, bool) if mask is None else mask.cpu().numpy()
        off = np.abs(self.image - _shades_of(self.image, tissue)[..., None] * tissue).mean(-1)
        self.residual = uniform_filter(off, WINDOW_PX)

    def within(self, share: float) -> np.ndarray:
        """bool [H, W]: pixels within `share` of the width of a rendered instrument."""
        reach = 2 * math.ceil(share * self.label.shape[1]) + 1
        return cv2.dilate((self.label > LEAST_LABEL).astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0

    def silhouette(self, lower: float, upper: float, colors: np.ndarray) -> torch.Tensor:
        """Return the frame's values [H, W] uint8 of `Silhouettes`: residuals above `upper` are instrument, those below
        `lower` tissue where instruments, with these shares of `colors`, rarely look like it."""
        off = np.clip((self.residual - lower) / (upper - lower), 0, 1)
        instrument = np.where(self.within(NEAR), 2 * off - 1, 0).clip(0, 1)
        tissue = np.where(colors[_bins(self.image)] < ALIKE, 1 - 2 * off, 0).clip(0, 1)
        certain = np.where(self.usable, instrument - tissue, 0)
        return torch.from_numpy((UNKNOWN + certain * (INSTRUMENT - UNKNOWN)).round().clip(0, 255).astype(np.uint8))


def _noise(views: list[_View]) -> float:
    """Return the residual below which nearly all tissue far from instruments is; infinite where there is none."""
    far = [view.residual[view.usable & ~view.within(FAR)] for view in views]
    residuals = np.concatenate(far)
    return float(np.quantile(residuals, NOISE_QUANTILE)) if len(residuals) else math.inf


def _bins(colors: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the bins of colours [..., 3] in [0, 1], one array per channel."""
    found = np.clip((colors * N_BINS).astype(int), 0, N_BINS - 1)
    return found[..., 0], found[..., 1], found[..., 2]


def _color_shares(colors: np.ndarray) -> np.ndarray:
    """Return the share [N_BINS, N_BINS, N_BINS] of colours [M, 3] in [0, 1] that lie in each bin, smoothed."""
    counts = np.zeros((N_BINS,) * 3)
    np.add.at(counts, _bins(colors), 1)
    smooth: np.ndarray = gaussian_filter(counts, SMOOTHING)
    return smooth / max(smooth.sum(), 1e-9)


def _shades_of(images: np.ndarray, tissue: np.ndarray) -> np.ndarray:
    """Return the shade [...] of SHADES in which the rendered tissue [..., 3] is most like the images [..., 3]."""
    squared = (tissue**2).sum(-1)
    return np.clip((images * tissue).sum(-1) / np.maximum(squared, 1e-6), *SHADES)
