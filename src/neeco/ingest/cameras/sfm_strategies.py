"""Strategies of structure from motion, tried in turn; the choice of a result, and the reasons when none is good."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace

import cv2
import numpy as np

from neeco.base.errors import NeecoError
from neeco.geometry.lens import Lens

FIELDS_OF_VIEW = (70.0, 100.0)  # degrees across the round image of laparoscopes, and of wide ones
MIN_FIELD_OF_VIEW, MAX_FIELD_OF_VIEW = 30.0, 140.0  # degrees, of an estimated lens
MAX_DISTORTION = 0.35  # share of its radius by which an estimated lens shifts the farthest pixel
COMPLETE_SHARE = 0.9  # share of the keyframes that ends the search
RANK_STEP = 0.05  # share of the keyframes by which one attempt outranks another whatever its error
MAX_ERROR_PX = 2.5  # mean reprojection error
MIN_PARALLAX_DEG = 1.0  # degrees between the views of a point

STILL_SHARE = 0.02  # of the image's width, by which features of a still scope move (tissue breathes)
HOMOGRAPHY_SHARE = 0.004  # of the image's width: inlier threshold of a homography
MIN_EXPLAINED = 0.9  # share of the epipolar inliers that a homography explains without parallax
MIN_MATCHES, MIN_PAIRS = 30, 5  # of features, and of views


@dataclass(frozen=True)
class Strategy:
    """A strategy. words: its description; focal: px where the estimate begins, 0 for a given lens; free_lens: estimated
    with each frame added, not held until the keyframes are mapped; first_angle: degrees between the first two frames;
    several_models: begin again where a model ends; global_mapping: all frames at once; dense: from more features."""

    words: str
    focal: float = 0.0
    _: KW_ONLY
    free_lens: bool = False
    first_angle: float = 6.0
    several_models: bool = False
    global_mapping: bool = False
    dense: bool = False


@dataclass(frozen=True)
class Attempt:
    """Result of a strategy. models: keyframes in each model, the largest first, which the rest describes; error: px;
    parallax: median degrees between the views of a point; fault: why it is not used, in words, or empty."""

    strategy: Strategy
    keyframes: int
    _: KW_ONLY
    models: tuple[int, ...] = ()
    focal: float = 0.0
    distortion: float = 0.0
    points: int = 0
    error: float = 0.0
    parallax: float = 0.0
    fault: str = ""

    @property
    def placed(self) -> int:
        """Keyframes of the largest model."""
        return self.models[0] if self.models else 0

    @property
    def complete(self) -> bool:
        """Whether nothing is gained by trying further."""
        return not self.fault and self.placed >= COMPLETE_SHARE * self.keyframes

    def sentence(self) -> str:
        """Describe the attempt and its result."""
        if self.fault:
            return f"{self.strategy.words}: {self.fault}"
        lens = f", focal length {self.focal:.0f} px" if self.strategy.focal else ""
        return (
            f"{self.strategy.words}: {self.placed} of {self.keyframes} keyframes placed, {self.error:.2f} px, "
            f"{self.parallax:.1f} degrees of parallax{lens}"
        )


def strategies(radius: float | None) -> tuple[Strategy, ...]:
    """Return what to try, the likeliest first. radius: px from the image's middle to its farthest visible pixel; None
    where the lens is given."""
    if radius is None:
        dense = Strategy("with more features", first_angle=3.0, several_models=True, dense=True)
        return (
            Strategy("with the lens given"),
            Strategy("from other first frames, less far apart", first_angle=3.0, several_models=True),
            Strategy("all frames at once", global_mapping=True),
            dense,
        )
    likely, wide = (radius / math.tan(math.radians(angle) / 2) for angle in FIELDS_OF_VIEW)
    return (
        Strategy(f"beginning with a lens that sees {FIELDS_OF_VIEW[0]:.0f} degrees", likely),
        Strategy(f"beginning with a lens that sees {FIELDS_OF_VIEW[1]:.0f} degrees", wide),
        Strategy(
            "with the lens estimated from the first frames on",
            likely,
            free_lens=True,
            first_angle=4.0,
            several_models=True,
        ),
        Strategy("all frames at once", likely, global_mapping=True),
        Strategy("with more features", likely, first_angle=3.0, several_models=True, dense=True),
    )


def judge(attempt: Attempt, size: tuple[int, int], least: int) -> Attempt:
    """Return the attempt with its fault, if it has one. size: of the images; least: frames that a capture needs."""
    fault = ""
    if not attempt.models:
        fault = "no first pair of frames fits"
    elif attempt.placed < min(least, attempt.keyframes):
        fault = f"ends after {attempt.placed} of {attempt.keyframes} keyframes"
    elif attempt.points == 0:
        fault = "finds no point of the tissue"
    elif attempt.parallax < MIN_PARALLAX_DEG:
        fault = f"the views of a point differ by {attempt.parallax:.1f} degrees only: its depth is not known"
    elif attempt.error > MAX_ERROR_PX:
        fault = f"points are off by {attempt.error:.1f} px on average"
    elif attempt.strategy.focal:
        fault = _lens_fault(attempt, size)
    return replace(attempt, fault=fault)


def _lens_fault(attempt: Attempt, size: tuple[int, int]) -> str:
    half = math.hypot(*size) / 2
    sees = 2 * math.degrees(math.atan(half / attempt.focal)) if attempt.focal > 0 else 180.0
    bends = abs(attempt.distortion) * (half / max(attempt.focal, 1e-9)) ** 2
    if not MIN_FIELD_OF_VIEW <= sees <= MAX_FIELD_OF_VIEW:
        return f"ends at a focal length of {attempt.focal:.0f} px, which no endoscope has"
    if bends > MAX_DISTORTION:
        return f"ends at a radial distortion of {attempt.distortion:.2f}, which no endoscope has"
    try:
        estimated_lens(attempt.focal, attempt.distortion, size).pinhole(size)
    except NeecoError:
        return f"ends at a radial distortion of {attempt.distortion:.2f}, which folds the image over"
    return ""


def estimated_lens(focal: float, distortion: float, size: tuple[int, int]) -> Lens:
    """A lens of one focal length px, one radial term (k1), and the principal point in the middle: more cannot be
    estimated from a video of tissue that moves."""
    return Lens(focal, focal, size[0] / 2, size[1] / 2, (distortion, 0.0, 0.0, 0.0))


def best_attempt(attempts: Sequence[Attempt]) -> Attempt | None:
    """Return the attempt without a fault that places most keyframes (in steps of RANK_STEP), then fits best, then has
    most parallax; the earlier of equals. None when all have a fault."""
    usable = [attempt for attempt in attempts if not attempt.fault]

    def rank(attempt: Attempt) -> tuple[int, float, float]:
        return round(attempt.placed / attempt.keyframes / RANK_STEP), -attempt.error, attempt.parallax

    return max(usable, key=rank, default=None)


def motion_fault(matches: np.ndarray, width: int) -> str:
    """Explain why there is no parallax, where the features that match between views show it; else return nothing.

    matches [N, 5]: number of the pair of views, x, y, x', y' px. A homography explains all of two views from one place
    (Hartley & Zisserman 2004, section 13.6), and of a plane.
    """
    moved, explained = [], []
    for pair in np.unique(matches[:, 0]):
        first, second = np.split(matches[matches[:, 0] == pair, 1:], 2, axis=1)
        if len(first) < MIN_MATCHES:
            continue
        _, by_homography = cv2.findHomography(first, second, cv2.RANSAC, HOMOGRAPHY_SHARE * width)
        _, by_any = cv2.findFundamentalMat(first, second, cv2.FM_RANSAC, HOMOGRAPHY_SHARE * width / 2)
        rotated, counted = (np.zeros(len(first)) if fit is None else fit.ravel() for fit in (by_homography, by_any))
        if max(rotated.sum(), counted.sum()) < MIN_MATCHES / 2:
            continue
        explained.append(rotated.sum() / max(rotated.sum(), counted.sum()))
        moved.append(np.median(np.linalg.norm(second - first, axis=1)[rotated > 0]) if rotated.any() else math.inf)
    if len(moved) < MIN_PAIRS:
        return ""
    if np.quantile(moved, 0.9) < STILL_SHARE * width:
        return "the scope seems to stand still"
    if np.median(explained) > MIN_EXPLAINED:
        return "the scope seems only to turn or zoom where it stands"
    return ""
