"""Label weights of the instruments' Gaussians: near edges some model shadow or blur on the tissue.

A contact shadow between jaws and tissue, or the blur of an edge, moves with the instrument, so its Gaussians learn it
too. The recorded colours separate them: such pixels have the tissue's colour in another shade, others a colour of the
instruments' inside.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from neeco.methods.kinematic.articulation import LABEL_SHARE
from neeco.raster import rasterize
from neeco.scene.gaussian_scene import GaussianScene
from neeco.scene.visibility import visible_pixels
from neeco.training.session import GaussianSession

N_LABEL_FRAMES = 40  # whose colours separate instruments from shadow and blur on the tissue
N_BINS = 12  # of each colour in the histogram of the instruments' colours
SMOOTHING = 0.7  # bins, standard deviation
INSIDE = 0.9  # share of a pixel that is instrument, from which it may be inside one
EDGE = 0.012  # of the images' shorter side: within it of pixels below INSIDE, colours decide (3 px of 256)
SHADES = 0.5, 1.05  # range of shades of the rendered tissue in contact shadows; a dark shaft is darker
COLOR_ERROR = 0.02, 0.06  # standard deviation of a tissue pixel across its shades: constant, and times its brightness
OTHER_DENSITY = 0.02  # of colours that neither model explains
MIN_SHADE_LENGTH = 0.05  # of the segment in colour space that shades lie on
LOW, HIGH = 0.25, 0.35  # mean probability of its pixels at which a Gaussian's share is 0 and 1
OUTSIDE = 0.2  # mean probability of a Gaussian's pixels in a frame, below which that frame shows it on the tissue
FEW, MANY = 0.25, 0.45  # of the frames that show a Gaussian: on the tissue in so many, its share is 1 and 0
MIN_INSIDE = 0.9  # mean probability inside the instruments, below which colours do not separate them from the tissue
MIN_CERTAIN = 0.15  # share of a part's pixels that must be inside, for its colours to be known
MIN_PIXELS = 1e-3  # of a Gaussian in all frames; one with less counts as instrument
THRESHOLD = 0.5  # of the labels then: half of a pixel


@dataclass(frozen=True, kw_only=True)
class _View:
    """One training frame with its rendering, reduced to the P pixels that contain any instrument, to save memory."""

    index: int  # of the frame
    pixels: np.ndarray  # [H, W] bool: which these are
    image: np.ndarray  # [P, 3] as recorded
    tissue: np.ndarray  # [P, 3] rendered without instruments
    inside: np.ndarray  # [P] bool: certainly instrument
    parts: np.ndarray  # [P] index of the label column with the largest share, -1 below THRESHOLD


def store_label_shares(session: GaussianSession) -> None:
    """Store every instrument Gaussian's label weight in [0, 1] as the extra LABEL_SHARE, and set the scene's label
    threshold; neither where colours do not separate instruments from tissue.

    Where they separate only some parts, as a black shaft and not a mirror-like wrist, the others keep their weight.
    """
    scene = session.scene
    instrument = scene.canonical.of_instruments
    frames = session.frames_along_poses(N_LABEL_FRAMES)
    views = [_view(session, index) for index in frames]
    probable = _probabilities(views)
    known = np.concatenate([p[view.inside] for p, view in zip(probable, views, strict=True)])
    inside = float(known.mean()) if len(known) else 0.0
    scene.diagnostics["label_shares"] = {"inside": round(inside, 3)}
    known_parts, separable = _known_parts(scene, views, probable)
    if inside >= MIN_INSIDE:
        separable[:] = True
    elif not separable.any():
        return
    else:  # colours of the others are the tissue's, too
        known_parts[:] = False
        views = [replace(view, inside=view.inside & separable[view.parts]) for view in views]
        probable = _probabilities(views)
    probable = [np.where(view.inside, 1.0, p) for p, view in zip(probable, views, strict=True)]
    share, fringe = _label_shares(session, views, probable)
    part = scene.label_channels().argmax(1)
    learned = torch.from_numpy(known_parts).to(part.device)[part] & instrument
    weighed = torch.from_numpy(separable).to(part.device)[part]
    share = torch.where(learned, torch.minimum(share, fringe), share)
    share[instrument & ~weighed] = 1
    scene.canonical = scene.canonical.with_extras(**{LABEL_SHARE: share})
    scene.label_threshold = THRESHOLD
    scene.diagnostics["label_shares"]["mean"] = round(float(share[instrument].mean()), 3)


def _known_parts(scene: GaussianScene, views: list[_View], probable: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return two bool [L]: parts whose colours are known, since many of their pixels are inside, and those of them that
    colours separate from the tissue by themselves, whatever the others look like."""
    known, separable = np.zeros((2, len(scene.label_names)), bool)
    for part in range(len(known)):
        own = [view.parts == part for view in views]
        inside = np.concatenate([p[view.inside & rows] for p, view, rows in zip(probable, views, own, strict=True)])
        known[part] = len(inside) > MIN_CERTAIN * sum(int(rows.sum()) for rows in own)
        separable[part] = known[part] and float(inside.mean()) >= MIN_INSIDE
    return known, separable


def _label_shares(session: GaussianSession, views: list[_View], probable: list[np.ndarray]) -> tuple[Tensor, Tensor]:
    """Return label weights [N] in [0, 1] by two criteria; 1 for tissue and unobserved Gaussians.

    The first follows the mean probability of the pixels that show a Gaussian, the second the share of frames that show
    it on the tissue: a fringe beside a surface lies in front of the instrument in some views, the surface never beside
    it.
    """
    scene = session.scene
    shown, as_instrument, frames, on_tissue = scene.canonical.opacity_logits.new_zeros(4, len(scene.canonical))
    for view, probability in zip(views, probable, strict=True):
        state, camera = session.corrected(view.index)
        posed = scene.at(state)
        mask = session.views.mask(view.index)
        counted = shown.new_ones(view.pixels.shape) if mask is None else mask.to(shown)
        likely = torch.zeros_like(counted)
        likely[torch.from_numpy(view.pixels).to(shown.device)] = torch.from_numpy(probability).to(shown)
        pixels = visible_pixels(posed, camera, counted)
        of_instrument = visible_pixels(posed, camera, likely * counted)
        shown += pixels
        as_instrument += of_instrument
        frames += pixels.clamp_max(1)
        on_tissue += pixels.clamp_max(1) * (of_instrument < OUTSIDE * pixels)
    share = ((as_instrument / shown.clamp_min(MIN_PIXELS) - LOW) / (HIGH - LOW)).clamp(0, 1)
    outside = on_tissue / frames.clamp_min(MIN_PIXELS)
    fringe = ((MANY - outside) / (MANY - FEW)).clamp(0, 1)
    for weight in (share, fringe):
        weight[~scene.canonical.of_instruments | (shown < MIN_PIXELS)] = 1
    return share, fringe


@torch.no_grad()
def _view(session: GaussianSession, index: int) -> _View:
    scene = session.scene
    columns = torch.cat([scene.canonical.of_instruments.float()[:, None], scene.label_channels()], 1)
    channels, tissue = channels_and_tissue(session, index, columns)
    share, parts = channels[..., 0].cpu().numpy(), channels[..., 1:].argmax(-1).cpu().numpy()
    reach = 2 * max(1, math.ceil(EDGE * min(share.shape))) + 1
    inside = cv2.erode((share > INSIDE).astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0
    image, mask = session.views.target(index).cpu().numpy(), session.views.mask(index)
    if mask is not None:
        inside &= mask.cpu().numpy()
    pixels = share > 0
    return _View(
        index=index,
        pixels=pixels,
        image=image[pixels],
        tissue=tissue[pixels],
        inside=inside[pixels],
        parts=np.where(share > THRESHOLD, parts, -1)[pixels],
    )


@torch.no_grad()
def channels_and_tissue(session: GaussianSession, index: int, columns: Tensor) -> tuple[Tensor, np.ndarray]:
    """Return, for training frame `index`, the scene's channels [H, W, C] of `columns` [N, C], and its tissue rendered
    without instruments [H, W, 3] in [0, 1]."""
    scene = session.scene
    state, camera = session.corrected(index)
    posed = scene.at(state)
    channels = rasterize(posed, camera, channels=columns).channels
    assert channels is not None
    tissue = rasterize(posed.select(~scene.canonical.of_instruments), camera).color.clamp(0, 1)
    return channels, tissue.cpu().numpy()


def _bins(colors: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the bins of colours [..., 3] in [0, 1], one array per channel."""
    found = np.clip((colors * N_BINS).astype(int), 0, N_BINS - 1)
    return found[..., 0], found[..., 1], found[..., 2]


def _probabilities(views: list[_View]) -> list[np.ndarray]:
    """Return the probability [P] that each pixel of the views shows an instrument, by the colours inside them."""
    density = color_density(np.concatenate([view.image[view.inside] for view in views]))
    return [_instrument_probability(view.image, view.tissue, density) for view in views]


def share_of_colors(images: np.ndarray, density: np.ndarray) -> np.ndarray:
    """Return the share [...] of the colours with this density that are like each pixel of the images [..., 3]."""
    shares: np.ndarray = density[_bins(images)] / N_BINS**3
    return shares


def color_density(colors: np.ndarray) -> np.ndarray:
    """[N_BINS, N_BINS, N_BINS] density of colours [M, 3] in [0, 1], per unit of the colour cube."""
    counts = np.zeros((N_BINS,) * 3)
    np.add.at(counts, _bins(colors), 1)
    smooth = gaussian_filter(counts, SMOOTHING)
    return smooth / max(smooth.sum(), 1e-9) * N_BINS**3


def shades_of(images: np.ndarray, tissue: np.ndarray) -> np.ndarray:
    """Return the shade [...] of SHADES in which the rendered tissue [..., 3] is most like the images [..., 3]."""
    squared = (tissue**2).sum(-1)
    return np.clip((images * tissue).sum(-1) / np.maximum(squared, 1e-6), *SHADES)


def _instrument_probability(images: np.ndarray, tissue: np.ndarray, density: np.ndarray) -> np.ndarray:
    """Return the probability [...] in (0, 1) that a pixel [..., 3] shows an instrument whose colours have this density,
    with equal priors.

    Tissue in an unknown shade: uniform along the segment of its colour's shades, normal across it.
    """
    squared = (tissue**2).sum(-1)
    shade = shades_of(images, tissue)
    across = ((images - shade[..., None] * tissue) ** 2).sum(-1)
    variance = (COLOR_ERROR[0] + COLOR_ERROR[1] * shade * np.sqrt(squared)) ** 2
    length = np.maximum((SHADES[1] - SHADES[0]) * np.sqrt(squared), MIN_SHADE_LENGTH)
    of_tissue = np.exp(-across / (2 * variance)) / (2 * math.pi * variance * length)
    of_instrument = density[_bins(images)]
    found: np.ndarray = (of_instrument + OTHER_DENSITY) / (of_instrument + of_tissue + 2 * OTHER_DENSITY)
    return found
