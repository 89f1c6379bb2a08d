"""The clocks of the recordings of an ingest, found from motion, and where SfM's cameras stand to the trackers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neeco.errors import NeecoError
from neeco.ingest.foreground.motion import ResidualFlow
from neeco.ingest.readers.logs import PoseLog
from neeco.ingest.recording.model import IngestSettings
from neeco.ingest.registration.hand_eye import Registration, register_with_laparoscope
from neeco.ingest.shaft.video_instruments import seen_in_video
from neeco.ingest.timing.clock_search import (
    ASSUMED,
    GIVEN,
    INSTRUMENT_MOTION,
    SCOPE_MOTION,
    ClockOffset,
    clock_from_instrument,
)
from neeco.ingest.timing.episodes import Episodes
from neeco.ingest.timing.synchronized import SynchronizedRecording

CONTRADICTION = 4.0  # standard deviations by which two clocks are not the same
INSTRUMENT_SLACK = 0.1  # s by which an instrument's outline may move earlier or later than its tracked frame
LARGE_RATE = 0.003  # from 1: no clock is that fast; frame rates are mistaken by more


def register(
    data: Episodes, world_from_camera: np.ndarray, times: np.ndarray, frames: np.ndarray, settings: IngestSettings
) -> Registration | None:
    """SfM's frame to the tracker's, where the scope was tracked and moved enough; else None, with a note why.

    world_from_camera [M, 4, 4] in SfM's frame; times [M] s on the joint timeline, frames [M] their numbers. Every
    episode's clock is found from its own motion first, then all of them are registered together.
    """
    if data.scope is None and seen_in_video(data) is not None:
        return None  # what tells the scale is said with the instrument
    if data.scope is None:
        data.note(
            "the laparoscope was not tracked: "
            + ("instrument poses stay in the tracker's frame (unregistered), and " if data.poses else "")
            + f"lengths are scaled as if the tissue were {settings.scene_distance_mm:g} mm away"
        )
        return None
    found = None
    for episode in range(len(data.parts)):
        rows = np.flatnonzero(data.episode_of(frames) == episode)
        found = _register_one(data, episode, world_from_camera[rows], times[rows] - data.starts[episode], settings)
        if found is None and data.parts[episode].clocks.get(data.scope.clock) is None:
            return None
    if data.single:
        return found
    try:
        return register_with_laparoscope(world_from_camera, times, data.scope, ClockOffset(0.0, 0.0, GIVEN), settings)
    except NeecoError as error:
        data.note(f"not registered, instrument poses stay in the tracker's frame: {error}")
        return None


def _register_one(
    data: Episodes, episode: int, world_from_camera: np.ndarray, times: np.ndarray, settings: IngestSettings
) -> Registration | None:
    """One episode's registration, which tells its clock; times [M] s are its own."""
    part = data.parts[episode]
    scope = part.scope
    assert scope is not None
    given, why = part.clocks.get(scope.clock), ""
    by_motion: Registration | None = None
    try:
        by_motion = register_with_laparoscope(world_from_camera, times, scope, None, settings)
    except NeecoError as error:
        why = str(error)
    if given is not None and given.source == GIVEN:
        found = None if by_motion is None else by_motion.clock
        if not _compare(data, episode, scope.clock, found, times):
            by_motion = None  # as stated
    elif by_motion is None and given is not None:
        data.note(f"the clock {scope.clock!r} is taken as {given.source}: {why}", episode)
    if by_motion is not None:
        # a clock that images and logs share tells when they were written, motion when they were taken
        _take(data, episode, scope.clock, by_motion.clock)
        return by_motion
    try:
        if given is not None:
            return register_with_laparoscope(world_from_camera, times, scope, given, settings)
    except NeecoError as error:
        why = str(error)
    if data.single or given is None:
        data.note(f"not registered, instrument poses stay in the tracker's frame: {why}", episode)
    return None


def _compare(data: Episodes, episode: int, name: str, found: ClockOffset | None, times: np.ndarray) -> bool:
    """Doubt a clock that `sync` states where motion gives another. Returns whether motion's is to be taken: it agrees
    at some time of the video, [M] s, and has a rate, which `sync` cannot state."""
    stated = data.parts[episode].clocks[name]
    sentence, takes_motion = "", False
    if found is not None:
        off = found.at(times) - stated.at(times)
        slack = max(CONTRADICTION * found.sd, float(np.median(np.diff(data.parts[episode].times))) / 2)
        slack = max(slack, INSTRUMENT_SLACK) if found.source == INSTRUMENT_MOTION else slack
        if off.min() > slack or off.max() < -slack:
            sentence = (
                f"sync: {name}: {1000 * stated.seconds:.1f} ms contradicts what moves in the images, which gives "
                f"{found} ({found.source}): correct it, or leave it out"
            )
        else:
            takes_motion = found.rate != 1
    data.doubt(f"sync {name}", sentence, severe=True, episode=episode)
    return takes_motion


def _take(data: Episodes, episode: int, name: str, found: ClockOffset) -> None:
    """Take a clock as motion gave it. One whose rate is that of no clock is named, with the likely cause, a wrong frame
    rate; then all clocks that are not found from motion run at that rate."""
    part, sentence = data.parts[episode], ""
    part.clocks[name] = found
    if abs(found.rate - 1) > max(LARGE_RATE, CONTRADICTION * found.rate_sd):
        for other, clock in part.clocks.items():
            if clock.source in (GIVEN, ASSUMED):
                part.clocks[other] = replace(clock, rate=found.rate)
        fps = 1 / float(np.median(np.diff(part.times)))
        fits, own, says = fps / found.rate, part.video.own_fps, ""
        if own is not None:
            fits = own if abs(fits / own - 1) < CONTRADICTION * found.rate_sd else fits
            says = f"; {part.video.path.name} itself says {own:.4g}"
        fast = fits / fps - 1
        sentence = (
            f"the video runs {100 * abs(fast):.1f} % {'fast' if fast > 0 else 'slow'} against the clock {name!r}: fps? "
            f"It is taken as {fps:.4g} frames a second, {fits:.4g} fits{says}; correct fps (or the log's times) and "
            "ingest again: until then states are right, but not times and speeds"
        )
    data.doubt(f"rate of {name}", sentence, severe=False, episode=episode)


def find_instrument_clocks(data: Episodes, flow: ResidualFlow, times: np.ndarray, frames: np.ndarray) -> None:
    """Clocks of instruments that the scope did not give, from how they move in the images: taken where nothing gave
    them, compared where `sync` did. times [M] s on the joint timeline of the rows of `flow`, frames [M] their
    numbers."""
    moved = flow.fastest_motion()
    for episode, part in enumerate(data.parts):
        rows = np.flatnonzero(data.episode_of(frames) == episode)
        own = times[rows] - data.starts[episode]
        for clock, log in {log.clock: log for log in part.poses.values() if _is_open(part, log)}.items():
            stated, found = clock in part.clocks, None
            try:
                found = clock_from_instrument(moved[rows[:-1]], own, log)
            except NeecoError as error:
                if not stated:
                    data.note(str(error), episode)
            if stated and not _compare(data, episode, clock, found, own):
                continue
            if found is not None:
                _take(data, episode, clock, found)


def _is_open(part: SynchronizedRecording, log: PoseLog) -> bool:
    """Whether how an instrument moves in the images has to say something of its log's clock."""
    if part.scope is not None and part.scope.clock == log.clock:
        return log.clock not in part.clocks
    return log.clock not in part.clocks or part.clocks[log.clock].source == GIVEN


def doubt_frame_rates(data: Episodes) -> None:
    """Doubt frame rates that videos contradict themselves, where no clock found from motion settles it."""
    for episode, part in enumerate(data.parts):
        settled = any(clock.source in (SCOPE_MOTION, INSTRUMENT_MOTION) for clock in part.clocks.values())
        own, sentence = part.video.own_fps, ""
        if own is not None and not settled and part.poses:
            fps = 1 / float(np.median(np.diff(part.times)))
            sentence = (
                f"fps: the recording says {fps:.4g} frames a second, {part.video.path.name} itself {own:.4g}, and no "
                "clock found from motion settles it: leave fps out unless you know better"
            )
        data.doubt("fps", sentence, severe=False, episode=episode)


def open_clocks(data: Episodes) -> bool:
    """Whether the clock of an instrument's poses is to be found, or compared, in some episode."""
    return any(_is_open(part, log) for part in data.parts for log in part.poses.values())
