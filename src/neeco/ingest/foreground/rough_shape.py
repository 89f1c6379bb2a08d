"""Rough shape of an instrument, carved in its tracked frame from pixels that move, and its projection into every frame:
features on it must not hold up the cameras.

Unlike `methods/carving`, which needs a scene of the tissue, it serves before there are cameras to train one with.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation

from neeco.geometry.camera import Camera
from neeco.geometry.lens import Lens
from neeco.geometry.projection import project, project_world
from neeco.ingest.foreground.masks import FLOW
from neeco.ingest.frames.images import SfmResult


@dataclass(frozen=True, kw_only=True)
class RoughShapeSettings:
    """Settings of the search for a rough shape."""

    n_cells: int = 48  # cells of the carving grid, per side
    reach: float = 0.4  # half a side of that grid, share of the distance to the camera
    min_visible: float = 0.3  # minimum share of the frames with a point in view
    min_agreement: float = 0.3  # minimum share of the frames in which a point of the instrument lies on moving pixels
    # of the best point's evidence, for a point to belong to the instrument: flow bleeds over edges
    min_relative: float = 0.85
    lag_cells: int = 16  # cells of the grid for lags, per side
    lag_step_s: float = 0.1  # between lags that are tried
    max_lag_s: float = 60.0  # maximum lag that is tried
    min_known: float = 0.5  # minimum share of the frames with a pose at a lag
    lag_gain: float = 1.1  # minimum ratio of agreement to that at 0 and at all other lags
    lag_peak: float = 0.8  # share of the best agreement, from which a lag counts in the weighted mean
    lag_lobe_s: float = 0.5  # distance from the best lag within which lags count in it
    margin_px: int = 6  # margin about the projection of the shape
    nearest_mm: float = 1e-3  # minimum depth in front of the camera


ROUGH_SHAPE = RoughShapeSettings()


PosesAt = Callable[[float], tuple[np.ndarray, np.ndarray]]  # lag s -> poses [N, 4, 4] mm, bool [N] where known


@dataclass(frozen=True)
class RoughShape:
    """Points [K, 3] mm of an instrument in its tracked frame, the grid's spacing mm, and how often the images agree."""

    points: np.ndarray
    spacing: float
    agreement: float  # share of frames in which a point of it lies on moving pixels, [0, 1]


def carve_shapes(evidence: np.ndarray, tracked: Mapping[str, PosesAt], pinhole: Lens) -> dict[str, RoughShape]:
    """Carve the shapes of instruments by their poses in the camera's frame; see `carve_shape`."""
    shapes = {}
    for name, poses_at in tracked.items():
        poses, valid = poses_at(0.0)
        if (shape := carve_shape(evidence[valid], poses[valid], pinhole)) is not None:
            shapes[name] = shape
    return shapes


def carve_shape(evidence: np.ndarray, camera_from_instrument: np.ndarray, pinhole: Lens) -> RoughShape | None:
    """Carve the points of a grid about the tracked frame that lie on moving pixels most of the time they are in view.

    evidence [R, h, w] from `ResidualFlow.moving_pixels` (NaN: hidden), camera_from_instrument [R, 4, 4] mm. None when
    no point stands out: the instrument hardly moves, or its poses do not fit the cameras.
    """
    grid, spacing, share, enough = _agreement(evidence, camera_from_instrument, pinhole, ROUGH_SHAPE.n_cells)
    best = float(np.quantile(share[enough], 0.999)) if enough.any() else 0.0
    background = float(np.nanmean(evidence)) if not np.isnan(evidence).all() else 0.0
    if best < 2 * background or best < ROUGH_SHAPE.min_agreement:
        return None
    belongs = share > max(ROUGH_SHAPE.min_relative * best, 2 * background)
    return RoughShape(grid[belongs], spacing, best) if belongs.any() else None


def best_lag(evidence: np.ndarray, poses_at: PosesAt, pinhole: Lens, longest: float) -> float:
    """Lag s within +-longest (at most `max_lag_s`) at which poses explain motion clearly better than at 0 and at all
    others, else 0.

    evidence [R, h, w] as for `carve_shape`; poses_at(lag): camera_from_instrument [R, 4, 4] mm that the log has `lag` s
    later than its clock says, and bool [R] where it has one.
    """
    count = int(min(longest, ROUGH_SHAPE.max_lag_s) / ROUGH_SHAPE.lag_step_s)
    lags = ROUGH_SHAPE.lag_step_s * np.arange(-count, count + 1)
    scores = np.zeros(len(lags))
    for index, lag in enumerate(lags):
        poses, valid = poses_at(float(lag))
        if valid.sum() >= ROUGH_SHAPE.min_known * len(evidence):
            _, _, share, enough = _agreement(evidence[valid], poses[valid], pinhole, ROUGH_SHAPE.lag_cells)
            scores[index] = np.quantile(share[enough], 0.99) if enough.any() else 0.0
    return lag_of(scores)


def lag_of(scores: np.ndarray) -> float:
    """Return the lag s that agreements at 2 N + 1 lags, `lag_step_s` apart about 0, show. Those up to `lag_step_s` are
    not resolved, as agreement has a flat top: they are 0."""
    count = len(scores) // 2
    lags, best = ROUGH_SHAPE.lag_step_s * np.arange(-count, count + 1), float(scores.max())
    lobe = np.abs(lags - lags[scores.argmax()]) < ROUGH_SHAPE.lag_lobe_s
    rival = float(scores[~lobe].max(initial=0.0))  # motion that repeats fits at several lags
    if best < ROUGH_SHAPE.min_agreement or best < ROUGH_SHAPE.lag_gain * max(float(scores[count]), rival):
        return 0.0
    weights = np.clip(scores - ROUGH_SHAPE.lag_peak * best, 0, None) * lobe
    lag = float((weights * lags).sum() / weights.sum())
    return lag if abs(lag) > ROUGH_SHAPE.lag_step_s else 0.0


def _agreement(
    evidence: np.ndarray, camera_from_instrument: np.ndarray, pinhole: Lens, cells: int
) -> tuple[np.ndarray, float, np.ndarray, np.ndarray]:
    """A grid [G, 3] mm about the tracked frame, its spacing mm, the share [G] of the frames in which each of its points
    lies on moving pixels, and where [G] enough frames have it in view."""
    distance = float(np.median(camera_from_instrument[:, 2, 3])) if len(evidence) else 0.0
    if distance <= 0:
        return np.zeros((0, 3)), 0.0, np.zeros(0), np.zeros(0, dtype=bool)
    axis = np.linspace(-ROUGH_SHAPE.reach, ROUGH_SHAPE.reach, cells) * distance
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)  # [G, 3]
    total, visible = np.zeros(len(grid)), np.zeros(len(grid))
    for pixels, pose in zip(evidence, camera_from_instrument, strict=True):
        x, y, inside = _raster_cells(grid, pose, pinhole.intrinsics, pixels.shape)
        inside &= ~np.isnan(pixels[y, x])
        total[inside] += pixels[y[inside], x[inside]]
        visible += inside
    enough = visible > ROUGH_SHAPE.min_visible * len(evidence)
    share = np.where(enough, total / np.maximum(visible, 1), 0.0)
    return grid, float(axis[1] - axis[0]), share, enough


def project_mask(shape: RoughShape, camera_from_instrument: np.ndarray, camera: Camera) -> np.ndarray:
    """Pixels bool [H, W] that the shape may cover in the camera's image, with a margin."""
    small = (camera.height // FLOW.step_px + 1, camera.width // FLOW.step_px + 1)
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    x, y, inside = _raster_cells(shape.points, camera_from_instrument, intrinsics, small)
    mask = np.zeros(small, dtype=bool)
    mask[y[inside], x[inside]] = True
    depth = float(camera_from_instrument[2, 3])
    cell = shape.spacing * camera.fx / max(depth, 1.0)  # px between neighbouring points
    mask = binary_dilation(mask, iterations=max(1, round((ROUGH_SHAPE.margin_px + cell / 2) / FLOW.step_px)))
    return mask.repeat(FLOW.step_px, axis=0).repeat(FLOW.step_px, axis=1)[: camera.height, : camera.width]


def observations_on(
    shape: RoughShape, camera_from_instrument: np.ndarray, sfm: SfmResult, row: int, points: np.ndarray, camera: Camera
) -> np.ndarray:
    """Mark observations bool [Q] of a row of `sfm` on the shape. points [P, 3] mm: its points in the world."""
    mask = project_mask(shape, camera_from_instrument, camera)
    mine = np.flatnonzero(sfm.observations[:, 0] == row)
    pixels, _ = project_world(points[sfm.observations[mine, 1].astype(int)], camera, nearest=camera.near)
    x = np.clip(pixels[:, 0].astype(int), 0, camera.width - 1)
    y = np.clip(pixels[:, 1].astype(int), 0, camera.height - 1)
    on = np.zeros(len(sfm.observations), dtype=bool)
    on[mine] = mask[y, x]
    return on


def _raster_cells(
    points: np.ndarray,
    camera_from_instrument: np.ndarray,
    intrinsics: tuple[float, float, float, float],
    shape: tuple[int, ...],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Column, row and visibility [K] of points on the `step_px`-spaced raster of `shape` (rows, columns)."""
    camera = points @ camera_from_instrument[:3, :3].T + camera_from_instrument[:3, 3]
    x, y = (np.floor(place / FLOW.step_px) for place in project(camera, *intrinsics, nearest=ROUGH_SHAPE.nearest_mm))
    inside = (camera[:, 2] > ROUGH_SHAPE.nearest_mm) & (x >= 0) & (y >= 0) & (x < shape[1]) & (y < shape[0])
    return np.where(inside, x, 0).astype(int), np.where(inside, y, 0).astype(int), inside
