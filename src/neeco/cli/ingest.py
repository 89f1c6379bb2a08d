"""`neeco ingest`: from a video and logs to a capture."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

if TYPE_CHECKING:
    from neeco.ingest.recording.model import Recording
    from neeco.ingest.result import IngestResult
    from neeco.report.ingest_page import Ingested

RECORDING = "recording.yaml"
CHOICES = "recording_choices.png"


@dataclass(frozen=True)
class Ingest:
    """Make a capture from a recording: video and tracker logs; says how good it is in CAPTURE/ingest.html."""

    source: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """recording.yaml, or several of one instrument for one capture; or a folder in another format to convert
    (nerfstudio, Blender, COLMAP, EndoNeRF); with --init, a recording's folder or file."""
    output: Path | None = None
    """Folder of the capture to write; must not exist."""
    video: Path | None = None
    """Video file, or a folder of images."""
    fps: float | None = None
    """Frames per second, where the video does not say or is wrong."""
    instrument: Path | None = None
    """CSV log of the instrument's tracker."""
    laparoscope: Path | None = None
    """CSV log of the laparoscope's tracker; it puts the cameras into the tracker's frame, in mm."""
    shaft_diameter: float | None = None
    """Shaft's diameter, mm, of a rigid instrument that nothing tracked: it is found in the video (instead of
    --instrument)."""
    joint: Annotated[tuple[tuple[str, Path, Path], ...], tyro.conf.UseAppendAction] = ()
    """Joint sensor: NAME LOG.csv CALIBRATION.csv (counts and angles). May be given several times."""
    intrinsics: tuple[float, float, float, float] | None = None
    """FX FY CX CY in pixels; estimated with distortion when left out."""
    calibration: Path | None = None
    """Intrinsics from a file instead: OpenCV/ROS YAML or nerfstudio JSON."""
    sync: Path | None = None
    """JSON with clock offsets (t_log = t_video + offset); found from the images when left out."""
    frames: int | None = None
    """How many frames to keep, spread over states and views."""
    init: bool = False
    """Look at the files in SOURCE (a folder; default: here), or into a file of several streams, and write a commented
    recording.yaml into it, or beside it."""
    formats: bool = False
    """List the formats that recordings are read from."""
    rrd: Path | None = None
    """Write images, poses, joints, what moves and clocks into this file, too, for the rerun viewer."""
    json: bool = False
    """Print the numbers as JSON."""
    strict: bool = False
    """End with exit status 1 where the verdict is DOUBTFUL."""


def run(args: Ingest) -> int:
    """Ingest, convert, or write a template."""
    from neeco.errors import NeecoError
    from neeco.ingest.readers import format_of

    if args.formats:
        _refuse_beside(args, "--formats", keep=("formats",))
        return _list_formats()
    if args.init:
        _refuse_beside(args, "--init", keep=())
        if len(args.source) > 1:
            raise NeecoError("--init: looks at one folder or file; give one")
        return _init(args.source[0] if args.source else Path())
    output = args.output and Path(os.path.normpath(args.output))  # a/../b is b, whatever a is
    if output is None:
        raise NeecoError("--output: give the folder of the capture to write")
    for source in args.source:
        if (known := format_of(source)) is not None and source.exists():
            raise NeecoError(
                f"{source}: is in a recording's format ({known.format}) but says not what is what in it; write that "
                f"down first: neeco ingest --init {source}"
            )
        if source.is_dir():
            if (source / RECORDING).is_file():
                raise NeecoError(f"{source}: holds a recording; give the file: {source / RECORDING}")
            if len(args.source) > 1:
                raise NeecoError(f"{source}: is a folder; of several recordings give each recording.yaml")
            _refuse_beside(args, f"{source}: a folder in another format", keep=("output",))
            return _convert(source, output)
    made = _ingest(recordings_of(args), output, args.rrd, args.json)
    return 1 if args.strict and made.verdict == "doubtful" else 0


def _refuse_beside(args: Ingest, what: str, keep: tuple[str, ...]) -> None:
    """Raise NeecoError when an option was given that would be ignored beside `what`."""
    from neeco.errors import NeecoError

    for option in fields(Ingest):
        if option.name not in ("source", "init", *keep) and getattr(args, option.name) != option.default:
            raise NeecoError(f"{what}, and --{option.name} would be ignored beside it; leave one of them out")


def _list_formats() -> int:
    from rich.markup import escape
    from rich.table import Table

    from neeco.ingest.readers import recording_formats

    table = Table("format", "read of it", "needs")
    for known in recording_formats():
        table.add_row(known.format, known.holds, escape(f"neeco[{known.extra}]") if known.extra else "")
    Console().print(table)
    return 0


def _init(folder: Path) -> int:
    from neeco.errors import NeecoError
    from neeco.files import write_text
    from neeco.ingest.recording.template import holds_streams, write_template
    from neeco.report.choice_picture import write_choice_picture

    path = (folder.parent if holds_streams(folder) else folder) / RECORDING
    if path.exists():
        raise NeecoError(f"{path}: already exists; edit it, or move it away first")
    write_text(path, write_template(folder, lambda problem: print(f"left out: {problem}")))
    picture = path.with_name(CHOICES)
    try:
        if holds_streams(folder) and write_choice_picture(folder, picture):
            print(f"wrote {picture}: what its poses would be under each choice that the file leaves open")
    except NeecoError as error:  # recording.yaml, which names the choices, is written all the same
        print(f"no picture of the choices that the file leaves open: {error}")
    print(f"wrote {path}: look through it, then: neeco ingest {path} --output CAPTURE")
    return 0


def _convert(folder: Path, output: Path) -> int:
    from neeco.ingest.convert import convert_folder

    for sentence in convert_folder(folder, output):
        print(f"note: {sentence}")
    print(f"capture: {output}  (next: neeco check {output})")
    return 0


def recordings_of(args: Ingest) -> list[Recording]:
    """The recordings that the words name. Raises NeecoError naming the option."""
    from neeco.errors import NeecoError
    from neeco.ingest.recording.file import check_frames, read_recording, recording_from_flags

    if args.source:
        _refuse_beside(
            args, f"{args.source[0]}: says what was recorded", keep=("output", "frames", "rrd", "json", "strict")
        )
        check_frames(args.frames)
        recordings = [read_recording(source) for source in args.source]
        return [item if args.frames is None else replace(item, frames=args.frames) for item in recordings]
    if args.video is None:
        raise NeecoError("--video: give the video (or images' folder), or a recording.yaml (`neeco ingest --init`)")
    if args.intrinsics is not None and args.calibration is not None:
        raise NeecoError("--calibration: given beside --intrinsics; give one of them")
    recording = recording_from_flags(
        args.video,
        args.instrument,
        args.laparoscope,
        args.joint,
        args.calibration or args.intrinsics,
        args.sync,
        args.frames,
        args.fps,
        args.shaft_diameter,
    )
    return [recording]


def _ingest(recordings: list[Recording], output: Path, rrd: Path | None, as_json: bool) -> Ingested:
    """Make the capture, print what was found and how good it is."""
    from neeco.capture.check import errors_only
    from neeco.cli._output import require_ending
    from neeco.files import finite
    from neeco.report.ingest_page import ingest_with_page

    if rrd is not None:
        require_ending("--rrd", rrd, ".rrd")
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        tasks: dict[str, TaskID] = {}

        def report(what: str, done: int, total: int) -> None:
            if what not in tasks:
                for task in tasks.values():
                    bar.update(task, total=1, completed=1)
                tasks[what] = bar.add_task(what, total=total or None)
            bar.update(tasks[what], completed=done, total=total or None)

        try:
            made = ingest_with_page(recordings, output, report, rrd)
        except KeyboardInterrupt:
            raise KeyboardInterrupt("nothing was written") from None
    results, assessments = made.results, made.assessments
    if as_json:
        numbers = finite({name: result.as_json() | assessments[name].as_json() for name, result in results.items()})
        print(json.dumps(numbers.get("", {"tissues": numbers}), indent=2, allow_nan=False))
        return made
    for tissue, result in results.items():
        if tissue:
            print(f"tissue {tissue}:")
        print_result(result)
    for problem in errors_only(list(made.problems)):
        print(f"wrong: {problem}")
    print(f"capture: {output}  ({len(made.problems)} remarks by `neeco check`)")
    print(f"page: {', '.join(map(str, made.pages))}")
    if rrd is not None:
        print(f"to scrub through: rerun {rrd}")
    for tissue, assessment in assessments.items():
        first, *others = assessment.lines()
        print(f"how good it is: {f'{tissue}: ' if tissue else ''}{first}", *others, sep="\n")
    return made


def print_result(result: IngestResult) -> None:
    """What an ingest found, in lines."""
    numbers = result.as_json()
    print(f"{numbers['kept']} of {numbers['video_frames']} video frames kept, {numbers['points']} points")
    for name, (first, last) in result.episodes.items():
        count = int(((result.selected >= first) & (result.selected <= last)).sum())
        print(f"episode {name}: {count} of {last + 1 - first} frames kept")
    if result.still:
        print(f"still scope: the world is its camera's frame; the tissue's depth is {result.tissue}")
    if not result.registered:
        print("not registered: instrument poses stay in their tracker's frame")
    elif result.registration is not None:
        fit = numbers["registration"]
        print(f"registered to {fit['position_rms_mm']:.2f} mm, {fit['rotation_rms_deg']:.2f} deg rms")
    for name, clock in result.clocks.items():
        print(f"clock {name}: {clock} ({clock.source})")
    for sentence in result.search:
        print(f"cameras: {sentence}")
    for note in result.notes:
        print(f"note: {note}")
