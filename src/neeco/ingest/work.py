"""One ingest while it is under way: what was logged, whose clock says what, and the states at any video time."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from neeco.capture.model import Instrument, InstrumentState, State
from neeco.errors import NeecoError
from neeco.ingest.clocks import LONGEST, ClockOffset
from neeco.ingest.interpolate import poses_at, readings_at
from neeco.ingest.logs import PoseLog, ReadingLog, read_pose_log, read_reading_log
from neeco.ingest.recording import Recording
from neeco.ingest.sfm import SfmResult, StageProgress
from neeco.ingest.video import VideoSource

SLOWEST, FASTEST = 0.01, 10_000.0  # frames a second
SMALLEST = 32  # px: smaller frames have nothing to find cameras by

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
    progress: StageProgress
    video: VideoSource
    times: np.ndarray  # [V] s, every video frame
    logs: Logs
    notes: list[str]
    clocks: dict[str, ClockOffset] = field(default_factory=dict)
    dropped: dict[int, str] = field(default_factory=dict)  # video frame -> why
    kept: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))  # [K] video frames chosen

    def times_of(self, sfm: SfmResult) -> np.ndarray:
        """[M] s of the frames that got a camera."""
        return self.times[self.kept[sfm.indices]]


def begin(recording: Recording, folder: Path, progress: StageProgress) -> Work:
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
    work = Work(recording, folder, progress, video, _video_times(recording, video), logs, notes)
    for name, seconds in recording.sync.items():
        work.clocks[name] = ClockOffset(float(seconds), 0.0, "given")
    _assume_clocks(work)
    return work


def _video_times(recording: Recording, video: VideoSource) -> np.ndarray:
    """The frames' times s. Raises NeecoError for those that no recording has, and for frames too small."""
    times, source = video.times, recording.times or video.path
    rate = 1 / float(np.median(np.diff(times)))
    if not (SLOWEST < rate < FASTEST and times[-1] - times[0] < LONGEST):
        raise NeecoError(
            f"{source}: frames at {rate:.3g} a second over {(times[-1] - times[0]) / 3600:.3g} h cannot be; correct "
            "fps or the times' unit"
        )
    if min(video.size) < SMALLEST:
        width, height = video.size
        raise NeecoError(f"{video.path}: its frames are {width}x{height} pixels; give {SMALLEST} or more each way")
    return times


def _assume_clocks(work: Work) -> None:
    """Joints' clocks that nothing gives are taken to be the video's: images do not tell them to better than some 20 ms.

    Trackers' clocks, and those of joints on one of them, are found later, from motion.
    """
    scope = [work.logs.scope] if work.logs.scope else []
    found_later = {log.clock for log in [*work.logs.poses.values(), *scope]}
    for name in work.logs.poses:
        for joint, reading in work.logs.joints[name].items():
            if reading.clock not in work.clocks and reading.clock not in found_later:
                _assume(
                    work, reading, f"the clock of joint {joint!r} was not given", ": at 1 rad/s, 20 ms off are 1.1 deg"
                )


def _assume(work: Work, log: PoseLog | ReadingLog, why: str, cost: str = "") -> None:
    """Take a log's clock to be the video's, with a note. Raises NeecoError when their times do not meet."""
    if log.times[-1] < work.times[0] or log.times[0] > work.times[-1]:
        raise NeecoError(
            f"{log.path}: its times ({log.times[0]:g} to {log.times[-1]:g} s) do not meet the video's "
            f"({work.times[0]:g} to {work.times[-1]:g} s), and nothing ties the clocks; give the offset: "
            f"sync: {{{log.clock}: seconds}}"
        )
    work.clocks[log.clock] = ClockOffset(0.0, float("nan"), "assumed equal to the video's")
    work.notes.append(f"{why} and is taken to be the video's{cost}")


def offset_of(work: Work, log: PoseLog | ReadingLog) -> float:
    """Seconds the log's clock is ahead; the video's own clock when motion did not tell it."""
    if log.clock not in work.clocks:
        _assume(work, log, f"the clock {log.clock!r} was not given and could not be found,")
    return work.clocks[log.clock].seconds


def note_once(work: Work, note: str) -> None:
    if note not in work.notes:
        work.notes.append(note)


def instrument_poses(work: Work, log: PoseLog, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses [N, 4, 4] in the tracker's frame at video times, and where known."""
    return poses_at(log, times + offset_of(work, log))


def states_for_choice(work: Work) -> tuple[np.ndarray, np.ndarray]:
    """[V, 6 * instruments + joints] states for coverage, and where they are known; nothing while a clock is unknown.

    Raises NeecoError when a log has nothing to say of the video.
    """
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
        _must_meet(work, log, valid)
    for name in work.logs.poses:
        for reading in work.logs.joints[name].values():
            clock = work.clocks.get(reading.clock)
            if clock is None:
                continue
            values, valid = readings_at(reading, work.times + clock.seconds)
            usable &= valid
            columns.append(np.where(valid, values, 0.0)[:, None])
            _must_meet(work, reading, valid)
    return np.concatenate(columns[1:] or columns, 1), usable


def _must_meet(work: Work, log: PoseLog | ReadingLog, valid: np.ndarray) -> None:
    if not valid.any():
        first, last = (end - work.clocks[log.clock].seconds for end in (log.times[0], log.times[-1]))
        raise NeecoError(
            f"{log.path}: has no sample for any video frame: by the video's clock it covers {first:g} to {last:g} s, "
            f"the video {work.times[0]:g} to {work.times[-1]:g} s; correct the offset of its clock, sync: {log.clock}"
        )


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
            values, known = readings_at(reading, times + offset_of(work, reading))
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
