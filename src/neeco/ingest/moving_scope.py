"""The world of a scope that moves: structure from motion finds its cameras, its tracker registers them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from neeco.base.errors import NeecoError
from neeco.capture.model import SEPARATE_TISSUES, PointCloud
from neeco.geometry.lens import Lens
from neeco.ingest.cameras.sfm import StructureFromMotion
from neeco.ingest.foreground.masks import passing_masks
from neeco.ingest.foreground.residual_flow import ResidualFlow
from neeco.ingest.foreground.rough_shape import RoughShape, best_lag, carve_shape, observations_on
from neeco.ingest.frames.images import ChosenImages, undistort_images
from neeco.ingest.frames.views import SfmResult, StageProgress, Views
from neeco.ingest.recording.model import MIN_FRAMES
from neeco.ingest.registration.base import BaseRegistration
from neeco.ingest.registration.clocks import find_instrument_clocks, register
from neeco.ingest.registration.find_bases import (
    check_reference_frames,
    correct_placement,
    find_bases,
    follow_cameras,
    require_no_base,
)
from neeco.ingest.registration.hand_eye import Registration
from neeco.ingest.shaft.from_video import find_in_video, on_masks
from neeco.ingest.timing.episodes import Episodes
from neeco.ingest.world import (
    World,
    longest_lag,
    note_motion_contradiction,
    residual_flow,
)


def find_moving_world(data: Episodes, images: ChosenImages, folder: Path, progress: StageProgress) -> World:
    """Find cameras, registration, clocks, bases and instruments; then adjust the cameras without what moves.

    folder: for temporary files. Raises NeecoError where too few images get a camera.
    """
    check_reference_frames(data, moving=True)
    settings = data.recording.settings
    lens = images.lens
    motion = StructureFromMotion(
        work=folder / "sfm", source=data.video.path, folder=images.folder / "raw", names=images.names,
        size=images.size, pinhole=lens.pinhole(images.size) if lens else None, masks=images.masks, settings=settings,
        episodes=data.episode_of(images.selected),
    )  # fmt: skip
    sfm = motion.reconstruct(progress)
    _check_joined(data, images.selected[sfm.indices])
    if lens is None:
        assert sfm.lens is not None
        data.notes.add(
            f"intrinsics were estimated by structure from motion (focal length {sfm.lens.fl_x:.1f} px, radial "
            f"distortion {sfm.lens.distortion[0]:.3f}); a calibration is better"
        )
        images = undistort_images(images, sfm.lens, data.video, progress)

    views = images.views(data, sfm.indices, sfm.world_from_camera)
    flow = residual_flow(sfm, views)

    def foreground(rows: np.ndarray) -> np.ndarray:
        return passing_masks(views.load, flow, rows, settings.moving_px, views.visible)

    data, registration = register(data, views)
    data = find_instrument_clocks(data, flow, views, progress)
    bases: dict[str, BaseRegistration] = {}
    shapes: dict[str, RoughShape] = {}
    evidence: dict[int, np.ndarray] = {}
    before: Views | None = None
    masks = None
    on_instruments = np.zeros(len(sfm.observations), dtype=bool)
    if registration is None:
        require_no_base(data)
    else:
        before = _registered(views, registration)
        data, bases = find_bases(data, before, foreground, progress, registration)
        data, corrected = correct_placement(data, before, registration, foreground, progress)
        bases |= corrected
        data = data.with_assumed_clocks()
        progress("finding the instrument", 0, 0)
        on_instruments, shapes, evidence = _carve_instruments(data, sfm, views, flow, registration)
    if data.video_instrument is not None:
        progress("finding what moves", 0, 0)
        masks = foreground(np.arange(len(sfm.indices)))
        on_instruments |= on_masks(masks, sfm, images.size)

    first = sfm.indices
    sfm = motion.adjust(sfm, on_instruments, progress)
    views = images.views(data, sfm.indices, sfm.world_from_camera)
    data, registration = register(data, views)  # first: it may find clocks
    distance, shaft = settings.scene_distance_mm, None
    placed, points = _in_mm(sfm, views, registration, distance)
    if before is not None and registration is not None:
        data, bases = follow_cameras(data, bases, before, placed)
    if data.video_instrument is not None:
        assert masks is not None
        masks = masks[np.isin(first, sfm.indices)]
        tissue = None if registration is not None else float(np.median(_distances(points, placed.world_from_camera)))
        progress("finding the shaft", 0, 0)
        data, shaft = find_in_video(data, data.video_instrument, placed, masks, tissue)
        placed, points = _in_mm(sfm, views, registration, shaft.axes.scale * distance)
    data = data.with_assumed_clocks()
    if registration is not None and evidence:
        _compare_motion(data, placed, shapes, evidence, flow.pinhole)
    states, usable = data.states_at(views.times)
    return World(
        data=data, images=images, views=placed, states=states, usable=usable, tissue=_reliable(data, sfm, points),
        shapes=shapes, bases=bases, shaft=shaft, masks=masks, registration=registration,
        reprojection_px=sfm.reprojection_px, search=motion.search, moving=evidence, still=False,
    )  # fmt: skip


def _check_joined(data: Episodes, placed: np.ndarray) -> None:
    """Raise NeecoError for an episode that structure from motion did not join to the others. placed [M]: the frames
    that got a camera."""
    counts = np.bincount(data.episode_of(placed), minlength=len(data.parts))
    for part, count in zip(data.parts, counts, strict=True):
        if count < MIN_FRAMES and not data.single:
            raise NeecoError(
                f"{part.recording.path}: {part.name} stands alone: {count} of its frames show enough of what the other "
                f"recordings show to find their cameras together (at least {MIN_FRAMES} are needed); where it "
                f"shows another tissue, {SEPARATE_TISSUES}, else leave it out"
            )


def _registered(views: Views, registration: Registration) -> Views:
    return replace(views, world_from_camera=registration.cameras(views.world_from_camera))


def _in_mm(
    sfm: SfmResult, views: Views, registration: Registration | None, distance_mm: float
) -> tuple[Views, np.ndarray]:
    """Return views and points [P, 3] in the tracker's frame, or in SfM's with the tissue `distance_mm` away."""
    if registration is not None:
        return _registered(views, registration), registration.points(sfm.points)
    scale = distance_mm / float(np.median(_distances(sfm.points, sfm.world_from_camera)))
    cameras = sfm.world_from_camera.copy()
    cameras[:, :3, 3] *= scale
    return replace(views, world_from_camera=cameras), sfm.points * scale


def _distances(points: np.ndarray, cameras: np.ndarray) -> np.ndarray:
    """Return distances [P, C] between points [P, 3] and every tenth camera."""
    return np.asarray(np.linalg.norm(points[:, None] - cameras[None, ::10, :3, 3], axis=-1))


def _reliable(data: Episodes, sfm: SfmResult, points: np.ndarray) -> PointCloud:
    """Return the tissue from the points [P, 3] mm of a reconstruction that several images observe and that fit well."""
    reliable = sfm.reliable_points()
    if not reliable.any():
        reliable = np.ones(len(points), dtype=bool)
        data.notes.add("no tissue point is observed by several frames and fits well: all of them are kept")
    return PointCloud(points[reliable].astype(np.float32), (sfm.colors[reliable] / 255).astype(np.float32))


def _carve_instruments(
    data: Episodes, sfm: SfmResult, views: Views, flow: ResidualFlow, registration: Registration
) -> tuple[np.ndarray, dict[str, RoughShape], dict[int, np.ndarray]]:
    """Carve the rough shape of every tracked instrument from what moves with its pose.

    Return the observations bool [Q] on instruments, the shapes, and by video frame where [h, w] pixels moved.
    """
    settings = data.recording.settings
    rows = np.unique(np.linspace(0, len(sfm.indices) - 1, settings.shape_frames).astype(int))
    evidence = flow.moving_pixels(rows, settings.moving_px)
    points, views = registration.points(sfm.points), _registered(views, registration)
    camera_from_world = np.linalg.inv(views.world_from_camera)
    on_instruments, shapes = np.zeros(len(sfm.observations), dtype=bool), {}
    for name in data.parts[0].poses:
        poses, valid = data.instrument_poses(name, views.times)
        camera_from_instrument = camera_from_world @ np.where(valid[:, None, None], poses, np.eye(4))
        usable = valid[rows]
        shape = carve_shape(evidence[usable], camera_from_instrument[rows[usable]], flow.pinhole)
        if shape is None:
            continue
        shapes[name] = shape
        for row in np.flatnonzero(valid):
            on_instruments |= observations_on(
                shape, camera_from_instrument[row], sfm, int(row), points,
                camera=flow.pinhole.camera(views.world_from_camera[row]),
            )  # fmt: skip
    return on_instruments, shapes, dict(zip(views.frames[rows].tolist(), evidence, strict=True))


def _compare_motion(
    data: Episodes, views: Views, shapes: Mapping[str, RoughShape], evidence: Mapping[int, np.ndarray], pinhole: Lens
) -> None:
    """Note instruments that do not move in the images as their poses do, by the capture's own clocks and cameras.

    evidence: by video frame where [h, w] pixels moved.
    """
    rows = np.flatnonzero(np.isin(views.frames, list(evidence)))
    moved = np.stack([evidence[frame] for frame in views.frames[rows].tolist()])
    camera_from_world = np.linalg.inv(views.world_from_camera[rows])
    for name in data.parts[0].poses:

        def before_cameras(lag: float, of: str = name) -> tuple[np.ndarray, np.ndarray]:
            poses, known = data.instrument_poses(of, views.times[rows], lag)
            return camera_from_world @ np.where(known[:, None, None], poses, np.eye(4)), known

        lag = best_lag(moved, before_cameras, pinhole, longest_lag(data))
        note_motion_contradiction(data, name, name in shapes, lag)
