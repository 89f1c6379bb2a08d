"""What the recording of a still scope shows: the instruments' rough shapes, and the tissue behind them.

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
from neeco.capture.model import REFERENCE_PIXELS, Frame, evenly_spaced
from neeco.errors import NeecoError
from neeco.geometry.lens import Lens
from neeco.ingest.calibration.lens import MAX_BORDER_FRAMES, find_border, visible_mask
from neeco.ingest.calibration.stereo import read_stereo
from neeco.ingest.cameras.still import Background, find_background, moving_masks
from neeco.ingest.cameras.tissue_surface import TissueSurface, surface_behind, surface_from_stereo
from neeco.ingest.foreground.motion import STEP, PosesAt, RoughShape, best_lag, carve_shape, project_mask
from neeco.ingest.frames.views import SfmResult, StageProgress, reduced
from neeco.ingest.recording.model import IngestSettings, StereoPartner

Load = Callable[[int], np.ndarray]  # row of the chosen frames -> image uint8 [H, W, 3], undistorted
Tracked = Mapping[str, PosesAt]  # instrument -> camera_from_instrument [K, 4, 4] of the chosen frames


@dataclass(frozen=True)
class StillScene:
    """points [P, 3] mm and colors uint8 [P, 3] of the tissue; shapes: of the instruments, by name; lags: by name, s at
    which an instrument's poses fit what moves better (0: none); how: the tissue's depth was found, in words; notes: one
    sentence each."""

    points: np.ndarray
    colors: np.ndarray
    shapes: dict[str, RoughShape]
    lags: dict[str, float]
    how: str
    notes: tuple[str, ...]


@dataclass(frozen=True)
class RightCamera:
    """The second camera of a stereo scope. folder: of its images, `names` by row of the chosen frames (none: it took
    none then); mask: where its border is masked."""

    pinhole: Lens
    world_from_camera: np.ndarray
    folder: Path
    names: Mapping[int, str]
    visible: np.ndarray | None
    mask: Path | None

    def load(self, row: int) -> np.ndarray:
        """uint8 [H, W, 3]."""
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
    return RightCamera(lens.pinhole(video.size), np.linalg.inv(right_from_left), folder, names, visible, mask)


def seen_by(right: RightCamera, frames: tuple[Frame, ...], rows: list[int]) -> tuple[Frame, ...]:
    """The training frames among `frames`, rows of the chosen ones, as the right camera saw them."""
    camera = right.pinhole.camera(right.world_from_camera)
    return tuple(
        replace(frame, image_path=right.folder / right.names[row], camera=camera, mask_path=right.mask)
        for frame, row in zip(frames, rows, strict=True)
        if frame.split == "train" and row in right.names
    )


def _nearest(right: np.ndarray, left: np.ndarray, frame: int, count: int) -> int:
    """The right video's frame that was taken with a frame of the left, whose times are given; -1: none was."""
    if len(right) == count:
        return frame
    found = int(np.abs(right - left[frame]).argmin())
    step = float(np.median(np.diff(left)))
    return found if abs(right[found] - left[frame]) < step / 2 else -1


def still_cameras(count: int) -> SfmResult:
    """What structure from motion would say of `count` frames of a still scope, were there any parallax."""
    return SfmResult(
        np.arange(count), np.tile(np.eye(4), (count, 1, 1)), np.zeros((0, 3)), np.zeros((0, 3), np.uint8),
        np.zeros(0), np.zeros(0), np.zeros((0, 5)), None, 0.0,
    )  # fmt: skip


def look_behind(
    load: Load,
    count: int,
    pinhole: Lens,
    visible: np.ndarray | None,
    tracked: Tracked,
    length: float,
    settings: IngestSettings,
    right: RightCamera | None,
    progress: StageProgress,
) -> StillScene:
    """What `count` frames of a still scope show. tracked: instruments whose place before it is known; visible: bool
    [H, W], the field of view; length: of the recording, s."""
    progress("finding the instrument", 0, 0)
    small = Lens.of(pinhole.camera(np.eye(4)).within(REFERENCE_PIXELS))
    shapes, lags = _rough_shapes(load, count, small, visible, tracked, length, settings)
    placed_at = {name: poses_at(0.0) for name, poses_at in tracked.items()}
    notes = []
    progress("finding the tissue behind it", 0, 0)

    def hidden_from(lens: Lens, world_from_camera: np.ndarray, rows: list[int]) -> Callable[[int], np.ndarray] | None:
        camera, camera_from_world = lens.camera(np.eye(4)), np.linalg.inv(world_from_camera)
        none = np.zeros((camera.height, camera.width), dtype=bool)

        def hidden(place: int) -> np.ndarray:
            row, found = rows[place], none
            for name, shape in shapes.items():
                poses, known = placed_at[name]
                if known[row]:
                    found = found | project_mask(shape, camera_from_world @ poses[row], camera)
            return found

        return hidden if shapes else None

    every = list(range(count))
    background = find_background(load, count, hidden_from(pinhole, np.eye(4), every))
    surface = None
    if right is not None:
        rows = sorted(right.names)
        hidden = hidden_from(right.pinhole, right.world_from_camera, rows)
        other = find_background(lambda place: right.load(rows[place]), len(rows), hidden)
        surface = _by_stereo(background, other, pinhole, right, visible, small)
        if surface is None:
            notes.append("the stereo partner's images match too little for depth; is its calibration this scope's?")
    if surface is None:
        deepest = [float(poses[known, 2, 3].max()) for poses, known in placed_at.values() if known.any()]
        placed = [(shape, placed_at[name][0][placed_at[name][1]]) for name, shape in shapes.items()]
        surface = surface_behind(placed, small, max(deepest, default=None), settings.scene_distance_mm)
    points, colors = surface.points(background.colors, pinhole, visible)
    return StillScene(points, colors, shapes, lags, surface.how, tuple(notes))


def _by_stereo(
    left: Background, right: Background, pinhole: Lens, other: RightCamera, visible: np.ndarray | None, small: Lens
) -> TissueSurface | None:
    seen = left.seen > 0 if visible is None else (left.seen > 0) & visible
    colors = right.colors
    if colors.shape != left.colors.shape:
        return None
    assert small.size is not None
    right_from_left = np.linalg.inv(other.world_from_camera)
    return surface_from_stereo(left.colors, colors, (pinhole, other.pinhole), right_from_left, seen, small.size)


def _rough_shapes(
    load: Load,
    count: int,
    small: Lens,
    visible: np.ndarray | None,
    tracked: Tracked,
    length: float,
    settings: IngestSettings,
) -> tuple[dict[str, RoughShape], dict[str, float]]:
    """The rough shape of every tracked instrument that moves in the images, and the lag of every one's poses."""
    if not tracked:
        return {}, {}
    rows = np.unique(np.linspace(0, count - 1, settings.shape_frames).astype(int))
    masks = moving_masks(load, count, rows, visible).astype(np.float32)  # [R, h, w]
    size = -(-masks.shape[2] // STEP), -(-masks.shape[1] // STEP)
    evidence = np.stack([cv2.resize(mask, size, interpolation=cv2.INTER_AREA) for mask in masks])
    if visible is not None:
        shown = cv2.resize(reduced(visible.astype(np.uint8) * 255), size, interpolation=cv2.INTER_AREA) == 255
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

        lags[name] = best_lag(evidence, at_rows, small, length)
    return shapes, lags
