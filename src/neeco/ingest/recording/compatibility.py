"""Selection of the recordings that make one capture, and their names in it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

from neeco.base.errors import NeecoError
from neeco.ingest.readers import format_of
from neeco.ingest.readers.sections import JointColumns, PoseColumns
from neeco.ingest.recording.model import IngestSettings, InstrumentLogs, Recording, StereoPartner, VideoFile


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
