"""The tissue behind the instruments of a still scope, their rough shapes, and a stereo scope's second camera.

The world is the scope's own frame (OpenCV axes, mm), which for a stereo scope is its left camera's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch

from neeco.capture.images import open_image, write_image, write_labels
from neeco.capture.model import Frame, evenly_spaced
from neeco.errors import NeecoError
from neeco.geometry.lens import Lens
from neeco.ingest.calibration.lens import MAX_BORDER_FRAMES, find_border, visible_mask
from neeco.ingest.calibration.stereo import read_stereo
from neeco.ingest.cameras.tissue_surface import TissueSurface, surface_behind, surface_from_stereo
from neeco.ingest.foreground.background import Background, find_background
from neeco.ingest.foreground.masks import moving_masks
from neeco.ingest.foreground.residual_flow import STEP_PX
from neeco.ingest.foreground.rough_shape import PosesAt, RoughShape, best_lag, carve_shape, project_mask
from neeco.ingest.frames.views import SfmResult, StageProgress, Views, reduced
from neeco.ingest.recording.model import IngestSettings, StereoPartner

Tracked = Mapping[str, PosesAt]  # instrument -> camera_from_instrument [K, 4, 4] of the chosen frames


@dataclass(frozen=True)
class StillScene:
    """The tissue, the instruments and the remarks that a still scope's images give."""

    points: np.ndarray  # [P, 3] mm, of the tissue
    colors: np.ndarray  # uint8 [P, 3]
    shapes: dict[str, RoughShape]  # by instrument
    lags: dict[str, float]  # by instrument, s at which its poses fit what moves better (0: none)
    how: str  # the tissue's depth was found, in words
    notes: tuple[str, ...]  # one sentence each


@dataclass(frozen=True)
class RightCamera:
    """The second camera of a stereo scope."""

    pinhole: Lens
    world_from_camera: np.ndarray  # [4, 4]
    folder: Path  # of its images
    names: Mapping[int, str]  # of its images, by row of the chosen frames; none where it took none
    mask: Path | None  # of its border

    def load(self, row: int) -> np.ndarray:
        """Return an image uint8 [H, W, 3]."""
        return np.asarray(open_image(self.folder / self.names[row]).convert("RGB"))


def read_right_camera(
    partner: StereoPartner,
    selected: np.ndarray,
    times: np.ndarray,
    stems: Sequence[str],
    folder: Path,
    progress: StageProgress,
) -> RightCamera:
    """Write the right camera's images at the `selected` [K] video frames, called as `stems`, undistorted, into
    `folder`. times [V] s: of the left video's frames. The two videos begin together. Raises NeecoError."""
    _, lens, right_from_left = read_stereo(partner.calibration)
    video = partner.source.open()
    lens.check_size(video.size, partner.calibration)
    rows = {_nearest(video.times, times, int(frame), len(times)): row for row, frame in enumerate(selected)}
    rows.pop(-1, None)
    if 2 * len(rows) < len(selected):
        raise NeecoError(
            f"{video.path}: {len(video.times)} frames, the left video has {len(times)}: they show {len(rows)} of the "
            f"{len(selected)} chosen moments together; give the videos of one recording"
        )
    folder.mkdir(exist_ok=True)
    sample = sorted(rows)
    border = find_border(
        image for _, image in video.read([sample[i] for i in evenly_spaced(len(rows), MAX_BORDER_FRAMES)])
    )
    visible = None if border is None else lens.undistort_mask(visible_mask(border, video.size))
    mask = None if visible is None else folder / "visible.png"
    if visible is not None and mask is not None:
        write_labels(mask, torch.from_numpy(visible.astype(np.uint8) * 255))
    names = {}
    for done, (frame, image) in enumerate(video.read(sample)):
        progress("writing the right camera's frames", done, len(rows))
        row = rows[frame]
        names[row] = f"{stems[row]}_right.png"
        write_image(folder / names[row], torch.from_numpy(lens.undistort(image).astype(np.float32) / 255))
    return RightCamera(lens.pinhole(video.size), np.linalg.inv(right_from_left), folder, names, mask)


def right_frames(right: RightCamera, frames: tuple[Frame, ...], rows: list[int]) -> tuple[Frame, ...]:
    """Return the training frames among `frames`, rows of the chosen ones, as taken by the right camera."""
    camera = right.pinhole.camera(right.world_from_camera)
    return tuple(
        replace(frame, image_path=right.folder / right.names[row], camera=camera, mask_path=right.mask)
        for frame, row in zip(frames, rows, strict=True)
        if frame.split == "train" and row in right.names
    )


def _nearest(right: np.ndarray, left: np.ndarray, frame: int, count: int) -> int:
    """Return the right video's frame that was taken with a frame of the left, whose times are given; -1: none."""
    if len(right) == count:
        return frame
    found = int(np.abs(right - left[frame]).argmin())
    step = float(np.median(np.diff(left)))
    return found if abs(right[found] - left[frame]) < step / 2 else -1


def still_cameras(count: int) -> SfmResult:
    """Return a reconstruction without points: all `count` cameras in one place."""
    return SfmResult(
        indices=np.arange(count), world_from_camera=np.tile(np.eye(4), (count, 1, 1)), points=np.zeros((0, 3)),
        colors=np.zeros((0, 3), np.uint8), errors=np.zeros(0), lengths=np.zeros(0), observations=np.zeros((0, 5)),
        lens=None, reprojection_px=0.0,
    )  # fmt: skip


def look_behind(
    views: Views, tracked: Tracked, longest_lag: float, settings: IngestSettings, right: RightCamera | None
) -> StillScene:
    """Find the instruments' rough shapes in the views of a still scope, and the tissue behind them.

    tracked: instruments whose poses in front of it are known; longest_lag: s that their logs may be off.
    """
    shapes, lags = _rough_shapes(views, tracked, longest_lag, settings.shape_frames)
    poses = {name: poses_at(0.0) for name, poses_at in tracked.items()}
    notes = []

    def hidden_from(lens: Lens, world_from_camera: np.ndarray, rows: list[int]) -> Callable[[int], np.ndarray] | None:
        camera, camera_from_world = lens.camera(np.eye(4)), np.linalg.inv(world_from_camera)
        none = np.zeros((camera.height, camera.width), dtype=bool)

        def hidden(place: int) -> np.ndarray:
            row, found = rows[place], none
            for name, shape in shapes.items():
                placed, known = poses[name]
                if known[row]:
                    found = found | project_mask(shape, camera_from_world @ placed[row], camera)
            return found

        return hidden if shapes else None

    count, pinhole, visible = len(views.times), views.pinhole, views.visible
    background = find_background(views.load, count, hidden_from(pinhole, np.eye(4), list(range(count))))
    surface = None
    if right is not None:
        rows = sorted(right.names)
        hidden = hidden_from(right.pinhole, right.world_from_camera, rows)
        other = find_background(lambda place: right.load(rows[place]), len(rows), hidden)
        surface = _by_stereo(background, other, views, right)
        if surface is None:
            notes.append("the stereo partner's images match too little for depth; is its calibration this scope's?")
    if surface is None:
        deepest = [float(placed[known, 2, 3].max()) for placed, known in poses.values() if known.any()]
        swept = [(shape, poses[name][0][poses[name][1]]) for name, shape in shapes.items()]
        small = views.reduced_pinhole
        surface = surface_behind(swept, small, max(deepest, default=None), settings.scene_distance_mm)
    points, colors = surface.points(background.colors, pinhole, visible)
    return StillScene(points, colors, shapes, lags, surface.how, tuple(notes))


def _by_stereo(left: Background, right: Background, views: Views, other: RightCamera) -> TissueSurface | None:
    """Return the surface from two cameras' backgrounds; None where they match too little or differ in size."""
    shown = left.seen > 0 if views.visible is None else (left.seen > 0) & views.visible
    if right.colors.shape != left.colors.shape:
        return None
    size = views.reduced_pinhole.size
    assert size is not None
    right_from_left = np.linalg.inv(other.world_from_camera)
    lenses = (views.pinhole, other.pinhole)
    return surface_from_stereo(left.colors, right.colors, lenses, right_from_left, shown, size)


def _rough_shapes(
    views: Views, tracked: Tracked, longest_lag: float, n_frames: int
) -> tuple[dict[str, RoughShape], dict[str, float]]:
    """Carve the rough shape of every tracked instrument that moves in the images; return the lag of every one's poses,
    too."""
    if not tracked:
        return {}, {}
    count, small = len(views.times), views.reduced_pinhole
    rows = np.unique(np.linspace(0, count - 1, n_frames).astype(int))
    masks = moving_masks(views.load, count, rows, views.visible).astype(np.float32)  # [R, h, w]
    size = -(-masks.shape[2] // STEP_PX), -(-masks.shape[1] // STEP_PX)
    evidence = np.stack([cv2.resize(mask, size, interpolation=cv2.INTER_AREA) for mask in masks])
    if views.visible is not None:
        shown = cv2.resize(reduced(views.visible.astype(np.uint8) * 255), size, interpolation=cv2.INTER_AREA) == 255
        evidence[:, ~shown] = np.nan
    shapes, lags = {}, {}
    for name, poses_at in tracked.items():
        poses, known = (values[rows] for values in poses_at(0.0))
        shape = carve_shape(evidence[known], poses[known], small)
        if shape is not None:
            shapes[name] = shape

        def at_rows(lag: float, of: PosesAt = poses_at) -> tuple[np.ndarray, np.ndarray]:
            poses, known = of(lag)
            return poses[rows], known[rows]

        lags[name] = best_lag(evidence, at_rows, small, longest_lag)
    return shapes, lags
