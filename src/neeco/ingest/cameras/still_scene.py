"""A still scope: its detection, the tissue behind the instruments, their rough shapes, and a stereo scope's second
camera.

The world is the scope's own frame (OpenCV axes, mm), for a stereo scope its left camera's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from neeco.base.errors import NeecoError
from neeco.base.files import write_unsynced
from neeco.capture.images import encoded_rgb, open_image, write_labels
from neeco.capture.model import PointCloud, evenly_spaced
from neeco.geometry.lens import Lens
from neeco.ingest.calibration.lens import BORDERS, find_border, visible_mask
from neeco.ingest.cameras.tissue_surface import epipolar_error, surface_behind, surface_from_stereo
from neeco.ingest.foreground.masks import FLOW, find_background, moving_masks
from neeco.ingest.foreground.rough_shape import RoughShape, project_mask
from neeco.ingest.frames.images import StageProgress, Views, reduced
from neeco.ingest.readers import VideoSource
from neeco.ingest.recording.model import IngestSettings, Recording, VideoFile
from neeco.ingest.timing.episodes import Notes


@dataclass(frozen=True, kw_only=True)
class StillScopeSettings:
    """Settings of the detection of a still scope, and of its second camera."""

    n_frames: int = 24  # compared frames, spread over the recording
    n_cells: int = 20  # cells across an image, with one feature each
    min_texture: float = 2e-5  # minimum texture of a feature: lesser eigenvalue of its slopes' covariance, white is 1
    min_features: int = 30  # minimum number of features of an image
    in_place: float = 0.0125  # share of the image's width within which a feature is in place (tissue breathes)
    max_return_px: float = 1.0  # maximum error of a feature tracked forwards and back
    still_share: float = 0.2  # minimum share of features in place between two frames of a still scope
    still_pairs: float = 0.85  # minimum share of the pairs of frames for which this holds
    max_epipolar: float = 0.004  # maximum distance from epipolar lines, share of the image's width: 0.25 degrees


STILL_SCOPE = StillScopeSettings()

TRACKING: dict[str, Any] = {"winSize": (15, 15), "maxLevel": 1, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}


def stands_still(load: Callable[[int], np.ndarray], count: int) -> bool:
    """Return whether a scope was still over `count` images: most features stay in place in other frames.

    load: one of the images, uint8 [H, W, 3].
    """
    rows = evenly_spaced(count, STILL_SCOPE.n_frames)
    grey = [_even_light(cv2.cvtColor(reduced(load(row)), cv2.COLOR_RGB2GRAY)) for row in rows]
    stay = []
    for step in {1, len(grey) // 3, len(grey) // 2, 2 * len(grey) // 3} - {0}:
        stay += [_share_in_place(first, second) for first, second in zip(grey, grey[step:], strict=False)]
    shares = np.array([share for share in stay if share is not None])
    return len(shares) > 0 and float(np.mean(shares > STILL_SCOPE.still_share)) > STILL_SCOPE.still_pairs


def video_stands_still(video: VideoSource) -> bool:
    """Return the same of a video. Raises NeecoError where it cannot be read."""
    images = [image for _, image in video.read(evenly_spaced(len(video.times), STILL_SCOPE.n_frames))]
    return stands_still(images.__getitem__, len(images))


def same_place(first: np.ndarray, second: np.ndarray) -> float | None:
    """Return the share of a background's features that are in place in a second, uint8 [H, W, 3]; None: too few."""
    grey = [_even_light(cv2.cvtColor(reduced(image), cv2.COLOR_RGB2GRAY)) for image in (first, second)]
    return _share_in_place(*grey)


def _share_in_place(first: np.ndarray, second: np.ndarray) -> float | None:
    """`same_place` of equalised images [H, W]."""
    features = _features(first)
    if len(features) < STILL_SCOPE.min_features:
        return None
    tracked, seen, _ = cv2.calcOpticalFlowPyrLK(first, second, features, features.copy(), **TRACKING)
    back, seen_back, _ = cv2.calcOpticalFlowPyrLK(second, first, tracked, tracked.copy(), **TRACKING)
    returns = np.linalg.norm(back - features, axis=-1)[:, 0] < STILL_SCOPE.max_return_px
    near = np.linalg.norm(tracked - features, axis=-1)[:, 0] < STILL_SCOPE.in_place * first.shape[1]
    return float((returns & near & (seen[:, 0] > 0) & (seen_back[:, 0] > 0)).mean())


def _even_light(grey: np.ndarray) -> np.ndarray:
    """Return an image uint8 [H, W] relative to its local brightness, compensating exposure and shadows."""
    around = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), grey.shape[1] / STILL_SCOPE.n_cells)
    return np.clip(128.0 * grey / np.maximum(around, 8), 0, 255).astype(np.uint8)


def _features(grey: np.ndarray) -> np.ndarray:
    """Return the best feature float32 [K, 1, 2] px per cell of an image uint8 [H, W]; highlights are unstable."""
    strength = cv2.cornerMinEigenVal(grey, 7)
    side = max(1, grey.shape[1] // STILL_SCOPE.n_cells)
    places = []
    for top in range(side // 2, grey.shape[0] - side, side):
        for left in range(side // 2, grey.shape[1] - side, side):
            cell = strength[top : top + side, left : left + side]
            if cell.max() > STILL_SCOPE.min_texture:
                row, column = np.unravel_index(cell.argmax(), cell.shape)
                places.append((left + column, top + row))
    return np.array(places, np.float32).reshape(-1, 1, 2)


@dataclass(frozen=True)
class RightCamera:
    """The second camera of a stereo scope."""

    pinhole: Lens
    world_from_camera: np.ndarray  # [4, 4]
    folder: Path  # of its images
    names: Mapping[int, str]  # of its images, by row of the chosen frames; none where it took none
    delays: Mapping[int, float]  # s, by which these were taken after the left camera's, by row
    mask: Path | None  # of its border

    def load(self, row: int) -> np.ndarray:
        """Return an image uint8 [H, W, 3]."""
        return np.asarray(open_image(self.folder / self.names[row]).convert("RGB"))


def read_right_camera(
    recording: Recording,
    selected: np.ndarray,
    times: np.ndarray,
    stems: Sequence[str],
    folder: Path,
    progress: StageProgress,
) -> RightCamera:
    """Write the right camera's images at the `selected` [K] video frames, called as `stems`, undistorted, into
    `folder`. times [V] s: of the left video's frames. Two streams of one file share a clock; two videos begin together.
    Raises NeecoError."""
    assert recording.stereo is not None
    source = recording.stereo.source
    _, lens, right_from_left, calibration = recording.read_stereo()
    video = source.open()
    lens.check_size(video.size, calibration)
    one_clock = isinstance(source, VideoFile) and source.file == recording.file
    pairs = _pairs(video.times, times, selected, one_clock)
    if 2 * len(pairs) < len(selected):
        raise NeecoError(
            f"{video.path}: {len(video.times)} frames, the left video has {len(times)}: they show {len(pairs)} of the "
            f"{len(selected)} chosen moments together; give the videos of one recording"
        )
    rows = {right: row for row, right in pairs.items()}
    folder.mkdir(exist_ok=True)
    sample = sorted(rows)
    border = find_border(
        image for _, image in video.read([sample[i] for i in evenly_spaced(len(rows), BORDERS.max_frames)])
    )
    visible = None if border is None else lens.undistort_mask(visible_mask(border, video.size))
    mask = None if visible is None else folder / "visible.png"
    if visible is not None and mask is not None:
        write_labels(mask, torch.from_numpy(visible.astype(np.uint8) * 255))
    names = {}
    for done, (frame, image) in enumerate(video.read(sample), 1):
        progress("writing the right camera's frames", done, len(rows))
        row = rows[frame]
        names[row] = f"{stems[row]}_right.png"
        write_unsynced(folder / names[row], encoded_rgb(lens.undistort(image)))
    delays = {
        row: float(video.times[right] - times[selected[row]]) if one_clock else 0.0 for row, right in pairs.items()
    }
    return RightCamera(lens.pinhole(video.size), np.linalg.inv(right_from_left), folder, names, delays, mask)


def _pairs(right: np.ndarray, left: np.ndarray, selected: np.ndarray, one_clock: bool) -> dict[int, int]:
    """Return the simultaneous frame of the right camera, by row of the `selected` frames of the left one.

    right [R], left [V] s: times of all frames, on one clock or, for videos that start together, each on its own; with
    equal counts, these are paired by number. A right frame nearest to two rows is assigned to the nearer one.
    """
    if not one_clock and len(right) == len(left):
        return dict(enumerate(selected.tolist()))
    moments = left[selected]
    nearest = np.abs(right - moments[:, None]).argmin(axis=1)
    off = np.abs(right[nearest] - moments)
    step = float(np.median(np.diff(left)))
    pairs: dict[int, int] = {}
    for row in np.argsort(off, kind="stable").tolist():
        if off[row] < step / 2 and int(nearest[row]) not in pairs.values():
            pairs[row] = int(nearest[row])
    return pairs


def look_behind(
    notes: Notes,
    views: Views,
    shapes: Mapping[str, RoughShape],
    tracked: Mapping[str, tuple[np.ndarray, np.ndarray]],
    settings: IngestSettings,
    right: RightCamera | None,
) -> tuple[PointCloud, str]:
    """Estimate the tissue behind the instruments in the views of a still scope, and say where its depth is from.

    notes: of the recording; shapes: of instruments; tracked: camera_from_instrument [M, 4, 4] of those with known
    poses, and where known [M].
    """

    def hidden_from(lens: Lens, world_from_camera: np.ndarray, rows: list[int]) -> Callable[[int], np.ndarray] | None:
        camera, camera_from_world = lens.camera(np.eye(4)), np.linalg.inv(world_from_camera)
        none = np.zeros((camera.height, camera.width), dtype=bool)

        def hidden(place: int) -> np.ndarray:
            row, mask = rows[place], none
            for name, shape in shapes.items():
                placed, valid = tracked[name]
                if valid[row]:
                    mask = mask | project_mask(shape, camera_from_world @ placed[row], camera)
            return mask

        return hidden if shapes else None

    count, pinhole, visible = len(views.times), views.pinhole, views.visible
    background = find_background(views.load, count, hidden_from(pinhole, np.eye(4), list(range(count))))
    surface = None
    if right is not None:
        rows = sorted(right.names)
        hidden = hidden_from(right.pinhole, right.world_from_camera, rows)
        other = find_background(lambda place: right.load(rows[place]), len(rows), hidden)
        if background.colors.shape == other.colors.shape:
            left_colors, lenses = background.colors, (pinhole, right.pinhole)
            right_from_left = np.linalg.inv(right.world_from_camera)
            error = epipolar_error(left_colors, other.colors, lenses, right_from_left)
            limit = STILL_SCOPE.max_epipolar * left_colors.shape[1]
            if error is not None and error > limit:
                doubt = (
                    f"what the second camera shows lies {error:.1f} px off where its calibration puts it (median; up "
                    f"to {limit:.1f} px is usual): check that the calibration is this scope's and of these images"
                )
                notes.contradict("stereo", doubt, severe=True)
            shown = background.seen > 0 if visible is None else (background.seen > 0) & visible
            size = views.reduced_pinhole.size
            assert size is not None
            surface = surface_from_stereo(left_colors, other.colors, lenses, right_from_left, shown, size)
        if surface is None:
            notes.add("the stereo partner's images match too little for depth; check its calibration")
    if surface is None:
        deepest = [float(placed[valid, 2, 3].max()) for placed, valid in tracked.values() if valid.any()]
        swept = [(shape, tracked[name][0][tracked[name][1]]) for name, shape in shapes.items()]
        small = views.reduced_pinhole
        surface = surface_behind(swept, small, max(deepest, default=None), settings.scene_distance_mm)
    points, colors = surface.points(background.colors, pinhole, visible)
    return PointCloud(points.astype(np.float32), (colors / 255).astype(np.float32)), surface.how


def moving_shares(views: Views, rows: np.ndarray) -> np.ndarray:
    """Shares [R, h, w] of moving pixels about places `FLOW.step_px` apart in rows [R] of a still scope's views, as from
    `ResidualFlow.moving_pixels`."""
    masks = moving_masks(views.load, len(views.times), rows, views.visible).astype(np.float32)
    size = -(-masks.shape[2] // FLOW.step_px), -(-masks.shape[1] // FLOW.step_px)
    shares = np.stack([cv2.resize(mask, size, interpolation=cv2.INTER_AREA) for mask in masks])
    if views.visible is not None:
        visible = cv2.resize(reduced(views.visible.astype(np.uint8) * 255), size, interpolation=cv2.INTER_AREA) == 255
        shares[:, ~visible] = np.nan
    return shares
