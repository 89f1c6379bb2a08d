"""The sources that `neeco ingest` is given: recordings, files named on the command line, or a folder to convert."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from neeco.base.errors import NeecoError
from neeco.base.files import write_text
from neeco.base.settings import Fault
from neeco.ingest.cameras.still_scene import video_stands_still
from neeco.ingest.readers import format_of, read_table
from neeco.ingest.readers.names import recognise_time
from neeco.ingest.readers.video import VIDEOS
from neeco.ingest.recording.model import MIN_FRAMES, Recording, read_recording, recording_of
from neeco.ingest.recording.template import open_questions, write_template
from neeco.ingest.request import IngestRequest

RECORDING = "recording.yaml"
_OPTIONS = {
    "video.fps": "--fps",
    "images.fps": "--fps",
    "video": "--video",
    "images": "--video",
    "instruments[0].joints": "--joint",
    "instruments[0].from_video": "--shaft-diameter",
    "instruments[0].poses": "--instrument",
    **{name: f"--{name}" for name in ("intrinsics", "laparoscope", "sync", "frames")},
}  # by the beginning of a field of recording.yaml


def write_draft(sources: Sequence[Path], report: Callable[[str], None]) -> list[str]:
    """Write a recording.yaml for what lies at the one source (none: here), into the folder or next to the file, and
    return lines on it; `report` is called with what is left out. Raises NeecoError where there is one, and where there
    are no images."""
    if len(sources) > 1:
        raise NeecoError("--init: looks at one folder or file; give one")
    source = sources[0] if sources else Path()
    path = (source.parent if source.is_file() or format_of(source) is not None else source) / RECORDING
    if path.exists():
        raise NeecoError(f"{path}: already exists; edit it, or move it away first")
    draft = write_template(source, lambda problem: report(f"left out: {problem}"), video_stands_still)
    write_text(path, draft)
    questions = [f"{n}. {path}:{line}: {words}" for n, (line, words) in enumerate(open_questions(draft), 1)]
    lines = ["still open:", *questions] if questions else []
    return [*lines, f"wrote {path}: look through it, then: neeco ingest {path} --output CAPTURE"]


def sources_of(request: IngestRequest, output: Path | None) -> tuple[Path | None, list[Recording]]:
    """Return the folder in another format that a request names, to be converted; else the recordings that it states: by
    files, or by its other options, whose columns are recognised from the headers. Raises NeecoError naming the file or
    the option, and where there is no output."""
    folder = None  # the one that holds cameras in another format
    for source in request.source:
        if source.suffix.lower() in VIDEOS:
            raise NeecoError(f"{source}: is a video; give it as --video {shlex.quote(str(source))}")
        if (kind := format_of(source)) is not None and source.exists():
            raise NeecoError(
                f"{source}: is in a recording's format ({kind.format}) but does not state the meaning of its streams; "
                f"write that down first: neeco ingest --init {source}"
            )
        if source.is_dir() and (source / RECORDING).is_file():
            raise NeecoError(f"{source}: holds a recording; give the file: {source / RECORDING}")
        if source.is_dir() and len(request.source) > 1:
            raise NeecoError(f"{source}: is a folder; of several recordings give each recording.yaml")
        folder = source if source.is_dir() else None
    if not request.source and request.video is None:
        raise NeecoError("--video: give the video (or a folder of images), or a recording.yaml")
    if output is None:
        raise NeecoError("--output: give the folder of the capture to write")
    ignored = [option for option in request.options if folder is not None or option != "--frames"]
    if request.source and ignored:
        raise NeecoError(f"{request.source[0]}: {ignored[0]} has no effect with it; leave one of them out")
    if request.frames is not None and request.frames < MIN_FRAMES:
        raise NeecoError(f"--frames: {request.frames} is too few; give {MIN_FRAMES} or more")
    if folder is not None:
        return folder, []
    if request.video is not None:
        return None, [_recording_of_options(request, request.video)]
    recordings = [read_recording(source) for source in request.source]
    return None, [item if request.frames is None else replace(item, frames=request.frames) for item in recordings]


def _recording_of_options(request: IngestRequest, video: Path) -> Recording:
    if request.intrinsics is not None and request.calibration is not None:
        raise NeecoError("--calibration: given together with --intrinsics; give one of them")
    shaft, joints = request.shaft_diameter, request.joint
    tracked = request.instrument is not None or shaft is not None
    for joint, log, table in joints:
        if [name for name, *_ in joints].count(joint) > 1:
            raise NeecoError(f"--joint {joint}: given twice; give each joint once")
        if not tracked:
            raise NeecoError(f"--joint {joint}: needs --instrument, whose joint it is, or --shaft-diameter")
        timed = [recognise_time(read_table(file).header).time for file in (log, table) if file and file.exists()]
        if timed and timed[0] is None and timed[-1] is not None:
            raise NeecoError(f"--joint {joint}: {log} has no times, {table} has; give the log first, its table second")
    is_folder = video.is_dir() and format_of(video) is None
    tool = {
        "name": "instrument",
        "poses": request.instrument,
        "joints": {joint: {"file": log, "calibration": table} for joint, log, table in joints},
        "from_video": None if shaft is None else {"shaft_diameter_mm": shaft},
    }
    document = {
        "images" if is_folder else "video": {"folder" if is_folder else "file": video, "fps": request.fps},
        "intrinsics": request.calibration or request.intrinsics,
        "instruments": [tool] if tracked else [],
        **{name: getattr(request, name) for name in ("laparoscope", "sync", "frames")},
    }
    try:
        plain = json.loads(json.dumps(document, default=str))  # as recording.yaml has it
        return replace(recording_of(plain, Path("this folder")), path=video)
    except Fault as fault:
        options = (option for field, option in _OPTIONS.items() if fault.field.startswith(field))
        option = "--calibration" if request.calibration and fault.field == "intrinsics" else next(options, fault.field)
        joint = fault.field.split(".")[2] if option == "--joint" else ""
        raise NeecoError(f"{option} {joint}".rstrip() + f": {fault}") from None
