"""A recording becomes a capture, in stages that take and return frozen values:

    read            recordings  -> Episodes       logs and video on one timeline, with the clocks that are given
    choose frames   Episodes    -> ChosenImages   sharp frames that differ, undistorted, without a dark border
    find the world  both        -> World          cameras, clocks, bases, instruments, tissue (see below, and world.py)
    split           World       -> splits         which frames train, which test
    write           all         -> Capture        and the IngestResult, which reports how good it is

The world of a scope that moves: find cameras by structure from motion, register them to the scope's
tracker, find the instruments, adjust the cameras without these, register again. The world of a scope that stands still
is its own frame: find bases, instruments, and the tissue behind them. What a stage learns about clocks, bases and
instruments is in the `Episodes` that it returns; what it has to report, in `Episodes.notes`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.capture.model import (
    BaseUncertainty,
    Capture,
    Frame,
    FromVideo,
    Instrument,
    InstrumentState,
    State,
    Uncertainty,
)
from neeco.capture.writer import write_capture
from neeco.ingest.cameras.still_scene import RightCamera
from neeco.ingest.frames.images import DropReason, StageProgress, choose_images
from neeco.ingest.posing.posed_capture import prepare
from neeco.ingest.recording.model import Recording, Splits
from neeco.ingest.registration.clocks import note_frame_rates
from neeco.ingest.result import IngestResult
from neeco.ingest.shaft.from_video import NOT_VISIBLE
from neeco.ingest.staging import staged
from neeco.ingest.timing.episodes import Episodes, States
from neeco.ingest.timing.reading import read_episodes, separate
from neeco.ingest.world import World, find_moving_world, find_still_world, is_still


@dataclass(frozen=True, kw_only=True)
class SplitSettings:
    """Settings of the choice of test frames."""

    unseen_margin: int = 3  # video frames on each side of an unseen one that no other split may use
    min_range: float = 0.1  # minimum range of a joint's readings, rad, by which frames are split
    test_every: int = 8  # test share: one frame, or episode, in this many, unless the recording states another rule


SPLITS = SplitSettings()

LEFT_OUT = "left out"  # split of a frame too similar to an unseen one for training


def ingest(
    recording: Recording | Sequence[Recording],
    output: Path,
    progress: StageProgress,
    complete: Callable[[IngestResult, Path], None] = lambda result, folder: None,
) -> IngestResult:
    """Make the capture `output` from a recording, or from several of one instrument, and report how good it is.

    Nothing appears at `output` before the capture is whole: `complete` may add files to its `folder` before. Raises
    NeecoError for unusable input: file, row or key, and what to do.
    """
    recordings = separate([recording] if isinstance(recording, Recording) else recording)
    with staged(output) as folder:
        progress("reading logs and video", 0, 0)
        data = read_episodes(recordings)
        images = choose_images(data, folder, progress)
        (folder / "sfm").mkdir()
        find = find_still_world if is_still(data, images, progress) else find_moving_world
        world = find(data, images, folder, progress)
        note_frame_rates(world.data)
        splits, rule = split_frames(world.data, world.views.frames, world.states, world.usable)
        chosen = np.flatnonzero(world.usable & (splits != LEFT_OUT))
        capture = _capture(world, splits, chosen)
        dropped = {**world.images.dropped, **_left_out(world, splits)}
        result = _result(world, output, capture, chosen, dropped, rule)
        write_capture(capture, folder / "capture")
        item = world.data.video_instrument
        if item is not None and item.roll is None and world.right is None and world.masks is not None:
            # for `neeco view --annotate`; a second camera's images have no masks
            progress("measuring roll and joints", 0, 0)
            masks = world.masks[np.isin(world.views.frames, result.selected)]
            prepare(folder / "capture", {item.name: lambda frame: masks[frame]})
        complete(result, folder / "capture")
        return result


def _capture(world: World, splits: np.ndarray, chosen: np.ndarray) -> Capture:
    """Return the capture with the `chosen` rows of the views."""
    data, images, views, shaft = world.data, world.images, world.views, world.shaft
    frames = tuple(
        Frame(
            images.rename(int(views.frames[row]), data.frame_name(int(views.frames[row]))),
            views.pinhole.camera(views.world_from_camera[row]),
            _state(world.states, row, float(views.times[row]), None if shaft is None else shaft.uncertainties[row]),
            splits[row],
            images.mask_of(int(views.frames[row])),
        )
        for row in chosen.tolist()
    )
    if world.right is not None:  # only for training; test frames have one camera
        frames += _right_frames(data, world.right, frames, views.rows[chosen].tolist())
    assert images.lens is not None
    registered = world.registration is not None or set(data.parts[0].poses) <= set(data.world_from_base)
    lens = replace(images.lens, size=images.size, border=images.border)
    instruments = tuple(
        Instrument(
            item.name,
            {name: source.limits for name, source in item.joints.items()},
            item.kinematics,
            from_video=None
            if shaft is None or item.from_video is None
            else FromVideo(item.from_video.shaft_diameter_mm, shaft.working_length),
            base_uncertainty=_shared_uncertainty(world, item.name, chosen),
        )
        for item in data.recording.instruments
        if item.placed
    )
    return Capture(
        images.folder, frames, instruments, world.tissue, registered=registered, lens=lens, still=world.still
    )


def _shared_uncertainty(world: World, name: str, chosen: np.ndarray) -> BaseUncertainty | None:
    """Return the covariance of the error common to the `chosen` poses of an instrument: of its estimated base, else of
    the scope's hand-eye calibration; None for poses from the images, or if unknown."""
    poses = world.states[name][0][chosen]
    if (base := world.bases.get(name)) is not None:
        return base.uncertainty(world.views.world_from_camera[0], poses)
    if world.registration is None or name not in world.data.parts[0].poses:
        return None
    return world.registration.uncertainty(poses[:, :3, 3])


def _right_frames(data: Episodes, right: RightCamera, frames: Sequence[Frame], rows: list[int]) -> tuple[Frame, ...]:
    """Return the training frames among `frames`, rows of the chosen ones, with the right camera's images and the states
    at their times, if known."""
    taken = [
        (frame, row) for frame, row in zip(frames, rows, strict=True) if frame.split == "train" and row in right.names
    ]
    if not taken:
        return ()
    times = np.array([frame.state.time + right.delays[row] for frame, row in taken])
    states, valid = data.states_at(times)
    camera, right_frames = right.pinhole.camera(right.world_from_camera), []
    for index, (frame, row) in enumerate(taken):
        if valid[index]:
            path, state = right.folder / right.names[row], frame.state
            if right.delays[row] != 0:
                uncertainty = next((item.uncertainty for item in state.instruments.values()), None)
                state = _state(states, index, float(times[index]), uncertainty)
            right_frames.append(replace(frame, image_path=path, camera=camera, state=state, mask_path=right.mask))
    return tuple(right_frames)


def _result(
    world: World, output: Path, capture: Capture, chosen: np.ndarray, dropped: Mapping[int, DropReason], rule: str
) -> IngestResult:
    """Return the report on a capture of the `chosen` rows of the views, split by `rule`."""
    data, images, views, registration = world.data, world.images, world.views, world.registration
    item, unregistered = data.video_instrument, {}
    if registration is not None:
        sensors = np.linalg.inv(data.scope_poses(views.times[chosen]))
        unregistered = {name: sensors @ poses[chosen] for name, (poses, _) in world.states.items()}
    return IngestResult(
        capture=output,
        recording=", ".join(dict.fromkeys(str(part.recording.path) for part in data.parts)),
        video_frames=len(data.times),
        video_fps=float(1 / np.median(np.diff(data.times))),
        size=images.size,
        selected=views.frames[chosen],
        selected_times=views.times[chosen],
        dropped=tuple(sorted(dropped.items())),
        clocks=data.reported_clocks,
        registration=registration,
        reprojection_px=world.reprojection_px,
        points=len(world.tissue.positions),
        shapes=dict(world.shapes),
        still=world.still,
        depth_source=world.depth_source,
        split_rule=rule,
        notes=data.notes.sentences,
        search=world.search,
        unregistered=unregistered,
        moving=dict(world.moving),
        registered=capture.registered,
        bases=dict(world.bases),
        episodes=data.ranges,
        in_video=() if item is None else (item.name,),
        episode_starts={} if data.single else {part.name: part.start_s for part in data.parts},
        contradictions=data.notes.contradictions,
    )


def _left_out(world: World, splits: np.ndarray) -> dict[int, DropReason]:
    """Return why chosen video frames are not in the capture, by frame."""
    views, shaft = world.views, world.shaft
    without_camera = set(world.images.selected.tolist()) - set(views.frames.tolist())
    reasons = dict.fromkeys(without_camera, DropReason("no camera: too few of its features match other frames"))
    for row in np.flatnonzero(~world.usable).tolist():
        unseen = shaft is not None and not shaft.known[row]
        why = NOT_VISIBLE if unseen else "no instrument state at its time (gap in a log)"
        reasons[int(views.frames[row])] = DropReason(why)
    left_out = views.frames[world.usable & (splits == LEFT_OUT)].tolist()
    return reasons | dict.fromkeys(left_out, DropReason("next to an unseen frame", frame_usable=True))


def _state(states: States, row: int, time: float, uncertainty: Uncertainty | None) -> State:
    instruments = {
        name: InstrumentState(
            torch.from_numpy(poses[row].copy()),
            {joint: float(values[row]) for joint, values in joints.items()},
            uncertainty=uncertainty,
        )
        for name, (poses, joints) in states.items()
    }
    return State(instruments, time)


def split_frames(data: Episodes, frames: np.ndarray, states: States, usable: np.ndarray) -> tuple[np.ndarray, str]:
    """Split video frames [M] by the first tracked instrument's states where these are `usable` [M]; LEFT_OUT elsewhere.

    Return the splits and the rule in words. Raises NeecoError.
    """
    poses, joints = next(iter(states.values()), (np.tile(np.eye(4), (len(frames), 1, 1)), {}))
    where, rule = data.recording.path, data.recording.splits
    by = rule.unseen_by if rule else None
    if by is not None and by not in joints:  # another instrument's
        owner = next((values for _, values in states.values() if by in values), None)
        if owner is None:
            raise NeecoError(f"{where}: splits.unseen_by: {by!r} belongs to an instrument without poses; name another")
        joints = owner
    rule = rule or (Splits() if states else Splits(unseen_fraction=0.0))
    readings = {joint: values[usable] for joint, values in joints.items()}
    assigned, words = assign_splits(frames[usable], poses[usable], readings, rule, data.ranges)
    if "train" not in assigned:
        raise NeecoError(f"{where}: splits: leave no frame to train on ({words}); change them")
    for name in rule.test_episodes + rule.unseen_episodes:
        first, last = data.ranges[name]
        if not ((frames[usable] >= first) & (frames[usable] <= last)).any():
            data.notes.add(f"splits: no frame of the episode {name} is in the capture")
    for kind, ranges in (("test", rule.test), ("unseen", rule.unseen)):
        if ranges and kind not in assigned:
            data.notes.add(
                f"splits.{kind}: no frame of the capture lies in the ranges given (the video has "
                f"{len(data.times)} frames)"
            )
    splits = np.full(len(frames), LEFT_OUT, dtype=object)
    splits[usable] = assigned
    return splits, words


def assign_splits(
    frames: np.ndarray,
    poses: np.ndarray,
    joints: Mapping[str, np.ndarray],
    rule: Splits,
    episodes: Mapping[str, tuple[int, int]] | None = None,
) -> tuple[np.ndarray, str]:
    """Assign video frames [N], given by number, to splits; return the splits [N] and a description of the rule.

    Unseen frames are chosen by poses [N, 4, 4] of the instrument and readings [N] rad by joint. A frame too similar to
    one of them is LEFT_OUT. episodes: the frames (first, last) of each of several.
    """
    episodes = episodes or {}
    whole = rule.test_episodes
    if episodes and not (whole or rule.test or rule.test_every is not None):
        whole = tuple(episodes)[-max(1, len(episodes) // SPLITS.test_every) :]
    every = SPLITS.test_every if rule.test_every is None else rule.test_every
    splits = np.full(len(frames), "train", dtype=object)
    if whole or rule.test:
        inside, words = _spans(frames, whole, rule.test, episodes)
        splits[inside], words = "test", f"test: {words}"
    elif every:
        splits[frames % every == every // 2] = "test"
        words = f"test: video frames whose number leaves {every // 2} when divided by {every}"
    else:
        words = "test: none"
    if rule.unseen_episodes or rule.unseen:
        inside, unseen_words = _spans(frames, rule.unseen_episodes, rule.unseen, episodes)
        splits[inside] = "unseen"
        return splits, f"{words}; unseen: {unseen_words}"
    if rule.unseen_fraction == 0:
        return splits, f"{words}; unseen: none"
    # the extreme of one joint, of the instrument's rotation from its mean direction, or half of each
    moving = [name for name, values in joints.items() if np.ptp(values) > SPLITS.min_range]
    joint = rule.unseen_by or (moving[0] if moving else None)
    share = rule.unseen_fraction if rule.unseen_by or joint is None else rule.unseen_fraction / 2
    unseen = np.zeros(len(poses), dtype=bool)
    why = []
    if joint is not None:
        limit = float(np.quantile(joints[joint], 1 - share))
        unseen |= joints[joint] > limit
        why.append(f"{joint} above {np.degrees(limit):.0f} deg")
    if rule.unseen_by is None:
        turn = Rotation.from_matrix(poses[:, :3, :3])
        away = (turn.mean().inv() * turn).magnitude()
        limit = float(np.quantile(away, 1 - share))
        unseen |= away > limit
        why.append(f"instrument turned more than {np.degrees(limit):.0f} deg from its mean direction")
    if not unseen.any():
        return splits, f"{words}; unseen: none, as nothing moves"
    splits[unseen] = "unseen"
    splits[~unseen & (np.abs(frames[:, None] - frames[unseen]).min(1) <= SPLITS.unseen_margin)] = LEFT_OUT
    left_out = f"frames within {SPLITS.unseen_margin} of an unseen one are left out of the capture"
    return splits, f"{words}; unseen: {' or '.join(why)}; {left_out}"


def _spans(
    frames: np.ndarray, names: Sequence[str], ranges: Sequence[tuple[int, int]], episodes: Mapping[str, tuple[int, int]]
) -> tuple[np.ndarray, str]:
    """Return which frames [N] belong to the named episodes or, without any, to the ranges (first, last); in words."""
    spans = [episodes[name] for name in names] or ranges
    inside = np.any([(frames >= first) & (frames <= last) for first, last in spans], axis=0)
    if names:
        return inside, f"the recording{'s' * (len(names) > 1)} {', '.join(names)}"
    return inside, "video frames " + ", ".join(f"{first}-{last}" for first, last in ranges)
