"""Recordings over several tissues: each tissue is a world of its own, and one capture holds them all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from neeco.capture.model import Capture, PointCloud, Tissue
from neeco.capture.writer import write_capture
from neeco.errors import NeecoError
from neeco.ingest.frames.views import StageProgress
from neeco.ingest.pipeline import find_world, finish
from neeco.ingest.recording.compatibility import check_shared_settings, episode_names, file_name, separate
from neeco.ingest.recording.model import EACH, Recording, Splits
from neeco.ingest.result import IngestResult
from neeco.ingest.staging import staged
from neeco.ingest.timing.reading import check_episodes, read_episodes
from neeco.ingest.world import World


def ingest_tissues(
    recordings: Sequence[Recording],
    output: Path,
    progress: StageProgress,
    complete: Callable[[dict[str, IngestResult], Path], None] = lambda results, folder: None,
) -> dict[str, IngestResult]:
    """Make a capture of recordings that name their tissues, as `ingest` does of others; return a report on each tissue.

    Each tissue gets a world of its own, found from its own recordings.
    """
    with staged(output) as folder:
        progress("reading logs and video", 0, 0)
        read = {str(tissue): read_episodes(own, str(tissue)) for tissue, own in by_tissue(separate(recordings)).items()}
        check_episodes([part for data in read.values() for part in data.parts], tissues=True)
        worlds = {}
        for number, (tissue, data) in enumerate(read.items()):
            own = folder / f"world_{number}"
            own.mkdir()
            worlds[tissue] = find_world(data, own, progress)
        readings = _joined_readings(list(worlds.values()))
        found = {tissue: finish(world, output, readings) for tissue, world in worlds.items()}
        write_capture(_joined({tissue: capture for tissue, (capture, _) in found.items()}), folder / "capture")
        results = {tissue: result for tissue, (_, result) in found.items()}
        complete(results, folder / "capture")
        return results


def _joined(captures: dict[str, Capture]) -> Capture:
    """Return one capture of several tissues, from that of each. Raises NeecoError for what it can only state once."""
    parts = list(captures.values())
    frames = tuple(
        replace(frame, state=replace(frame.state, tissue=tissue))
        for tissue, capture in captures.items()
        for frame in capture.frames
    )
    for tissue, capture in captures.items():
        for what, one, first in (
            ("registered", capture.registered, parts[0].registered),
            ("of a scope that stands still", capture.still, parts[0].still),
        ):
            if one != first:
                word = "is" if one else "is not"
                raise NeecoError(
                    f"tissue: {tissue} {word} {what}, unlike {next(iter(captures))}; one capture has the same of all: "
                    "ingest it alone"
                )
    lens = parts[0].lens if all(capture.lens == parts[0].lens for capture in parts) else None  # each was estimated
    tissues = tuple(Tissue(tissue, capture.points) for tissue, capture in captures.items())
    # the base stands elsewhere in each world
    instruments = tuple(replace(item, base_uncertainty=None) for item in parts[0].instruments)
    return replace(
        parts[0], frames=frames, instruments=instruments, points=PointCloud(measured=False), lens=lens, tissues=tissues
    )


def by_tissue(recordings: Sequence[Recording]) -> dict[str | None, list[Recording]]:
    """Return the recordings of every tissue, by its name; all under None where none names one.

    What the first states for all (splits, frames, settings) is then stated in each. Raises NeecoError.
    """
    if not any(recording.tissue for recording in recordings):
        return {None: list(recordings)}
    named = [replace(item, episode=name) for item, name in zip(recordings, episode_names(recordings), strict=True)]
    worlds: dict[str | None, list[Recording]] = {}
    for item in named:
        if any(instrument.from_video for instrument in item.instruments):
            raise NeecoError(
                f"{item.path}: from_video: over each tissue an instrument found in the video has a frame of its own; "
                "ingest one tissue at a time"
            )
        if item.tissue is None:
            others = ", ".join(dict.fromkeys(other.tissue for other in named if other.tissue))
            raise NeecoError(f"{item.path}: tissue: is missing, where other recordings name theirs: {others}; name it")
        worlds.setdefault(item.episode if item.tissue == EACH else item.tissue, []).append(item)
    if len({file_name(tissue or "") for tissue in worlds}) < len(worlds):
        raise NeecoError(
            f"{named[0].path}: tissue: two of {', '.join(map(str, worlds))} make one file's name; rename one"
        )
    first = named[0]
    for item in named[1:]:
        check_shared_settings(item, first)
    for tissue, own in worlds.items():
        splits = first.splits and _splits_of(first.splits, named, own, str(tissue))
        worlds[tissue] = [replace(item, splits=splits, frames=first.frames, settings=first.settings) for item in own]
    return worlds


def _splits_of(splits: Splits, named: Sequence[Recording], own: Sequence[Recording], tissue: str) -> Splits:
    """Return the part of the splits of all that holds for the recordings of one tissue. Raises NeecoError."""
    names, known = [item.episode for item in own], {item.episode for item in named}
    tested, unseen = splits.test_episodes, splits.unseen_episodes
    for episode in tested + unseen:
        if episode not in known:
            listed = ", ".join(item.episode for item in named)
            raise NeecoError(f"{named[0].path}: splits: no episode is called {episode!r}; they are {listed}")
    if splits.test or splits.unseen:
        raise NeecoError(
            f"{named[0].path}: splits: test and unseen count one video's frames, and there are {len(named)} "
            "recordings; name test_episodes and unseen_episodes"
        )
    if set(names) <= set(tested + unseen):
        raise NeecoError(f"{named[0].path}: splits: leave no recording of the tissue {tissue} to train on; change them")
    found = replace(
        splits,
        test_episodes=tuple(name for name in tested if name in names),
        unseen_episodes=tuple(name for name in unseen if name in names),
    )
    found = replace(found, test_every=0) if tested and not found.test_episodes else found
    return replace(found, unseen_fraction=0.0) if unseen and not found.unseen_episodes else found


def _joined_readings(worlds: Sequence[World]) -> dict[str, dict[str, np.ndarray]]:
    """Return the readings over all tissues, by instrument and joint."""
    names = {name: list(joints) for name, (_, joints) in worlds[0].states.items()}
    return {
        name: {joint: np.concatenate([one.states[name][1][joint][one.usable] for one in worlds]) for joint in joints}
        for name, joints in names.items()
    }
