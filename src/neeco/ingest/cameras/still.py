"""A scope that stands still: how it is noticed, what stands behind the instrument, and what moves before that.

The background is what each pixel shows most often, after every frame's exposure is evened out. A pixel moves where it
is off the background by more than that pixel usually is (tissue that breathes or shines is off often), by more than
compression makes of a neighbour, and not merely darker, as in the instrument's shadow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from neeco.capture.model import evenly_spaced
from neeco.ingest.foreground.colors import color_levels, color_odds, whole_pieces
from neeco.ingest.frames.views import reduced

# noticing
LOOKED_AT = 24  # frames, spread over the recording, that are compared with each other
CELLS = 20  # across an image, with a feature each
TEXTURED = 2e-5  # of a feature: the lesser eigenvalue of its slopes' covariance, of a white of 1
FEW_FEATURES = 30  # from which nothing is concluded
FOLLOWING: dict[str, Any] = {"winSize": (15, 15), "maxLevel": 1, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
IN_PLACE = 0.0125  # of the image's width: a feature is where it was (tissue breathes)
RETURNS = 1.0  # px that a feature may be off when it is followed there and back
STILL_SHARE = 0.2  # of the features, that stay in place in frames of a still scope; the others move or breathe
STILL_PAIRS = 0.85  # of the pairs of frames, in which they do

# background and what moves before it
BACKGROUND_FRAMES = 64
MEMORY = 2**28  # bytes that the frames for one background may take
FLOOR = 11.0  # of 255: less is noise of sensor and compression
SPREADS = 4.0  # standard deviations of a pixel about the background that it is usually off
CANDIDATES = 7  # of a pixel's samples, about which half of the others may lie
HALF_DISTANCE = 0.6745  # standard deviations from the mean of a normal distribution, within which its half lies
NEIGHBOURS = np.ones((3, 3), np.uint8)  # edges move by a pixel
SHADOW = (0.35, 0.97)  # share of the light that a shadow leaves
SHADOW_TINT = 0.08  # by which that share may differ between the colours
COLORFUL = 0.2  # saturation of a background from which a shadow is told from a dark instrument
SPECK = 0.001  # of the image: what moves is larger

# colours of what moves
AROUND, COVERS = 4, 3  # px about what moves that are not surely tissue, and that do not count as background
LIKELY, SURE, DECIDED = 0.5, 1.0, 2.0  # logarithms of odds
VOTING_PX, NEAR_PX = 1.5, 0.7  # within which neighbours vote, at first and for outlines
OF_IT_MOVES = 0.2  # share of what has its colours
RARELY = 0.02  # share of images that show what is behind, too few to tell it


def stands_still(load: Callable[[int], np.ndarray], count: int) -> bool:
    """Whether a scope stood still while it took `count` images (load: one of them, uint8 [H, W, 3]): most features that
    are not on something that moves are where they were in every other frame looked at."""
    rows = evenly_spaced(count, LOOKED_AT)
    grey = [_even_light(cv2.cvtColor(reduced(load(row)), cv2.COLOR_RGB2GRAY)) for row in rows]
    stay = []
    for step in {1, len(grey) // 3, len(grey) // 2, 2 * len(grey) // 3} - {0}:
        stay += [_share_in_place(first, second) for first, second in zip(grey, grey[step:], strict=False)]
    shares = np.array([share for share in stay if share is not None])
    return len(shares) > 0 and float(np.mean(shares > STILL_SHARE)) > STILL_PAIRS


def same_place(first: np.ndarray, second: np.ndarray) -> float | None:
    """The share of the features of a background uint8 [H, W, 3] that are where they were in a second; None: it has too
    few."""
    grey = [_even_light(cv2.cvtColor(reduced(image), cv2.COLOR_RGB2GRAY)) for image in (first, second)]
    return _share_in_place(*grey)


def _share_in_place(first: np.ndarray, second: np.ndarray) -> float | None:
    """`same_place` of images [H, W] in even light."""
    found = _features(first)
    if len(found) < FEW_FEATURES:
        return None
    there, seen, _ = cv2.calcOpticalFlowPyrLK(first, second, found, found.copy(), **FOLLOWING)
    back, seen_back, _ = cv2.calcOpticalFlowPyrLK(second, first, there, there.copy(), **FOLLOWING)
    returns = np.linalg.norm(back - found, axis=-1)[:, 0] < RETURNS
    near = np.linalg.norm(there - found, axis=-1)[:, 0] < IN_PLACE * first.shape[1]
    return float((returns & near & (seen[:, 0] > 0) & (seen_back[:, 0] > 0)).mean())


def _even_light(grey: np.ndarray) -> np.ndarray:
    """An image uint8 [H, W] against its surroundings' brightness, which exposure and shadows change."""
    around = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), grey.shape[1] / CELLS)
    return np.clip(128.0 * grey / np.maximum(around, 8), 0, 255).astype(np.uint8)


def _features(grey: np.ndarray) -> np.ndarray:
    """float32 [K, 1, 2] px: the place easiest to find again in every cell of an image uint8 [H, W], where there is one.
    The easiest of the whole image would be highlights, which come and go."""
    strength = cv2.cornerMinEigenVal(grey, 7)
    side = grey.shape[1] // CELLS
    places = []
    for top in range(side // 2, grey.shape[0] - side, side):
        for left in range(side // 2, grey.shape[1] - side, side):
            cell = strength[top : top + side, left : left + side]
            if cell.max() > TEXTURED:
                row, column = np.unravel_index(cell.argmax(), cell.shape)
                places.append((left + column, top + row))
    return np.array(places, np.float32).reshape(-1, 1, 2)


@dataclass(frozen=True)
class Background:
    """What a still scope sees behind all that moves.

    colors: float32 [H, W, 3], of 255; spread: float32 [H, W], of 255, one standard deviation of its
    brightness while it is seen; seen: [H, W] share of the frames that show the background there.
    """

    colors: np.ndarray
    spread: np.ndarray
    seen: np.ndarray


def find_background(
    load: Callable[[int], np.ndarray], count: int, hidden: Callable[[int], np.ndarray] | None = None
) -> Background:
    """The background of `count` images (load: one of them, uint8 [H, W, 3]).

    hidden: bool [H, W] of one of them, True where an instrument is known to hide the background; a pixel that it hides
    in all frames has the colours of all of them, and is `seen` in none.
    """
    first = load(0)
    rows = evenly_spaced(count, max(8, min(BACKGROUND_FRAMES, MEMORY // first.nbytes)))
    frames = np.stack([load(row) for row in rows])  # [N, H, W, 3]
    covered = np.zeros(frames.shape[:3], bool) if hidden is None else np.stack([hidden(row) for row in rows])
    seen = 1 - covered.mean(0)
    covered[:, covered.all(0)] = False  # nothing better is known
    colors, spread = _commonest(frames, covered)
    gains = np.stack([exposure(image, colors) for image in frames])  # [N, 3]
    if np.abs(gains - 1).max() > 0.01:
        frames = np.clip(np.rint(frames / gains[:, None, None]), 0, 255).astype(np.uint8)
        colors, spread = _commonest(frames, covered)
    return Background(colors, spread, seen.astype(np.float32))


def _commonest(frames: np.ndarray, covered: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colours [H, W, 3] and spread [H, W], float32, of frames uint8 [N, H, W, 3] where they are not covered, bool
    [N, H, W]: the mean of that half of a pixel's samples that is nearest to one of them (least median of distances). An
    instrument that comes to a pixel in less than half of the frames leaves no trace there; a median would shift."""
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

        best, found = np.full(len(count), np.inf, np.float32), samples[0]
        for place in np.linspace(0, 1, CANDIDATES):
            center = np.take_along_axis(samples, np.rint(place * (count - 1)).astype(int)[None, :, None], 0)[0]
            reach = half_about(center)[1]
            found = np.where((reach < best)[:, None], center, found)
            best = np.minimum(best, reach)
        for _ in range(2):  # from one sample to the mean of its half
            distances, reach = half_about(found)
            near = distances <= reach
            found = (samples * near[..., None]).sum(0) / near.sum(0)[:, None]
        colors[row], spread[row] = found, reach / HALF_DISTANCE
    return colors, spread


def exposure(image: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """[3] by how much brighter each colour of an image uint8 [H, W, 3] is than a background [H, W, 3] of 255."""
    usable = (colors > 25).all(-1) & (colors < 235).all(-1) & (image < 250).all(-1)
    if usable.sum() < 100:
        return np.ones(3)
    ratios = image[usable].astype(np.float32) / colors[usable]
    return np.asarray(np.median(ratios, axis=0), np.float64)


def moving_mask(image: np.ndarray, background: Background) -> np.ndarray:
    """bool [H, W]: where an image uint8 [H, W, 3] shows something that moves before the background."""
    colors = background.colors
    even = (image / exposure(image, colors)).astype(np.float32)
    low, high = cv2.erode(colors, NEIGHBOURS), cv2.dilate(colors, NEIGHBOURS)
    off = np.maximum(even - high, low - even).max(-1)
    moves = off > np.maximum(FLOOR, SPREADS * background.spread)
    moves &= ~_is_shadow(even, colors)
    moves = cv2.morphologyEx(moves.astype(np.uint8), cv2.MORPH_OPEN, NEIGHBOURS)
    moves = cv2.morphologyEx(moves, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    count, labels, facts, _ = cv2.connectedComponentsWithStats(moves, connectivity=8)
    large = facts[:, cv2.CC_STAT_AREA] >= SPECK * moves.size
    large[0] = False  # the rest of the image
    return large[labels] if count > 1 else np.zeros(moves.shape, bool)


def _is_shadow(even: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """bool [H, W]: where an image differs from the background as its shadow would: all colours darker by one share. Of
    a background without colour, nothing is told."""
    shares = even / np.maximum(colors, 1)
    share = even.sum(-1) / np.maximum(colors.sum(-1), 1)
    saturation = 1 - colors.min(-1) / np.maximum(colors.max(-1), 1)
    alike = (np.ptp(shares, axis=-1) < 2 * SHADOW_TINT) & (saturation > COLORFUL)
    return alike & (share > SHADOW[0]) & (share < SHADOW[1])


def moving_masks(
    load: Callable[[int], np.ndarray], count: int, rows: np.ndarray, visible: np.ndarray | None = None
) -> np.ndarray:
    """What moves before the still background, in some of `count` images of a still scope.

    load: one image uint8 [H, W, 3]; rows [R]: which of them; visible: bool [H, W], the field of view, where it has a
    border. Returns bool [R, h, w], of the images `reduced`.

    Nothing is known of instruments here. Where a shaft lies in most images, it is background at first, and only its
    ends move; but it has colours that are seen where something moves and hardly elsewhere. What these show does not
    count for the background in a second pass.
    """
    background = find_background(lambda row: reduced(load(row)), count)
    images = np.stack([reduced(load(int(row))) for row in rows])
    shown = np.ones(images.shape[1:3], bool)
    if visible is not None:
        shown = reduced(visible.astype(np.uint8) * 255) == 255
    moves = np.stack([moving_mask(image, background) for image in images]) & shown
    colors = color_levels(images)
    around = np.stack([_grown(mask, AROUND) for mask in moves])
    odds = color_odds(colors, moves, ~around & shown)
    hidden = np.stack([
        _grown(mask | (whole_pieces(odds.smoothed(found, VOTING_PX) > LIKELY, SPECK, mask, OF_IT_MOVES)), COVERS)
        for mask, found in zip(moves, colors, strict=True)
    ])  # fmt: skip
    background = find_background(lambda place: images[place], len(rows), lambda place: hidden[place])
    unseen = background.seen < RARELY
    return shown & np.stack([
        _with_colors(moving_mask(image, background) | (covered & unseen), odds.smoothed(found, NEAR_PX))
        for image, found, covered in zip(images, colors, hidden, strict=True)
    ])  # fmt: skip


def _with_colors(moves: np.ndarray, odds: np.ndarray) -> np.ndarray:
    """What moves, bool [h, w], and what has its colours beside it, by the odds [h, w] of each pixel."""
    return whole_pieces((moves & (odds > -DECIDED)) | (odds > SURE), SPECK, moves, OF_IT_MOVES)


def _grown(mask: np.ndarray, px: int) -> np.ndarray:
    """A mask bool [h, w] and what is within so many px of it."""
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((2 * px + 1,) * 2, np.uint8)) > 0)
