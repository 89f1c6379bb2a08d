"""Reading of recordings: logs, videos, stated clocks, and checks of their consistency, also of those that make one
capture."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from neeco.base.errors import NeecoError
from neeco.geometry.lens import Lens
from neeco.ingest.readers import MAX_UNLIKE, VideoSource, compare_counts, format_of
from neeco.ingest.readers.logs import PoseLog, ReadingLog, read_pose_log, read_reading_log
from neeco.ingest.readers.names import BASE, VIDEO_CLOCK
from neeco.ingest.readers.sections import JointColumns, PoseColumns
from neeco.ingest.recording.base import STATED
from neeco.ingest.recording.model import STILL, IngestSettings, InstrumentLogs, Recording, StereoPartner, VideoFile
from neeco.ingest.timing.clock_search import CLOCK, GIVEN, VIDEOS_OWN, ClockOffset
from neeco.ingest.timing.episodes import EPISODES, Episode, Episodes, Notes, assumed_clock


@dataclass(frozen=True, kw_only=True)
class ReadingSettings:
    """Limits of usable recordings."""

    min_fps: float = 0.01
    max_fps: float = 10_000.0
    same_focal: float = 0.02  # relative difference of focal lengths between calibrations of one lens
    min_side_px: int = 32  # smaller frames have too few features for finding cameras


READING = ReadingSettings()


def separate(recordings: Sequence[Recording]) -> tuple[Recording, ...]:
    """Return one recording for each of the episodes that a recording lists. Raises NeecoError."""
    separated: list[Recording] = []
    for recording in recordings:
        separated += [_of_episode(recording, number) for number in recording.episodes] or [recording]
    return tuple(separated)


def _of_episode(recording: Recording, episode: int) -> Recording:
    """Return the recording with all its streams of one episode of the data set that holds them."""
    moved = []

    def in_episode(value: Any, key: str) -> Any:
        if isinstance(value, Mapping):
            return {name: in_episode(item, f"{key}: {name}") for name, item in value.items()}
        if isinstance(value, tuple):
            return tuple(in_episode(item, key) for item in value)
        if isinstance(value, InstrumentLogs | StereoPartner):
            values = {field.name: in_episode(getattr(value, field.name), field.name) for field in fields(value)}
            return replace(value, **values)
        if not isinstance(value, VideoFile | PoseColumns | JointColumns):
            return value
        reader = format_of(value.file)
        if reader is None or reader.of_episode("", episode) is None:
            return value
        if value.stream is None:
            raise NeecoError(f"{recording.path}: {key}: stream: missing; name the feature, as in observation.state")
        moved.append(key)
        return replace(value, stream=reader.of_episode(value.stream, episode))

    streams = {
        key: in_episode(getattr(recording, key), key) for key in ("video", "instruments", "laparoscope", "stereo")
    }
    changed = replace(recording, **streams, episode=f"episode_{episode}")
    if not moved:
        raise NeecoError(
            f"{recording.path}: episodes: no file named here holds several; leave it out, and give several recordings "
            "as `neeco ingest A/recording.yaml B/recording.yaml`"
        )
    return changed


def read_episodes(recordings: Sequence[Recording]) -> Episodes:
    """Read logs and videos, and put them on one timeline, with the clocks that are given.

    Raises NeecoError for recordings that cannot be used, or that one capture cannot hold.
    """
    names = episode_names(recordings)
    notes = Notes(names)
    parts: list[Episode] = []
    for episode, recording in enumerate(recordings):
        part = _read(recording, names[episode], notes, episode)
        if parts:
            before = parts[-1]
            start = before.start_s + before.times[-1] + EPISODES.pause_s - part.times[0]
            part = replace(part, start_s=start, first_frame=before.first_frame + len(before.times))
        parts.append(part)
    first = parts[0]
    for part in parts[1:]:
        if part.video.size != first.video.size:
            sizes = [f"{width}x{height}" for width, height in (part.video.size, first.video.size)]
            raise refusal(part.recording, f"images: are {sizes[0]}, not {sizes[1]} as", first.recording)
    check_recordings(recordings)
    for part in parts[1:]:
        for name, log in part.poses.items():
            if log.frame != first.poses[name].frame:
                raise refusal(part.recording, f"instruments: {name}: poses are in another frame than", first.recording)
    single = len(names) == 1
    splits = recordings[0].splits
    video = first.video
    for name in splits.test_episodes + splits.unseen_episodes if splits else ():
        if single or name not in names:
            listed = "one recording has none" if single else f"they are {', '.join(names)}"
            raise NeecoError(f"{recordings[0].path}: splits: no episode is called {name!r}; {listed}")
    if not single and splits and (splits.test or splits.unseen):
        raise NeecoError(
            f"{recordings[0].path}: splits: test and unseen count one video's frames, and there are {len(names)} "
            "recordings; name test_episodes and unseen_episodes"
        )
    if not single:
        videos, starts = tuple(part.video for part in parts), [part.first_frame for part in parts]
        times = np.concatenate([part.times + part.start_s for part in parts])

        def images(indices: list[int]) -> Iterator[tuple[int, np.ndarray]]:
            wanted = np.asarray(indices, dtype=np.int64)
            for part, before, after in zip(videos, starts, [*starts[1:], len(times)], strict=True):
                local = wanted[(wanted >= before) & (wanted < after)] - before
                for index, image in part.read(local.tolist()) if len(local) else ():
                    yield index + before, image

        video = VideoSource(video.path, video.size, (), times, images=images)
    return Episodes(tuple(parts), video, notes)


def _read(recording: Recording, name: str, notes: Notes, episode: int) -> Episode:
    """Read one recording. Raises NeecoError for logs and videos that cannot be used."""
    # logs are read first, as faults in them are found quickly
    items = recording.instruments
    poses = {item.name: read_pose_log(item.poses) for item in items if item.poses is not None}
    joints = {item.name: {joint: read_reading_log(source) for joint, source in item.joints.items()} for item in items}
    rolls = {item.name: read_reading_log(item.roll) for item in items if item.roll is not None}
    scope = read_pose_log(recording.laparoscope) if recording.laparoscope else None
    for item in items:  # nothing would register poses in bases of different names
        posed = poses.get(item.name)
        tracker = None if scope is None else scope.stated_in
        if tracker is None or item.base is not None or posed is None or posed.frame != BASE:
            continue
        if posed.stated_in not in (None, tracker):
            raise NeecoError(
                f"{recording.path}: laparoscope: its poses are stated in {tracker}, those of {item.name} in "
                f"{posed.stated_in}; where these are one frame write `frame: base` for both, else state how they stand "
                "(world_from_base)"
            )
    require_answers(recording, poses)
    video = recording.source.open()
    logs: list[PoseLog | ReadingLog] = [*poses.values(), *([scope] if scope else [])]
    logs += [log for by_joint in joints.values() for log in by_joint.values()] + [*rolls.values()]
    for note in (*recording.notes, *(note for log in logs for note in log.notes), *video.notes):
        notes.add(note, episode)
    for item in items:
        if not item.placed:
            notes.add(f"instrument {item.name!r} was not tracked: it is left out of the capture's states", episode)
    placed = [item.name for item in items if item.placed]
    if not placed:
        notes.add("no instrument was tracked: the capture has cameras and images only (method 3dgs trains)", episode)
    rate, length = 1 / float(np.median(np.diff(video.times))), video.times[-1] - video.times[0]
    if not (READING.min_fps < rate < READING.max_fps and length < CLOCK.max_length_s):
        raise NeecoError(
            f"{video.path}: frames at {rate:.3g} a second over {length / 3600:.3g} h "
            "cannot be; correct fps or the times' unit"
        )
    if min(video.size) < (least := READING.min_side_px):
        width, height = video.size
        raise NeecoError(f"{video.path}: its frames are {width}x{height} pixels; give {least} or more each way")
    if recording.stereo is not None:  # before anything that takes long
        left, right, _, calibration = recording.read_stereo()
        right.check_size(recording.stereo.source.open().size, calibration)
        reader = None if recording.file is None else format_of(recording.file)
        stated = None
        sentence = ""
        with suppress(NeecoError):  # the calibration of the images' file is not used
            stated = None if reader is None or recording.file is None else reader.lens(recording.file, recording.stream)
        if stated is not None and abs(left.fl_x / stated.fl_x - 1) >= READING.same_focal:
            sentence = (
                f"stereo.calibration: {calibration.name} states a focal length of {left.fl_x:.0f} px, the images' own "
                f"file one of {stated.fl_x:.0f} px: check that it is of this scope and zoom"
            )
        notes.contradict("calibration", sentence, severe=False, episode=episode)
    for log in (log for log in logs if log.clock == VIDEO_CLOCK):
        if log.image_hz is not None:  # its rows belong to images one by one
            rows, images = (round(float(seconds) * log.image_hz) + 1 for seconds in (log.times[-1], length))
            remedy = "give the video of this log"
            if images != rows and abs(len(video.times) - rows) <= 1:
                remedy = f"its {len(video.times)} images match the states: set `fps: {log.image_hz:g}`"
            noun = f"states at {log.image_hz:g} Hz"
            for note in compare_counts(video.path, images, rows, noun, MAX_UNLIKE, remedy):
                notes.add(note, episode)
        elif log.path != recording.file:
            beyond = max(0.0, log.times[-1] - video.times[-1]) + max(0.0, video.times[0] - log.times[0])
            if beyond > MAX_UNLIKE * length:
                note = (
                    f"{log.path.name}: goes from {log.times[0]:.1f} to {log.times[-1]:.1f} s on the video's clock, the "
                    f"video from {video.times[0]:.1f} to {video.times[-1]:.1f} s: check that both are of one recording"
                )
                notes.add(note, episode)
    clocks = {name: ClockOffset(float(seconds), 0.0, GIVEN) for name, seconds in recording.sync.items()}
    if VIDEO_CLOCK in recording.clocks:
        clocks.setdefault(VIDEO_CLOCK, ClockOffset(0.0, 0.0, VIDEOS_OWN))
    # joints' clocks that nothing gives are the video's: images determine them to some 20 ms at best; trackers' clocks,
    # and those of joints on one of them, are found later, from motion
    found_later = {log.clock for log in (*poses.values(), *([scope] if scope else []))}
    for joint, log in ((joint, log) for name in placed for joint, log in joints[name].items()):
        if log.clock not in clocks and log.clock not in found_later:
            clocks[log.clock] = assumed_clock(log, video.times)
            notes.add(
                f"the clock of joint {joint!r} was not given and is taken to be the video's: at 1 rad/s, 20 ms off are "
                "1.1 deg",
                episode,
            )
    return Episode(
        name=name, recording=recording, video=video, poses=poses, joints=joints, rolls=rolls, scope=scope, clocks=clocks
    )


def require_answers(recording: Recording, poses: Mapping[str, PoseLog]) -> None:
    """Raise NeecoError for missing inputs of a later stage, before any computation that takes minutes."""
    for item in recording.instruments:
        place, base = f"{recording.path}: instruments: {item.name}", item.base
        log = poses.get(item.name)
        in_base = log is not None and log.frame == BASE and log.stated_in is not None
        if recording.camera == STILL and in_base and base is None:
            raise NeecoError(
                f"{place}: camera_from_base: missing; its poses are stated in a robot's base, and nothing says how "
                f"that stands to the camera: give {STATED} roughly measured, a file of the dVRK's registration, or "
                "unknown (with kinematics)"
            )
        if base is not None and base.matrix is None and item.kinematics is None and len(item.joints) > 1:
            raise NeecoError(
                f"{place}: kinematics: missing; a wrist that bends does not show an unknown base: give its "
                f"links ({{dvrk_tool: TOOL.json}}, urdf or links), or {base.key} as roughly measured (sd_mm, sd_deg)"
            )
    if recording.camera == STILL:
        require_lens(recording, recording.read_lens()[0])


def require_lens(recording: Recording, lens: Lens | None) -> None:
    """Raise NeecoError for a scope that stands still without a lens."""
    if lens is None:
        raise NeecoError(
            f"{recording.path}: intrinsics: missing; images of a scope that stands still do not determine its "
            "lens; give fl_x, fl_y, cx, cy or a calibration"
        )


def episode_names(recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Return distinct names: a recording's own, else its file's, or its folder's where all files have one name."""
    stems = {recording.path.stem for recording in recordings}
    names: list[str] = []
    for recording in recordings:
        of_file = recording.path.stem if len(stems) > 1 else recording.path.resolve().parent.name
        # with only the characters that file names in a capture have
        name = re.sub(r"[^A-Za-z0-9.-]+", "_", recording.episode or of_file).strip("_.") or "recording"
        number = 2
        while name in names:
            name, number = f"{name.removesuffix(f'_{number - 1}')}_{number}", number + 1
        names.append(name)
    return tuple(names)


def check_recordings(recordings: Sequence[Recording]) -> None:
    """Raise NeecoError for recordings that one capture cannot hold."""
    first = recordings[0]
    lens, where = first.read_lens()
    for other in recordings[1:]:
        if other.read_lens()[0] != lens:
            raise refusal(other, f"intrinsics: differ from what {where} gives", first)
        theirs = _stated_once(first)
        for place, mine in _stated_once(other).items():
            if mine != theirs[place]:
                raise refusal(other, f"{place}: differs from that", first)
        for key, default in (("frames", None), ("splits", None), ("settings", IngestSettings())):
            if getattr(other, key) not in (default, getattr(first, key)):
                raise refusal(other, f"{key}: differs from that", first)


def refusal(other: Recording, what: str, first: Recording) -> NeecoError:
    return NeecoError(
        f"{other.path}: {what} in {first.path}: recordings of one capture have the same; correct it, or ingest it alone"
    )


def _stated_once(recording: Recording) -> dict[str, Any]:
    """Return what a capture states once for all of its recordings, by place; the instruments' names come first."""
    items, camera = recording.instruments, recording.camera
    stated: dict[str, Any] = {"instruments": [item.name for item in items], "camera": camera}
    stated |= {key: getattr(recording, key) is not None for key in ("laparoscope", "stereo")}
    for item in items:
        base = item.base
        matrix = None if base is None or base.matrix is None else base.matrix.tolist()
        of_item = {
            "poses": (item.poses is not None, item.from_video),
            "roll": item.roll is not None,
            "joints": {name: log.limits for name, log in item.joints.items()},
            "kinematics": item.kinematics,
            "base": base and (matrix, base.sd_mm, base.sd_deg, base.to_world),
        }
        stated |= {f"instruments: {item.name}: {key}": value for key, value in of_item.items()}
    return stated
