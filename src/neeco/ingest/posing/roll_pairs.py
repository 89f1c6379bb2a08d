"""Roll of an instrument between two frames, from the texture of its wrist: several hypotheses for each pair.

The wrist is unrolled about the shaft's axis in every frame. Shading stays with the view and is subtracted; texture
moves sideways when the instrument rolls.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from neeco.ingest.posing.along_shaft import Load, Shafts, unroll

COLUMN_RAD = np.radians(3.0)  # between columns of the unrolled texture
MAX_AZIMUTH = np.radians(63.0)  # azimuths either side of the view; beyond, the surface is too oblique
ROW_MM = 0.3  # between rows
BAND = (-0.1, 0.4)  # of the working length, from the origin: beyond it jaws move on their own
MAX_COLUMNS = 20  # by which two textures are shifted against each other: they still overlap by half
MAX_ROWS, ROW_STEP = 4, 2  # along the shaft, whose end is known to 0.5 mm
MIN_VISIBLE = 0.9  # share of a texture that must be in the image
MAX_CONTRAST = 0.8  # of logarithmic colour: a glint is clipped
SHADING_FRAMES = 15.0  # standard deviation of the window over which shading is averaged
MIN_SCORE = 0.3  # correlation of a hypothesis
MAX_HYPOTHESES = 3  # per pair
# frames between those that are always compared: nearer ones turn by less than a column, and residual shading holds the
# peak at 0 (gains of 0.3 to 0.6 against the truth at 1 to 3 frames, about 1 from 5 on)
NEAR_FRAMES = (5, 6, 8, 10, 12, 15, 20, 30, 60)
FAR_FRAMES, FAR_PAIRS = 20, 8  # and for every frame the best of those later: where a view comes back, drift ends
BLOCK = 256  # frames compared with all others at a time


@dataclass(frozen=True, eq=False)
class RollPairs:
    """Frames first, second [P], and hypotheses of the roll from one to the other: `turns` [P, H] rad with correlations
    `scores` [P, H], best first; unused ones have score 0."""

    first: np.ndarray
    second: np.ndarray
    turns: np.ndarray
    scores: np.ndarray


def unrolled_textures(shafts: Shafts, load: Load) -> tuple[np.ndarray, np.ndarray]:
    """Return textures [F, A, B, C] float32 without the view's shading, and which frames [F] show enough of theirs."""
    along = np.arange(BAND[0] * shafts.working_length_mm, BAND[1] * shafts.working_length_mm, ROW_MM)
    azimuths = np.arange(-MAX_AZIMUTH, MAX_AZIMUTH + 0.01, COLUMN_RAD)
    visible = np.empty(len(shafts), bool)
    textures = np.empty((len(shafts), len(along), len(azimuths), 3), np.float32)
    for frame in range(len(shafts)):
        pixels = unroll(shafts, frame, load(frame), along, azimuths)
        visible[frame] = (pixels.max(-1) > 0).mean() > MIN_VISIBLE
        textures[frame] = np.log(pixels.astype(np.float32) + 10)
    textures -= np.median(textures, axis=(1, 2), keepdims=True)
    if visible.any():
        _take_out_shading(textures, visible)
    np.clip(textures, -MAX_CONTRAST, MAX_CONTRAST, out=textures)
    for texture in textures:
        cv2.GaussianBlur(texture, (0, 0), 0.8, dst=texture)
        # light from elsewhere varies slowly across the shaft
        texture -= cv2.blur(texture, (15, 1), borderType=cv2.BORDER_REPLICATE)
    return textures, visible


def _take_out_shading(textures: np.ndarray, visible: np.ndarray) -> None:
    """Subtract from each texture the mean of those about it in time, in which the instrument has turned."""
    frames = np.arange(len(textures))
    weights = np.exp(-0.5 * ((frames[:, None] - frames) / SHADING_FRAMES) ** 2) * visible
    # a frame without neighbours: the mean over the whole video
    weights = weights + 1e-3 * visible
    flat = textures.reshape(len(textures), -1)
    flat -= (weights / weights.sum(1, keepdims=True)).astype(np.float32) @ flat


def _correlations(textures: np.ndarray, rows: slice) -> np.ndarray:
    """Normalised cross-correlation [R, F, 2 M + 1] of some textures with all of [F, A, B, C]; at [i, j, M + q] the
    second is the first shifted by q columns, and by the number of rows within MAX_ROWS that fits best."""
    height, width = textures.shape[1:3]
    own = textures[rows]
    scores = np.full((len(own), len(textures), 2 * MAX_COLUMNS + 1), -1.0, np.float32)
    for down in range(-MAX_ROWS, MAX_ROWS + 1, ROW_STEP):
        upper, lower = slice(max(-down, 0), height - max(down, 0)), slice(max(down, 0), height - max(-down, 0))
        for shift in range(-MAX_COLUMNS, MAX_COLUMNS + 1):
            left, right = slice(max(-shift, 0), width - max(shift, 0)), slice(max(shift, 0), width - max(-shift, 0))
            found = _normalised(own[:, upper, left]) @ _normalised(textures[:, lower, right]).T
            best = scores[:, :, MAX_COLUMNS + shift]
            np.maximum(best, found, out=best)
    return scores


def _normalised(textures: np.ndarray) -> np.ndarray:
    flat = textures.reshape(len(textures), -1)
    flat = flat - flat.mean(1, keepdims=True)
    return np.asarray(flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-6))


def roll_pairs(textures: np.ndarray, visible: np.ndarray) -> RollPairs:
    """Compare frames near in time, and every frame with the most similar ones long after it; only those `visible`."""
    blocks = [
        RollPairs(
            *(np.zeros((0, *shape), kind) for shape, kind in ((((), int),) * 2 + (((MAX_HYPOTHESES,), float),) * 2))
        )
    ]
    for start in range(0, len(textures), BLOCK):
        # pairs are counted once: the second comes later
        scores = _correlations(textures[start:], slice(0, BLOCK))
        first, second = _chosen(scores.max(-1), visible[start:])
        turns, found = _peaks(scores[first, second])
        good = found[:, 0] >= MIN_SCORE
        blocks.append(RollPairs(first[good] + start, second[good] + start, turns[good], found[good]))
    return RollPairs(
        *(np.concatenate([getattr(block, name) for block in blocks]) for name in ("first", "second", "turns", "scores"))
    )


def _chosen(best: np.ndarray, visible: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Choose pairs [R, F] from their highest correlations."""
    apart = np.arange(best.shape[1]) - np.arange(best.shape[0])[:, None]
    both = visible & visible[: len(best), None]
    far = np.where((apart > FAR_FRAMES) & both, best, -1.0)
    similar = np.argsort(-far, axis=1, kind="stable")[:, :FAR_PAIRS]
    chosen = np.isin(apart, NEAR_FRAMES)
    np.put_along_axis(chosen, similar, True, axis=1)
    first, second = np.nonzero(chosen & both & (apart > 0))
    return first, second


def _peaks(scores: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Highest local maxima of correlations [P, 2 M + 1] over the shift, at subcolumn precision: turns rad and scores
    [P, MAX_HYPOTHESES]."""
    before, middle, after = scores[:, :-2], scores[:, 1:-1], scores[:, 2:]
    is_peak = (middle >= before) & (middle > after)
    ranked = np.where(is_peak, middle, 0.0)
    order = np.argsort(-ranked, axis=1, kind="stable")[:, :MAX_HYPOTHESES]
    rows = np.arange(len(scores))[:, None]
    a, b, c = before[rows, order], middle[rows, order], after[rows, order]
    fraction = 0.5 * (a - c) / np.minimum(a - 2 * b + c, -1e-6)
    turns = (order + 1 - MAX_COLUMNS + np.clip(fraction, -0.5, 0.5)) * COLUMN_RAD
    return turns, np.maximum(ranked[rows, order], 0.0)
