"""The sources that `neeco ingest` is given: recordings, or a folder in another format."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from neeco.errors import NeecoError
from neeco.ingest.readers import format_of
from neeco.ingest.recording.file import check_frame_count, read_recording
from neeco.ingest.recording.model import Recording

RECORDING = "recording.yaml"


def folder_to_convert(sources: Sequence[Path]) -> Path | None:
    """Return the folder that holds cameras in another format; None where the sources are files of recordings. Raises
    NeecoError for what is neither."""
    for source in sources:
        if (known := format_of(source)) is not None and source.exists():
            raise NeecoError(
                f"{source}: is in a recording's format ({known.format}) but does not state the meaning of its streams; "
                f"write that down first: neeco ingest --init {source}"
            )
        if source.is_dir():
            if (source / RECORDING).is_file():
                raise NeecoError(f"{source}: holds a recording; give the file: {source / RECORDING}")
            if len(sources) > 1:
                raise NeecoError(f"{source}: is a folder; of several recordings give each recording.yaml")
            return source
    return None


def read_recordings(sources: Sequence[Path], frames: int | None = None) -> list[Recording]:
    """Read recording files. frames: how many to keep, instead of what they state. Raises NeecoError."""
    check_frame_count(frames)
    recordings = [read_recording(source) for source in sources]
    return [item if frames is None else replace(item, frames=frames) for item in recordings]
