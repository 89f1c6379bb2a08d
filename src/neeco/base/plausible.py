"""Limits of plausible cameras, joints, times, masks and frame counts, for all file readers and the Python API.

Each function returns a fault and its remedy, or None. Poses: `neeco.geometry.rotations.rigid_fault`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

Fault = tuple[str, str]  # what is wrong, what to do


@dataclass(frozen=True, kw_only=True)
class PlausibleLimits:
    """Limits of plausible values."""

    max_size_px: int = 65_535  # px along a side of an image
    min_focal: float = 0.1  # focal length of any lens, in lengths of the image's longer side
    max_focal: float = 50.0  # the same, at most
    max_anamorphic: float = 2.5  # ratio of the two focal lengths: single fields of interlaced video have 2
    # of the sides, distance of a principal point from the middle by a lens's own tolerances
    max_off_middle: float = 0.08
    max_middle_error: float = 0.03  # of the sides, the same after scaling intrinsics of another image size
    full_turn: float = 2 * math.pi  # rad; maximum of a joint without stated limits
    max_slide_mm: float = 1000.0  # mm; maximum of a sliding joint without stated limits
    limit_tolerance: float = 1e-3  # rad (mm of sliding joints) by which rounding and noise may exceed a limit
    max_time_s: float = 1e10  # s, beyond any Unix time of a clock
    few_train_frames: int = 20  # number below which results are poor
    max_hidden: float = 0.5  # share of the lit pixels of most images that a loss mask may hide
    max_points_hidden: float = 0.8  # share of the projected sparse points that loss masks may hide


PLAUSIBLE = PlausibleLimits()


def size_fault(width: float, height: float) -> Fault | None:
    """Check the size of an image, px."""
    sides = (width, height)
    if not all(math.isfinite(side) and side % 1 == 0 and 1 <= side <= PLAUSIBLE.max_size_px for side in sides):
        return f"image size {width:g} x {height:g} is not usable", "give whole numbers of pixels"
    return None


def focal_fault(fx: float, fy: float, width: float, height: float) -> Fault | None:
    """Check focal lengths in px on an image of width x height px."""
    if not all(math.isfinite(focal) and focal > 0 for focal in (fx, fy)):
        return f"focal lengths {fx:g} and {fy:g} px are not positive numbers", "give them in pixels"
    fits = all(PLAUSIBLE.min_focal < focal / max(width, height) < PLAUSIBLE.max_focal for focal in (fx, fy))
    if not fits or max(fx, fy) > PLAUSIBLE.max_anamorphic * min(fx, fy):
        message = f"focal lengths {fx:g} and {fy:g} px fit no lens on a {width:g}x{height:g} image"
        return message, "give them in pixels of this image (not in mm, nor as shares of its size)"
    return None


def camera_fault(fx: float, fy: float, cx: float, cy: float, width: float, height: float, near: float) -> Fault | None:
    """Check a camera's numbers, px and mm; its image may be cropped from a larger one, or enlarged."""
    if (fault := size_fault(width, height)) is not None:
        return fault
    if not all(math.isfinite(number) and number > 0 for number in (fx, fy, near)):
        return f"fx, fy, near: {fx:g} px, {fy:g} px, {near:g} mm are not all positive and finite", "correct them"
    if not all(math.isfinite(number) for number in (cx, cy)):
        return f"cx, cy: {cx:g} and {cy:g} px are not finite", "correct them"
    return None


def center_fault(cx: float, cy: float, width: float, height: float) -> Fault | None:
    """Check a principal point in px on an image of width x height px."""
    if 0 < cx < width and 0 < cy < height:  # NaN compares false
        return None
    return f"principal point ({cx:g}, {cy:g}) lies outside the {width:g}x{height:g} image", "give it in pixels of it"


def other_size_fault(cx: float, cy: float, width: float, height: float) -> Fault | None:
    """Check whether one factor brings a principal point far from the middle there: intrinsics of another image size."""
    scale = cx / width + cy / height  # of the image whose middle it is
    off = 2 * PLAUSIBLE.max_middle_error * scale
    if abs(scale - 1) <= 2 * PLAUSIBLE.max_off_middle or abs(cx / width - cy / height) > off:
        return None
    message = (
        f"principal point ({cx:g}, {cy:g}) is the middle of a {width * scale:.0f}x{height * scale:.0f} image, not of "
        f"this {width:g}x{height:g} one: intrinsics of another image size"
    )
    return message, f"scale them by {1 / scale:.3g}, or give this image's (right where images are cropped)"


def time_fault(time: float) -> Fault | None:
    """Check a time in s."""
    if abs(time) <= PLAUSIBLE.max_time_s:  # NaN compares false
        return None
    return f"is {time:g} s", "give seconds (not milli- or nanoseconds)"


def exceeds_limits(value: float, limits: tuple[float, float] | None) -> bool:
    """Return True if a joint's value exceeds its limits by more than rounding."""
    slack = PLAUSIBLE.limit_tolerance
    return limits is not None and not limits[0] - slack <= value <= limits[1] + slack


def joint_fault(value: float, limits: tuple[float, float] | None, slides: bool, slack: float = 0.0) -> Fault | None:
    """Check a joint's value, rad, or mm of a sliding joint. slack: share of its range by which it may exceed that."""
    unit = "mm" if slides else "rad"
    if not math.isfinite(value):
        return f"is {value:g}, not a finite number", f"give it in {unit}"
    if limits is not None:
        room = slack * (limits[1] - limits[0]) if slack else 0.0
        limits = limits[0] - room, limits[1] + room
        message = f"is {value:g} {unit}, outside its limits {limits[0]:g} .. {limits[1]:g}"
        remedy = "repair the reading or the limits" if slides else "repair the reading (radians?) or the limits"
        return (message, remedy) if exceeds_limits(value, limits) else None
    if abs(value) > (PLAUSIBLE.max_slide_mm if slides else PLAUSIBLE.full_turn) * (1 + slack):
        if slides:
            return f"is {value:g} mm, farther than any instrument slides", "give mm, or state the joint's limits"
        remedy = "give radians; state the joint's limits in the header if it does turn that far"
        return f"is {value:g} rad, more than a full turn: degrees?", remedy
    return None


def mask_fault(pixels: float, points: float | None) -> Fault | None:
    """Check loss masks by the shares that they hide: of the lit pixels in most images, and of the projected sparse
    points (None: there are none)."""
    hides = []
    if pixels > PLAUSIBLE.max_hidden:
        hides.append(f"{pixels:.0%} of most images")
    if points is not None and points > PLAUSIBLE.max_points_hidden:
        hides.append(f"{points:.0%} of the sparse points in view")
    if not hides:
        return None
    return f"loss masks hide {' and '.join(hides)}: inverted polarity?", "black is ignored by the loss: invert them"
