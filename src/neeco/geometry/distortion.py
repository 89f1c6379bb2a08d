"""Lens distortion: OpenCV's models, and the round border of an endoscope's field of view."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from neeco.geometry.camera import Camera


@dataclass(frozen=True, kw_only=True)
class DistortionSettings:
    """Tolerances and steps of undistortion."""

    max_slope: float = 3.0  # maximum slope of a ray that a lens may project into the image (72 degrees)
    max_miss_px: float = 0.05  # maximum error of a ray's distorted position
    n_newton_steps: int = 6  # maximum number of Newton steps
    node_spacing_px: int = 4  # spacing of pixels with computed rays; others are interpolated, accurate to 0.01 px
    derivative_step: float = 1e-6  # slope over which the derivative of a distortion is taken


DISTORTION = DistortionSettings()


class LensField(NamedTuple):
    """Rays that a camera observes through its lens."""

    slopes: np.ndarray  # float32 [H, W, 2]: x/z, y/z of the ray of every pixel; NaN without a ray
    lowest: np.ndarray  # [2] minima of the slopes
    highest: np.ndarray


def distorted(slopes: np.ndarray, distortion: tuple[float, ...]) -> np.ndarray:
    """Distort slopes [P, 2] (x/z, y/z) by OpenCV's coefficients k1, k2, p1, p2[, k3, ...]."""
    if not len(slopes) or not any(distortion):
        return slopes
    points = np.concatenate([slopes, np.ones((len(slopes), 1))], 1)
    pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.array(distortion))[0]
    return np.asarray(pixels[:, 0])


def undistorted(slopes: np.ndarray, distortion: tuple[float, ...]) -> np.ndarray:
    """Invert `distorted` by Newton's method; the result is arbitrary for pixels without a ray.

    cv2.undistortPoints stops after five steps, each of which gains one digit at most.
    """
    if not len(slopes) or not any(distortion):
        return slopes
    estimate = slopes.astype(np.float64)
    with np.errstate(all="ignore"):
        for _ in range(DISTORTION.n_newton_steps):
            projected = distorted(estimate, distortion)
            (a, c), (b, d) = (
                (
                    (distorted(estimate + DISTORTION.derivative_step * axis, distortion) - projected)
                    / DISTORTION.derivative_step
                ).T
                for axis in np.eye(2)
            )  # columns of the Jacobian
            x, y = (slopes - projected).T
            estimate = estimate + (np.stack([d * x - b * y, a * y - c * x]) / (a * d - b * c)).T
            estimate = np.clip(np.nan_to_num(estimate), -2 * DISTORTION.max_slope, 2 * DISTORTION.max_slope)
    return estimate


def pixels_of_rays(slopes: np.ndarray, camera: Camera) -> np.ndarray:
    """Return pixels [P, 2] of rays of slopes [P, 2] through the lens of `camera`; NaN outside its field."""
    field = lens_field(camera)
    margin = 1 / camera.fx  # to the edges of the outermost pixels
    with np.errstate(invalid="ignore"):
        inside = ((slopes > field.lowest - margin) & (slopes < field.highest + margin)).all(1)
    pixels = np.full(slopes.shape, np.nan)
    pixels[inside] = distorted(slopes[inside], camera.distortion) * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    return pixels if camera.border is None else np.where(within(pixels, camera.border)[:, None], pixels, np.nan)


def rays_of_pixels(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """Return slopes [P, 2] (x/z, y/z) of the rays that `camera` observes at pixels [P, 2] through its lens."""
    return undistorted((pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy], camera.distortion)


def within(pixels: np.ndarray, border: tuple[float, float, float]) -> np.ndarray:
    """Mask [...] bool of pixels [..., 2] within a round border (centre x, y and radius, px)."""
    x, y, radius = border
    return np.hypot(pixels[..., 0] - x, pixels[..., 1] - y) < radius


def field_pinhole(camera: Camera) -> Camera:
    """Return the pinhole camera of the same pose, focal lengths and pixel grid whose image covers the whole field of
    view of `camera` through its lens, undistorted."""
    if camera.is_pinhole:
        return camera
    field = lens_field(camera)
    focal, center = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    left, top = np.floor(field.lowest * focal + center).astype(int) - 1
    right, bottom = np.ceil(field.highest * focal + center).astype(int) + 1
    return replace(
        camera,
        cx=camera.cx - float(left),
        cy=camera.cy - float(top),
        width=int(right - left),
        height=int(bottom - top),
        distortion=(),
        border=None,
    )


def lens_field(camera: Camera) -> LensField:
    """Return the rays that `camera` observes through its lens. The arrays are cached and must not be modified."""
    intrinsics = camera.fx, camera.fy, camera.cx, camera.cy
    return _lens_field(intrinsics, camera.width, camera.height, camera.distortion, camera.border)


@lru_cache(maxsize=4)
def _lens_field(
    intrinsics: tuple[float, float, float, float],
    width: int,
    height: int,
    distortion: tuple[float, ...],
    border: tuple[float, float, float] | None,
) -> LensField:
    focal, center = np.array(intrinsics[:2]), np.array(intrinsics[2:])
    nodes = _centers(
        width // DISTORTION.node_spacing_px + 2, height // DISTORTION.node_spacing_px + 2, DISTORTION.node_spacing_px
    )
    slopes = undistorted((nodes.reshape(-1, 2) - center) / focal, distortion)
    again = distorted(slopes, distortion) * focal + center
    valid = (np.abs(slopes) <= DISTORTION.max_slope).all(1) & (
        np.abs(again - nodes.reshape(-1, 2)) < DISTORTION.max_miss_px
    ).all(1)
    slopes = np.where(valid[:, None], slopes, np.nan).reshape(nodes.shape).astype(np.float32)
    slopes = _between(_between(slopes, height).transpose(1, 0, 2), width).transpose(1, 0, 2)
    if border is not None:
        slopes = np.where(within(_centers(width, height), border)[..., None], slopes, np.float32(np.nan))
    rays = slopes[~np.isnan(slopes[..., 0])]
    lowest, highest = (pick(rays, 0).astype(np.float64) if len(rays) else np.zeros(2) for pick in (np.min, np.max))
    return LensField(np.ascontiguousarray(slopes), lowest, highest)


def _centers(width: int, height: int, step: int = 1) -> np.ndarray:
    """Centres [height, width, 2] of an image's pixels, or of every `step`-th."""
    rows, columns = np.mgrid[0:height, 0:width] * step + 0.5
    return np.stack([columns, rows], -1)


def _between(nodes: np.ndarray, count: int) -> np.ndarray:
    """Interpolate [count, ...] linearly between nodes [N, ...] `node_spacing_px` apart; NaN next to NaN nodes."""
    place, rest = np.divmod(np.arange(count), DISTORTION.node_spacing_px)
    share = (rest / np.float32(DISTORTION.node_spacing_px)).astype(np.float32)[:, None, None]
    return (1 - share) * nodes[place] + share * nodes[place + 1]
