"""Optical flow between frames of a scope that moves, less the flow of a still scene: what remains moves by itself."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.ndimage import binary_dilation
from scipy.spatial import QhullError

from neeco.capture.model import REFERENCE_PIXELS
from neeco.geometry.lens import Lens
from neeco.geometry.projection import project, project_world
from neeco.ingest.frames.images import SfmResult, Views


@dataclass(frozen=True, kw_only=True)
class FlowSettings:
    """Settings of the flow that the scope's motion leaves."""

    step_px: int = 4  # spacing of the places where flow is compared
    interval_s: float = 0.12  # between frames that are compared: one and two intervals before and after
    bleeding: int = 2  # places by which flow bleeds over the border of the field of view
    patch_share: float = 0.04  # area of a patch, share of the image: about an instrument's front
    min_depth: float = 1e-9  # minimum depth, in SfM's unit, that may be divided by


FLOW = FlowSettings()


class ResidualFlow:
    """Optical flow between frames at every `step_px`-th pixel, less what a still scene explains.

    Frames are reduced to REFERENCE_PIXELS: one pixel is as much of the scene in every recording.

    views: the rows of `sfm`; those of one episode are compared. `self.pinhole` is that of the reduced images.
    """

    def __init__(self, sfm: SfmResult, views: Views) -> None:
        self.episodes, times = views.episodes, views.times
        camera = views.pinhole.camera(np.eye(4)).within(REFERENCE_PIXELS)
        self.sfm, self.pinhole = sfm, Lens.of(camera)
        self.estimator: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)  # its stub asks for a flow
        height, width = camera.height, camera.width

        @lru_cache(maxsize=16)
        def grey(row: int) -> np.ndarray:
            image = cv2.resize(views.load(row), (width, height), interpolation=cv2.INTER_AREA)
            return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)

        self.grey = grey
        self.v, self.u = np.mgrid[FLOW.step_px // 2 : height : FLOW.step_px, FLOW.step_px // 2 : width : FLOW.step_px]
        self.step = max(1, round(FLOW.interval_s / float(np.median(np.diff(times))))) if len(times) > 1 else 1  # rows
        self.hidden = np.zeros(self.u.shape, dtype=bool)
        if views.visible is not None:
            size = self.u.shape[::-1]
            share = cv2.resize(views.visible.astype(np.float32), size, interpolation=cv2.INTER_AREA)
            self.hidden = binary_dilation(share < 1, iterations=FLOW.bleeding)

    def moving_pixels(self, rows: np.ndarray, moving_px: float) -> np.ndarray:
        """Shares [R, h, w] of the neighbours of rows [R] to which a pixel's residual flow exceeds `moving_px`; NaN
        beyond the field of view."""
        evidence = []
        for row in rows.tolist():
            near = [row + steps * self.step for steps in (-2, -1, 1, 2)]
            others = [other for other in near if 0 <= other < len(self.sfm.indices)]
            others = [other for other in others if self.episodes[other] == self.episodes[row]]
            moved = sum((motion > moving_px for motion in self._residuals(row, others)), np.zeros(self.u.shape))
            evidence.append(np.where(self.hidden, np.nan, moved / max(len(others), 1)))
        return np.stack(evidence)

    def fastest_motion(self) -> np.ndarray:
        """Residual flow [M-1] px of the fastest patch of each frame to the next."""
        visible = ~self.hidden
        patch = max(1, round(FLOW.patch_share * visible.sum()))
        motion = np.zeros(len(self.sfm.indices) - 1)
        for row in np.flatnonzero(self.episodes[1:] == self.episodes[:-1]).tolist():
            (residual,) = self._residuals(row, [row + 1])
            motion[row] = np.sort(residual[visible])[-patch:].mean()
        return motion

    def _residuals(self, row: int, others: list[int]) -> Iterator[np.ndarray]:
        """Yield the residual flow [h, w] px from a row of `sfm` to each of the others."""
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
            x, y = project(moved, *lens.intrinsics, nearest=FLOW.min_depth)
            yield np.linalg.norm(flow - np.stack([x - self.u - 0.5, y - self.v - 0.5], -1), axis=-1)

    def _still_depth(self, row: int) -> np.ndarray:
        """Depth [h, w] of the still scene: between the points that this frame observes, and of the nearest beyond."""
        seen = self.sfm.observations[:, 0] == row
        points = self.sfm.points[self.sfm.observations[seen, 1].astype(int)]
        pixels, depth = project_world(
            points, self.pinhole.camera(self.sfm.world_from_camera[row]), nearest=FLOW.min_depth
        )
        near = np.median(depth[depth > 0]) if (depth > 0).any() else np.nan
        keep = (depth > 0.3 * near) & (depth < 3 * near)
        pixels, inverse = pixels[keep], 1 / depth[keep]
        if len(pixels) == 0:
            return np.full(self.u.shape, np.nan)  # nothing is known, so nothing counts as moving
        places = np.stack([self.u + 0.5, self.v + 0.5], -1)
        nearest = NearestNDInterpolator(pixels, inverse)(places)
        try:
            between = LinearNDInterpolator(pixels, inverse)(places)
        except QhullError:  # fewer than three, or all on one line
            return np.asarray(1 / nearest)
        return np.asarray(1 / np.where(np.isnan(between), nearest, between))
