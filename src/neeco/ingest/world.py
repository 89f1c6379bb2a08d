"""The world of an ingest: cameras, tissue and instruments. Cameras of a moving scope are estimated by structure from
motion and registered by its tracker; the frame of a still scope is the world."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from neeco.base.errors import NeecoError
from neeco.capture.model import SEPARATE_TISSUES, PointCloud, evenly_spaced
from neeco.geometry.lens import Lens
from neeco.ingest.cameras.sfm import StructureFromMotion
from neeco.ingest.cameras.still_scene import (
    STILL_SCOPE,
    RightCamera,
    look_behind,
    moving_shares,
    read_right_camera,
    same_place,
    stands_still,
)
from neeco.ingest.foreground.masks import ResidualFlow, find_background, moving_masks, passing_masks
from neeco.ingest.foreground.rough_shape import PosesAt, RoughShape, best_lag, carve_shapes, observations_on
from neeco.ingest.frames.images import ChosenImages, SfmResult, StageProgress, Views, write_images
from neeco.ingest.readers.names import CAMERA
from neeco.ingest.recording.model import MIN_FRAMES, MOVING, STILL
from neeco.ingest.registration.base import BaseRegistration
from neeco.ingest.registration.clocks import find_instrument_clocks, register
from neeco.ingest.registration.find_bases import check_reference_frames, correct_placement, find_bases, follow_cameras
from neeco.ingest.registration.hand_eye import Registration
from neeco.ingest.shaft.from_video import FoundShaft, find_in_video, on_masks
from neeco.ingest.timing.episodes import Episodes, States
from neeco.ingest.timing.reading import require_lens


@dataclass(frozen=True, kw_only=True)
class WorldSettings:
    """Thresholds between episodes and cameras of a scope that stands still, and of points of tissue."""

    same_place: float = 0.4  # minimum share of features of one episode's background in place in another's
    mostly_similar: float = 0.7  # share of these features, below which the change is noted
    same_moment_s: float = 1e-3  # maximum time between two cameras' images of one moment
    min_point_images: int = 4  # minimum number of images that observe a point that is tissue
    max_point_error_px: float = 1.2  # maximum misfit of such a point


WORLD = WorldSettings()


@dataclass(frozen=True, eq=False, kw_only=True)
class World:
    """Lengths in mm. Rows are those of `views`."""

    data: Episodes  # with all clocks, bases and instruments in the video
    images: ChosenImages
    views: Views
    states: States
    usable: np.ndarray  # [M] bool, whether the states of all instruments are known
    tissue: PointCloud
    shapes: Mapping[str, RoughShape]  # by instrument
    bases: Mapping[str, BaseRegistration]  # by instrument, if estimated from moving pixels
    still: bool  # the scope stood still
    shaft: FoundShaft | None = None  # the instrument found in the video
    masks: np.ndarray | None = None  # bool [M, h, w], moving foreground, if an instrument was found in the video
    # of a scope that moves
    registration: Registration | None = None  # None: poses remain in their tracker's frame
    reprojection_px: float | None = None
    search: tuple[str, ...] = ()  # attempts at finding cameras, one sentence each
    moving: Mapping[int, np.ndarray] = field(default_factory=dict)  # video frame -> [h, w] motion frequency
    # of a scope that stands still
    depth_source: str | None = None  # continues "the tissue's depth is"
    right: RightCamera | None = None


def tracked_in(data: Episodes, names: Iterable[str], views: Views, rows: np.ndarray | slice) -> dict[str, PosesAt]:
    """Return what gives the poses of instruments in the cameras' frames of some rows of the views, by their names."""
    camera_from_world = np.linalg.inv(views.world_from_camera[rows])

    def poses_at(name: str, lag: float) -> tuple[np.ndarray, np.ndarray]:
        poses, valid = data.instrument_poses(name, views.times[rows], lag)
        return camera_from_world @ np.where(valid[:, None, None], poses, np.eye(4)), valid

    return {name: partial(poses_at, name) for name in names}


def compare_motion(
    data: Episodes,
    tracked: Mapping[str, PosesAt],
    shapes: Mapping[str, RoughShape],
    evidence: np.ndarray,
    pinhole: Lens,
) -> None:
    """Note instruments whose poses do not match any motion in the images, or match it at another time.

    evidence: moving pixels [R, h, w] of the rows of `tracked`, through `pinhole`.
    """
    longest = max(float(np.ptp(part.times)) for part in data.parts) / 2  # s; beyond, half of the frames have no poses
    for name, poses_at in tracked.items():
        lag = best_lag(evidence, poses_at, pinhole, longest)
        logs = data.parts[0].poses
        clock, sentence = logs[name].clock if name in logs else "", ""
        if lag and not data.notes.is_contradicted(f"sync {clock}"):
            after = "later" if lag > 0 else "earlier"
            sentence = (
                f"what moves in the images fits the poses of {name} that its log has {abs(lag):.1f} s {after}: if its "
                f"clock {clock!r} is not that of the other logs, give it one of its own (poses: clock), else correct "
                "`sync`"
            )
        elif lag or name not in shapes:
            sentence = (
                f"nothing in the images moves with the tracked pose of {name}: check its log, its frame and its clock"
            )
        data.notes.contradict(f"motion of {name}", sentence, severe=True)


def find_moving_world(data: Episodes, images: ChosenImages, folder: Path, progress: StageProgress) -> World:
    """Estimate cameras, registration, clocks, bases and instruments; then adjust the cameras without moving features.

    folder: for temporary files. Raises NeecoError if too few images get a camera.
    """
    check_reference_frames(data, moving=True)
    settings = data.recording.settings
    lens = images.lens
    motion = StructureFromMotion(
        work=folder / "sfm",
        source=data.video.path,
        folder=images.folder / "raw",
        names=images.names,
        size=images.size,
        pinhole=lens.pinhole(images.size) if lens else None,
        masks=images.masks,
        settings=settings,
        episodes=data.episode_of(images.selected),
    )
    sfm = motion.reconstruct(progress)
    counts = np.bincount(data.episode_of(images.selected[sfm.indices]), minlength=len(data.parts))
    for part, placed_count in zip(data.parts, counts, strict=True):
        if placed_count < MIN_FRAMES and not data.single:
            raise NeecoError(
                f"{part.recording.path}: {part.name} stands alone: {placed_count} of its frames show enough of what "
                "the other recordings show to find their cameras together (at least "
                f"{MIN_FRAMES} are needed); where it shows another tissue, {SEPARATE_TISSUES}, else leave it out"
            )
    if lens is None:
        assert sfm.lens is not None
        data.notes.add(
            f"intrinsics were estimated by structure from motion (focal length {sfm.lens.fl_x:.1f} px, radial "
            f"distortion {sfm.lens.distortion[0]:.3f}); a calibration is better"
        )
        images = replace(images, lens=sfm.lens)
        write_images(images, data.video, progress)

    views = images.views(data, sfm.indices, sfm.world_from_camera)
    flow = ResidualFlow(sfm, views)

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
        for item in (item for item in data.recording.instruments if item.base is not None):
            raise NeecoError(
                f"{data.recording.path}: world_from_base: where the base of {item.name} stands can be found only for a "
                "scope whose own poses are recorded (laparoscope) and move enough to register it; leave it out"
            )
    else:
        before, first_points = _in_mm(sfm, views, registration, settings.scene_distance_mm)
        data, bases = find_bases(data, before, foreground, progress, registration)
        data, corrected = correct_placement(data, before, registration, foreground, progress)
        bases |= corrected
        data = data.with_assumed_clocks()
        progress("finding the instrument", 0, 0)
        on_instruments, shapes, evidence = _carve_instruments(data, sfm, before, first_points, flow)
    if data.video_instrument is not None:
        progress("finding what moves", 0, 0)
        masks = foreground(np.arange(len(sfm.indices)))
        on_instruments |= on_masks(masks, sfm, images.size)

    first = sfm.indices
    sfm = motion.adjust(sfm, on_instruments, progress)
    views = images.views(data, sfm.indices, sfm.world_from_camera)
    data, registration = register(data, views)  # may estimate clocks
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
        rows = np.flatnonzero(np.isin(views.frames, list(evidence)))
        moved = np.stack([evidence[frame] for frame in views.frames[rows].tolist()])
        compare_motion(data, tracked_in(data, data.parts[0].poses, placed, rows), shapes, moved, flow.pinhole)
    reliable = (sfm.lengths >= WORLD.min_point_images) & (sfm.errors < WORLD.max_point_error_px)
    if not reliable.any():
        reliable = np.ones(len(points), dtype=bool)
        data.notes.add("no tissue point is observed by several frames and fits well: all of them are kept")
    states, usable = data.states_at(views.times)
    return World(
        data=data,
        images=images,
        views=placed,
        states=states,
        usable=usable,
        tissue=PointCloud(points[reliable].astype(np.float32), (sfm.colors[reliable] / 255).astype(np.float32)),
        shapes=shapes,
        bases=bases,
        shaft=shaft,
        masks=masks,
        registration=registration,
        reprojection_px=sfm.reprojection_px,
        search=motion.search,
        moving=evidence,
        still=False,
    )


def _in_mm(
    sfm: SfmResult, views: Views, registration: Registration | None, distance_mm: float
) -> tuple[Views, np.ndarray]:
    """Return views and points [P, 3] in the tracker's frame, or in SfM's with the tissue `distance_mm` away."""
    if registration is not None:
        placed = replace(views, world_from_camera=registration.cameras(views.world_from_camera))
        return placed, registration.points(sfm.points)
    scale = distance_mm / float(np.median(_distances(sfm.points, sfm.world_from_camera)))
    cameras = sfm.world_from_camera.copy()
    cameras[:, :3, 3] *= scale
    return replace(views, world_from_camera=cameras), sfm.points * scale


def _distances(points: np.ndarray, cameras: np.ndarray) -> np.ndarray:
    """Return distances [P, C] between points [P, 3] and every tenth camera."""
    return np.asarray(np.linalg.norm(points[:, None] - cameras[None, ::10, :3, 3], axis=-1))


def _carve_instruments(
    data: Episodes, sfm: SfmResult, views: Views, points: np.ndarray, flow: ResidualFlow
) -> tuple[np.ndarray, dict[str, RoughShape], dict[int, np.ndarray]]:
    """Carve the rough shape of every tracked instrument from pixels that move with its pose.

    views, points [P, 3]: in mm. Return the observations bool [Q] on instruments, the shapes, and moving pixels [h, w]
    by video frame.
    """
    settings = data.recording.settings
    rows = np.unique(np.linspace(0, len(sfm.indices) - 1, settings.shape_frames).astype(int))
    evidence = flow.moving_pixels(rows, settings.moving_px)
    on_instruments = np.zeros(len(sfm.observations), dtype=bool)
    names = data.parts[0].poses
    shapes = carve_shapes(evidence, tracked_in(data, names, views, rows), flow.pinhole)
    for name, poses_at in tracked_in(data, shapes, views, slice(None)).items():
        poses, valid = poses_at(0.0)
        for row in np.flatnonzero(valid):
            camera = flow.pinhole.camera(views.world_from_camera[row])
            on_instruments |= observations_on(shapes[name], poses[row], sfm, int(row), points, camera)
    return on_instruments, shapes, dict(zip(views.frames[rows].tolist(), evidence, strict=True))


def is_still(data: Episodes, images: ChosenImages, progress: StageProgress) -> bool:
    """Return whether the scope is still: as the recording states, else according to its images."""
    stated, stereo = data.recording.camera, data.recording.stereo is not None
    if stereo and stated == MOVING:
        data.notes.add("stereo: the second camera of a scope that moves is not used")
    if stated is not None:
        return stated == STILL
    progress("looking whether the scope moves", 0, 0)
    still = all(stands_still(images.loader(rows), len(rows)) for rows in _rows_by_episode(data, images).values())
    if still:
        data.notes.add("the scope stands still: nothing but the foreground moves in the images")
    elif stereo:
        sentence = "its second camera is for a scope that stands still, and the background moves: state `camera`"
        data.notes.contradict("scope", sentence, severe=False)
    return still or stereo


def find_still_world(data: Episodes, images: ChosenImages, folder: Path, progress: StageProgress) -> World:
    """Estimate clocks, bases, instruments and tissue for a still scope, whose frame is the world.

    folder: for temporary files. Raises NeecoError for an unknown lens.
    """
    require_lens(data.recording, images.lens)
    if data.parts[0].scope is not None:
        data.notes.add("the scope stands still: the laparoscope's log adds nothing to its images, and is ignored")
    check_reference_frames(data, moving=False)
    _check_one_place(data, images, progress)
    right = _right_camera(data, images, folder, progress)
    count = len(images.selected)
    cameras = SfmResult(  # a reconstruction without points: all cameras in one place
        indices=np.arange(count),
        world_from_camera=np.tile(np.eye(4), (count, 1, 1)),
        points=np.zeros((0, 3)),
        colors=np.zeros((0, 3), np.uint8),
        errors=np.zeros(0),
        lengths=np.zeros(0),
        observations=np.zeros((0, 5)),
        lens=None,
        reprojection_px=0.0,
    )
    views = images.views(data, cameras.indices, cameras.world_from_camera)

    def moving(rows: np.ndarray) -> np.ndarray:
        return moving_masks(views.load, count, rows, views.visible)

    data = find_instrument_clocks(data, ResidualFlow(cameras, views), views, progress)
    in_camera = [name for name, log in data.parts[0].poses.items() if log.frame == CAMERA]
    data = replace(data, world_from_base={name: np.eye(4) for name in in_camera})
    data, bases = find_bases(data, views, moving, progress)
    if unplaced := [name for name in data.parts[0].poses if name not in data.world_from_base]:
        data.notes.add(
            f"nothing states how the poses of {', '.join(unplaced)} stand to the camera (poses: {{frame: camera}}, "
            "or camera_from_base): they stay in their own frame (unregistered)"
        )
    shaft = masks = None
    if data.video_instrument is not None:
        progress("finding what moves", 0, 0)
        masks = moving(cameras.indices)
        progress("finding the shaft", 0, 0)
        data, shaft = find_in_video(data, data.video_instrument, views, masks, None)
    data = data.with_assumed_clocks()
    names = (*data.world_from_base, *data.video_poses)
    progress("finding the tissue behind the instrument", 0, 0)
    settings = data.recording.settings
    shapes = dict[str, RoughShape]()
    if names:
        rows = np.unique(np.linspace(0, count - 1, settings.shape_frames).astype(int))
        moved = moving_shares(views, rows)
        tracked = tracked_in(data, names, views, rows)
        shapes = carve_shapes(moved, tracked, views.reduced_pinhole)
    poses = {name: poses_at(0.0) for name, poses_at in tracked_in(data, names, views, slice(None)).items()}
    tissue, how = look_behind(data.notes, views, shapes, poses, settings, right)
    if names:
        compare_motion(data, tracked, shapes, moved, views.reduced_pinhole)
    states, usable = data.states_at(views.times)
    return World(
        data=data,
        images=images,
        views=views,
        states=states,
        usable=usable,
        tissue=tissue,
        shapes=shapes,
        bases=bases,
        shaft=shaft,
        masks=masks,
        still=True,
        depth_source=how,
        right=right,
    )


def _rows_by_episode(data: Episodes, images: ChosenImages) -> dict[int, np.ndarray]:
    """Return the rows of the chosen frames by episode."""
    episodes = data.episode_of(images.selected)
    return {int(episode): np.flatnonzero(episodes == episode) for episode in np.unique(episodes)}


def _check_one_place(data: Episodes, images: ChosenImages, progress: StageProgress) -> None:
    """Raise NeecoError for an episode in which a still scope observed another scene than in the first."""
    if data.single:
        return
    progress("comparing what the recordings show", 0, 0)
    backgrounds = {}
    for episode, rows in _rows_by_episode(data, images).items():
        load = images.loader(rows[evenly_spaced(len(rows), STILL_SCOPE.n_frames)])
        background = find_background(load, min(len(rows), STILL_SCOPE.n_frames))
        backgrounds[episode] = np.clip(background.colors, 0, 255).astype(np.uint8)
    first, *later_backgrounds = backgrounds
    for episode in later_backgrounds:
        share = same_place(backgrounds[first], backgrounds[episode])
        name, before = data.parts[episode].name, data.parts[first].name
        if share is not None and share < WORLD.same_place:
            raise NeecoError(
                f"{data.parts[episode].recording.path}: {name} shows another place than {before}: {share:.0%} of "
                f"the background is where it was; ingest each place alone; of several tissues, {SEPARATE_TISSUES}"
            )
        if share is not None and share < WORLD.mostly_similar:
            data.notes.add(
                f"{1 - share:.0%} of the background is not where it was in {before}: what changed is blurred", episode
            )


def _right_camera(data: Episodes, images: ChosenImages, folder: Path, progress: StageProgress) -> RightCamera | None:
    """Write the right camera's images of all episodes into `folder`."""
    if data.recording.stereo is None:
        return None
    names = [data.frame_name(int(frame)) for frame in images.selected]
    camera, names_by_row, delays = None, dict[int, str](), dict[int, float]()
    for episode, rows in _rows_by_episode(data, images).items():
        part = data.parts[episode]
        frames, stems = images.selected[rows] - part.first_frame, [names[row] for row in rows]
        right = read_right_camera(part.recording, frames, part.times, stems, folder / "right", progress)
        late = np.array([*right.delays.values()])
        if np.median(np.abs(late)) > WORLD.same_moment_s:
            data.notes.add(
                f"the right camera's images were taken {1000 * np.median(late):+.0f} ms after the left one's (median; "
                f"{1000 * late.min():+.0f} to {1000 * late.max():+.0f} ms): theirs are the states of these moments",
                episode,
            )
        camera = camera or right
        names_by_row |= {int(rows[row]): name for row, name in right.names.items()}
        delays |= {int(rows[row]): delay for row, delay in right.delays.items()}
    return None if camera is None else replace(camera, names=names_by_row, delays=delays)
