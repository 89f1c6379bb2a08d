"""One ingest while it is under way: what was logged, whose clock says what, and the states at any video time."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from neeco.capture.ingest.clocks import ClockOffset
from neeco.capture.ingest.interpolate import poses_at, readings_at
from neeco.capture.ingest.logs import PoseLog, ReadingLog, read_pose_log, read_reading_log
from neeco.capture.ingest.recording import TRACKER_CLOCK, Recording
from neeco.capture.ingest.sfm import Progress
from neeco.capture.ingest.video import VideoSource
from neeco.capture.model import Instrument, InstrumentState, State
from neeco.errors import NeecoError

States = dict[str, tuple[np.ndarray, dict[str, np.ndarray]]]  # instrument -> poses [N, 4, 4], readings [N] by joint

LIMIT_SLACK = 0.03  # rad beyond a joint's limits that noise and calibration make


@dataclass
class Logs:
    """What was logged, by instrument."""

    poses: dict[str, PoseLog]
    joints: dict[str, dict[str, ReadingLog]]
    scope: PoseLog | None

    @property
    def notes(self) -> list[str]:
        logs: list[PoseLog | ReadingLog] = [*self.poses.values(), *([self.scope] if self.scope else [])]
        logs += [log for joints in self.joints.values() for log in joints.values()]
        return [note for log in logs for note in log.notes]


@dataclass
class Work:
    """Where an ingest stands; filled step by step."""

    recording: Recording
    folder: Path  # for everything temporary
    progress: Progress
    video: VideoSource
    times: np.ndarray  # [V] s, every video frame
    logs: Logs
    notes: list[str]
    clocks: dict[str, ClockOffset] = field(default_factory=dict)
    dropped: dict[int, str] = field(default_factory=dict)  # video frame -> why


def begin(recording: Recording, folder: Path, progress: Progress) -> Work:
    """Read the logs (quick, and wrong ones are found before the video is touched), then the video's times."""
    progress("reading logs", 0, 0)
    tracked = {item.name: read_pose_log(item.poses) for item in recording.instruments if item.poses is not None}
    joints = {
        item.name: {name: read_reading_log(source) for name, source in item.joints.items()}
        for item in recording.instruments
    }
    scope = read_pose_log(recording.laparoscope) if recording.laparoscope else None
    logs = Logs(tracked, joints, scope)
    progress("reading video", 0, 0)
    video = recording.open()
    notes = [*recording.notes, *logs.notes, *video.notes]
    for item in recording.instruments:
        if item.poses is None:
            notes.append(f"instrument {item.name!r} was not tracked: it is left out of the capture's states")
    if not tracked:
        notes.append("no instrument was tracked: the capture has cameras and images only (method 3dgs trains)")
    work = Work(recording, folder, progress, video, video.frame_times(), logs, notes)
    for name, seconds in recording.sync.items():
        work.clocks[name] = ClockOffset(float(seconds), 0.0, "given")
    _joint_clocks(work)
    return work


def _joint_clocks(work: Work) -> None:
    """A joint's own clock is given or taken to be the video's: images do not tell it to better than some 20 ms."""
    for logs in work.logs.joints.values():
        for name, log in logs.items():
            if log.clock in work.clocks or log.clock == TRACKER_CLOCK:
                continue
            if log.times[-1] < work.times[0] or log.times[0] > work.times[-1]:
                raise NeecoError(
                    f"{log.path}: its times ({log.times[0]:g} to {log.times[-1]:g} s) do not meet the video's (0 to "
                    f"{work.times[-1]:g} s); give the offset of its clock: sync: {{{log.clock}: seconds}}"
                )
            work.clocks[log.clock] = ClockOffset(0.0, float("nan"), "assumed equal to the video's")
            work.notes.append(
                f"the clock of joint {name!r} was not given and is taken to be the video's: at 1 rad/s, 20 ms off are "
                "1.1 deg"
            )


def note_once(work: Work, note: str) -> None:
    if note not in work.notes:
        work.notes.append(note)


def instrument_poses(work: Work, log: PoseLog, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses [N, 4, 4] in the tracker's frame at video times, and where known."""
    clock = work.clocks.get(log.clock)
    if clock is None:
        if log.times[-1] < work.times[0] or log.times[0] > work.times[-1]:
            raise NeecoError(
                f"{log.path}: its times ({log.times[0]:g} to {log.times[-1]:g} s) do not meet the video's, and nothing "
                f"ties the clocks; give the offset: sync: {{{log.clock}: seconds}}"
            )
        clock = work.clocks[log.clock] = ClockOffset(0.0, float("nan"), "assumed equal to the video's")
        note_once(work, f"the clock {log.clock!r} was not given and could not be found; it is taken to be the video's")
    return poses_at(log, times + clock.seconds)


def states_for_choice(work: Work) -> tuple[np.ndarray, np.ndarray]:
    """[V, 6 * instruments + joints] states for coverage, and where they are known; nothing while a clock is unknown."""
    columns, usable = [np.zeros((len(work.times), 6))], np.ones(len(work.times), dtype=bool)
    for log in work.logs.poses.values():
        clock = work.clocks.get(log.clock)
        if clock is None:
            continue
        poses, valid = poses_at(log, work.times + clock.seconds)
        usable &= valid
        arms = np.where(valid[:, None], poses[:, :3, 3], 0.0)
        turns = np.where(valid[:, None], poses[:, :3, :3].reshape(-1, 9)[:, :3], 0.0)
        columns.append(np.concatenate([arms, turns], 1))
    return np.concatenate(columns[1:] or columns, 1), usable


def states_at(work: Work, times: np.ndarray) -> tuple[States, np.ndarray]:
    """Every tracked instrument's states at video times [N], and where all of them are known."""
    states: States = {}
    usable = np.ones(len(times), dtype=bool)
    limits = {
        item.name: {joint: source.limits for joint, source in item.joints.items()}
        for item in work.recording.instruments
    }
    for name, log in work.logs.poses.items():
        poses, valid = instrument_poses(work, log, times)
        usable &= valid
        readings = {}
        for joint, reading in work.logs.joints[name].items():
            values, known = readings_at(reading, times + work.clocks[reading.clock].seconds)
            readings[joint] = _within_limits(work, reading, limits[name][joint], values)
            usable &= known
        states[name] = (poses, readings)
    if not usable.any():
        raise NeecoError(
            f"{work.recording.path}: no frame has a state of every instrument; check the logs' clocks in `sync`"
        )
    return states, usable


def _within_limits(work: Work, log: ReadingLog, limits: tuple[float, float] | None, values: np.ndarray) -> np.ndarray:
    """Readings [N] rad held within the joint's stated limits, where only noise carries them out."""
    if limits is None:
        return values
    held = np.clip(values, *limits)
    excess = float(np.nanmax(np.abs(values - held), initial=0.0))
    if excess > LIMIT_SLACK:
        raise NeecoError(
            f"{log.path}: readings go {np.degrees(excess):.1f} deg beyond the joint's limits {limits[0]:g} .. "
            f"{limits[1]:g} rad; correct `limits` in the recording, or the calibration"
        )
    if excess > 0:
        note_once(
            work, f"{log.path.name}: readings up to {np.degrees(excess):.1f} deg beyond the limits are held at them"
        )
    return held


def state_of(states: States, row: int, time: float) -> State:
    instruments = {
        name: InstrumentState(
            torch.from_numpy(poses[row].copy()), {joint: float(values[row]) for joint, values in joints.items()}
        )
        for name, (poses, joints) in states.items()
    }
    return State(instruments, time)


def instruments_of(work: Work) -> tuple[Instrument, ...]:
    return tuple(
        Instrument(item.name, {name: source.limits for name, source in item.joints.items()})
        for item in work.recording.instruments
        if item.poses is not None
    )
