"""How far along its line an instrument is in every image, from what is painted on it: where a shaft ends in a wrist, a
band, a screw.

Outlines tell little of that, and what moves ends where jaws end, which open. Colours along the line of the instrument,
as a first fit has it, are the same in all frames but for light; how far each frame's are shifted against those of all
is what the fit is off there.
"""

from __future__ import annotations

import warnings
from dataclasses import replace

import cv2
import numpy as np

from neeco.geometry.projection import project
from neeco.ingest.registration.base_fit import FRONT
from neeco.ingest.registration.base_shape import NEAREST, Fit, Problem, surface_points

STEP_PX = 1.0  # between the places where colours are looked at
SIDES = (-0.7, -0.35, 0.0, 0.35, 0.7)  # rad about the line, from the side that faces the camera
REACH_PX = 14.0  # by which a first fit may be off
NOISE = 0.04  # of the logarithm of a colour
DARK = 12.0  # of 255, added before logarithms are taken
ROUNDS = 5
MARKED = 0.5  # of the frames, that must tell something
ENOUGH = 0.6  # of what is compared, that a frame must show
CERTAIN_PX = 1.0  # standard deviation from which a frame's shift tells nothing


def with_marks(problem: Problem, fit: Fit) -> tuple[Problem, Fit]:
    """The problem, and the fit, with what its images tell of how far along its line the instrument is; unchanged where
    most of them tell nothing."""
    if problem.images is None:
        return problem, fit
    fx = problem.seen.intrinsics[0]
    depth = np.median(
        (problem.camera_from_world @ fit.world_from_base)[:, 2, :3] @ problem.middle
        + (problem.camera_from_world @ fit.world_from_base)[:, 2, 3]
    )
    step = STEP_PX * float(depth) / fx  # mm
    behind = np.arange(FRONT * fit.stations[-1], fit.stations[-1], step)
    colors = _profiles(problem, fit, problem.images, behind)
    shifts, certainty, weights = _align(colors, round(REACH_PX / STEP_PX))
    place = float((weights * behind).sum() / max(weights.sum(), 1e-12))
    at = place + shifts[:, None] * step
    x, y = project(surface_points(problem, fit, at)[:, 0], *problem.seen.intrinsics, nearest=NEAREST)
    sd = certainty * STEP_PX
    places = np.where((sd < CERTAIN_PX)[:, None], np.stack([x, y], -1), np.nan)
    if np.isfinite(places[:, 0]).mean() < MARKED:
        return replace(problem, marks=None), fit
    return replace(problem, marks=places), replace(fit, mark=place)


def _profiles(problem: Problem, fit: Fit, images: np.ndarray, behind: np.ndarray) -> np.ndarray:
    """Logarithms of colours [F, K, 3] along the line, NaN where a frame's mask does not show the instrument."""
    found, count = [], np.zeros((len(images), len(behind)))
    for side in SIDES:
        x, y = project(surface_points(problem, fit, behind, side), *problem.seen.intrinsics, nearest=NEAREST)
        inside = problem.seen.inside(x, y, margin=1.0)
        inside &= problem.seen.look_up(x, y)[0] > 0
        sampled = np.stack([
            cv2.remap(image, (column - 0.5).astype(np.float32)[None], (row - 0.5).astype(np.float32)[None],
                      cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0]
            for image, column, row in zip(images, x, y, strict=True)
        ])  # fmt: skip
        found.append(np.where(inside[..., None], np.log(sampled.astype(np.float64) + DARK), 0.0))
        count += inside
    colors = np.sum(found, 0) / np.maximum(count, 1)[..., None]
    return np.where((count > len(SIDES) / 2)[..., None], colors, np.nan)


def _align(colors: np.ndarray, reach: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """By how many places each of the profiles [F, K, 3] is shifted against all of them [F], standard deviations of that
    [F] (inf: not told), and how much each place [K] tells."""
    frames = len(colors)
    shifts = np.zeros(frames)
    grid = np.arange(-reach, reach + 1)
    certainty = np.full(frames, np.inf)
    for _ in range(ROUNDS):
        moved = _shifted(colors, shifts)
        shown = np.isfinite(moved[..., 0])
        template, variance = _common(moved, shown)
        used = shown.mean(0) > 0.4
        weight = np.where(used, 1 / (variance + NOISE**2), 0.0)  # [K]
        inner = used & np.roll(used, 1) & np.roll(used, -1)
        inner[[0, -1]] = False
        tells = weight * np.square(np.where(inner[:, None], np.gradient(template, axis=0), 0.0)).sum(-1)
        costs = np.full((frames, len(grid)), np.inf)
        for column, shift in enumerate(grid):
            other = _shifted(colors, shifts + shift)
            seen = np.isfinite(other[..., 0]) & used
            w = weight * seen
            total = w.sum(1)
            off = np.where(seen[..., None], other - template, 0.0)
            off = off - ((w[..., None] * off).sum(1) / np.maximum(total, 1e-9)[:, None])[:, None]
            cost = (w[..., None] * np.where(seen[..., None], off, 0.0) ** 2).sum((1, 2)) / np.maximum(total, 1e-9)
            enough = (tells * seen).sum(1) > ENOUGH * tells.sum()
            costs[:, column] = np.where(enough, cost, np.inf)
        best = costs.argmin(1)
        middle = np.clip(best, 1, len(grid) - 2)
        rows = np.arange(frames)
        low, here, high = costs[rows, middle - 1], costs[rows, middle], costs[rows, middle + 1]
        with np.errstate(invalid="ignore"):  # where too little of a frame can be compared
            curve = low - 2 * here + high
        good = np.isfinite(curve) & (curve > 1e-12) & (best == middle)
        with np.errstate(invalid="ignore", divide="ignore"):
            move = np.where(good, grid[middle] + np.clip(0.5 * (low - high) / curve, -1, 1), 0.0)
            # a misfit of `here` per place, of which neighbours are alike over some px
            independent = np.maximum(1.0, used.sum() / 4)
            certainty = np.where(good, np.sqrt(2 * here / np.maximum(curve, 1e-12) / independent), np.inf)
        shifts = shifts + move
        shifts = shifts - np.median(shifts[good]) if good.any() else shifts
    return shifts, certainty, tells


def _shifted(colors: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """Profiles read so many places further on [F], between places linear; NaN beyond their ends."""
    frames, places, _ = colors.shape
    at = np.arange(places) + shifts[:, None]
    low = np.floor(at).astype(int)
    share = (at - low)[..., None]
    outside = (low < 0) | (low + 1 >= places)
    low = np.clip(low, 0, places - 2)
    rows = np.arange(frames)[:, None]
    out = (1 - share) * colors[rows, low] + share * colors[rows, low + 1]
    return np.where(outside[..., None], np.nan, out)


def _common(profiles: np.ndarray, shown: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The profile [K, 3] that most frames agree on but for brightness, and how much they vary about it [K]."""
    offsets = np.zeros((len(profiles), 1, 3))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a place that no frame shows has no median
        for _ in range(3):
            template = np.nanmedian(profiles - offsets, axis=0)
            offsets = np.nan_to_num(np.nanmedian(profiles - template, axis=1, keepdims=True))
        rest = np.where(shown[..., None], profiles - offsets - template, np.nan)
        variance = np.square(1.48 * np.nanmedian(np.abs(rest), axis=0)).mean(-1)
    return np.nan_to_num(template), np.nan_to_num(variance, nan=1e6)
