"""Where the instrument is in the images, from motion and its tracked pose: its features must not hold up the cameras.

Three steps: pixels whose optical flow is not what a still scene would show; the set of points in the instrument's
tracked frame that such pixels cover in most frames (its rough shape); and that shape projected into every frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.ndimage import binary_dilation
from scipy.spatial import QhullError

from neeco.capture.model import REFERENCE_PIXELS
from neeco.geometry.camera import Camera
from neeco.geometry.lens import Lens
from neeco.geometry.projection import project, project_world
from neeco.ingest.frames.views import SfmResult

STEP = 4  # px between the places where flow is compared
INTERVAL = 0.12  # s between frames that are compared: one and two intervals before and after
BLEEDING = 2  # places by which flow bleeds over the border of the field of view
PATCH = 0.04  # of the image: about what an instrument's front takes
CELLS = 48  # of the carving grid, per side
REACH = 0.4  # of the distance to the camera: half a side of that grid
MIN_AGREEMENT = 0.3  # of the frames, in which a point of the instrument lies on moving pixels
LAG_CELLS, LAG_STEP = 16, 0.1  # of the grid for lags, per side; s between the lags that are tried
LONGEST_LAG = 60.0  # s
MIN_KNOWN = 0.5  # of the frames that need a pose at a lag
LAG_GAIN = 1.1  # by how much more agreement than at 0 and at all other lags one is clear
LAG_TOP, LAG_LOBE = 0.95, 0.5  # of the best agreement, and s about its lag: what the lag is the mean of
COVERED = 0.85  # of the best point's evidence, for a point to belong to the instrument: flow bleeds over edges
MARGIN = 6  # px about its projection
NEAREST = 1e-3  # mm; what is less deep is not in front of the camera
TINY = 1e-9  # depth in SfM's unit that may be divided by

PosesAt = Callable[[float], tuple[np.ndarray, np.ndarray]]  # lag s -> poses [N, 4, 4] mm, bool [N] where known


@dataclass(frozen=True)
class RoughShape:
    """Points [K, 3] mm of an instrument in its tracked frame, the grid's spacing mm, and how often the images agree."""

    points: np.ndarray
    spacing: float
    agreement: float  # share of frames in which a point of it lies on moving pixels, [0, 1]


class ResidualFlow:
    """Optical flow between frames at every STEP-th pixel, less what a still scene explains.

    Frames are reduced to REFERENCE_PIXELS: one pixel is as much of the scene whatever was recorded.

    load(row): image [H, W, 3] uint8 of a row of `sfm`, as `pinhole` sees it; times [M] s of the rows; visible: bool
    [H, W], the field of view, where it has a border; episodes [M]: which of several recordings each row is of: those of
    one are compared. `self.pinhole` is that of the reduced images.
    """

    def __init__(
        self,
        load: Callable[[int], np.ndarray],
        sfm: SfmResult,
        times: np.ndarray,
        pinhole: Lens,
        visible: np.ndarray | None = None,
        episodes: np.ndarray | None = None,
    ) -> None:
        self.episodes = np.zeros(len(times)) if episodes is None else episodes
        camera = pinhole.camera(np.eye(4)).within(REFERENCE_PIXELS)
        self.sfm, self.pinhole = sfm, Lens.of(camera)
        self.estimator: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)  # its stub asks for a flow
        height, width = camera.height, camera.width

        @lru_cache(maxsize=16)
        def grey(row: int) -> np.ndarray:
            image = cv2.resize(load(row), (width, height), interpolation=cv2.INTER_AREA)
            return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)

        self.grey = grey
        self.v, self.u = np.mgrid[STEP // 2 : height : STEP, STEP // 2 : width : STEP]
        self.step = max(1, round(INTERVAL / float(np.median(np.diff(times))))) if len(times) > 1 else 1  # rows
        self.hidden = np.zeros(self.u.shape, dtype=bool)
        if visible is not None:
            size = self.u.shape[::-1]
            shown = cv2.resize(visible.astype(np.float32), size, interpolation=cv2.INTER_AREA)
            self.hidden = binary_dilation(shown < 1, iterations=BLEEDING)

    def moving_pixels(self, rows: np.ndarray, moving_px: float) -> np.ndarray:
        """[R, h, w] share of the neighbours of rows [R] against which a pixel moved by more than tissue would and
        `moving_px`; NaN beyond the field of view."""
        evidence = []
        for row in rows.tolist():
            near = [row + steps * self.step for steps in (-2, -1, 1, 2)]
            others = [other for other in near if 0 <= other < len(self.sfm.indices)]
            others = [other for other in others if self.episodes[other] == self.episodes[row]]
            moved = sum((motion > moving_px for motion in self._residuals(row, others)), np.zeros(self.u.shape))
            evidence.append(np.where(self.hidden, np.nan, moved / max(len(others), 1)))
        return np.stack(evidence)

    def fastest_motion(self) -> np.ndarray:
        """[M-1] px by which the fastest patch of each frame moves to the next one, beyond what a still scene would."""
        shown = ~self.hidden
        patch = max(1, round(PATCH * shown.sum()))
        motion = np.zeros(len(self.sfm.indices) - 1)
        for row in np.flatnonzero(self.episodes[1:] == self.episodes[:-1]).tolist():
            (residual,) = self._residuals(row, [row + 1])
            motion[row] = np.sort(residual[shown])[-patch:].mean()
        return motion

    def _residuals(self, row: int, others: list[int]) -> Iterator[np.ndarray]:
        """[h, w] px by which the flow from a row of `sfm` to each of the others differs from a still scene's."""
        cameras, lens = self.sfm.world_from_camera, self.pinhole
        rays = np.stack(
            [(self.u + 0.5 - lens.cx) / lens.fl_x, (self.v + 0.5 - lens.cy) / lens.fl_y, np.ones(self.u.shape)], -1
        )
        points = rays * self._still_depth(row)[..., None]
        for other in others:
            flow = self.estimator.calc(self.grey(row), self.grey(other), None)[self.v, self.u]  # [h, w, 2]
            if np.array_equal(cameras[other], cameras[row]):  # at whatever depth the scene lies
                yield np.linalg.norm(flow, axis=-1)
                continue
            relative = np.linalg.inv(cameras[other]) @ cameras[row]
            moved = points @ relative[:3, :3].T + relative[:3, 3]
            x, y = project(moved, *lens.intrinsics, nearest=TINY)
            yield np.linalg.norm(flow - np.stack([x - self.u - 0.5, y - self.v - 0.5], -1), axis=-1)

    def _still_depth(self, row: int) -> np.ndarray:
        """[h, w] depth of the still scene: between the points that this frame sees, and of the nearest beyond them."""
        seen = self.sfm.observations[:, 0] == row
        points = self.sfm.points[self.sfm.observations[seen, 1].astype(int)]
        pixels, depth = project_world(points, self.pinhole.camera(self.sfm.world_from_camera[row]), nearest=TINY)
        near = np.median(depth[depth > 0]) if (depth > 0).any() else np.nan
        keep = (depth > 0.3 * near) & (depth < 3 * near)
        pixels, inverse = pixels[keep], 1 / depth[keep]
        if len(pixels) == 0:
            return np.full(self.u.shape, np.nan)  # nothing is known, so nothing is seen to move
        places = np.stack([self.u + 0.5, self.v + 0.5], -1)
        nearest = NearestNDInterpolator(pixels, inverse)(places)
        try:
            between = LinearNDInterpolator(pixels, inverse)(places)
        except QhullError:  # fewer than three, or all on one line
            return np.asarray(1 / nearest)
        return np.asarray(1 / np.where(np.isnan(between), nearest, between))


def carve_shape(evidence: np.ndarray, camera_from_instrument: np.ndarray, pinhole: Lens) -> RoughShape | None:
    """The points of a grid about the tracked frame that lie on moving pixels most of the time they are in view.

    evidence [R, h, w] from `ResidualFlow.moving_pixels` (NaN: not seen), camera_from_instrument [R, 4, 4] mm. None when
    no point stands out: the instrument hardly moves, or its poses do not fit the cameras.
    """
    grid, spacing, share, enough = _agreement(evidence, camera_from_instrument, pinhole, CELLS)
    best = float(np.quantile(share[enough], 0.999)) if enough.any() else 0.0
    background = float(np.nanmean(evidence)) if not np.isnan(evidence).all() else 0.0
    if best < 2 * background or best < MIN_AGREEMENT:
        return None
    belongs = share > max(COVERED * best, 2 * background)
    return RoughShape(grid[belongs], spacing, best) if belongs.any() else None


def best_lag(evidence: np.ndarray, poses_at: PosesAt, pinhole: Lens, longest: float) -> float:
    """Lag s within +-longest (at most LONGEST_LAG) at which poses explain what moves clearly better than at 0 and at
    all others, else 0.

    evidence [R, h, w] as for `carve_shape`; poses_at(lag): camera_from_instrument [R, 4, 4] mm that the log has `lag` s
    later than its clock says, and bool [R] where it has one.
    """
    count = int(min(longest, LONGEST_LAG) / LAG_STEP)
    lags = LAG_STEP * np.arange(-count, count + 1)
    scores = np.zeros(len(lags))
    for index, lag in enumerate(lags):
        poses, known = poses_at(float(lag))
        if known.sum() >= MIN_KNOWN * len(evidence):
            _, _, share, enough = _agreement(evidence[known], poses[known], pinhole, LAG_CELLS)
            scores[index] = np.quantile(share[enough], 0.99) if enough.any() else 0.0
    best = float(scores.max())
    lobe = np.abs(lags - lags[scores.argmax()]) < LAG_LOBE
    rival = float(scores[~lobe].max(initial=0.0))  # motion that repeats fits at several lags
    if best < MIN_AGREEMENT or best < LAG_GAIN * max(float(scores[count]), rival):
        return 0.0
    weights = np.clip(scores - LAG_TOP * best, 0, None) * lobe
    return float((weights * lags).sum() / weights.sum())


def _agreement(
    evidence: np.ndarray, camera_from_instrument: np.ndarray, pinhole: Lens, cells: int
) -> tuple[np.ndarray, float, np.ndarray, np.ndarray]:
    """A grid [G, 3] mm about the tracked frame, its spacing mm, the share [G] of the frames in which each of its points
    lies on moving pixels, and where [G] enough frames have it in view."""
    distance = float(np.median(camera_from_instrument[:, 2, 3])) if len(evidence) else 0.0
    if distance <= 0:
        return np.zeros((0, 3)), 0.0, np.zeros(0), np.zeros(0, dtype=bool)
    axis = np.linspace(-REACH, REACH, cells) * distance
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)  # [G, 3]
    total, seen = np.zeros(len(grid)), np.zeros(len(grid))
    for pixels, pose in zip(evidence, camera_from_instrument, strict=True):
        x, y, inside = _raster_cells(grid, pose, pinhole.intrinsics, pixels.shape)
        inside &= ~np.isnan(pixels[y, x])
        total[inside] += pixels[y[inside], x[inside]]
        seen += inside
    enough = seen > 0.3 * len(evidence)
    share = np.where(enough, total / np.maximum(seen, 1), 0.0)
    return grid, float(axis[1] - axis[0]), share, enough


def project_mask(shape: RoughShape, camera_from_instrument: np.ndarray, camera: Camera) -> np.ndarray:
    """[H, W] bool: pixels the shape may cover in the camera's image, with a margin."""
    small = (camera.height // STEP + 1, camera.width // STEP + 1)
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    x, y, inside = _raster_cells(shape.points, camera_from_instrument, intrinsics, small)
    mask = np.zeros(small, dtype=bool)
    mask[y[inside], x[inside]] = True
    depth = float(camera_from_instrument[2, 3])
    cell = shape.spacing * camera.fx / max(depth, 1.0)  # px between neighbouring points
    mask = binary_dilation(mask, iterations=max(1, round((MARGIN + cell / 2) / STEP)))
    return mask.repeat(STEP, axis=0).repeat(STEP, axis=1)[: camera.height, : camera.width]


def observations_on(
    shape: RoughShape, camera_from_instrument: np.ndarray, sfm: SfmResult, row: int, points: np.ndarray, camera: Camera
) -> np.ndarray:
    """bool [Q]: observations of a row of `sfm` that lie on the shape. points [P, 3] mm: its points in the world."""
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
    """Column, row and insideness [K] of points on the STEP-spaced raster of `shape` (rows, columns)."""
    camera = points @ camera_from_instrument[:3, :3].T + camera_from_instrument[:3, 3]
    x, y = (np.floor(place / STEP) for place in project(camera, *intrinsics, nearest=NEAREST))
    inside = (camera[:, 2] > NEAREST) & (x >= 0) & (y >= 0) & (x < shape[1]) & (y < shape[0])
    return np.where(inside, x, 0).astype(int), np.where(inside, y, 0).astype(int), inside
