"""The clocks of the recordings of an ingest, found from motion, and where SfM's cameras stand to the trackers."""

from __future__ import annotations

import numpy as np

from neeco.errors import NeecoError
from neeco.ingest.episodes import Episodes
from neeco.ingest.motion import ResidualFlow
from neeco.ingest.recording import IngestSettings
from neeco.ingest.registration import GIVEN, Registration, offset_from_instrument, register_with_laparoscope
from neeco.ingest.video_instruments import seen_in_video


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
        return register_with_laparoscope(world_from_camera, times, data.scope, 0.0, settings)
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
    given = part.clocks.get(scope.clock)
    # a clock that images and logs share tells when they were written, motion when they were taken
    offsets: list[float | None] = [] if given is not None and given.source == GIVEN else [None]
    offsets += [] if given is None else [given.seconds]
    why = ""
    for offset in offsets:
        try:
            registration = register_with_laparoscope(world_from_camera, times, scope, offset, settings)
        except NeecoError as error:
            why = why or str(error)
            continue
        if why:
            source = given.source if given else GIVEN
            data.note(f"the clock {scope.clock!r} is taken as {source}: {why}", episode)
        part.clocks[scope.clock] = given if why and given is not None else registration.clock
        return registration
    if data.single or given is None:
        data.note(f"not registered, instrument poses stay in the tracker's frame: {why}", episode)
    return None


def find_instrument_clocks(data: Episodes, flow: ResidualFlow, times: np.ndarray, frames: np.ndarray) -> None:
    """Clocks that neither `sync` nor the scope gave: from how the instruments move in the images. times [M] s on the
    joint timeline of the rows of `flow`, frames [M] their numbers."""
    moved = flow.fastest_motion()
    for episode, part in enumerate(data.parts):
        rows = np.flatnonzero(data.episode_of(frames) == episode)
        unknown = {log.clock: log for log in part.poses.values() if log.clock not in part.clocks}
        for clock, log in unknown.items():
            try:
                part.clocks[clock] = offset_from_instrument(moved[rows[:-1]], times[rows] - data.starts[episode], log)
            except NeecoError as error:
                data.note(str(error), episode)


def unknown_clocks(data: Episodes) -> bool:
    """Whether the clock of an instrument's poses is not known in some episode."""
    return any(log.clock not in part.clocks for part in data.parts for log in part.poses.values())
