"""A recording read into memory: the video's times, the logs on its clock, and the instruments' states at any time."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.errors import NeecoError
from neeco.ingest.readers import MAX_UNLIKE, compare_lengths
from neeco.ingest.readers.columns import BASE, VIDEO_CLOCK
from neeco.ingest.readers.interpolate import poses_at, readings_at
from neeco.ingest.readers.logs import PoseLog, ReadingLog, read_pose_log, read_reading_log
from neeco.ingest.recording.model import Recording
from neeco.ingest.timing.clock_search import ASSUMED, GIVEN, LONGEST, ClockOffset

SLOWEST, FASTEST = 0.01, 10_000.0  # frames a second
SAME_INSTANT = 1e-6  # s
SMALLEST = 32  # px: smaller frames have nothing to find cameras by
LIMIT_SLACK = 0.03  # rad beyond a joint's limits that noise and calibration make

States = dict[str, tuple[np.ndarray, dict[str, np.ndarray]]]  # instrument -> poses [N, 4, 4], readings [N] by joint


class SynchronizedRecording:
    """The video, the logs by instrument, and the clocks known so far (more are found while cameras are).

    notes: what was lost or assumed, one sentence each. Raises NeecoError for logs and videos that cannot be used.
    """

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        # logs are quick to read: wrong ones are found before the video is touched
        self.poses = {item.name: read_pose_log(item.poses) for item in recording.instruments if item.poses is not None}
        self.joints = {
            item.name: {joint: read_reading_log(source) for joint, source in item.joints.items()}
            for item in recording.instruments
        }
        self.rolls = {item.name: read_reading_log(item.roll) for item in recording.instruments if item.roll is not None}
        # by instrument, of those found in the video: times [N] s and poses [N, 4, 4] of the frames that show them
        self.found: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        self.placed = tuple(item.name for item in recording.instruments if item.placed)
        self.scope = read_pose_log(recording.laparoscope) if recording.laparoscope else None
        self._check_bases()
        self.video = recording.source.open()
        self.times = self.video.times  # [V] s, every frame
        logs: list[PoseLog | ReadingLog] = [*self.poses.values(), *([self.scope] if self.scope else [])]
        logs += [log for joints in self.joints.values() for log in joints.values()] + [*self.rolls.values()]
        found = [*recording.notes, *(note for log in logs for note in log.notes), *self.video.notes]
        self.notes = list(dict.fromkeys(found))  # two joints may be of one stream
        for item in recording.instruments:
            if not item.placed:
                self.note(f"instrument {item.name!r} was not tracked: it is left out of the capture's states")
        if not self.placed:
            self.note("no instrument was tracked: the capture has cameras and images only (method 3dgs trains)")
        self._check_video()
        self._check_lengths(logs)
        self.clocks = {name: ClockOffset(float(seconds), 0.0, GIVEN) for name, seconds in recording.sync.items()}
        if VIDEO_CLOCK in recording.clocks:
            self.clocks[VIDEO_CLOCK] = ClockOffset(0.0, 0.0, "the images' own")
        self._assume_joint_clocks()
        # by instrument, where its log is not in the world's frame: [4, 4] mm
        self.world_from_base: dict[str, np.ndarray] = {}

    def note(self, note: str) -> None:
        """Add a note, once."""
        if note not in self.notes:
            self.notes.append(note)

    def logged_poses(self, log: PoseLog, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Poses [N, 4, 4] in the tracker's frame at video times, and where known."""
        return poses_at(log, self._clock(log).at(times))

    def instrument_poses(self, name: str, times: np.ndarray, lag: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Poses [N, 4, 4] of an instrument at video times, or `lag` s later, in the world's frame as far as that is
        known (else in its tracker's), and where known."""
        if name in self.found:
            return self._found_poses(name, times)
        poses, known = self.logged_poses(self.poses[name], times + lag)
        return (self.world_from_base[name] @ poses if name in self.world_from_base else poses), known

    def _found_poses(self, name: str, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`instrument_poses` of one found in the video, with its roll where that is logged."""
        held, poses = self.found[name]
        if not len(held):
            return np.full((len(times), 4, 4), np.nan), np.zeros(len(times), dtype=bool)
        row = np.abs(times[:, None] - held).argmin(1)
        known = np.abs(times - held[row]) < SAME_INSTANT
        found = np.where(known[:, None, None], poses[row], np.nan)
        if name in self.rolls:
            roll, logged = readings_at(self.rolls[name], self._clock(self.rolls[name]).at(times))
            found, known = with_roll(found, np.nan_to_num(roll)), known & logged
        return found, known

    def states_at(self, times: np.ndarray) -> tuple[States, np.ndarray]:
        """Every tracked instrument's states at video times [N], and where all of them are known."""
        states: States = {}
        usable = np.ones(len(times), dtype=bool)
        limits = {
            item.name: {joint: source.limits for joint, source in item.joints.items()}
            for item in self.recording.instruments
        }
        for name in [*self.poses, *self.found]:
            poses, valid = self.instrument_poses(name, times)
            usable &= valid
            readings = {}
            for joint, reading in self.joints[name].items():
                values, known = readings_at(reading, self._clock(reading).at(times))
                readings[joint] = self._within_limits(reading, limits[name][joint], values)
                usable &= known
            states[name] = (poses, readings)
        if not usable.any():
            raise NeecoError(
                f"{self.recording.path}: no frame has a state of every instrument; check the clocks, `sync`"
            )
        return states, usable

    def coverage_states(self) -> tuple[np.ndarray, np.ndarray]:
        """[V, 6 * instruments + joints] states to choose frames by, and where they are known; nothing while a clock is
        unknown. Raises NeecoError when a log has no sample for any video frame."""
        columns, usable = [], np.ones(len(self.times), dtype=bool)
        for log in self.poses.values():
            if log.clock in self.clocks:
                poses, valid = poses_at(log, self.clocks[log.clock].at(self.times))
                usable &= valid
                columns.append(np.where(valid[:, None], poses[:, :3, 3], 0.0))
                columns.append(np.where(valid[:, None], poses[:, :3, :3].reshape(-1, 9)[:, :3], 0.0))
                self._check_overlap(log, valid)
        for reading in (reading for name in self.placed for reading in self.joints[name].values()):
            if reading.clock in self.clocks:
                values, valid = readings_at(reading, self.clocks[reading.clock].at(self.times))
                usable &= valid
                columns.append(np.where(valid, values, 0.0)[:, None])
                self._check_overlap(reading, valid)
        return np.concatenate(columns or [np.zeros((len(self.times), 6))], 1), usable

    def _check_bases(self) -> None:
        """Raise NeecoError where the scope's poses and an instrument's are stated in bases of different names: nothing
        would register them."""
        scope = None if self.scope is None else self.scope.stated_in
        placed = {item.name for item in self.recording.instruments if item.base is not None}
        for name, log in self.poses.items():
            if scope is not None and name not in placed and log.stated_in not in (None, scope) and log.frame == BASE:
                raise NeecoError(
                    f"{self.recording.path}: laparoscope: its poses are stated in {scope}, those of {name} in "
                    f"{log.stated_in}; where these are one frame say `frame: base` for both, else say how they stand "
                    "(world_from_base)"
                )

    def _check_video(self) -> None:
        """Raise NeecoError for times that no recording has, and for frames too small."""
        times, video = self.times, self.video
        rate, length = 1 / float(np.median(np.diff(times))), times[-1] - times[0]
        if not (SLOWEST < rate < FASTEST and length < LONGEST):
            raise NeecoError(
                f"{video.path}: frames at {rate:.3g} a second over {length / 3600:.3g} h "
                "cannot be; correct fps or the times' unit"
            )
        if min(video.size) < SMALLEST:
            width, height = video.size
            raise NeecoError(f"{video.path}: its frames are {width}x{height} pixels; give {SMALLEST} or more each way")

    def _check_lengths(self, logs: list[PoseLog | ReadingLog]) -> None:
        """Note logs on the video's clock that are longer than the video, and those whose rows belong to images one by
        one and are not as many. Raises NeecoError where these are far from as many."""
        video = self.video
        of_video = [log for log in logs if log.clock == VIDEO_CLOCK and log.path != self.recording.video]
        for log in of_video:
            if log.image_hz is not None:
                rows = round(float(log.times[-1]) * log.image_hz) + 1
                for note in compare_lengths(video.path, video, rows, log.image_hz):
                    self.note(note)
                continue
            beyond = max(0.0, log.times[-1] - self.times[-1]) + max(0.0, self.times[0] - log.times[0])
            if beyond > MAX_UNLIKE * (self.times[-1] - self.times[0]):
                self.note(
                    f"{log.path.name}: goes from {log.times[0]:.1f} to {log.times[-1]:.1f} s on the video's clock, the "
                    f"video from {self.times[0]:.1f} to {self.times[-1]:.1f} s: are they of one recording?"
                )

    def _assume_joint_clocks(self) -> None:
        """Joints' clocks that nothing gives are taken to be the video's: images tell them to some 20 ms at best.

        Trackers' clocks, and those of joints on one of them, are found later, from motion.
        """
        found_later = {log.clock for log in [*self.poses.values(), *([self.scope] if self.scope else [])]}
        for name in self.placed:
            for joint, reading in self.joints[name].items():
                if reading.clock not in self.clocks and reading.clock not in found_later:
                    cost = ": at 1 rad/s, 20 ms off are 1.1 deg"
                    self._assume(reading, f"the clock of joint {joint!r} was not given", cost)

    def _assume(self, log: PoseLog | ReadingLog, why: str, cost: str = "") -> None:
        """Take a log's clock to be the video's, with a note. Raises NeecoError when their times do not meet."""
        if log.times[-1] < self.times[0] or log.times[0] > self.times[-1]:
            raise NeecoError(
                f"{log.path}: its times ({log.times[0]:g} to {log.times[-1]:g} s) do not meet the video's "
                f"({self.times[0]:g} to {self.times[-1]:g} s), and nothing ties the clocks; give the offset: "
                f"sync: {{{log.clock}: seconds}}"
            )
        self.clocks[log.clock] = ClockOffset(0.0, float("nan"), ASSUMED)
        self.notes.append(f"{why} and is taken to be the video's{cost}")

    def _clock(self, log: PoseLog | ReadingLog) -> ClockOffset:
        """The log's clock; the video's own clock when motion did not give it."""
        if log.clock not in self.clocks:
            self._assume(log, f"the clock {log.clock!r} was not given and could not be found,")
        return self.clocks[log.clock]

    def _check_overlap(self, log: PoseLog | ReadingLog, valid: np.ndarray) -> None:
        if not valid.any():
            first, last = self.clocks[log.clock].video_times(log.times[[0, -1]])
            raise NeecoError(
                f"{log.path}: has no sample for any video frame: by the video's clock it covers {first:g} to {last:g} "
                f"s, the video {self.times[0]:g} to {self.times[-1]:g} s; correct the offset of its clock, sync: "
                f"{log.clock}"
            )

    def _within_limits(self, log: ReadingLog, limits: tuple[float, float] | None, values: np.ndarray) -> np.ndarray:
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
            degrees = np.degrees(excess)
            self.note(f"{log.path.name}: readings up to {degrees:.1f} deg beyond the limits are held at them")
        return held


def with_roll(poses: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """Poses [F, 4, 4] turned about their own z by roll [F] rad."""
    turned = np.tile(np.eye(4), (len(poses), 1, 1))
    turned[:, :3, :3] = Rotation.from_rotvec(roll[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    return np.asarray(poses @ turned)
