"""Silhouettes of instruments: how likely each pixel of a training image shows one, given the tissue learned so far.

The scene's tissue, rendered without instruments, is each image's background. A shadow dims it by one factor, so that a
pixel is described by the factor that fits best (`shade`) and by what that leaves (`residual`). Two densities of these
two are learned from the images themselves: of tissue, where no instrument is near, any shade of a shadow being as
likely; of the instruments, well inside of where they are rendered. Their ratio tells which of the two a pixel shows,
and says nothing where both are alike: a black shaft is no shadow of dark cloth where its residuals differ from those
of cloth, and undetermined where they do not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from scipy.ndimage import gaussian_filter, uniform_filter

from neeco.capture.model import evenly_spaced
from neeco.raster import rasterize
from neeco.training.session import GaussianSession
from neeco.training.silhouettes import INSTRUMENT, UNKNOWN, Silhouettes

OBSERVED_AT = (0.1, 0.32, 0.6)  # shares of the run


@dataclass(frozen=True)
class EvidenceSettings:
    """How pixels are compared."""

    n_sampled: int = 20  # frames from which densities are learned
    window_px: int = 3  # over which residuals are averaged
    dark: float = 0.03  # added to the brightness [0, 1] that residuals are shares of: the camera's noise in the dark
    shadow: tuple[float, float] = (0.45, 1.05)  # range of shades of tissue; darker than any shadow is an instrument
    residuals: tuple[float, float, int] = (-6.0, 1.0, 28)  # range of their logarithms, and bins
    shades: tuple[float, float, int] = (0.0, 1.5, 15)  # range, and bins
    smoothing: float = 1.0  # bins, standard deviation
    floor: float = 0.02  # share of a uniform density in each: what was not sampled is not impossible
    # ratios of the densities up to which a pixel tells nothing and from which on it tells all: of an instrument's to
    # the tissue's, and of the tissue's to the instrument's
    instrument: tuple[float, float] = (3.0, 20.0)
    tissue: tuple[float, float] = (5.0, 30.0)
    near: float = 0.075  # of the images' width: no instrument shows farther from a rendered one
    far: float = 0.04  # of the images' width from a rendered instrument: tissue without one
    inside_px: int = 2  # from the outline of a rendered instrument: certainly one
    least_pixels: int = 200  # of each kind, below which nothing is said


@torch.no_grad()
def observe_silhouettes(session: GaussianSession, settings: EvidenceSettings | None = None) -> None:
    """Set the session's silhouettes from its scene as learned so far, where its tissue explains the images better than
    when they were last observed, and well enough to tell anything."""
    settings = settings or EvidenceSettings()
    if not session.scene.instruments:
        return
    count = len(session.views.frames)
    sampled = {index: _View(session, index, settings) for index in evenly_spaced(count, settings.n_sampled)}
    ratio = _DensityRatio.of(list(sampled.values()), settings)
    known = session.silhouettes
    if ratio is None or (known is not None and ratio.noise >= known.noise):
        return
    views = (sampled[index] if index in sampled else _View(session, index, settings) for index in range(count))
    session.silhouettes = Silhouettes(tuple(view.silhouette(ratio) for view in views), ratio.noise)


class _View:
    """A training image beside the scene's tissue: shade and residual [H, W], and label [H, W] as rendered."""

    def __init__(self, session: GaussianSession, index: int, settings: EvidenceSettings) -> None:
        self.settings, scene = settings, session.scene
        state, camera = session.corrected(index)
        posed, instruments = scene.at(state), scene.canonical.of_instruments
        channels = rasterize(posed, camera, channels=instruments.float()[:, None]).channels
        assert channels is not None
        tissue = rasterize(posed.select(~instruments), camera).color.clamp(0, 1).cpu().numpy()
        image = session.views.target(index).cpu().numpy()
        mask = session.views.mask(index)
        self.label = channels[..., 0].cpu().numpy()
        self.usable = np.ones(self.label.shape, bool) if mask is None else mask.cpu().numpy()
        over, under = (uniform_filter((image * tissue).sum(-1), settings.window_px), (tissue**2).sum(-1))
        self.shade = over / np.maximum(uniform_filter(under, settings.window_px), 1e-6)
        off = np.abs(image - np.clip(self.shade, *settings.shadow)[..., None] * tissue).mean(-1)
        light = settings.dark + uniform_filter(np.clip(self.shade, *settings.shadow) * tissue.mean(-1), settings.window_px)
        self.residual = uniform_filter(off, settings.window_px) / light

    def within(self, share: float) -> np.ndarray:
        """bool [H, W]: pixels within `share` of the width of where an instrument may be rendered."""
        reach = 2 * math.ceil(share * self.label.shape[1]) + 1
        return cv2.dilate((self.label > 0.1).astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0

    def inside(self) -> np.ndarray:
        """bool [H, W]: pixels well inside of a rendered instrument."""
        reach = 2 * self.settings.inside_px + 1
        return cv2.erode((self.label > 0.7).astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0

    def silhouette(self, ratio: _DensityRatio) -> torch.Tensor:
        """Return the frame's values [H, W] uint8 of `Silhouettes`."""
        found = ratio.logarithm(self)
        instrument, tissue = (
            np.clip((sign * found - math.log(least)) / math.log(most / least), 0, 1)
            for sign, (least, most) in ((1, self.settings.instrument), (-1, self.settings.tissue))
        )
        certain = np.where(self.usable, np.where(self.within(self.settings.near), instrument, 0) - tissue, 0)
        return torch.from_numpy((UNKNOWN + certain * (INSTRUMENT - UNKNOWN)).round().clip(0, 255).astype(np.uint8))


@dataclass(frozen=True)
class _DensityRatio:
    """Logarithm of the ratio of both densities by bins of log residual and shade, and the tissue's noise: the residual
    that nearly all of it is below."""

    values: np.ndarray  # [R, S]
    noise: float
    settings: EvidenceSettings

    @staticmethod
    def of(views: list[_View], settings: EvidenceSettings) -> _DensityRatio | None:
        """Learn both densities from views; None where there is too little of either."""
        far = [view.usable & ~view.within(settings.far) for view in views]
        inside = [view.usable & view.inside() for view in views]
        if min(sum(int(mask.sum()) for mask in masks) for masks in (far, inside)) < settings.least_pixels:
            return None
        of_tissue = np.concatenate([view.residual[mask] for view, mask in zip(views, far, strict=True)])
        r = np.concatenate([view.residual[mask] for view, mask in zip(views, inside, strict=True)])
        s = np.concatenate([view.shade[mask] for view, mask in zip(views, inside, strict=True)])
        (low, high, n_residuals), (dark, light, n_shades) = settings.residuals, settings.shades
        edges = np.linspace(low, high, n_residuals + 1), np.linspace(dark, light, n_shades + 1)
        instrument = np.histogram2d(_log(r).clip(low, high), s.clip(dark, light), edges)[0]
        residuals = np.histogram(_log(of_tissue).clip(low, high), edges[0])[0].astype(float)
        middles = (edges[1][1:] + edges[1][:-1]) / 2
        shades = ((middles > settings.shadow[0]) & (middles < settings.shadow[1])).astype(float)
        tissue = residuals[:, None] * shades
        densities = []
        for counts in (instrument, tissue):
            smooth = gaussian_filter(counts, settings.smoothing, mode="nearest")
            share = settings.floor / smooth.size
            densities.append((1 - settings.floor) * smooth / smooth.sum() + share)
        noise = float(np.quantile(of_tissue, 0.98))
        return _DensityRatio(np.log(densities[0] / densities[1]), noise, settings)

    def logarithm(self, view: _View) -> np.ndarray:
        """Of every pixel of a view [H, W]: positive where an instrument is the likelier."""
        (low, high, n_residuals), (dark, light, n_shades) = self.settings.residuals, self.settings.shades
        row = ((_log(view.residual) - low) / (high - low) * n_residuals).astype(int).clip(0, n_residuals - 1)
        column = ((view.shade - dark) / (light - dark) * n_shades).astype(int).clip(0, n_shades - 1)
        return np.asarray(self.values[row, column])


def _log(residuals: np.ndarray) -> np.ndarray:
    return np.log(np.maximum(residuals, 1e-6))
