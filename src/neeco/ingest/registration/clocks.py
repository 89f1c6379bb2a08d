"""The clocks of an ingest's recordings, found from motion, and SfM's cameras registered to the trackers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from neeco.base.errors import NeecoError
from neeco.ingest.foreground.masks import ResidualFlow
from neeco.ingest.frames.images import StageProgress, Views
from neeco.ingest.readers.logs import PoseLog
from neeco.ingest.registration.hand_eye import Registration, register_with_laparoscope
from neeco.ingest.timing.clock_search import (
    ASSUMED,
    GIVEN,
    INSTRUMENT_MOTION,
    SCOPE_MOTION,
    ClockOffset,
    clock_from_instrument,
)
from neeco.ingest.timing.episodes import Episode, Episodes


@dataclass(frozen=True, kw_only=True)
class ClockSettings:
    """Limits of the clocks of one recording."""

    contradiction_sd: float = 4.0  # standard deviations by which two clocks differ
    instrument_slack: float = 0.1  # s by which an instrument's outline may move earlier or later than its tracked frame
    large_rate: float = 0.003  # from 1: no clock is that fast; frame rates are mistaken by more


CLOCKS = ClockSettings()


def register(data: Episodes, views: Views) -> tuple[Episodes, Registration | None]:
    """Register SfM's cameras to the laparoscope's tracker; return the clocks that this gives, too.

    views: in SfM's frame. Every episode's clock is found from its own motion first, then all of them are registered
    together. Without a registration a note states the reason.
    """
    settings = data.recording.settings
    if data.parts[0].scope is None:
        if data.video_instrument is None:  # else a note on the instrument in the video states how the scale is found
            data.notes.add(
                "the laparoscope was not tracked: "
                + ("instrument poses stay in the tracker's frame (unregistered), and " if data.parts[0].poses else "")
                + f"lengths are scaled as if the tissue were {settings.scene_distance_mm:g} mm away"
            )
        return data, None
    result = None
    for episode, part in enumerate(data.parts):
        rows = np.flatnonzero(views.episodes == episode)
        data, result = _register_episode(data, episode, views.world_from_camera[rows], views.times[rows] - part.start_s)
        if result is None and _scope(data.parts[episode]).clock not in data.parts[episode].clocks:
            return data, None
    if data.single:
        return data, result
    joint, synchronous = data.joint_log(_scope), ClockOffset(0.0, 0.0, GIVEN)
    try:
        result = register_with_laparoscope(views.world_from_camera, views.times, joint, synchronous, settings)
        return data, result
    except NeecoError as error:
        data.notes.add(f"not registered, instrument poses stay in the tracker's frame: {error}")
        return data, None


def _scope(part: Episode) -> PoseLog:
    assert part.scope is not None
    return part.scope


def _register_episode(
    data: Episodes, episode: int, world_from_camera: np.ndarray, times: np.ndarray
) -> tuple[Episodes, Registration | None]:
    """Register one episode, which gives its clock; times [M] s are its own."""
    part, settings = data.parts[episode], data.recording.settings
    scope = _scope(part)
    clock, why = part.clocks.get(scope.clock), ""
    by_motion: Registration | None = None
    try:
        by_motion = register_with_laparoscope(world_from_camera, times, scope, None, settings)
    except NeecoError as error:
        why = str(error)
    if clock is not None and clock.source == GIVEN:
        measured = None if by_motion is None else by_motion.clock
        if not _compare(data, episode, scope.clock, measured, times):
            by_motion = None  # as stated
    elif by_motion is None and clock is not None:
        data.notes.add(f"the clock {scope.clock!r} is taken as {clock.source}: {why}", episode)
    if by_motion is not None:
        # a clock that images and logs share is that of writing them, motion gives that of taking them
        return _take(data, episode, scope.clock, by_motion.clock), by_motion
    try:
        if clock is not None:
            return data, register_with_laparoscope(world_from_camera, times, scope, clock, settings)
    except NeecoError as error:
        why = str(error)
    if data.single or clock is None:
        data.notes.add(f"not registered, instrument poses stay in the tracker's frame: {why}", episode)
    return data, None


def _compare(data: Episodes, episode: int, name: str, measured: ClockOffset | None, times: np.ndarray) -> bool:
    """Compare a clock that `sync` states with the one from motion, at times of the video [M] s; note a contradiction.

    Return whether the clock from motion is to be taken: it agrees at some time, and has a rate, which `sync` cannot
    state.
    """
    stated = data.parts[episode].clocks[name]
    sentence, takes_motion = "", False
    if measured is not None:
        off = measured.at(times) - stated.at(times)
        slack = max(CLOCKS.contradiction_sd * measured.sd, float(np.median(np.diff(data.parts[episode].times))) / 2)
        slack = max(slack, CLOCKS.instrument_slack) if measured.source == INSTRUMENT_MOTION else slack
        if off.min() > slack or off.max() < -slack:
            sentence = (
                f"sync: {name}: {1000 * stated.seconds:.1f} ms contradicts what moves in the images, which gives "
                f"{measured} ({measured.source}): correct it, or leave it out"
            )
        else:
            takes_motion = measured.rate != 1
    data.notes.contradict(f"sync {name}", sentence, severe=True, episode=episode)
    return takes_motion


def _take(data: Episodes, episode: int, name: str, measured: ClockOffset) -> Episodes:
    """Set a clock as found from motion.

    A rate that no clock has is noted with its likely cause, a wrong frame rate; then all clocks that are not found from
    motion run at that rate, too.
    """
    part, sentence = data.parts[episode], ""
    clocks = {name: measured}
    if abs(measured.rate - 1) > max(CLOCKS.large_rate, CLOCKS.contradiction_sd * measured.rate_sd):
        for other, clock in part.clocks.items():
            if other != name and clock.source in (GIVEN, ASSUMED):
                clocks[other] = replace(clock, rate=measured.rate)
        fps = 1 / float(np.median(np.diff(part.times)))
        fits, stated_fps, says = fps / measured.rate, part.video.own_fps, ""
        if stated_fps is not None:
            fits = stated_fps if abs(fits / stated_fps - 1) < CLOCKS.contradiction_sd * measured.rate_sd else fits
            says = f"; {part.video.path.name} itself says {stated_fps:.4g}"
        fast = fits / fps - 1
        sentence = (
            f"the video runs {100 * abs(fast):.1f} % {'fast' if fast > 0 else 'slow'} against the clock {name!r}: its "
            f"fps is taken as {fps:.4g}, but {fits:.4g} fits{says}; correct fps (or the log's times) and "
            "ingest again: until then states are right, but not times and speeds"
        )
    data.notes.contradict(f"rate of {name}", sentence, severe=False, episode=episode)
    return data.with_clocks(episode, clocks)


def find_instrument_clocks(data: Episodes, flow: ResidualFlow, views: Views, progress: StageProgress) -> Episodes:
    """Find the clocks of instruments that the scope did not give, from their motion in the images.

    They are taken where nothing gave them, and compared where `sync` did. views: the rows of `flow`.
    """
    if not any(_is_open(part, log) for part in data.parts for log in part.poses.values()):
        return data
    progress("finding the instrument's clock", 0, 0)
    moved = flow.fastest_motion()
    for episode, part in enumerate(data.parts):
        rows = np.flatnonzero(views.episodes == episode)
        times = views.times[rows] - part.start_s
        for clock, log in {log.clock: log for log in part.poses.values() if _is_open(part, log)}.items():
            stated, measured = clock in data.parts[episode].clocks, None
            try:
                measured = clock_from_instrument(moved[rows[:-1]], times, log)
            except NeecoError as error:
                if not stated:
                    data.notes.add(str(error), episode)
            if stated and not _compare(data, episode, clock, measured, times):
                continue
            if measured is not None:
                data = _take(data, episode, clock, measured)
    return data


def _is_open(part: Episode, log: PoseLog) -> bool:
    """Return whether the clock of an instrument's log is to be found from its motion, or compared with it."""
    if part.scope is not None and part.scope.clock == log.clock:
        return log.clock not in part.clocks
    return log.clock not in part.clocks or part.clocks[log.clock].source == GIVEN


def note_frame_rates(data: Episodes) -> None:
    """Note frame rates that videos contradict themselves, where no clock found from motion settles it."""
    for episode, part in enumerate(data.parts):
        settled = any(clock.source in (SCOPE_MOTION, INSTRUMENT_MOTION) for clock in part.clocks.values())
        rate, sentence = part.video.own_fps, ""
        if rate is not None and not settled and part.poses:
            fps = 1 / float(np.median(np.diff(part.times)))
            sentence = (
                f"fps: the recording says {fps:.4g} frames a second, {part.video.path.name} itself {rate:.4g}; no "
                "clock found from motion settles it: leave fps out unless you know better"
            )
        data.notes.contradict("fps", sentence, severe=False, episode=episode)
