"""A recording becomes a capture, in stages that take and return frozen values:

    read            recordings  -> Episodes       logs and video on one timeline, with the clocks that are given
    choose frames   Episodes    -> ChosenImages   sharp frames that differ, undistorted, without a dark border
    find the world  both        -> World          cameras, clocks, bases, instruments, tissue (see below)
    split           World       -> splits         which frames train, which test
    write           all         -> Capture        and the IngestResult, which reports how good it is

The world of a scope that moves (`moving_scope.py`): find cameras by structure from motion, register them to the scope's
tracker, find the instruments, adjust the cameras without these, register again. The world of a scope that stands still
(`still_scope.py`) is its own frame: find bases, instruments, and the tissue behind them. What a stage learns about
clocks, bases and instruments is in the `Episodes` that it returns; what it has to report, in `Episodes.notes`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from neeco.capture.model import BaseUncertainty, Capture, Frame, InstrumentState, State, Uncertainty
from neeco.capture.writer import write_capture
from neeco.ingest.cameras.still_scene import RightCamera
from neeco.ingest.frames.images import DropReason, choose_images
from neeco.ingest.frames.views import StageProgress
from neeco.ingest.moving_scope import find_moving_world
from neeco.ingest.posing.posed_capture import prepare
from neeco.ingest.recording.compatibility import separate
from neeco.ingest.recording.model import Recording
from neeco.ingest.registration.clocks import note_frame_rates
from neeco.ingest.result import IngestResult
from neeco.ingest.shaft.from_video import NOT_VISIBLE, instruments_of, uncertainties
from neeco.ingest.splits import LEFT_OUT, split_frames
from neeco.ingest.staging import staged
from neeco.ingest.still_scope import find_still_world, is_still
from neeco.ingest.timing.episodes import Episodes, States
from neeco.ingest.timing.reading import read_episodes
from neeco.ingest.world import World


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
        _measure_roll(world, result, folder / "capture", progress)
        complete(result, folder / "capture")
        return result


def _capture(world: World, splits: np.ndarray, chosen: np.ndarray) -> Capture:
    """Return the capture of the `chosen` rows of the views."""
    data, images, views, shaft = world.data, world.images, world.views, world.shaft
    item = data.video_instrument
    deviations = uncertainties(item, shaft) if item and shaft else None
    frames = tuple(
        Frame(
            images.rename(int(views.frames[row]), data.frame_name(int(views.frames[row]))),
            views.pinhole.camera(views.world_from_camera[row]),
            _state(world.states, row, float(views.times[row]), None if deviations is None else deviations[row]),
            splits[row],
            images.mask_of(int(views.frames[row])),
        )
        for row in chosen.tolist()
    )
    if world.right is not None:  # one camera more to learn from; what is tested stays one
        frames += _right_frames(data, world.right, frames, views.rows[chosen].tolist())
    assert images.lens is not None
    registered = world.registration is not None or set(data.parts[0].poses) <= set(data.world_from_base)
    lens = replace(images.lens, size=images.size, border=images.border)
    instruments = tuple(
        replace(one, base_uncertainty=_shared_uncertainty(world, one.name, chosen))
        for one in instruments_of(data.recording, shaft)
    )
    return Capture(
        images.folder, frames, instruments, world.tissue, registered=registered, lens=lens, still=world.still
    )


def _shared_uncertainty(world: World, name: str, chosen: np.ndarray) -> BaseUncertainty | None:
    """Return the covariance of the error that the `chosen` poses of an instrument share: of its base as found in the
    images, else of the scope's hand-eye calibration; None where poses come from the images, or nothing is known."""
    poses = world.states[name][0][chosen]
    if (base := world.bases.get(name)) is not None:
        return base.uncertainty(world.views.world_from_camera[0], poses)
    if world.registration is None or name not in world.data.parts[0].poses:
        return None
    return world.registration.uncertainty(poses[:, :3, 3])


def _right_frames(data: Episodes, right: RightCamera, frames: Sequence[Frame], rows: list[int]) -> tuple[Frame, ...]:
    """Return the training frames among `frames`, rows of the chosen ones, as the right camera took them: with the
    states of its own moments, where these are known."""
    taken = [
        (frame, row) for frame, row in zip(frames, rows, strict=True) if frame.split == "train" and row in right.names
    ]
    if not taken:
        return ()
    times = np.array([frame.state.time + right.delays[row] for frame, row in taken])
    states, known = data.states_at(times)
    camera, found = right.pinhole.camera(right.world_from_camera), []
    for index, (frame, row) in enumerate(taken):
        if known[index]:
            path, state = right.folder / right.names[row], frame.state
            if right.delays[row] != 0:
                uncertainty = next((item.uncertainty for item in state.instruments.values()), None)
                state = _state(states, index, float(times[index]), uncertainty)
            found.append(replace(frame, image_path=path, camera=camera, state=state, mask_path=right.mask))
    return tuple(found)


def _result(
    world: World, output: Path, capture: Capture, chosen: np.ndarray, dropped: Mapping[int, DropReason], rule: str
) -> IngestResult:
    """Return the report on a capture of the `chosen` rows of the views, split by `rule`."""
    data, images, views, registration = world.data, world.images, world.views, world.registration
    item = data.video_instrument
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
        unregistered=_unregistered(world, chosen) if registration is not None else {},
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
    found = set(world.images.selected.tolist()) - set(views.frames.tolist())
    reasons = dict.fromkeys(found, DropReason("no camera: too few of its features match other frames"))
    for row in np.flatnonzero(~world.usable).tolist():
        unseen = shaft is not None and not shaft.known[row]
        why = NOT_VISIBLE if unseen else "no instrument state at its time (gap in a log)"
        reasons[int(views.frames[row])] = DropReason(why)
    left_out = views.frames[world.usable & (splits == LEFT_OUT)].tolist()
    return reasons | dict.fromkeys(left_out, DropReason("next to an unseen frame", frame_usable=True))


def _unregistered(world: World, chosen: np.ndarray) -> dict[str, np.ndarray]:
    """`IngestResult.unregistered`, of the `chosen` of the views."""
    sensors = world.data.scope_poses(world.views.times[chosen])
    return {name: np.linalg.inv(sensors) @ poses[chosen] for name, (poses, _) in world.states.items()}


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


def _measure_roll(world: World, result: IngestResult, capture: Path, progress: StageProgress) -> None:
    """Measure roll and joints of an instrument found in the video in the written capture, for `neeco view --annotate`;
    not where the roll was logged, nor with a second camera, whose masks are not known."""
    item = world.data.video_instrument
    if item is None or item.roll is not None or world.right is not None or world.masks is None:
        return
    progress("measuring roll and joints", 0, 0)
    masks = world.masks[np.isin(world.views.frames, result.selected)]
    prepare(capture, {item.name: lambda frame: masks[frame]})
