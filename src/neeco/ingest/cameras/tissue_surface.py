"""Depth of the tissue behind a still scope: from a second camera, else from the instruments in front of it.

One camera observes no depth. A second one permits semi-global matching of the two backgrounds (Hirschmueller 2008).
Otherwise the tissue is behind every recorded position of an instrument: the surface is the smoothest one with this
property. Surfaces are smooth in inverse depth, which is linear in the image for a plane.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from neeco.geometry.lens import Lens
from neeco.geometry.projection import project
from neeco.ingest.foreground.rough_shape import RoughShape


@dataclass(frozen=True, kw_only=True)
class SurfaceSettings:
    """Settings of the surface of tissue behind instruments."""

    spacing_px: int = 3  # px of a reduced image between tissue points
    cell_px: int = 4  # px of a reduced image, cell size of the smoothing grid
    stiffness: float = 30.0  # weight of bending relative to a cell's measurement
    # depth of the tissue over that of an instrument, whose rough shape lacks what opens and closes
    behind_ratio: float = 1.5
    min_inverse_ratio: float = 0.75  # of the least inverse depth at which an instrument was
    pull_weight: float = 1e-3  # towards the instruments, in cells where the tissue may be deeper
    max_rounds: int = 30  # iterations of detecting instruments behind the surface
    min_depth_mm: float = 20.0  # minimum distance in mm of tissue from a stereo scope
    min_matched: float = 0.2  # minimum matched share of the image for depth from stereo
    max_features: int = 2000  # features of both backgrounds for epipolar geometry
    min_matches: int = 30  # of these features
    max_distance_ratio: float = 0.75  # ratio of descriptor distances, best to second best match (Lowe 2004)
    max_deviation: float = 0.15  # maximum relative deviation of a matched depth from its surroundings


SETTINGS = SurfaceSettings()


@dataclass(frozen=True)
class TissueSurface:
    """depth: [h, w] mm along z behind a reduced image's pixels; how: in words, after "the tissue's depth is"; measured:
    by a second camera."""

    depth: np.ndarray
    how: str
    measured: bool = False

    def points(self, colors: np.ndarray, pinhole: Lens, visible: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Return points [P, 3] mm, camera frame, all over the image and their colours uint8 [P, 3].

        colors: a background float32 [H, W, 3] of 255 through `pinhole`; visible: bool [H, W], where points may lie.
        """
        height, width = colors.shape[:2]
        scale = width / self.depth.shape[1]
        step = SETTINGS.spacing_px
        v, u = np.mgrid[step / 2 : self.depth.shape[0] : step, step / 2 : self.depth.shape[1] : step]
        u, v = u.ravel(), v.ravel()
        depth = self.depth[v.astype(int), u.astype(int)]
        x, y = np.minimum(u * scale, width - 0.5), np.minimum(v * scale, height - 0.5)
        row, column = y.astype(int), x.astype(int)
        valid = np.isfinite(depth) if visible is None else visible[row, column] & np.isfinite(depth)
        rays = np.stack([(x - pinhole.cx) / pinhole.fl_x, (y - pinhole.cy) / pinhole.fl_y, np.ones(len(x))], -1)
        return (rays * depth[:, None])[valid], np.rint(colors[row, column][valid]).astype(np.uint8)


def surface_behind(
    shapes: Iterable[tuple[RoughShape, np.ndarray]], pinhole: Lens, deepest: float | None, otherwise: float
) -> TissueSurface:
    """Estimate the tissue behind the instruments of a still scope.

    shapes: each rough shape with camera_from_instrument [N, 4, 4] mm of all frames; pinhole: of reduced images;
    deepest: mm of the tracked origins where no shape was found; None, or behind the camera: no instrument's place is
    known, and `otherwise` mm are assumed.
    """
    assert pinhole.size is not None
    width, height = pinhole.size
    columns, rows = -(-width // SETTINGS.cell_px), -(-height // SETTINGS.cell_px)
    nearest = np.zeros((rows, columns))  # greatest depth mm of the middle of an instrument in each cell; 0: none was
    for shape, poses in shapes:
        for pose in poses:
            points = shape.points @ pose[:3, :3].T + pose[:3, 3]
            x, y = project(points, *pinhole.intrinsics, nearest=1.0)
            with np.errstate(invalid="ignore"):
                column, row = np.floor(x / SETTINGS.cell_px), np.floor(y / SETTINGS.cell_px)
                inside = (points[:, 2] > 1) & (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
            cell = row[inside].astype(int) * columns + column[inside].astype(int)
            count = np.bincount(cell, minlength=nearest.size)
            total = np.bincount(cell, points[inside, 2], minlength=nearest.size)
            # the mean: observed from one side only, a rough shape reaches too far to the back and to the front
            nearest = np.maximum(nearest, (total / np.maximum(count, 1)).reshape(rows, columns))
    bound = nearest > 0
    if not bound.any():
        deepest = deepest if deepest is not None and deepest > 0 else None
        flat = (otherwise if deepest is None else SETTINGS.behind_ratio * deepest) * np.ones((height, width))
        source = (
            f"not known and taken to be {otherwise:.0f} mm, as nothing says where an instrument was"
            if deepest is None
            else f"not known; a plane well behind the deepest recorded pose ({deepest:.0f} mm) stands for it"
        )
        return TissueSurface(flat, source)
    # the inverse depths that bend least, nowhere above `most`, and near it, or near its minimum elsewhere: cells where
    # the surface would be in front of an instrument are constrained, until none is
    most = 1 / (SETTINGS.behind_ratio * np.where(bound, nearest, np.inf))
    least = most[bound].min()
    weight = np.full(most.shape, SETTINGS.pull_weight)
    for _ in range(SETTINGS.max_rounds):
        smooth = _smoothed(np.where(bound, most, least), weight)
        before = bound & (smooth > most * 1.001) & (weight < 1)
        if not before.any():
            break
        weight[before] = 1.0
    inverse = np.maximum(smooth, SETTINGS.min_inverse_ratio * least)  # beyond all that is known it may bend to infinity
    depth = 1 / cv2.resize(inverse, (width, height), interpolation=cv2.INTER_LINEAR)
    low, high = np.quantile(depth, (0.05, 0.95))
    source = f"not measured: a smooth surface well behind all places of the instruments ({low:.0f} to {high:.0f} mm)"
    return TissueSurface(depth, source)


def _smoothed(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return values [rows, columns] smoothed by their `weight`: a thin plate on springs."""
    rows, columns = values.shape
    step_across, step_down = (sparse.diags([-1.0, 1.0], [0, 1], shape=(side - 1, side)) for side in (columns, rows))
    bend_across, bend_down = (
        sparse.diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(side - 2, side)) for side in (columns, rows)
    )
    across, down = sparse.kron(sparse.eye(rows), bend_across), sparse.kron(bend_down, sparse.eye(columns))
    twist = sparse.kron(step_down, step_across)
    plate = across.T @ across + down.T @ down + 2 * twist.T @ twist
    system = sparse.diags(weight.ravel()) + SETTINGS.stiffness * weight.mean() * plate
    return np.asarray(spsolve(system.tocsc(), (weight * values).ravel())).reshape(rows, columns)


def surface_from_stereo(
    left: np.ndarray,
    right: np.ndarray,
    pinholes: tuple[Lens, Lens],
    right_from_left: np.ndarray,
    seen: np.ndarray,
    size: tuple[int, int],
) -> TissueSurface | None:
    """The tissue by which the backgrounds of two cameras, float32 [H, W, 3] of 255, match; None where too little does.

    pinholes: of these; right_from_left [4, 4] mm; seen: bool [H, W], where the left one shows tissue; size: (width,
    height) of reduced images.
    """
    depth = _matched_depth(left, right, pinholes, right_from_left)
    depth[~seen] = np.nan
    if np.isfinite(depth).mean() < SETTINGS.min_matched:
        return None
    columns, rows = -(-size[0] // SETTINGS.cell_px), -(-size[1] // SETTINGS.cell_px)
    inverse = np.full((rows, columns), np.nan)  # medians in cells of which half is known
    for row, band in enumerate(np.array_split(1 / depth, rows, axis=0)):
        for column, cell in enumerate(np.array_split(band, columns, axis=1)):
            finite = cell[np.isfinite(cell)]
            if 2 * len(finite) >= cell.size:
                inverse[row, column] = np.median(finite)
    for _ in range(2):  # what is far from its surroundings was matched wrongly
        weight = np.isfinite(inverse).astype(float)
        smooth = _smoothed(np.where(weight > 0, inverse, 0.0), weight)
        inverse[np.abs(inverse / smooth - 1) > SETTINGS.max_deviation] = np.nan
    filled = cv2.resize(smooth, size, interpolation=cv2.INTER_LINEAR)
    filtered = cv2.medianBlur(np.nan_to_num(depth, nan=0.0).astype(np.float32), 5)  # without single outliers
    fine = 1 / cv2.resize(np.where(filtered > 0, filtered, np.nan), size, interpolation=cv2.INTER_NEAREST)
    fine = np.where(np.abs(fine / filled - 1) < SETTINGS.max_deviation, fine, filled)
    share, far = float(weight.mean()), 1 / np.quantile(fine, (0.95, 0.05))
    return TissueSurface(
        1 / fine, f"from the stereo partner, {share:.0%} of the image ({far[0]:.0f} to {far[1]:.0f} mm)", True
    )


def epipolar_error(
    left: np.ndarray, right: np.ndarray, pinholes: tuple[Lens, Lens], right_from_left: np.ndarray
) -> float | None:
    """Return the median distance, px, of features of the right background from the epipolar lines of their matches in
    the left one, float32 [H, W, 3] of 255; None where too few match.

    It shows cameras that are turned against each other otherwise than stated, but no wrong baseline and no turn about
    the vertical, which only make the depth another one. pinholes, right_from_left as in `surface_from_stereo`.
    """
    sift: Any = cv2.SIFT.create(SETTINGS.max_features)
    (points, descriptors), (right_points, of_right) = (
        sift.detectAndCompute(cv2.cvtColor(np.clip(image, 0, 255).astype(np.uint8), cv2.COLOR_RGB2GRAY), None)
        for image in (left, right)
    )
    if descriptors is None or of_right is None or min(len(descriptors), len(of_right)) < SETTINGS.min_matches:
        return None
    pairs = cv2.BFMatcher().knnMatch(descriptors, of_right, k=2)
    good = [first for first, second in pairs if first.distance < SETTINGS.max_distance_ratio * second.distance]
    if len(good) < SETTINGS.min_matches:
        return None
    # OpenCV counts from the first pixel's centre
    seen = np.array([[*points[match.queryIdx].pt, *right_points[match.trainIdx].pt] for match in good]) + 0.5
    rays = [
        np.column_stack(
            [(seen[:, k] - lens.cx) / lens.fl_x, (seen[:, k + 1] - lens.cy) / lens.fl_y, np.ones(len(seen))]
        )
        for k, lens in zip((0, 2), pinholes, strict=True)
    ]
    normals = np.cross(right_from_left[:3, 3], rays[0] @ right_from_left[:3, :3].T)  # of the epipolar planes
    slopes = np.linalg.norm(normals[:, :2] / (pinholes[1].fl_x, pinholes[1].fl_y), axis=1)
    return float(np.median(np.abs((normals * rays[1]).sum(axis=1)) / np.maximum(slopes, 1e-12)))


def _matched_depth(
    left: np.ndarray, right: np.ndarray, pinholes: tuple[Lens, Lens], right_from_left: np.ndarray
) -> np.ndarray:
    """Depths [H, W] mm along the left camera's z, NaN where nothing matches."""
    height, width = left.shape[:2]
    matrices = [np.array([[p.fl_x, 0, p.cx - 0.5], [0, p.fl_y, p.cy - 0.5], [0, 0, 1]]) for p in pinholes]
    rotation, shift = right_from_left[:3, :3], right_from_left[:3, 3:]
    none = np.zeros(5)  # no distortion
    turn_left, turn_right, new_left, new_right, *_ = cv2.stereoRectify(
        matrices[0], none, matrices[1], none, (width, height), R=rotation, T=shift, alpha=0
    )
    views = []
    for image, matrix, turn, new in (
        (left, matrices[0], turn_left, new_left),
        (right, matrices[1], turn_right, new_right),
    ):
        maps = cv2.initUndistortRectifyMap(matrix, none, turn, new[:3, :3], (width, height), cv2.CV_32FC1)
        views.append(cv2.remap(np.clip(np.rint(image), 0, 255).astype(np.uint8), *maps, cv2.INTER_LINEAR))
    length = abs(float(new_right[0, 3]))  # focal length times baseline, px mm
    most = int(np.ceil(length / SETTINGS.min_depth_mm / 16)) * 16
    block = 5 if width < 800 else 7
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=most,
        blockSize=block,
        P1=8 * 3 * block**2,
        P2=32 * 3 * block**2,
        disp12MaxDiff=1,
        preFilterCap=31,
        uniquenessRatio=8,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    disparity = matcher.compute(views[0], views[1]).astype(np.float32) / 16
    with np.errstate(divide="ignore"):
        depth = np.where(disparity > 0, length / disparity, np.nan)
    # from the rectified camera's pixels back to the left one's: both see along rays through one centre
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(matrices[0]).T
    turned = rays @ turn_left.T
    x = turned[..., 0] / turned[..., 2] * new_left[0, 0] + new_left[0, 2]
    y = turned[..., 1] / turned[..., 2] * new_left[1, 1] + new_left[1, 2]
    warped = cv2.remap(
        depth.astype(np.float32), x.astype(np.float32), y.astype(np.float32), cv2.INTER_NEAREST, borderValue=np.nan
    )
    return np.asarray(warped / turned[..., 2])  # along the rectified z, then along the left camera's
