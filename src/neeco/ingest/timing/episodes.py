"""Several recordings of one instrument (episodes) on one timeline: what an ingest reads as if it were one recording.

Every episode keeps its own clocks. On the joint timeline one begins PAUSE_S after the one before has ended; frames are
counted on from episode to episode. A single recording is an episode that keeps its own times and numbers.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from neeco.errors import NeecoError
from neeco.ingest.readers import VideoSource, format_of
from neeco.ingest.readers.logs import PoseLog, ReadingLog
from neeco.ingest.recording.base import same_base
from neeco.ingest.recording.model import (
    MIN_FRAMES,
    ImageFolder,
    IngestSettings,
    InstrumentLogs,
    Recording,
    VideoFile,
)
from neeco.ingest.timing.clock_search import GIVEN, ClockOffset
from neeco.ingest.timing.notes import Doubt
from neeco.ingest.timing.synchronized import States, SynchronizedRecording

PAUSE_S = 2.0  # longer than anything that is smooth in time looks beyond an instant
NAME_TISSUES = "say in every recording over which `tissue` it was taken"
Log = TypeVar("Log", PoseLog, ReadingLog)


class Episodes:
    """The recordings, read into memory, and all that is known of them on the joint timeline.

    Raises NeecoError for recordings that cannot be used, or that cannot be of one capture.
    """

    def __init__(self, recordings: Sequence[Recording], tissue: str | None = None) -> None:
        self.tissue = tissue  # of several that one capture holds, the one that these were taken over
        self.parts = [SynchronizedRecording(recording) for recording in recordings]
        self.recording = recordings[0]  # what is said once for all: lens, links, frames, splits, settings
        self.names = episode_names(recordings)
        check_alike(self.parts)
        self._check_split_names()
        times: list[np.ndarray] = []
        starts: list[float] = []
        first = [0]
        for part in self.parts:
            starts.append(times[-1][-1] + PAUSE_S - part.times[0] if times else 0.0)
            times.append(part.times + starts[-1])
            first.append(first[-1] + len(part.times))
        self.times = np.concatenate(times)  # [V] s, every frame
        self.starts = np.array(starts)  # [E] s of every episode's own 0
        self.first = np.array(first)  # [E + 1] frames before every episode
        videos = [part.video for part in self.parts]
        self.video = videos[0] if self.single else _joined_videos(videos, self.times, self.first)
        # by instrument, where its log is not in the world's frame: [4, 4] mm
        self.world_from_base: dict[str, np.ndarray] = {}
        for part in self.parts:
            part.world_from_base = self.world_from_base
        self._notes: list[str] = []
        self._doubts: dict[tuple[str, int | None], Doubt] = {}

    @property
    def single(self) -> bool:
        return len(self.parts) == 1

    @property
    def notes(self) -> list[str]:
        """What was lost or assumed, one sentence each; what is of one episode names it."""
        if self.single:
            return self.parts[0].notes
        named = [(name, note) for name, part in zip(self.names, self.parts, strict=True) for note in part.notes]
        everywhere = {note for _, note in named if all(note in part.notes for part in self.parts)}
        own = [note if note in everywhere else f"{name}: {note}" for name, note in named]
        return list(dict.fromkeys([*own, *self._notes]))

    def note(self, note: str, episode: int | None = None) -> None:
        """Add a note, once: of all of it, or of one episode."""
        if self.single or episode is not None:
            self.parts[episode or 0].note(note)
        elif note not in self._notes:
            self._notes.append(note)

    @property
    def doubts(self) -> tuple[Doubt, ...]:
        """What parts of the recordings contradict each other in."""
        return tuple(self._doubts.values())

    def is_doubted(self, subject: str) -> bool:
        """Whether there is a doubt on a subject."""
        return any(held == subject for held, _ in self._doubts)

    def doubt(self, subject: str, sentence: str, *, severe: bool, episode: int | None = None) -> None:
        """Set the doubt on a subject, of all of it or of one episode, in place of an earlier one; none where the
        sentence is empty."""
        if not sentence:
            self._doubts.pop((subject, episode), None)
        else:
            named = sentence if self.single or episode is None else f"{self.names[episode]}: {sentence}"
            self._doubts[subject, episode] = Doubt(named, severe)

    def episode_of(self, frames: np.ndarray) -> np.ndarray:
        """[N] the episodes that frames [N] are of."""
        return np.searchsorted(self.first, frames, side="right") - 1

    def frame_name(self, frame: int) -> str:
        """What the image of a frame is called in the capture: of several episodes, it begins with the episode's
        name."""
        of = "" if self.tissue is None else file_name(self.tissue) + "_"
        if self.single:
            return f"{of}{frame:06d}"
        episode = int(self.episode_of(np.array([frame]))[0])
        return f"{of}{self.names[episode]}_{frame - self.first[episode]:06d}"

    def refuse_alone(self, placed: np.ndarray) -> None:
        """Raise NeecoError for an episode that structure from motion did not join to the others. placed [M]: the frames
        that got a camera."""
        counts = np.bincount(self.episode_of(placed), minlength=len(self.parts))
        for name, part, count in zip(self.names, self.parts, counts, strict=True):
            if count < MIN_FRAMES and not self.single:
                raise NeecoError(
                    f"{part.recording.path}: {name} stands alone: {count} of its frames show enough of what the other "
                    f"recordings show to find their cameras together (at least {MIN_FRAMES} are needed); where it "
                    f"shows another tissue, {NAME_TISSUES}, else leave it out"
                )

    @property
    def ranges(self) -> dict[str, tuple[int, int]]:
        """The frames (first, last) of each of several episodes, by its name."""
        if self.single:
            return {}
        return {name: (int(self.first[i]), int(self.first[i + 1]) - 1) for i, name in enumerate(self.names)}

    # logs on the joint timeline

    @property
    def clocks(self) -> dict[str, ClockOffset]:
        """What is known of the clocks of the joint logs: of several episodes, these are on the joint timeline already
        as far as their episodes' clocks are known, and a clock is here once it is known in all."""
        if self.single:
            return self.parts[0].clocks
        names = {name for part in self.parts for name in part.clocks}
        joint = {}
        for name in names:
            held = [part.clocks.get(name) for part in self.parts]
            known = [clock for clock in held if clock is not None]
            if len(known) == len(held):
                source = next((clock.source for clock in known if clock.source != GIVEN), GIVEN)
                joint[name] = ClockOffset(0.0, max(clock.sd for clock in known), source)
        return joint

    @property
    def found_clocks(self) -> dict[str, ClockOffset]:
        """Every episode's clocks, by what a report calls them."""
        if self.single:
            return self.parts[0].clocks
        return {
            f"{clock} of {name}": offset
            for name, part in zip(self.names, self.parts, strict=True)
            for clock, offset in part.clocks.items()
        }

    def move_clock(self, name: str, found: ClockOffset) -> None:
        """Take a clock of the joint logs to be `found`: every episode's own moves by as much."""
        before = self.clocks.get(name)
        moved = found.seconds - (before.seconds if before is not None else 0.0)
        for part in self.parts:
            held = part.clocks.get(name, ClockOffset(0.0, 0.0, GIVEN))
            part.clocks[name] = replace(held, seconds=held.seconds + moved, sd=found.sd, source=found.source)

    @property
    def poses(self) -> dict[str, PoseLog]:
        """Every tracked instrument's poses."""
        return {name: self._joint([part.poses[name] for part in self.parts]) for name in self.parts[0].poses}

    @property
    def joints(self) -> dict[str, dict[str, ReadingLog]]:
        """Every instrument's readings, by joint."""
        return {
            name: {joint: self._joint([part.joints[name][joint] for part in self.parts]) for joint in joints}
            for name, joints in self.parts[0].joints.items()
        }

    @property
    def scope(self) -> PoseLog | None:
        """The laparoscope's poses."""
        logs = [part.scope for part in self.parts if part.scope is not None]
        return self._joint(logs) if logs else None

    def _joint(self, logs: list[Log]) -> Log:
        """Logs of one body, or joint, as one on the joint timeline; what reaches into another episode is cut off."""
        if self.single:
            return logs[0]
        inner, times, rows = [], [], []
        for part, log, start in zip(self.parts, logs, self.starts, strict=True):
            known = part.clocks.get(log.clock, ClockOffset(0.0, 0.0, GIVEN))
            own = part.times + start
            moved = known.video_times(log.times) + start
            rows.append((moved > own[0] - PAUSE_S / 2) & (moved < own[-1] + PAUSE_S / 2))
            times.append(moved[rows[-1]])
            inner += [tuple(known.video_times(np.array(gap)) + start) for gap in log.gaps]
        joint = np.concatenate(times)
        gaps = {(before, after) for before, after in inner if before >= joint[0] and after <= joint[-1]}
        gaps |= {(float(before[-1]), float(after[0])) for before, after in pairwise(times)}

        def joined(arrays: list[np.ndarray]) -> np.ndarray:
            return np.concatenate([values[inside] for values, inside in zip(arrays, rows, strict=True)])

        held: dict[str, Any] = {"times": joint, "gaps": tuple(sorted(gaps))}
        for name in ("values",) if isinstance(logs[0], ReadingLog) else ("positions", "quats"):
            held[name] = joined([getattr(log, name) for log in logs])
        return replace(logs[0], **held)

    # states at video times, each from its episode's own logs

    def logged_scope(self, times: np.ndarray) -> np.ndarray:
        """The laparoscope's poses [N, 4, 4] in its tracker's frame at times [N] of the joint timeline."""

        def of(part: SynchronizedRecording, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            assert part.scope is not None
            return part.logged_poses(part.scope, own)

        return self._posed(of, times)[0]

    def instrument_poses(self, name: str, times: np.ndarray, lag: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """As `SynchronizedRecording.instrument_poses`, at times [N] of the joint timeline."""
        return self._posed(lambda part, own: part.instrument_poses(name, own, lag), times)

    def place(self, name: str, times: np.ndarray, poses: np.ndarray) -> None:
        """Take an instrument to be where it was found in the video: poses [N, 4, 4] at times [N] of the joint
        timeline."""
        for part in self.parts:
            part.found[name] = np.zeros(0), np.zeros((0, 4, 4))
        for part, rows, own in self._each(times):
            part.found[name] = own, poses[rows]

    def _posed(
        self, of: Callable[[SynchronizedRecording, np.ndarray], tuple[np.ndarray, np.ndarray]], times: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        poses, known = np.full((len(times), 4, 4), np.nan), np.zeros(len(times), dtype=bool)
        for part, rows, own in self._each(times):
            poses[rows], known[rows] = of(part, own)
        return poses, known

    def states_at(self, times: np.ndarray) -> tuple[States, np.ndarray]:
        """As `SynchronizedRecording.states_at`, at times [N] of the joint timeline."""
        states: States = {}
        usable = np.zeros(len(times), dtype=bool)
        for part, rows, own in self._each(times):
            found, usable[rows] = part.states_at(own)
            for name, (poses, readings) in found.items():
                empty = np.full((len(times), 4, 4), np.nan), {joint: np.full(len(times), np.nan) for joint in readings}
                held_poses, held_readings = states.setdefault(name, empty)
                held_poses[rows] = poses
                for joint, values in readings.items():
                    held_readings[joint][rows] = values
        return states, usable

    def coverage_states(self) -> tuple[np.ndarray, np.ndarray]:
        """As `SynchronizedRecording.coverage_states`, of all frames."""
        states, usable = zip(*(part.coverage_states() for part in self.parts), strict=True)
        if len({columns.shape[1] for columns in states}) > 1:  # a clock is known in some of them
            return np.zeros((len(self.times), 6)), np.concatenate(usable)
        return np.concatenate(states), np.concatenate(usable)

    def _each(self, times: np.ndarray) -> Iterator[tuple[SynchronizedRecording, np.ndarray, np.ndarray]]:
        """Every episode that times [N] fall into: which of them, and their seconds on its own timeline."""
        ends = self.times[self.first[1:] - 1] + PAUSE_S / 2
        of = np.searchsorted(ends[:-1], times)
        for episode in np.unique(of):
            rows = np.flatnonzero(of == episode)
            yield self.parts[episode], rows, times[rows] - self.starts[episode]

    def _check_split_names(self) -> None:
        """Raise NeecoError for splits that name what is no episode."""
        first, known = self.recording, set(self.names)
        for episode in first.splits.test_episodes + first.splits.unseen_episodes if first.splits else ():
            if self.single or episode not in known:
                listed = "one recording has none" if self.single else f"they are {', '.join(self.names)}"
                raise NeecoError(f"{first.path}: splits: no episode is called {episode!r}; {listed}")
        if not self.single and first.splits and (first.splits.test or first.splits.unseen):
            raise NeecoError(
                f"{first.path}: splits: test and unseen count one video's frames, and there are {len(self.parts)} "
                "recordings; name test_episodes and unseen_episodes"
            )


def check_alike(parts: Sequence[SynchronizedRecording], worlds: bool = False) -> None:
    """Raise NeecoError for recordings that one capture cannot hold together. worlds: each is of a world of its own."""
    first = parts[0].recording
    lens, where = first.read_lens()
    for part in parts[1:]:
        other = part.recording

        def refuse(what: str, path: object = other.path) -> NeecoError:
            return _refusal(path, what, first)

        size, own = part.video.size, parts[0].video.size
        if size != own:
            raise refuse(f"images: are {size[0]}x{size[1]}, not {own[0]}x{own[1]} as")
        if other.read_lens()[0] != lens:
            raise refuse(f"intrinsics: are others than {where} gives")
        for key in ("camera", "laparoscope", "stereo"):
            mine, theirs = getattr(other, key), getattr(first, key)
            if (mine is None) != (theirs is None) or (key == "camera" and mine != theirs):
                raise refuse(f"{key}: is not as")
        names = [item.name for item in other.instruments]
        if names != [item.name for item in first.instruments]:
            raise refuse(f"instruments: {', '.join(names) or 'none'} are not those")
        for mine, theirs in zip(other.instruments, first.instruments, strict=True):
            if fault := _unlike(mine, theirs, worlds):
                raise refuse(f"instruments: {mine.name}: {fault} not as")
            if mine.poses is not None and part.poses[mine.name].frame != parts[0].poses[mine.name].frame:
                raise refuse(f"instruments: {mine.name}: poses are in another frame than")
        refuse_other_words(other, first)


def refuse_other_words(other: Recording, first: Recording) -> None:
    """Raise NeecoError where a recording says another thing of all than the first."""
    for key, default in (("frames", None), ("splits", None), ("settings", IngestSettings())):
        if getattr(other, key) not in (default, getattr(first, key)):
            raise _refusal(other.path, f"{key}: says another than", first)


def _refusal(path: object, what: str, first: Recording) -> NeecoError:
    return NeecoError(
        f"{path}: {what} in {first.path}: recordings of one capture have the same; correct it, or ingest it alone"
    )


def separate(recordings: Sequence[Recording]) -> tuple[Recording, ...]:
    """One recording for each of the episodes that a recording lists. Raises NeecoError."""
    found: list[Recording] = []
    for recording in recordings:
        found += [_of_episode(recording, number) for number in recording.episodes] or [recording]
    return tuple(found)


def _of_episode(recording: Recording, episode: int) -> Recording:
    """The recording with all its streams of one episode of the data set that holds them."""
    moved = 0

    def stream_of(path: Path | None, stream: str | None, key: str) -> str | None:
        nonlocal moved
        known = None if path is None else format_of(path)
        if known is None or known.of_episode("", episode) is None:
            return stream
        if stream is None:
            raise NeecoError(f"{recording.path}: {key}: stream: missing; name the feature, as in observation.state")
        moved += 1
        return known.of_episode(stream, episode)

    def source_of(source: VideoFile | ImageFolder, key: str) -> VideoFile | ImageFolder:
        if isinstance(source, ImageFolder):
            return source
        return replace(source, stream=stream_of(source.file, source.stream, key))

    instruments = []
    for item in recording.instruments:
        poses = item.poses and replace(item.poses, stream=stream_of(item.poses.path, item.poses.stream, "poses"))
        joints = {
            name: replace(log, stream=stream_of(log.path, log.stream, f"joints: {name}"))
            for name, log in item.joints.items()
        }
        roll = item.roll and replace(item.roll, stream=stream_of(item.roll.path, item.roll.stream, "roll"))
        instruments.append(replace(item, poses=poses, joints=joints, roll=roll))
    scope, partner = recording.laparoscope, recording.stereo
    changed = replace(
        recording, source=source_of(recording.source, "video"), instruments=tuple(instruments),
        laparoscope=scope and replace(scope, stream=stream_of(scope.path, scope.stream, "laparoscope")),
        stereo=partner and replace(partner, source=source_of(partner.source, "stereo")),
        episode=f"episode_{episode}",
    )  # fmt: skip
    if not moved:
        raise NeecoError(
            f"{recording.path}: episodes: no file named here holds several; leave it out, and give several recordings "
            "as `neeco ingest A/recording.yaml B/recording.yaml`"
        )
    return changed


def episode_names(recordings: Sequence[Recording]) -> tuple[str, ...]:
    """What each of several recordings is called: as it says itself, else by its file, or its folder where the files
    are all called alike; different from all others."""
    stems = {recording.path.stem for recording in recordings}
    names: list[str] = []
    for recording in recordings:
        of_file = recording.path.stem if len(stems) > 1 else recording.path.resolve().parent.name
        name = file_name(recording.episode or of_file) or "recording"
        number = 2
        while name in names:
            name, number = f"{name.removesuffix(f'_{number - 1}')}_{number}", number + 1
        names.append(name)
    return tuple(names)


def file_name(text: str) -> str:
    """As files of a capture may be called."""
    return re.sub(r"[^A-Za-z0-9.-]+", "_", text).strip("_.")


def _unlike(mine: InstrumentLogs, theirs: InstrumentLogs, worlds: bool) -> str | None:
    """In what an instrument differs from that of another recording; None: in nothing that a capture states once, or
    `worlds`, each once."""
    if (mine.poses is None) != (theirs.poses is None) or mine.from_video != theirs.from_video:
        return "poses are"
    if (mine.roll is None) != (theirs.roll is None):
        return "roll is"
    limits = [{name: source.limits for name, source in item.joints.items()} for item in (mine, theirs)]
    if limits[0].keys() != limits[1].keys():
        return f"joints ({', '.join(limits[0]) or 'none'}) are"
    if limits[0] != limits[1]:
        return "limits of its joints are"
    if mine.kinematics != theirs.kinematics:
        return "kinematics are"
    if not worlds and not same_base(mine.base, theirs.base):
        return "the place of its base is"
    return None


@dataclass(frozen=True)
class _JoinedVideo(VideoSource):
    """The frames of several videos, counted on. first: frames before each, and of all."""

    videos: tuple[VideoSource, ...]
    first: tuple[int, ...]

    def read(self, indices: Sequence[int]) -> Iterator[tuple[int, np.ndarray]]:
        wanted = np.asarray(indices, dtype=np.int64)
        for video, before, after in zip(self.videos, self.first, self.first[1:], strict=False):
            own = wanted[(wanted >= before) & (wanted < after)] - before
            if len(own):
                for index, image in video.read(own.tolist()):
                    yield index + before, image


def _joined_videos(videos: list[VideoSource], times: np.ndarray, first: np.ndarray) -> VideoSource:
    size = videos[0].size
    return _JoinedVideo(videos[0].path, size, (), times, tuple(videos), tuple(first.tolist()))
