"""The two edges of a shaft in an image: roughly from its mask, then at subpixel precision from its shading.

A threshold cannot detect the edge of a dark limb next to a shadow: with a lamp at the lens, the limb of a cylinder
fades as its surface turns away. So the profile across an edge is fitted as a whole: a cylinder's shading, blurred by
the lens, against tissue that may darken towards it. The edge is at the best fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from neeco.capture.model import evenly_spaced
from neeco.geometry.lines import places_nearest_to_rays, unit
from neeco.ingest.foreground.masks import MASKS, color_odds
from neeco.ingest.foreground.silhouettes import border_of, largest_piece, slices_across
from neeco.ingest.shaft.axis import Intrinsics, ShaftAxes, ShaftEdges, axis_between, contour_normals, image_lines


@dataclass(frozen=True, kw_only=True)
class EdgeSettings:
    """Settings of the detection of a shaft's edges, and of its end."""

    # from masks
    inlier_px: float = 1.2  # scale of the robust loss of an edge's points
    line_rounds: int = 8  # rounds of reweighting
    min_length_px: int = 12  # minimum visible length of the shaft
    head_margin_px: float = 2.0  # margin at the distal end that is ignored
    places: int = 12  # points per edge
    outline_sd_px: float = 0.7  # standard deviation of a mask's edge as a whole
    # from shading
    block_px: int = 5  # length of shaft per point
    reach_px: float = 3.0  # search range about the predicted edge
    step_px: float = 0.1  # step of the search
    inside_px: float = 9.0  # fitted range inside
    outside_px: float = 6.0  # fitted range outside
    max_radius_share: float = 0.6  # maximum fitted share of the radius, excluding reflections in the middle
    sample_px: float = 0.25  # spacing of samples of images
    fine_px: float = 0.05  # spacing of samples of models
    blurs: tuple[float, ...] = (0.5, 0.7, 0.9, 1.2)  # candidate standard deviations of the lens's blur, px
    common_sd_px: float = 0.15  # of an edge as a whole, in addition to its noise
    min_misfit: float = 1.0  # minimum sum of squares of a profile, due to noise
    max_places: int = 60  # points per edge
    max_diameters: int = 30  # search range behind the shaft's end
    margin_radii: float = 0.4  # margin behind the shaft's end
    # Where a shaft ends and the wrist begins their colours differ, and neither is known. But what enters at the image's
    # border is shaft in most images that show much of the instrument, and what lies near the tip is not.
    shaft_share: float = 0.3  # share of a long mask's length at the border that is initially shaft
    head_share: float = 0.3  # share at the tip that is initially head
    long_share: float = 0.5  # share of the images (longest masks) from which colours are initially learned
    border_px: float = 2.0  # margin at the mask's or image's ends
    n_rounds: int = 4
    end_margin_px: float = 3.0  # margin about the estimated end, excluded from both colours
    max_odds: float = 3.0  # absolute logarithm, per point
    dark: float = 12.0  # of 255, added before logarithms
    # logarithms: red of green, green of blue, lightness
    tint_ranges: tuple[tuple[float, float], ...] = ((-0.5, 0.9), (-0.3, 0.5), (2.4, 5.6))
    min_contrast: float = 0.5  # minimum difference of the mean odds of shaft and head


EDGE = EdgeSettings()

OFFSETS = np.arange(-EDGE.inside_px, EDGE.outside_px + EDGE.sample_px / 2, EDGE.sample_px)  # px outwards, of samples
CANDIDATES = np.arange(-EDGE.reach_px, EDGE.reach_px + EDGE.step_px / 2, EDGE.step_px)  # px outwards, of an edge
LINEAR_LIGHT = (255 * (np.arange(256) / 255) ** 2.2).astype(np.float32)  # of the values of an image


def outline_edges(
    masks: np.ndarray, ends: np.ndarray, directions: np.ndarray, radius: float, intrinsics: Intrinsics
) -> tuple[ShaftAxes, ShaftEdges, np.ndarray]:
    """Fit the shaft of each mask [F, h, w], between two lines through its outline up to its `ends` [F, 2] px, about
    `directions` [F, 2].

    Returns the axes, each from its own image, with points at the shaft's end; points on both edges; and which frames
    have them [F].
    """
    count = len(masks)
    border = border_of(masks.shape[1:], None)
    points, axes = np.tile([0.0, 0.0, 1.0], (2, count, 1))
    pixels, deviations = np.zeros((count, 2, EDGE.places, 2)), np.full((count, 2, EDGE.places), np.inf)
    valid = np.zeros(count, dtype=bool)
    for frame in np.flatnonzero(np.isfinite(ends[:, 0])):
        piece = largest_piece(masks[frame])
        end = ends[frame]
        direction = directions[frame]
        for _ in range(2):  # the second time about the shaft's own middle
            _, middles, widths = slices_across(piece, border, end, direction)
            aside = np.array([-direction[1], direction[0]])
            shaft = (middles - end) @ direction < -EDGE.head_margin_px
            if shaft.sum() < EDGE.min_length_px:
                break
            x, middle = (middles[shaft] - end) @ direction, (middles[shaft] - end) @ aside
            # in the order of `contour_normals`: looking along the shaft, its right edge first
            sides = [middle + sign * widths[shaft] / 2 for sign in (1, -1)]
            lines = [np.array([0.0, np.median(side)]) for side in sides]  # slope, offset
            for _ in range(EDGE.line_rounds):  # least squares under a Cauchy loss
                weights = [
                    1 / np.hypot(1, (side - np.polyval(line, x)) / EDGE.inlier_px)
                    for side, line in zip(sides, lines, strict=True)
                ]
                lines = [np.polyfit(x, side, 1, w=weight) for side, weight in zip(sides, weights, strict=True)]
            reach = np.linspace(x[0], x[-1], EDGE.places)
            places = [end + np.outer(reach, direction) + np.outer(a * reach + b, aside) for a, b in lines]
            slope, offset = np.mean(lines, 0)
            end, direction = end + offset * aside, (direction + slope * aside) / np.hypot(1, slope)
        else:
            pixels[frame] = places
            through = np.cross(*(np.insert(pixels[frame][:, which], 2, 1.0, 1) for which in (0, -1)))
            points[frame], axes[frame] = axis_between(through, end, direction, radius, intrinsics)
            valid[frame] = points[frame][2] > radius  # NaN is not
    deviations[valid] = EDGE.outline_sd_px * np.sqrt(EDGE.places)
    points[~valid] = axes[~valid] = (0.0, 0.0, 1.0)
    return ShaftAxes(points=points, directions=axes), ShaftEdges(pixels, deviations), valid


def shaded_edges(
    images: np.ndarray, axes: ShaftAxes, radius: float, intrinsics: Intrinsics, blur: float
) -> tuple[ShaftEdges, np.ndarray, float]:
    """Detect the edges of the shaft in images uint8 [F, h, w, 3], near the contours of its predicted axes, whose points
    are where it ends.

    Returns the edges, how many diameters of shaft each image shows [F], and the profiles' mean squared misfit.
    """
    count = len(images)
    pixels, deviations = np.zeros((count, 2, EDGE.max_places, 2)), np.full((count, 2, EDGE.max_places), np.inf)
    diameters, misfits = np.zeros(count), []
    fx, fy, cx, cy = intrinsics
    back = np.linspace(EDGE.max_diameters * 2, EDGE.margin_radii, 400) * radius
    for frame in range(count):
        axis = axes.points[frame] - back[:, None] * axes.directions[frame]
        deep = np.maximum(axis[:, 2], 1e-6)
        places = np.stack([fx * axis[:, 0] / deep + cx, fy * axis[:, 1] / deep + cy], 1)
        inside = (axis[:, 2] > radius) & (places > 0).all(1) & (places < images.shape[2:0:-1]).all(1)
        if inside.sum() < 2:
            continue
        ends = places[np.flatnonzero(inside)[[0, -1]]]  # from the border to where the shaft ends
        width = float((2 * radius * np.sqrt(fx * fy) / deep[inside]).mean())
        length = float(np.linalg.norm(ends[1] - ends[0]))
        diameters[frame] = length / width
        if length < EDGE.min_length_px:
            continue
        light = LINEAR_LIGHT[images[frame]]  # shading and blur are of light, not of its gamma-coded values
        normals = contour_normals(axes.points[frame], axes.directions[frame], radius)
        for side, line in enumerate(image_lines(normals, intrinsics)):
            places, sds, misfit = _edge(light, ends, line, width / 2, blur)
            misfits += misfit.tolist()
            keep = evenly_spaced(len(places), EDGE.max_places)
            pixels[frame, side, : len(keep)] = places[keep]
            # an edge has an error as a whole, too: its places are not independent
            deviations[frame, side, : len(keep)] = np.hypot(sds[keep], EDGE.common_sd_px * np.sqrt(max(len(keep), 1)))
    return ShaftEdges(pixels, deviations), diameters, float(np.mean(misfits)) if misfits else np.inf


def _edge(
    light: np.ndarray, ends: np.ndarray, line: np.ndarray, radius_px: float, blur: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points [N, 2] px of an edge near an image line, along the axis between `ends` [2, 2] px; their standard
    deviations [N] px and mean squared misfits [N]."""
    length = int(np.linalg.norm(ends[1] - ends[0]))
    middle = ends[0] + (np.arange(length) / max(length, 1))[:, None] * (ends[1] - ends[0])
    foot = middle - (middle @ line[:2] + line[2])[:, None] * line[:2]
    bases, used = _profile_bases(round(2 * radius_px) / 2, blur)
    places = (foot[:, None] - OFFSETS[None, :, None] * line[:2] - 0.5).astype(np.float32)
    colors = cv2.remap(light, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    height, width = light.shape[:2]
    inside = (places > 0).all(-1) & (places[..., 0] < width - 1) & (places[..., 1] < height - 1)  # [S, U]
    whole = inside.all(1)
    blocks = len(foot) // EDGE.block_px
    if not blocks:
        return np.zeros((0, 2)), np.zeros(0), np.zeros(0)
    cut = blocks * EDGE.block_px
    whole = whole[:cut].reshape(blocks, EDGE.block_px).all(1)
    profiles = (
        np.median(colors[:cut].reshape(blocks, EDGE.block_px, len(OFFSETS), 3), axis=1)[whole] * used[:, None]
    )  # [B, U, 3]
    missed = (profiles**2).sum((1, 2))[:, None]
    missed = missed - (np.einsum("euk,buc->bekc", bases, profiles, optimize=True) ** 2).sum((2, 3))  # [B, E]
    best = missed.argmin(1)
    row = np.arange(len(best))
    inner = (best > 0) & (best < missed.shape[1] - 1)
    best = np.clip(best, 1, missed.shape[1] - 2)
    low, least, high = missed[row, best - 1], missed[row, best], missed[row, best + 1]
    curvature = np.maximum(low - 2 * least + high, 1e-9)
    shift = CANDIDATES[best] + EDGE.step_px * 0.5 * (low - high) / curvature
    noise = np.maximum(least, EDGE.min_misfit) / (3 * used.sum())
    independent = EDGE.sample_px  # neighbouring samples are of one pixel
    sds = np.sqrt(2 * noise / independent * EDGE.step_px**2 / curvature)
    centers = foot[:cut].reshape(blocks, EDGE.block_px, 2).mean(1)[whole]
    edge_places = centers - shift[:, None] * line[:2]
    return edge_places[inner], sds[inner], noise[inner]


@lru_cache(maxsize=256)
def _profile_bases(radius_px: float, blur: float) -> tuple[np.ndarray, np.ndarray]:
    """Orthonormal profiles [E, U, K] that an edge at each candidate may have, and which samples count [U].

    They span four, blurred: tissue, tissue that changes linearly towards the edge (a shadow), the shaft, and the shaft
    lit by a lamp at the lens, sqrt(1 - t^2) of the share t of its radius.
    """
    used = (-max(EDGE.max_radius_share * radius_px, 2.0) <= OFFSETS).astype(float)
    fine = np.arange(-EDGE.inside_px - 5, EDGE.outside_px + 5, EDGE.fine_px)
    reach = np.arange(-4 * blur, 4 * blur + EDGE.fine_px / 2, EDGE.fine_px)
    kernel = np.exp(-0.5 * (reach / blur) ** 2)
    kernel /= kernel.sum()
    bases = []
    for edge in CANDIDATES:
        beyond = fine - edge
        shaft = (beyond < 0).astype(float)
        lit = np.sqrt(np.clip(1 - (1 + beyond / max(radius_px, 3.0)) ** 2, 0, None)) * shaft
        parts = (1 - shaft, (1 - shaft) * beyond, shaft, lit)
        columns = [np.interp(OFFSETS, fine, np.convolve(part, kernel, "same")) * used for part in parts]
        bases.append(np.linalg.qr(np.stack(columns, 1))[0])
    return np.stack(bases), used


def axis_coordinates(axes: ShaftAxes, frame: int, pixels: np.ndarray, intrinsics: Intrinsics) -> np.ndarray:
    """Coordinates [N] mm along a frame's axis, from its point, nearest to the rays of pixels [N, 2]."""
    fx, fy, cx, cy = intrinsics
    rays = unit(np.stack([(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy, np.ones(len(pixels))], 1))
    return places_nearest_to_rays(axes.points[frame], axes.directions[frame], rays)


def shaft_ends(images: np.ndarray, masks: np.ndarray, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Coordinates [F] px along lines, through `points` [F, 2] px along unit `directions` [F, 2] towards the tip, where
    the shaft ends in the masks [F, h, w] of images uint8 [F, h, w, 3]. NaN where it does not end within the mask, or
    the line is NaN; in all frames, where the colours of shaft and head are similar."""
    assert images.shape[1:3] == masks.shape[1:3]
    frames = [frame for frame in np.flatnonzero(np.isfinite(points[:, 0])) if masks[frame].any()]
    ends = np.full(len(images), np.nan)
    if not frames:
        return ends
    seen = {}
    for frame in frames:
        v, u = np.nonzero(masks[frame])
        along = (np.stack([u, v], 1) + 0.5 - points[frame]) @ directions[frame]
        seen[frame] = _tints(images[frame][v, u]), along, float(along.min()), float(along.max())
    lengths = np.array([seen[frame][3] - seen[frame][2] for frame in frames])
    ranked = np.argsort(-lengths)[: max(1, round(EDGE.long_share * len(frames)))]
    shaft, head = [], []
    for frame in (frames[i] for i in ranked):
        colors, along, first, last = seen[frame]
        shaft.append(colors[along < first + EDGE.shaft_share * (last - first)])
        head.append(colors[along > last - EDGE.head_share * (last - first)])
    difference = 0.0
    for _ in range(EDGE.n_rounds):
        colors = np.concatenate([*shaft, *head])
        is_shaft = np.arange(len(colors)) < sum(map(len, shaft))
        odds = np.clip(color_odds(colors, is_shaft, ~is_shaft), -EDGE.max_odds, EDGE.max_odds)
        shaft, head = [], []
        for frame in frames:
            tints, along, first, last = seen[frame]
            bins = np.floor(along - first).astype(int)
            count = np.bincount(bins)
            mean = np.bincount(bins, odds[tints]) / np.maximum(count, 1)
            # maximum likelihood of the colours of all points
            gained = np.concatenate([[0.0], np.cumsum(mean)])
            best = int(gained.argmax())
            ends[frame] = first + best
            shaft.append(tints[along < ends[frame] - EDGE.end_margin_px])
            head.append(tints[along > ends[frame] + EDGE.end_margin_px])
        if not any(map(len, shaft)) or not any(map(len, head)):
            return np.full(len(images), np.nan)
        difference = float(odds[np.concatenate(shaft)].mean() - odds[np.concatenate(head)].mean())
    for frame in frames:
        _, _, first, last = seen[frame]
        if not first + EDGE.border_px < ends[frame] < last - EDGE.border_px:
            ends[frame] = np.nan
    return ends if difference > EDGE.min_contrast else np.full(len(images), np.nan)


def _tints(pixels: np.ndarray) -> np.ndarray:
    """Colours [N] of pixels uint8 [N, 3], numbered as by `color_levels`, but by tints, which separate greys, and
    lightness."""
    red, green, blue = np.log(pixels.astype(np.float64) + EDGE.dark).T
    light = (red + green + blue) / 3
    level = [
        np.clip((value - low) / (high - low) * MASKS.levels, 0, MASKS.levels - 1).astype(np.int64)
        for value, (low, high) in zip((red - green, green - blue, light), EDGE.tint_ranges, strict=True)
    ]
    return np.asarray((level[0] * MASKS.levels + level[1]) * MASKS.levels + level[2])
