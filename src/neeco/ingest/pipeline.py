"""From a recording to a capture: read, look over, find cameras, register, smooth, split, write."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch

from neeco.capture.images import open_image, write_image, write_labels
from neeco.capture.model import Capture, Frame, PointCloud
from neeco.capture.writer import write_capture
from neeco.errors import NeecoError
from neeco.ingest.border import SAMPLES, visible_mask
from neeco.ingest.clocks import offset_from_instrument
from neeco.ingest.lens import Lens, read_lens
from neeco.ingest.moving import FRAMES, RoughShape, carve_shape, motion_between, moving_pixels, project_mask
from neeco.ingest.recording import FEWEST_FRAMES, Recording, Splits
from neeco.ingest.registration import Registration, register_with_laparoscope
from neeco.ingest.result import IngestResult
from neeco.ingest.select import choose_frames, look_over
from neeco.ingest.sfm import SfmResult, StageProgress, StructureFromMotion
from neeco.ingest.splits import LEFT_OUT, Assigned, assign_splits
from neeco.ingest.staging import staged
from neeco.ingest.work import (
    States,
    Work,
    begin,
    instrument_poses,
    instruments_of,
    note_once,
    state_of,
    states_at,
    states_for_choice,
)
from neeco.raster.pinhole import project_world

MOST_FRAMES = 400  # kept unless the recording asks for another number
SCENE_MM = 100.0  # from the cameras to the tissue, taken when nothing measures it


def ingest(
    recording: Recording,
    output: Path,
    progress: StageProgress,
    complete: Callable[[IngestResult, Path], None] = lambda result, folder: None,
) -> IngestResult:
    """Make the capture `output` from a recording and say how good it is.

    Nothing appears at `output` before the capture is whole: `complete` may add files to its `folder` before. Raises
    NeecoError for unusable input: file, row or key, and what to do.
    """
    with staged(output) as folder:
        work = begin(recording, folder, progress)
        lens = _read_lens(recording, work.video.size)
        work.kept = _choose(work)
        names = _write_images(work, lens)
        sfm_folder = folder / "sfm"
        sfm_folder.mkdir()
        visible = _visible(work, lens, names)
        pinhole = lens.pinhole(work.video.size) if lens else None
        motion = StructureFromMotion(sfm_folder, work.video.path, folder / "raw", names, pinhole, visible)
        sfm = motion.reconstruct(progress)
        if pinhole is None:
            fl_x, fl_y, cx, cy, *distortion = (float(value) for value in sfm.camera_params)
            lens = Lens(fl_x, fl_y, cx, cy, tuple(distortion))
            pinhole = lens.pinhole(work.video.size)
            work.notes.append(
                f"intrinsics were estimated by structure from motion (focal lengths {lens.fl_x:.1f} x {lens.fl_y:.1f} "
                "px); a calibration is better"
            )
            _write_images(work, lens)
        registration = _register(work, sfm)
        _clocks_from_instruments(work, motion, sfm, pinhole)
        doubtful, shapes = _on_instruments(work, motion, sfm, pinhole, registration)
        sfm = motion.adjust(sfm, doubtful, progress)
        registration = _register(work, sfm)
        result = _finish(work, output, sfm, pinhole, registration, shapes, visible)
        complete(result, folder / "capture")
        return result


def _read_lens(recording: Recording, size: tuple[int, int]) -> Lens | None:
    """The lens given, checked against the video's size. Raises NeecoError naming where it was given."""
    given = recording.intrinsics
    where = given if isinstance(given, Path) else f"{recording.path}: intrinsics"
    try:
        lens = read_lens(given)
        if lens is not None:
            lens.check_size(size, where)
            lens.pinhole(size)
    except NeecoError as error:
        message = str(error)
        for name in ("intrinsics", "lens"):  # which is all that numbers and distortion know of where they came from
            message = message.replace(f"{name}: ", f"{where}: ", 1) if message.startswith(f"{name}: ") else message
        raise NeecoError(message) from error
    return lens


def _choose(work: Work) -> np.ndarray:
    """Video frames to keep."""
    count = len(work.times)

    def images() -> Iterator[np.ndarray]:
        for done, (_, image) in enumerate(work.video.read(range(count))):
            work.progress("looking at the frames", done, count)
            yield image

    look = look_over(images())
    states, usable = states_for_choice(work)
    limit = work.recording.frames or MOST_FRAMES
    selection = choose_frames(look, usable, states, limit)
    if work.recording.frames is None and count > MOST_FRAMES:
        work.notes.append(f"{MOST_FRAMES} of {count} frames are kept; ask for more with --frames")
    work.dropped |= dict(selection.dropped)
    if len(selection.kept) < FEWEST_FRAMES:
        raise NeecoError(
            f"{work.video.path}: only {len(selection.kept)} of {count} frames are usable (at least {FEWEST_FRAMES} are "
            f"needed); most are dropped because: {_commonest(work.dropped)}"
        )
    return selection.kept


def _commonest(dropped: dict[int, str]) -> str:
    reasons = [why.split(":")[0] for why in dropped.values()]
    return max(set(reasons), key=reasons.count) if reasons else "the video is short"


def _write_images(work: Work, lens: Lens | None) -> list[str]:
    """Frames as PNG: as recorded while the lens is unknown, else undistorted."""
    folder = work.folder / "raw"
    folder.mkdir(exist_ok=True)
    names = [f"{frame:06d}.png" for frame in work.kept]
    for done, (name, (_, image)) in enumerate(zip(names, work.video.read(work.kept.tolist()), strict=True)):
        work.progress("writing frames", done, len(names))
        straight = lens.undistort(image) if lens else image
        write_image(folder / name, torch.from_numpy(straight.astype(np.float32) / 255))
    return names


def _visible(work: Work, lens: Lens | None, names: list[str]) -> Path | None:
    """Masks of the endoscope's dark border, one file per frame as SfM wants them; None without a border."""
    sample = work.kept[np.linspace(0, len(names) - 1, min(SAMPLES, len(names))).astype(int)]
    seen = visible_mask(image for _, image in work.video.read(np.unique(sample).tolist()))
    if seen is None:
        return None
    if lens is not None:
        seen = lens.undistort_mask(seen)
    folder = work.folder / "visible"
    folder.mkdir()
    first = folder / f"{names[0]}.png"
    write_labels(first, torch.from_numpy(seen.astype(np.uint8) * 255))
    for name in names[1:]:
        shutil.copyfile(first, folder / f"{name}.png")
    work.notes.append(f"the endoscope's dark border ({1 - seen.mean():.0%} of the image) is masked")
    return folder


def _register(work: Work, sfm: SfmResult) -> Registration | None:
    """SfM's frame to the tracker's, where the scope was tracked and moved enough; else None, with a note why."""
    scope = work.logs.scope
    if scope is None:
        note_once(
            work,
            "the laparoscope was not tracked: "
            + ("instrument poses stay in the tracker's frame (unregistered), and " if work.logs.poses else "")
            + f"lengths are scaled as if the tissue were {SCENE_MM:g} mm away",
        )
        return None
    given = work.clocks.get(scope.clock)
    known = given.seconds if given is not None and given.source == "given" else None
    times = work.times_of(sfm)
    try:
        registration = register_with_laparoscope(sfm.world_from_camera, times, scope, known)
    except NeecoError as error:
        note_once(work, f"not registered, instrument poses stay in the tracker's frame: {error}")
        return None
    work.clocks[scope.clock] = registration.clock
    return registration


def _loader(work: Work, motion: StructureFromMotion, sfm: SfmResult) -> Callable[[int], np.ndarray]:
    """Image [H, W, 3] uint8 of a row of `sfm`."""

    def load(row: int) -> np.ndarray:
        return np.asarray(open_image(work.folder / "raw" / motion.names[int(sfm.indices[row])]).convert("RGB"))

    return load


def _clocks_from_instruments(work: Work, motion: StructureFromMotion, sfm: SfmResult, pinhole: Lens) -> None:
    """Clocks that neither `sync` nor the scope told: from how the instruments move in the images."""
    unknown = {log.clock: log for log in work.logs.poses.values() if log.clock not in work.clocks}
    if not unknown:
        return
    work.progress("finding the instrument's clock", 0, 0)
    moved = motion_between(_loader(work, motion, sfm), sfm, pinhole)
    for clock, log in unknown.items():
        try:
            work.clocks[clock] = offset_from_instrument(moved, work.times_of(sfm), log)
        except NeecoError as error:
            note_once(work, str(error))


def _on_instruments(
    work: Work, motion: StructureFromMotion, sfm: SfmResult, pinhole: Lens, registration: Registration | None
) -> tuple[np.ndarray, dict[str, RoughShape]]:
    """bool [Q]: observations on an instrument, whose rough shape is carved from what moves with its pose."""
    doubtful = np.zeros(len(sfm.observations), dtype=bool)
    if registration is None:
        return doubtful, {}
    work.progress("finding the instrument", 0, 0)
    rows = np.unique(np.linspace(0, len(sfm.indices) - 1, FRAMES).astype(int))
    evidence = moving_pixels(_loader(work, motion, sfm), sfm, pinhole, rows)
    cameras = registration.cameras(sfm.world_from_camera)
    shapes = {}
    for name, log in work.logs.poses.items():
        poses, valid = instrument_poses(work, log, work.times_of(sfm))
        camera_from_instrument = np.linalg.inv(cameras) @ np.where(valid[:, None, None], poses, np.eye(4))
        usable = valid[rows]
        shape = carve_shape(evidence[usable], camera_from_instrument[rows[usable]], pinhole)
        if shape is None:
            work.notes.append(
                f"instrument {name!r}: nothing in the images moves with its tracked pose; check its log and clock"
            )
            continue
        shapes[name] = shape
        doubtful |= _observations_on(shape, sfm, cameras, camera_from_instrument, valid, registration, pinhole, work)
    return doubtful, shapes


def _observations_on(
    shape: RoughShape,
    sfm: SfmResult,
    cameras: np.ndarray,
    camera_from_instrument: np.ndarray,
    valid: np.ndarray,
    registration: Registration,
    pinhole: Lens,
    work: Work,
) -> np.ndarray:
    """bool [Q]: observations that lie on the projected shape."""
    width, height = work.video.size
    points = registration.points(sfm.points)
    on = np.zeros(len(sfm.observations), dtype=bool)
    for row in np.flatnonzero(valid):
        mine = np.flatnonzero(sfm.observations[:, 0] == row)
        mask = project_mask(shape, camera_from_instrument[row], pinhole, (width, height))
        camera = pinhole.camera(cameras[row])
        spots, _ = project_world(points[sfm.observations[mine, 1].astype(int)], camera, nearest=camera.near)
        x = np.clip(spots[:, 0].astype(int), 0, width - 1)
        y = np.clip(spots[:, 1].astype(int), 0, height - 1)
        on[mine] = mask[y, x]
    return on


def _finish(
    work: Work,
    output: Path,
    sfm: SfmResult,
    pinhole: Lens,
    registration: Registration | None,
    shapes: dict[str, RoughShape],
    visible: Path | None,
) -> IngestResult:
    """States at every frame's time, splits, and the capture on disk."""
    for index in set(range(len(work.kept))) - set(sfm.indices.tolist()):
        work.dropped[int(work.kept[index])] = "no camera: too few of its features match other frames"
    frames, times = work.kept[sfm.indices], work.times_of(sfm)
    cameras, points = _placed(sfm, registration)
    states, usable = states_at(work, times)
    for frame in frames[~usable]:
        work.dropped[int(frame)] = "no instrument state at its time (gap in a log)"
    rule = _split(work, frames, states, usable)
    chosen = usable & (np.array(rule.names) != LEFT_OUT)
    for frame in frames[usable & ~chosen]:
        work.dropped[int(frame)] = "beside an unseen frame"
    capture_frames = tuple(
        Frame(
            work.folder / "raw" / f"{frames[i]:06d}.png",
            pinhole.camera(cameras[i]),
            state_of(states, int(i), float(times[i])),
            rule.names[i],
            visible / f"{frames[i]:06d}.png.png" if visible else None,
        )
        for i in np.flatnonzero(chosen)
    )
    reliable = sfm.reliable_points()
    if not reliable.any():
        reliable = np.ones(len(sfm.points), dtype=bool)
        work.notes.append("no tissue point is seen by several frames and fits well: all of them are kept")
    cloud = PointCloud(points[reliable].astype(np.float32), (sfm.colors[reliable] / 255).astype(np.float32))
    registered = registration is not None or not work.logs.poses
    capture = Capture(work.folder, capture_frames, instruments_of(work), cloud, registered)
    write_capture(capture, work.folder / "capture")
    order = np.flatnonzero(chosen)
    position = {row: index for index, row in enumerate(order.tolist())}
    registered_frames = (
        np.array([position.get(int(r), -1) for r in registration.used]) if registration else np.array([])
    )
    return IngestResult(
        output,
        str(work.recording.path),
        len(work.times),
        float(1 / np.median(np.diff(work.times))),
        work.video.size,
        frames[order],
        times[order],
        tuple(sorted(work.dropped.items())),
        work.clocks,
        registration,
        registered_frames,
        sfm.reprojection_px,
        int(reliable.sum()),
        shapes,
        rule.rule,
        tuple(work.notes),
    )


def _placed(sfm: SfmResult, registration: Registration | None) -> tuple[np.ndarray, np.ndarray]:
    """Cameras [M, 4, 4] and points [P, 3] in mm: the tracker's, or SfM's frame at a plausible size."""
    if registration is not None:
        return registration.cameras(sfm.world_from_camera), registration.points(sfm.points)
    distances = np.linalg.norm(sfm.points[:, None] - sfm.world_from_camera[None, ::10, :3, 3], axis=-1)
    scale = SCENE_MM / float(np.median(distances))
    cameras = sfm.world_from_camera.copy()
    cameras[:, :3, 3] *= scale
    return cameras, sfm.points * scale


def _split(work: Work, frames: np.ndarray, states: States, usable: np.ndarray) -> Assigned:
    """By the first tracked instrument; frames without a state are LEFT_OUT."""
    names = np.full(len(frames), LEFT_OUT, dtype=object)
    poses, joints = next(iter(states.values()), (np.tile(np.eye(4), (len(frames), 1, 1)), {}))
    rule = work.recording.splits
    by = rule.unseen_by if rule else None
    if by is not None and by not in joints:  # another instrument's
        owner = next((values for _, values in states.values() if by in values), None)
        if owner is None:
            raise NeecoError(
                f"{work.recording.path}: splits.unseen_by: {by!r} is the joint of an instrument without poses; "
                "name another"
            )
        joints = owner
    if not states and rule is None:
        rule = Splits(unseen_fraction=0.0)
    assigned = assign_splits(
        frames[usable], poses[usable], {joint: values[usable] for joint, values in joints.items()}, rule
    )
    names[usable] = assigned.names
    if "train" not in assigned.names:
        raise NeecoError(f"{work.recording.path}: splits: leave no frame to train on ({assigned.rule}); change them")
    for kind, ranges in (("test", rule.test), ("unseen", rule.unseen)) if rule else ():
        if ranges and kind not in assigned.names:
            work.notes.append(
                f"splits.{kind}: no frame of the capture lies in the ranges given (the video has "
                f"{len(work.times)} frames)"
            )
    return Assigned(tuple(names), assigned.rule)
