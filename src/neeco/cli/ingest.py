"""`neeco ingest`: from a video and logs to a capture."""

from __future__ import annotations

import os
import shlex
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from neeco.cli._output import JsonTarget, whole_lines
from neeco.errors import NeecoError, visible

if TYPE_CHECKING:
    from neeco.ingest.recording.model import Recording


@dataclass(frozen=True, kw_only=True)
class Ingest:
    """Make a capture from a recording: video and tracker logs; CAPTURE/ingest.html reports how good it is."""

    source: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """recording.yaml, or several of one instrument for one capture; or a folder in another format to convert
    (nerfstudio, Blender, COLMAP, EndoNeRF); with --init, a recording's folder or file."""
    output: Path | None = None
    """Folder of the capture to write; must not exist. Default: none; needed, but with --init and --formats."""
    video: Path | None = None
    """Video file, or a folder of images."""
    fps: float | None = None
    """Frames per second, where the video does not say or is wrong. Default: the video's."""
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
    """FX FY CX CY in pixels. Default: estimated, with distortion."""
    calibration: Path | None = None
    """Intrinsics from a file instead: OpenCV/ROS YAML or nerfstudio JSON."""
    sync: Path | None = None
    """JSON with clock offsets (t_log = t_video + offset). Default: found from the images."""
    frames: int | None = None
    """How many frames to keep, spread over states and views. Default: at most 400."""
    init: bool = False
    """Look at the files in SOURCE (a folder; default: here), or into a file of several streams, and write a commented
    recording.yaml into it, or next to it."""
    formats: bool = False
    """List the formats that recordings are read from."""
    json: JsonTarget = None
    strict: bool = False
    """End with exit status 1 where the verdict is DOUBTFUL."""


def run(args: Ingest) -> int:
    """Ingest, convert, or write a template."""
    from neeco.cli._output import ready_for_json, write_numbers
    from neeco.cli._progress import Bars
    from neeco.ingest.convert import convert_folder
    from neeco.ingest.sources import folder_to_convert, write_draft
    from neeco.report.ingest_page import ingest_and_report

    if args.formats:
        _refuse_others(args, "--formats", keep=("formats",))
        return _list_formats()
    if args.init:
        _refuse_others(args, "--init", keep=())
        if len(args.source) > 1:
            raise NeecoError("--init: looks at one folder or file; give one")
        print(*write_draft(args.source[0] if args.source else Path(), print), sep="\n")
        return 0
    if not args.source and args.video is None:
        raise NeecoError("ingest: no source; give recording.yaml (`neeco ingest --init` drafts it) or --video FILE")
    folder = folder_to_convert(args.source)
    if args.output is None:
        raise NeecoError("--output: give the folder of the capture to write")
    output = Path(os.path.normpath(args.output))  # a/../b is b, whatever a is
    if folder is not None:
        _refuse_others(args, f"{folder}: a folder in another format", keep=("output",))
        for sentence in convert_folder(folder, output):
            print(f"note: {visible(sentence)}")
        print(f"capture: {output}  (next: neeco check {shlex.quote(str(output))})")
        return 0
    recordings = recordings_of(args)
    with ready_for_json(args.json):
        with Bars() as bars:
            try:
                done = ingest_and_report(recordings, output, bars.stage)
            except KeyboardInterrupt:
                raise KeyboardInterrupt("nothing was written") from None
        if not write_numbers(args.json, done.as_json()):
            print(*map(visible, done.lines()), sep="\n")
            if done.verdict != "doubtful":  # whose last line says not to train
                print(f"next: neeco train {shlex.quote(str(output))} --output RUN")
    return 1 if args.strict and done.verdict == "doubtful" else 0


def _refuse_others(args: Ingest, what: str, keep: tuple[str, ...]) -> None:
    """Raise NeecoError when an option was given that `what` would ignore."""
    for option in fields(Ingest):
        if option.name not in ("source", "init", *keep) and getattr(args, option.name) != option.default:
            raise NeecoError(
                f"{what}, and --{option.name.replace('_', '-')} would be ignored with it; leave one of them out"
            )


def _list_formats() -> int:
    from rich.table import Table

    from neeco.ingest.readers import recording_formats

    table = Table("format", "read of it", "extra")
    for known in recording_formats():
        table.add_row(known.format, known.holds, known.extra or "")
    whole_lines().print(table)
    return 0


def recordings_of(args: Ingest) -> list[Recording]:
    """Return the recordings that the arguments name. Raises NeecoError naming the option."""
    from neeco.ingest.sources import read_recordings, recording_from_flags

    if args.source:
        keep = ("output", "frames", "json", "strict")
        _refuse_others(args, f"{args.source[0]}: says what was recorded", keep)
        return read_recordings(args.source, args.frames)
    assert args.video is not None
    recording = recording_from_flags(
        args.video, args.instrument, args.laparoscope, args.joint, args.intrinsics, args.calibration,
        sync=args.sync, frames=args.frames, fps=args.fps, shaft_diameter=args.shaft_diameter,
    )  # fmt: skip
    return [recording]
