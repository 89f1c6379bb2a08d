"""Recordings of one instrument (episodes) in memory, on one timeline.

Every episode has its own clocks. On the joint timeline an episode begins `pause_s` after the end of the previous one;
frames are numbered consecutively. A single recording is an episode with its own times and numbers. Later stages
estimate clocks, robot bases and instruments; each returns an updated `Episodes`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.ingest.readers import VideoSource
from neeco.ingest.readers.interpolate import poses_at, readings_at
from neeco.ingest.readers.logs import PoseLog, ReadingLog
from neeco.ingest.recording.model import InstrumentLogs, Recording
from neeco.ingest.timing.clock_search import ASSUMED, GIVEN, ClockOffset


@dataclass(frozen=True, kw_only=True)
class EpisodeSettings:
    """Settings of the joint timeline."""

    pause_s: float = 2.0  # longer than any temporal smoothing window
    same_instant: float = 1e-6  # s
    limit_slack: float = 0.03  # rad beyond a joint's limits explained by noise and calibration


EPISODES = EpisodeSettings()

States = dict[str, tuple[np.ndarray, dict[str, np.ndarray]]]  # instrument -> poses [N, 4, 4], readings [N] by joint
Log = TypeVar("Log", PoseLog, ReadingLog)


@dataclass(frozen=True)
class Contradiction:
    """A contradiction between parts of a recording, in one sentence. severe: the capture is probably wrong."""

    sentence: str
    severe: bool


class Notes:
    """Notes of all stages: the only mutable value of an ingest. names: of the episodes."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = tuple(names)
        self._sentences: dict[tuple[str, int | None], None] = {}  # ordered; without an episode: for all
        self._contradictions: dict[tuple[str, int | None], Contradiction] = {}

    def add(self, sentence: str, episode: int | None = None) -> None:
        """Add a sentence, once: about one episode, or about all."""
        self._sentences[sentence, 0 if len(self._names) == 1 else episode] = None

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on losses and assumptions; one about one of several episodes begins with its name."""
        sentences = []
        for episode, name in enumerate(self._names):
            for sentence in [sentence for sentence, of in self._sentences if of == episode]:
                everywhere = all((sentence, other) in self._sentences for other in range(len(self._names)))
                sentences.append(sentence if everywhere else f"{name}: {sentence}")
        return tuple(dict.fromkeys([*sentences, *(sentence for sentence, of in self._sentences if of is None)]))

    def contradict(self, subject: str, sentence: str, *, severe: bool, episode: int | None = None) -> None:
        """Set the contradiction on a subject, of one episode or all, replacing an earlier one; an empty sentence
        removes it."""
        if not sentence:
            self._contradictions.pop((subject, episode), None)
            return
        named = sentence if len(self._names) == 1 or episode is None else f"{self._names[episode]}: {sentence}"
        self._contradictions[subject, episode] = Contradiction(named, severe)

    def is_contradicted(self, subject: str) -> bool:
        return any(other == subject for other, _ in self._contradictions)

    @property
    def contradictions(self) -> tuple[Contradiction, ...]:
        return tuple(self._contradictions.values())


@dataclass(frozen=True, eq=False, kw_only=True)
class Episode:
    """One recording in memory, on its own timeline: that of its video."""

    name: str  # of its images and in messages; distinct
    recording: Recording
    video: VideoSource
    poses: Mapping[str, PoseLog]  # by instrument, of those that were tracked
    joints: Mapping[str, Mapping[str, ReadingLog]]  # by instrument and joint
    rolls: Mapping[str, ReadingLog]
    scope: PoseLog | None
    clocks: Mapping[str, ClockOffset]  # of the logs, as far as known
    start_s: float = 0.0  # its time 0 on the joint timeline
    first_frame: int = 0  # its first number in joint numbering

    @property
    def times(self) -> np.ndarray:
        """Times [V] s of every frame."""
        return self.video.times

    def logged(self, log: PoseLog | ReadingLog, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return poses [N, 4, 4] in the tracker's frame, or readings [N], at video times [N] s, and whether they are
        known."""
        at = self.clocks[log.clock].at(times)
        return poses_at(log, at) if isinstance(log, PoseLog) else readings_at(log, at)


@dataclass(frozen=True, eq=False)
class Episodes:
    """All recordings on the joint timeline. video: the frames of all."""

    parts: tuple[Episode, ...]
    video: VideoSource
    notes: Notes
    world_from_base: Mapping[str, np.ndarray] = field(default_factory=dict)  # [4, 4] mm of logs in another frame
    # by instrument found in the video: times [N] s of the joint timeline, poses [N, 4, 4]
    video_poses: Mapping[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)

    @property
    def recording(self) -> Recording:
        """The first recording, which applies to all: lens, links, frames, splits, settings."""
        return self.parts[0].recording

    @property
    def single(self) -> bool:
        return len(self.parts) == 1

    @property
    def video_instrument(self) -> InstrumentLogs | None:
        """The instrument to be found in the video, if any."""
        return next((item for item in self.recording.instruments if item.from_video is not None), None)

    # frames

    @property
    def times(self) -> np.ndarray:
        """Times [V] s of every frame."""
        return self.video.times

    def episode_of(self, frames: np.ndarray) -> np.ndarray:
        """Return the episode [N] of every frame [N]."""
        return np.searchsorted([part.first_frame for part in self.parts], frames, side="right") - 1

    @property
    def ranges(self) -> dict[str, tuple[int, int]]:
        """The frames (first, last) of each of several episodes, by its name."""
        if self.single:
            return {}
        return {part.name: (part.first_frame, part.first_frame + len(part.times) - 1) for part in self.parts}

    def frame_name(self, frame: int) -> str:
        """Return the name of a frame's image in the capture; of several episodes, it begins with the episode's."""
        if self.single:
            return f"{frame:06d}"
        part = self.parts[int(self.episode_of(np.array([frame]))[0])]
        return f"{part.name}_{frame - part.first_frame:06d}"

    def with_base(self, name: str, world_from_base: np.ndarray) -> Episodes:
        """Return a copy with the base [4, 4] mm of an instrument's log."""
        return replace(self, world_from_base={**self.world_from_base, name: world_from_base})

    # clocks

    def with_clocks(self, episode: int, clocks: Mapping[str, ClockOffset]) -> Episodes:
        """Return a copy with some clocks of one episode set."""
        parts = list(self.parts)
        parts[episode] = replace(parts[episode], clocks={**parts[episode].clocks, **clocks})
        return replace(self, parts=tuple(parts))

    def with_moved_clock(self, name: str, target: ClockOffset) -> Episodes:
        """Return a copy with a clock of the joint logs at `target`, shifting that of every episode equally."""
        before = self.clock(name)
        moved, data = target.seconds - (before.seconds if before is not None else 0.0), self
        for episode, part in enumerate(self.parts):
            current = part.clocks.get(name, ClockOffset(0.0, 0.0, GIVEN))
            clock = replace(current, seconds=current.seconds + moved, sd=target.sd, source=target.source)
            data = data.with_clocks(episode, {name: clock})
        return data

    def with_assumed_clocks(self) -> Episodes:
        """Return a copy in which unknown clocks of instruments are the video's.

        Raises NeecoError for a log whose times do not overlap the video's.
        """
        data = self
        for episode, part in enumerate(self.parts):
            logs: list[PoseLog | ReadingLog] = []
            for name in (*part.poses, *self.video_poses):
                logs += [log for log in (part.poses.get(name), part.rolls.get(name)) if log is not None]
                logs += part.joints[name].values()
            for log in logs:
                if log.clock not in data.parts[episode].clocks:
                    self.notes.add(
                        f"the clock {log.clock!r} was not given and could not be found, and is taken to be the video's",
                        episode,
                    )
                    data = data.with_clocks(episode, {log.clock: assumed_clock(log, part.times)})
        return data

    @property
    def reported_clocks(self) -> dict[str, ClockOffset]:
        """The clocks of all episodes, by their names in a report."""
        if self.single:
            return dict(self.parts[0].clocks)
        return {f"{clock} of {part.name}": offset for part in self.parts for clock, offset in part.clocks.items()}

    def clock(self, name: str) -> ClockOffset | None:
        """Return a clock of the joint logs, known if it is known in every episode."""
        clocks = [part.clocks.get(name) for part in self.parts]
        present = [clock for clock in clocks if clock is not None]
        if len(present) < len(clocks):
            return None
        if self.single:
            return present[0]
        source = next((clock.source for clock in present if clock.source != GIVEN), GIVEN)
        return ClockOffset(0.0, max(clock.sd for clock in present), source)

    def joint_log(self, of: Callable[[Episode], Log]) -> Log:
        """Return the logs of all episodes as one on the joint timeline, without overlaps."""
        logs = [of(part) for part in self.parts]
        if self.single:
            return logs[0]
        inner, times, rows = [], [], []
        for part, log in zip(self.parts, logs, strict=True):
            clock = part.clocks.get(log.clock, ClockOffset(0.0, 0.0, GIVEN))
            frame_times = part.times + part.start_s
            moved = clock.video_times(log.times) + part.start_s
            first, last = frame_times[0] - EPISODES.pause_s / 2, frame_times[-1] + EPISODES.pause_s / 2
            rows.append((moved > first) & (moved < last))
            times.append(moved[rows[-1]])
            inner += [tuple(clock.video_times(np.array(gap)) + part.start_s) for gap in log.gaps]
        joint = np.concatenate(times)
        gaps = {(before, after) for before, after in inner if before >= joint[0] and after <= joint[-1]}
        gaps |= {(float(before[-1]), float(after[0])) for before, after in pairwise(times)}
        fields: dict[str, Any] = {"times": joint, "gaps": tuple(sorted(gaps))}
        for name in ("values",) if isinstance(logs[0], ReadingLog) else ("positions", "quats"):
            columns = [getattr(log, name)[inside] for log, inside in zip(logs, rows, strict=True)]
            fields[name] = np.concatenate(columns)
        return replace(logs[0], **fields)

    # states at times [N] s of the joint timeline, each from its episode's own logs

    def scope_poses(self, times: np.ndarray) -> np.ndarray:
        """Return the laparoscope's poses [N, 4, 4] in its tracker's frame."""

        def of(part: Episode, local: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            assert part.scope is not None
            return part.logged(part.scope, local)

        return self._gathered(times, of, (4, 4))[0]

    def instrument_poses(self, name: str, times: np.ndarray, lag: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Return poses [N, 4, 4] of an instrument, logged `lag` s later, and whether they are known.

        In the world's frame if its base is known, else in the tracker's; of one found in the video, with its roll where
        that is logged.
        """
        if name in self.video_poses:
            video_times, poses = self.video_poses[name]
            if not len(video_times):
                return np.full((len(times), 4, 4), np.nan), np.zeros(len(times), dtype=bool)
            row = np.abs(times[:, None] - video_times).argmin(1)
            valid = np.abs(times - video_times[row]) < EPISODES.same_instant
            resampled = np.where(valid[:, None, None], poses[row], np.nan)
            if name in self.parts[0].rolls:
                roll, logged = self._gathered(times, lambda part, t: part.logged(part.rolls[name], t), ())
                resampled, valid = with_roll(resampled, np.nan_to_num(roll)), valid & logged
            return resampled, valid
        poses, valid = self._gathered(times, lambda part, t: part.logged(part.poses[name], t + lag), (4, 4))
        return (self.world_from_base[name] @ poses if name in self.world_from_base else poses), valid

    def states_at(self, times: np.ndarray) -> tuple[States, np.ndarray]:
        """Return every instrument's states, and whether all of them are known. All clocks must be known.

        Raises NeecoError for an episode without any known state, and for readings far beyond their limits.
        """
        states: States = {}
        usable = np.ones(len(times), dtype=bool)
        limits = {item.name: {j: log.limits for j, log in item.joints.items()} for item in self.recording.instruments}
        for name in (*self.parts[0].poses, *self.video_poses):
            poses, valid = self.instrument_poses(name, times)
            usable &= valid
            readings = {}
            for joint in self.parts[0].joints[name]:

                def of(part: Episode, local: np.ndarray, name: str = name, joint: str = joint) -> Any:
                    log = part.joints[name][joint]
                    span = limits[name][joint]
                    values, valid = part.logged(log, local)
                    if span is None:
                        return values, valid
                    clipped = np.clip(values, *span)
                    excess = float(np.nanmax(np.abs(values - clipped), initial=0.0))
                    beyond = f"{np.degrees(excess):.1f} deg beyond the"
                    if excess > EPISODES.limit_slack:
                        raise NeecoError(
                            f"{log.path}: readings go {beyond} joint's limits {span[0]:g} .. {span[1]:g} rad; correct "
                            "`limits` in the recording, or the calibration"
                        )
                    if excess > 0:
                        note = f"{log.path.name}: readings up to {beyond} limits are held at them"
                        self.notes.add(note, self.parts.index(part))
                    return clipped, valid

                readings[joint], valid = self._gathered(times, of, ())
                usable &= valid
            states[name] = (poses, readings)
        for part, rows, _ in self._each(times):
            if not usable[rows].any():
                raise NeecoError(
                    f"{part.recording.path}: no frame has a state of every instrument; check the clocks, `sync`"
                )
        return states, usable

    def coverage_states(self) -> tuple[np.ndarray, np.ndarray]:
        """Return states [V, 6 * instruments + joints] to choose frames by, and where they are known; zeros while a
        clock is unknown. Raises NeecoError when a log has no sample for any video frame."""
        states, usable = zip(*(_coverage(part) for part in self.parts), strict=True)
        if len({columns.shape[1] for columns in states}) > 1:  # a clock is known in some of them
            return np.zeros((len(self.times), 6)), np.concatenate(usable)
        return np.concatenate(states), np.concatenate(usable)

    def _each(self, times: np.ndarray) -> Iterator[tuple[Episode, np.ndarray, np.ndarray]]:
        """Yield every episode that times [N] fall into, their rows, and their seconds on its own timeline."""
        ends = np.array([part.start_s + part.times[-1] + EPISODES.pause_s / 2 for part in self.parts[:-1]])
        of = np.searchsorted(ends, times)
        for episode in np.unique(of):
            rows = np.flatnonzero(of == episode)
            yield self.parts[episode], rows, times[rows] - self.parts[episode].start_s

    def _gathered(
        self,
        times: np.ndarray,
        of: Callable[[Episode, np.ndarray], tuple[np.ndarray, np.ndarray]],
        shape: tuple[int, ...],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return values [N, *shape] of `of`, evaluated per episode at its own times, and whether they are known."""
        values, valid = np.full((len(times), *shape), np.nan), np.zeros(len(times), dtype=bool)
        for part, rows, local in self._each(times):
            values[rows], valid[rows] = of(part, local)
        return values, valid


def with_roll(poses: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """Return poses [F, 4, 4] turned about their own z axis by roll [F] rad."""
    turned = np.tile(np.eye(4), (len(poses), 1, 1))
    turned[:, :3, :3] = Rotation.from_rotvec(roll[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    return np.asarray(poses @ turned)


def _coverage(part: Episode) -> tuple[np.ndarray, np.ndarray]:
    """`Episodes.coverage_states` of one episode, [V] its frames."""
    columns, usable = [], np.ones(len(part.times), dtype=bool)
    placed = [item.name for item in part.recording.instruments if item.placed]
    logs: list[PoseLog | ReadingLog] = [*part.poses.values()]
    logs += [log for name in placed for log in part.joints[name].values()]
    for log in (log for log in logs if log.clock in part.clocks):
        values, valid = part.logged(log, part.times)
        usable &= valid
        state = [values[:, :3, 3], values[:, 0, :3]] if isinstance(log, PoseLog) else [values[:, None]]
        columns += [np.where(valid[:, None], each, 0.0) for each in state]
        if not valid.any():
            first, last = part.clocks[log.clock].video_times(log.times[[0, -1]])
            raise NeecoError(
                f"{log.path}: has no sample for any video frame: by the video's clock it covers {first:g} to {last:g} "
                f"s, the video {part.times[0]:g} to {part.times[-1]:g} s; correct the offset of its clock, sync: "
                f"{log.clock}"
            )
    return np.concatenate(columns or [np.zeros((len(part.times), 6))], 1), usable


def assumed_clock(log: PoseLog | ReadingLog, times: np.ndarray) -> ClockOffset:
    """Return the video's clock for a log. Raises NeecoError if their times do not overlap; times [V] s: the video's."""
    if log.times[-1] < times[0] or log.times[0] > times[-1]:
        raise NeecoError(
            f"{log.path}: its times ({log.times[0]:g} to {log.times[-1]:g} s) do not meet the video's "
            f"({times[0]:g} to {times[-1]:g} s), and nothing ties the clocks; give the offset: "
            f"sync: {{{log.clock}: seconds}}"
        )
    return ClockOffset(0.0, float("nan"), ASSUMED)
