"""The sources that `neeco ingest` is given: recordings, files named on the command line, or a folder to convert."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from neeco.errors import NeecoError
from neeco.files import write_text
from neeco.ingest.cameras.still_scene import video_stands_still
from neeco.ingest.readers import format_of, read_table
from neeco.ingest.readers.columns import recognise_time
from neeco.ingest.readers.video import IMAGES, VIDEOS
from neeco.ingest.recording.file import read_recording, recording_of
from neeco.ingest.recording.model import MAX_SHAFT_MM, MIN_FRAMES, Recording
from neeco.ingest.recording.template import open_questions, write_template
from neeco.settings import faults_in

RECORDING = "recording.yaml"


def write_draft(source: Path, report: Callable[[str], None]) -> list[str]:
    """Write a recording.yaml for what lies at `source`, into the folder or next to the file, and return lines on it;
    `report` is called with what is left out. Raises NeecoError where there is one, and where there are no images."""
    path = (source.parent if source.is_file() or format_of(source) is not None else source) / RECORDING
    if path.exists():
        raise NeecoError(f"{path}: already exists; edit it, or move it away first")
    draft = write_template(source, lambda problem: report(f"left out: {problem}"), video_stands_still)
    write_text(path, draft)
    questions = [f"{n}. {path}:{line}: {words}" for n, (line, words) in enumerate(open_questions(draft), 1)]
    lines = ["still open:", *questions] if questions else []
    return [*lines, f"wrote {path}: look through it, then: neeco ingest {path} --output CAPTURE"]


def folder_to_convert(sources: Sequence[Path]) -> Path | None:
    """Return the folder that holds cameras in another format; None where the sources are files of recordings. Raises
    NeecoError for what is neither."""
    for source in sources:
        if source.suffix.lower() in VIDEOS:
            raise NeecoError(f"{source}: is a video; give it as --video {shlex.quote(str(source))}")
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


def recording_from_flags(
    video: Path,
    instrument: Path | None = None,
    laparoscope: Path | None = None,
    joints: Sequence[tuple[str, Path, Path | None]] = (),
    intrinsics: Sequence[float] | None = None,
    calibration: Path | None = None,
    sync: Path | None = None,
    frames: int | None = None,
    fps: float | None = None,
    shaft_diameter: float | None = None,
) -> Recording:
    """Return a recording from the command line's options: columns are recognised from the headers. `video`: a file or a
    folder of images; joints: (name, log, calibration or None); shaft_diameter: mm, of an instrument that was not
    tracked. Raises NeecoError naming the option."""
    if intrinsics is not None and calibration is not None:
        raise NeecoError("--calibration: given together with --intrinsics; give one of them")
    given = [("--video", video), ("--instrument", instrument), ("--laparoscope", laparoscope), ("--sync", sync)]
    given += [(f"--joint {joint}", file) for joint, *files in joints for file in files]
    for option, file in given:
        if file is not None and not Path(file).exists():
            raise NeecoError(f"{option}: {file}: no such file; correct the path")
    for joint, log, table in joints:
        timed = [recognise_time(read_table(Path(file)).header).time for file in (log, table) if file is not None]
        if timed[0] is None and timed[-1] is not None:
            raise NeecoError(f"--joint {joint}: {log} has no times, {table} has; give the log first, its table second")
    names = [joint for joint, *_ in joints]
    twice = next((joint for joint in names if names.count(joint) > 1), None)
    if twice is not None:
        raise NeecoError(f"--joint {twice}: given twice; give each joint once")
    if joints and instrument is None and shaft_diameter is None:
        raise NeecoError(
            f"--joint {names[0]}: needs --instrument, the log of the instrument it belongs to, or --shaft-diameter"
        )
    if shaft_diameter is not None and instrument is not None:
        raise NeecoError("--shaft-diameter: finds an instrument that was not tracked, and --instrument says it was")
    if shaft_diameter is not None and not 0 < shaft_diameter < MAX_SHAFT_MM:
        raise NeecoError(f"--shaft-diameter: {shaft_diameter:g} is no shaft's; give it in mm, as in 5")
    check_frame_count(frames)
    if fps is not None and not 0 < fps < 1e6:  # NaN compares false
        raise NeecoError(f"--fps: {fps:g} is no frame rate; give frames per second")
    if intrinsics is not None and len(intrinsics) != 4:
        raise NeecoError(f"--intrinsics: takes FX FY CX CY, not {len(intrinsics)} numbers")
    video = Path(video)
    is_folder = video.is_dir() and format_of(video) is None
    if is_folder and fps is None:
        images = any(entry.suffix.lower() in IMAGES for entry in video.iterdir())
        problem = "when were the images taken? Give --fps" if images else "holds no images; give a folder of frames"
        raise NeecoError(f"--video: {video}: {problem}")
    tool = {
        "name": "instrument",
        "poses": _plain(instrument),
        "joints": {joint: {"file": _plain(log), "calibration": _plain(table)} for joint, log, table in joints},
        "from_video": shaft_diameter and {"shaft_diameter_mm": shaft_diameter},
    }
    document = {
        "images" if is_folder else "video": {"folder" if is_folder else "file": _plain(video), "fps": fps},
        "intrinsics": _plain(calibration or intrinsics),
        "instruments": [] if instrument is None and shaft_diameter is None else [tool],
        "laparoscope": _plain(laparoscope),
        "sync": _plain(sync),
        "frames": frames,
    }
    where = Path("command line")
    with faults_in(where):
        return replace(recording_of(document, where), path=video)


def check_frame_count(frames: int | None) -> None:
    """Raise NeecoError when the option asks for too few frames."""
    if frames is not None and frames < MIN_FRAMES:
        raise NeecoError(f"--frames: {frames} is too few; give {MIN_FRAMES} or more")


def _plain(value: Any) -> Any:
    """Return an option as recording.yaml has it."""
    return str(value) if isinstance(value, Path) else [*value] if isinstance(value, list | tuple) else value
