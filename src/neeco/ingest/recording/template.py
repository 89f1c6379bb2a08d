"""`neeco ingest --init`: a drafted recording.yaml, by looking at the files in a folder.

A line counts only where something was measured or read that says so; else it is a comment with the reason.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from neeco.base.errors import NeecoError, visible
from neeco.base.files import read_json, require_content
from neeco.base.placeholders import placeholder
from neeco.ingest.calibration.lens import read_lens
from neeco.ingest.calibration.stereo import read_stereo
from neeco.ingest.readers import DELIMITED, Kind, Stream, VideoSource, format_of, read_table
from neeco.ingest.readers import names as named
from neeco.ingest.readers.logs import with_named_frame
from neeco.ingest.readers.rosbag import DVRK_WRIST
from neeco.ingest.readers.video import IMAGES, VIDEOS
from neeco.ingest.recording.model import STILL, ImageFolder, VideoFile

StandsStill = Callable[[VideoSource], bool]  # does a scope stand still, by its images?
_EPISODES = re.compile(r"episodes (\d+) to (\d+)")
_NO_NAME = re.compile(r"[^A-Za-z0-9_]+")
_SCOPE = re.compile(r"camera|scope|laparo|endo|(^|[_\-])(cam|ecm|lens)([_\-]|$)", re.IGNORECASE)


@dataclass(frozen=True, kw_only=True)
class DraftLimits:
    """Limits on what is looked at, and the rates that are guessed."""

    files: int = 400  # a folder with more is not one recording
    min_images: int = 10  # in a folder of frames
    calibration_rows: int = 200  # of a joint's table
    image_rate: float = 25.0  # a second
    tracker_rate: float = 40.0


LIMITS, IN_BASE = DraftLimits(), named.NamedFrame(named.BASE)

# Lines of a draft that leave something open: what marks the first of them, and what to write there
_QUESTIONS = (
    (r"^  - name: ", "what is the instrument called in labels? Correct its name"),
    (r"^ +# kinematics: \{dvrk_tool", "which tool is it? Remove the # and give its file, or its links"),
    (r"^ +# camera_from_base: ", "how does the robot's base stand to the camera? Remove the #"),
    (r"a guess: correct it", "at which rate were these taken? Correct the number"),
    (r"# units: .*nothing says them", "in which units? Correct them and remove the #"),
    (r"^# intrinsics: .*no calibration was found", "which lens? Remove the # and give a calibration's file or numbers"),
    (r"^ +# clock: .*its own", "is it the clock of the poses? Remove the #; else give its offset in sync, below"),
    (r"is not clear: ", "which columns hold it? Name them"),
    (r"^ +# frame: ", "what are its poses stated in? Correct it, remove the #"),
)


def open_questions(draft: str) -> list[tuple[int, str]]:
    """Return the lines of a draft, from 1, that only the one who recorded can answer, and what to write there."""
    asked = [[words for marks, words in _QUESTIONS if re.search(marks, line)] for line in draft.splitlines()]
    return [(number, words[0]) for number, words in enumerate(asked, 1) if words]


@dataclass(frozen=True)
class _Frames:
    """Images of one camera. line: `video: …` or `images: …` of the draft; name: of their file there; file: the video,
    the folder of images or the file of which `stream` is one."""

    line: str
    name: str
    file: Path
    stream: str | None = None


@dataclass(frozen=True)
class _Log:
    """A log: its file, relative to the folder; says: the holder of remarks on the body (`hints`), and of keys that
    nothing in the file answers (`asks`), its stream or the meaning of a table's frame; in_base: are its poses stated in
    a robot's base?"""

    file: str
    says: Stream | named.NamedFrame = IN_BASE
    in_base: bool = False

    @property
    def stream(self) -> Stream | None:
        return self.says if isinstance(self.says, Stream) else None

    @property
    def stem(self) -> str:
        """A name for the log's body."""
        if self.stream is None:
            return named.without_frame(Path(self.file).stem)
        return named.without_frame(self.stream.body or re.sub(r"[^A-Za-z0-9]+", "_", self.stream.name).strip("_"))

    def lines(self) -> list[str]:
        stream = [] if self.stream is None else [f"stream: {_scalar(self.stream.name)}"]
        return [f"file: {_scalar(self.file)}", *stream]


@dataclass(kw_only=True)
class _FolderFiles:
    """The files of a folder by their likely kind, as paths relative to it. joints: log, time, column and joint's name;
    problems: what cannot be read, and whether it may be images; others: all that is not used; episodes: of a data set
    that holds several, "0-9"."""

    frames: list[_Frames] = field(default_factory=list)
    lenses: list[str] = field(default_factory=list)
    syncs: list[str] = field(default_factory=list)
    poses: list[tuple[_Log, named.RecognisedColumns]] = field(default_factory=list)
    joints: list[tuple[_Log, named.RecognisedColumns, str, str | None]] = field(default_factory=list)
    calibrations: list[tuple[str, tuple[str, ...]]] = field(default_factory=list)
    others: list[str] = field(default_factory=list)
    problems: list[tuple[str, bool]] = field(default_factory=list)
    episodes: str | None = None

    def leave_out(self, what: str, why: NeecoError | str = "", path: Path | None = None, images: bool = False) -> None:
        """List something as unused. why: its fault, if any, in a message that may begin with the file; images: whether
        it may contain images."""
        name = what.rpartition(": ")[2]
        reason = str(why).removeprefix(f"{path}: ").removeprefix(f"{name}: ")
        reason = reason if path is None else reason.replace(str(path), path.name)
        line = visible(f"{what}: {reason}" if reason else what)
        self.others.append(line)
        self.problems += [(line, images)] if reason else []


def write_template(
    source: Path, report: Callable[[str], None] = lambda problem: None, stands_still: StandsStill | None = None
) -> str:
    """Return a recording.yaml for the files in a folder and its subfolders, or for one file or folder of several
    streams, to stand next to it. report: called with each file that cannot be read, which is left out; stands_still:
    looks at images for `camera: still`. Raises NeecoError when there are no images."""
    source = Path(source)
    if not source.exists():
        raise NeecoError(f"{source}: no such file or folder; correct the path")
    if (reader := format_of(source)) is not None:
        reader.require_package(source)
    require_content(source)
    if source.is_file() and (reader is None or not reader.streams(source)):
        raise NeecoError(f"{source}: is a file of no format that holds images and logs; give the recording's folder")
    files = _find_files(source)
    if not files.frames:
        if problems := [line.removeprefix(f"{source.name}: ") for line, images in files.problems if images]:
            more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
            raise NeecoError(f"{source}: holds no images that can be read: {problems[0]}{more}")
        raise NeecoError(f"{source}: holds no video and no folder of images; put the recording's video there")
    for line, _ in files.problems:
        report(line)
    frames = files.frames
    scopes = [(log, columns) for log, columns in files.poses if _SCOPE.search(log.stem)]
    on_scope, right, still = _scope_lines(frames, [*map(_scalar, files.lenses)], stands_still)
    lines = [
        "# A recording, for `neeco ingest recording.yaml --output CAPTURE`, drafted by looking at the files. Check",
        "# every line. Paths are relative to this file; docs/recording.md explains all keys.",
        frames[0].line + ("   # the rate is a guess: correct it" if frames[0].line.startswith("images") else ""),
        *(f"# {item.line}   # another one found" for item in frames[1:] if item.line != right),
    ]
    if files.episodes:
        lines.append(f'# episodes: ["{files.episodes}"]   # of the data set, or [0, 3, 7]: they become one capture')
    lines += [*on_scope, *_instrument_lines(files, in_camera=still or not scopes)]
    if scopes:
        hints = scopes[0][0].says.hints
        of_scope = _pose_lines(*scopes[0])
        lines += ["laparoscope:", *(f"  # {hint}" for hint in hints), *(f"  {line}" for line in of_scope)]
        lines += [f"# laparoscope: {{{', '.join(log.lines())}}}   # another one found" for log, _ in scopes[1:]]
    shared = any(log.stream is not None and log.file == frames[0].name for log, _ in files.poses)
    offsets = f"# sync: {{{'video' if shared else 'em'}: 0.0}}   # s, t_log = t_video + offset, by clock"
    lines.append(f"sync: {_scalar(files.syncs[0])}" if files.syncs else offsets)
    lines += ["# There, too, and not used:", *(f"#   {line}" for line in files.others)] if files.others else []
    return "\n".join(lines) + "\n"


def _find_files(source: Path) -> _FolderFiles:
    files = _FolderFiles()
    if _add_streams(files, source, source.name):
        return files
    entries = [entry for pattern in ("*", "*/*") for entry in source.glob(pattern)]
    entries = [entry for entry in entries if not any(part[:1] == "." for part in entry.relative_to(source).parts)]
    for inner in sorted(entry for entry in entries if entry.is_dir()):
        _add_streams(files, inner, inner.relative_to(source).as_posix())
    used = {item.file for item in files.frames} | {source / log.file for log, _ in files.poses}
    entries = sorted(file for file in entries if (file.is_file() or placeholder(file)) and not used & {*file.parents})
    for file in [file for file in entries if file.suffix.lower() not in IMAGES][: LIMITS.files]:
        name, suffix = file.relative_to(source).as_posix(), file.suffix.lower()
        if problem := placeholder(file):
            files.leave_out(name, problem, images=True)
        elif suffix in VIDEOS:
            files.frames.append(_Frames(f"video: {_scalar(name)}", name, file))
        elif format_of(file) is not None and not _add_streams(files, file, name):
            try:
                table = read_table(file)
                meaning = with_named_frame(table, named.recognise_pose(table.header).position or ()).meaning
            except NeecoError as error:
                files.leave_out(name, error, file)
                continue
            log, pose, (value, when) = (
                _Log(name),
                named.recognise_pose(table.header),
                named.recognise_value(table.header),
            )
            columns = [column for column in table.header if column]
            angles = [one for one in columns if named.split_unit(one, "angle")[1] or one.lower().startswith("angle")]
            if pose.rotation or "rotation" in pose.unclear:
                files.poses.append((replace(log, says=meaning or log.says), pose))
                joints = named.joint_columns(columns, named.pose_bodies(columns))
                files.joints += [(log, when, column, _joint_of(column)) for column in joints]
            elif value and when.time:
                files.joints.append((log, when, value, None))
            elif when.time and len(angles) > 1:
                files.joints += [(log, when, column, _joint_of(column)) for column in angles]
            elif len(columns) == 2 and angles and not when.time and len(table.rows) <= LIMITS.calibration_rows:
                files.calibrations.append((name, table.header))
            elif not (when.time and len(columns) <= 2):
                files.leave_out(f"{name}: columns {', '.join(columns[:10])[:100]}")
        elif format_of(file) is None and suffix in (".yaml", ".yml", ".xml", ".json"):
            with suppress(NeecoError):
                document = read_json(file) if suffix == ".json" else None
                offsets = document.get("clocks") if isinstance(document, dict) else None
                if isinstance(offsets, dict) and offsets and {*map(type, offsets.values())} <= {int, float}:
                    files.syncs.append(name)
                else:
                    files.lenses += [name] if read_lens(file) is not None else []
    for parent, count in Counter(file.parent for file in entries if file.suffix.lower() in IMAGES).items():
        name = parent.relative_to(source).as_posix()
        line = f"images: {{folder: {_scalar(name)}, fps: {LIMITS.image_rate:g}}}"
        files.frames += [_Frames(line, name, parent)] if count >= LIMITS.min_images else []
    return files


def _add_streams(files: _FolderFiles, path: Path, name: str) -> bool:
    """Add the streams of what holds several, and all of them as a list to choose from."""
    reader = format_of(path)
    if reader is None:
        return False
    try:
        reader.require_package(path)
        streams = reader.streams(path)
    except NeecoError as error:
        files.leave_out(name, error, path, images=path.suffix.lower() not in DELIMITED)
        return True
    for stream in streams:
        log, title = _Log(name, stream), f"{name}: {stream.name}"
        used = stream.offered and stream.count > 0 and stream.problem is None
        if used and stream.kind == Kind.IMAGES:
            files.frames.append(_Frames(f"video: {{{', '.join(log.lines())}}}", name, path, stream.name))
        elif used and stream.kind in (Kind.POSES, Kind.READINGS):
            try:
                table = read_table(path, stream.name)
            except NeecoError as error:
                files.leave_out(title, error, path)
                continue
            when = named.recognise_time(table.header)
            joints: Sequence[tuple[str | None, str]] = stream.joints or ()
            if stream.kind == Kind.POSES:
                header = table.header if stream.columns is None else (*(when.time or ()), *stream.columns)
                in_base = table.frame in (None, named.BASE) and not stream.asks and stream.clock != named.TRACKER_CLOCK
                files.poses.append((replace(log, in_base=in_base), named.recognise_pose(header)))
            elif stream.joints is None:  # every angle is one
                joints = [(None, column) for column in table.header if named.split_unit(column, "angle")[1]]
            files.joints += [(log, when, column, joint) for joint, column in joints]
        elif stream.problem is not None:
            files.leave_out(title, stream.problem, path, stream.kind == Kind.IMAGES)
        else:
            rate = "" if stream.rate_hz is None else f" at {stream.rate_hz:.3g} a second"
            files.leave_out(f"{title}: {stream.type}, {stream.count}{rate}")
            if (several := _EPISODES.fullmatch(stream.name)) and reader.of_episode(stream.name, 0) is not None:
                files.episodes = f"{several[1]}-{several[2]}"
    return bool(streams)


def _scope_lines(
    frames: Sequence[_Frames], calibrations: Sequence[str], stands_still: StandsStill | None
) -> tuple[list[str], str | None, bool]:
    """Return the lines on the scope whose images are the first of `frames`, the line that names the second camera's
    images, and whether the scope is stated to stand still. calibrations: files of lenses in the folder of the frames'
    files, as YAML; stands_still: judges images, None: they are not looked at."""
    first = frames[0]
    right, stereo, problem = _second_camera(first, frames[1:], calibrations)
    still, camera = False, "# camera: still   # or moving"
    if stands_still is not None and (first.stream is not None or stereo):
        with suppress(NeecoError):
            video = VideoFile(first.file, stream=first.stream)
            source = ImageFolder(first.file, LIMITS.image_rate) if first.line.startswith("images") else video
            still = stands_still(source.open())
            camera += "; in frames spread over the recording, the background does not keep its place"
    if still:
        camera = f"camera: {STILL}   # in frames spread over the recording, the background keeps its place"
    lines = [camera]
    if stereo:
        lines.append(stereo if still else f"# {stereo}; for a scope that stands still")
    elif right:
        why = problem or "its second camera, begun together: measures the depth of the tissue"
        lines.append(f"# stereo: {{{right}, calibration: stereo.yaml}}   # {why}")
    lens, reader = None, None if first.stream is None else format_of(first.file)
    with suppress(NeecoError):
        lens = reader and reader.lens(first.file, first.stream)
    if lens:
        lines.append(f"# intrinsics: left out, {first.name} states the lens")
    elif not calibrations and not (stereo and still):
        lines.append("# intrinsics: [290, 290, 160, 128]   # fl_x, fl_y, cx, cy px; no calibration was found")
    lines += [f"{'# ' if index else ''}intrinsics: {name}" for index, name in enumerate(calibrations)]
    return lines, right, still


def _second_camera(
    left: _Frames, others: Sequence[_Frames], calibrations: Sequence[str]
) -> tuple[str | None, str, str]:
    """Return the line of the right camera's images, the line `stereo: …` where a calibration states both cameras, else
    the reason why it does not."""
    namesake = left.stream or left.name
    for one, other in (("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT")):
        namesake = namesake.replace(one, other)
    reader = None if left.stream is None else format_of(left.file)
    tries: list[tuple[str, Callable[[], Any]]] = []  # source of the calibration, reader
    if reader is None or left.stream is None:
        line = next((item.line for item in others if item.name == namesake), None)
        folder = left.file.parents[left.name.count("/")]
        tries = [(name, partial(read_stereo, folder / name)) for name in calibrations if line]
    else:
        streams = [item.name for item in reader.streams(left.file) if item.count and not item.problem]
        is_there = namesake != left.stream and namesake in streams
        line = left.line.replace(left.stream, namesake) if is_there else None
        tries = [("", partial(reader.stereo, left.file, left.stream, namesake))] if is_there else []
    problem = ""
    for calibration, read in tries:
        try:
            lenses = read()
        except NeecoError as error:
            problem = "" if calibration else " ".join(str(error).removeprefix(f"{left.file}: ").split())
            continue
        if lenses is not None:
            keys = f"{line}, calibration: {calibration}" if calibration else line
            apart = float(np.linalg.norm(lenses[2][:3, 3]))
            states = f"{calibration or left.name} states both lenses, {apart:.2f} mm apart"
            return line, f"stereo: {{{keys}}}   # {states}", ""
    return line, "", problem


def _instrument_lines(files: _FolderFiles, *, in_camera: bool) -> Iterator[str]:
    """Yield the lines of all instruments. in_camera: do the poses of a base have to be related to a still camera?"""
    poses = [(log, columns) for log, columns in files.poses if not _SCOPE.search(log.stem)]
    if not poses and not files.joints:
        return
    names = _unique([log.stem for log, _ in poses]) or ["instrument"]
    # a joint's log belongs to the instrument of its body or that its name begins with, else to the first
    owners = {
        log: min(names, key=lambda name: (log.stem != name, not log.stem.startswith(name.split("_")[0])))
        for log, *_ in files.joints
    }
    yield "instruments:"
    for index, name in enumerate(names):
        yield f"  - name: {_scalar(name)}"
        if poses:
            log, columns = poses[index]
            yield from (f"    # {hint}" for hint in log.says.hints)
            if in_camera and log.in_base:
                yield "    # camera_from_base: unknown   # or its registration, or a transform: docs/still-scopes.md"
            yield "    poses:"
            yield from (f"      {line}" for line in _pose_lines(log, columns))
        logs = [log for log in files.joints if owners[log[0]] == name]
        if all(joint in DVRK_WRIST for *_, joint in logs):
            logs.sort(key=lambda log: DVRK_WRIST.index(str(log[3])))
        yield from ["    joints:"] if logs else []
        for joint, (log, when, value, stated) in zip(_unique([_joint_name(*log) for log in logs]), logs, strict=True):
            lines, stem = log.lines(), log.stem.lower()
            if log.stream is None and stated:  # a table of several joints is a robot's, as its poses are
                lines.append("clock: em   # that of the poses: correct it where another computer logged it")
            elif log.stream is None and not files.syncs:
                lines.append("# clock: em   # left out, it is its own, whose offset nothing states")
            tables = [name for name, header in files.calibrations if value in header]
            tables += [name for name, _ in files.calibrations if Path(name).stem.lower().startswith(stem)]
            lines += [
                f"columns: {{value: {_scalar(value)}}}",
                *(f"calibration: {_scalar(name)}" for name in tables[:1]),
            ]
            lines += _unit_lines(when, {} if tables else {"angle": (value,)})
            yield from [f"      {_scalar(joint)}:", *(f"        {line}" for line in lines)]


def _pose_lines(log: _Log, columns: named.RecognisedColumns) -> list[str]:
    of_length = (columns.rotation or ())[3:4] if columns.form == named.MATRIX else columns.position
    clock = named.TRACKER_CLOCK if log.stream is None else log.stream.clock
    lines = [*log.lines(), *([f"clock: {clock}"] if clock else []), *(f"# {ask}" for ask in log.says.asks)]
    if log.stream is not None and log.stream.columns is not None:  # others are recognised again when read
        stated = (("position", columns.position), (columns.form, columns.rotation))
        lines += ["columns:", *(f"  {key}: [{', '.join(map(_scalar, names))}]" for key, names in stated if names)]
    lines += [f"# columns: {meaning} is not clear: {why}" for meaning, why in columns.unclear.items()]
    return lines + _unit_lines(columns, {"length": of_length})


def _unit_lines(columns: named.RecognisedColumns, wanted: dict[str, tuple[str, ...] | None]) -> list[str]:
    """A line asking for the units that neither the columns' names nor their format say."""
    lines, time = [], columns.time or ()
    if columns.counts_frames or not time:
        why = "time counts frames" if columns.counts_frames else "nothing says when its rows were taken"
        lines.append(f"rate_hz: {LIMITS.tracker_rate:g}   # {why}, and this rate is a guess: correct it")
    elif len(time) == 1 and not columns.time_unit:
        wanted = {"time": time} | wanted
    units = {"time": "s", "length": "mm", "angle": "rad"}
    unsaid = [
        f"{kind}: {units[kind]}"
        for kind, names in wanted.items()
        if names and not named.split_unit(names[0], kind)[1] and not (kind == "length" and columns.length_unit)
    ]
    if unsaid:
        lines.append(f"# units: {{{', '.join(unsaid)}}}   # nothing says them: correct, and remove the #")
    return lines


def _joint_name(log: _Log, when: named.RecognisedColumns, value: str, stated: str | None) -> str:
    if stated or log.stream is not None:
        return stated or _joint_of(value)
    stem = _NO_NAME.sub("_", log.stem)
    return stem if stem.endswith("angle") else f"{stem}_angle"


def _joint_of(column: str) -> str:
    return _NO_NAME.sub("_", named.split_unit(column, "angle")[0]).strip("_")


def _unique(names: list[str]) -> list[str]:
    return [name if names.index(name) == i else f"{name}_{names[:i].count(name) + 1}" for i, name in enumerate(names)]


def _scalar(text: str) -> str:
    """A name as YAML: in quotes where it needs them."""
    words = ("yes", "no", "on", "off", "true", "false", "null")
    plain = re.fullmatch(r"[A-Za-z][A-Za-z0-9_./\-]*", text) and text.lower() not in words
    return text if plain else json.dumps(text)
