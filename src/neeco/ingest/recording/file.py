"""Recordings from recording.yaml."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from neeco.base.errors import NeecoError, nearest
from neeco.base.files import parse_yaml, read_json, read_text, require_file
from neeco.base.settings import Fault, faults_in, join_places, printable, read
from neeco.capture.documents import Node, as_float
from neeco.capture.model import SEPARATE_TISSUES
from neeco.ingest.readers import format_of
from neeco.ingest.readers.columns import TRACKER_CLOCK, VIDEO_CLOCK
from neeco.ingest.readers.sections import MAX_NUMBER, existing_file
from neeco.ingest.recording.model import Recording, RecordingKeys, with_clock


def read_recording(path: Path) -> Recording:
    """Read recording.yaml; paths in it are relative to it. Raises NeecoError naming file, key and remedy."""
    path = Path(path)
    advice = "`neeco ingest --init` writes one by looking at the files"
    content = read_text(path, "a recording as YAML", f"no such file; {advice}")
    document = parse_yaml(path, content, "repair it")
    if document is None:
        raise NeecoError(f"{path}: the file is empty; {advice}")
    with faults_in(path):
        if isinstance(document, dict) and "tissue" in document:
            raise Fault("tissue", f"a capture has one tissue; leave the key out, or {SEPARATE_TISSUES}")
        return recording_of(document, path)


def recording_of(document: Any, path: Path) -> Recording:
    """Return the recording that a document of the file `path` states. Raises Fault."""
    stated: RecordingKeys = read(RecordingKeys, Node(document, str(path)))
    names = [joint for item in stated.instruments for joint in item.joints]
    shared = [name for name in names if names.count(name) > 1]
    scope = stated.laparoscope
    recording = replace(
        Recording(**vars(stated), path=path),
        instruments=tuple(item.completed(stated.file, stated, shared) for item in stated.instruments),
        laparoscope=None if scope is None else with_clock(scope, TRACKER_CLOCK, stated.file),
    )
    sync, notes = _sync(Node(stated.sync or None, str(path), "sync"), recording.clocks)
    reader = None if recording.file is None else format_of(recording.file)
    for log in recording.logs if reader is not None else ():
        if recording.file is None or reader is None or log.file != recording.file or log.clock != VIDEO_CLOCK:
            continue
        of_log, of_images = (reader.clock(recording.file, stream) for stream in (log.stream, recording.stream))
        if of_log and of_images and of_log != of_images:  # another part of one file, as of another episode
            problem = f"{printable(log.stream)} is of {of_log}, the images of {of_images}"
            raise Fault("stream", f"{problem}; name the same in both")
    return replace(recording, sync=sync, notes=notes)


def _sync(node: Node, clocks: tuple[str, ...]) -> tuple[dict[str, float], tuple[str, ...]]:
    """Return offsets s by clock, from a mapping or a JSON file, as in {"clocks": {"em": 0.038}}; and notes on those of
    no log."""
    if node.value is None:
        return {}, ()
    if isinstance(node.value, str):
        file = existing_file(node)
        require_file(file, "clock offsets as JSON")
        with faults_in(file):
            stated = Node(read_json(file), str(file)).child("clocks")
            return _sync(stated.at([] if stated.value is None else stated.value, stated.field), clocks)
    if not isinstance(node.value, dict):
        expected = 'expected clock offsets in s, as in {"clocks": {"em": 0.038}}'
        raise Fault(node.field, f"{expected}, or a JSON file of them; correct it")
    offsets, notes = dict[str, float](), []
    for name, value in node.value.items():
        place, seconds = join_places(node.field, str(name)), as_float(value)
        if seconds is None or not abs(seconds) < MAX_NUMBER:
            raise Fault(place, f"{printable(value)} is not an offset in seconds; t_log = t_video + offset")
        if name not in clocks and (likely := nearest(str(name), clocks)):
            raise Fault(place, f"no log has the clock {printable(name)}; did you mean {likely}?")
        if name in clocks:
            offsets[name] = seconds
        else:
            notes.append(f"{Path(node.file).name}: {printable(place)} belongs to no log of this recording; ignored")
    return offsets, tuple(notes)
