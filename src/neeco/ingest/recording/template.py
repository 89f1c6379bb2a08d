"""`neeco ingest --init`: a commented recording.yaml, by looking at the files in a folder."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from neeco.errors import NeecoError, visible
from neeco.files import read_json, require_content
from neeco.ingest.calibration.lens import read_lens
from neeco.ingest.readers import IMAGES as IMAGE_STREAMS
from neeco.ingest.readers import POSES, READINGS, Stream, Table, format_of, numbers, read_table
from neeco.ingest.readers.columns import (
    BASE,
    MATRIX,
    UNITS,
    PoseColumns,
    RecognisedColumns,
    joint_columns,
    pose_bodies,
    recognise_pose,
    recognise_time,
    recognise_value,
    split_unit,
)
from neeco.ingest.readers.frame_names import NamedFrame, without_frame
from neeco.ingest.readers.logs import with_named_frame
from neeco.ingest.readers.ndi import tool_columns, tool_names
from neeco.ingest.readers.rosbag import DVRK_WRIST
from neeco.ingest.readers.video import IMAGES, VIDEOS
from neeco.ingest.recording.drafted_scope import FoundFrames, StandsStill, draft_scope
from neeco.placeholders import placeholder

MAX_FILES = 400  # looked at; a folder with more is not one recording
MIN_IMAGES = 10  # in a folder of frames
MAX_CALIBRATION_ROWS = 200
MAX_OTHERS = 60  # listed as not used
SAME_VALUES = 0.02  # of their span, by which copies of a log may differ: rounded, or a few rows less
_EPISODES = re.compile(r"episodes (\d+) to (\d+)")
_SCOPE = re.compile(r"camera|scope|laparo|endo|(^|[_\-])(cam|ecm|lens)([_\-]|$)", re.IGNORECASE)


@dataclass(frozen=True)
class _Log:
    """A log: its file, relative to the folder; stream: which of it; tool: which of several in an NDI export; meaning:
    of the frame of a table's poses."""

    file: str
    stream: Stream | None = None
    tool: str | None = None
    meaning: NamedFrame | None = None
    in_base: bool = False  # are its poses stated in a base's frame?

    @property
    def hints(self) -> tuple[str, ...]:
        """Remarks on the body."""
        return self.stream.hints if self.stream else self.meaning.hints if self.meaning else ()

    @property
    def asks(self) -> tuple[str, ...]:
        """Keys that nothing in the file answers."""
        return self.stream.asks if self.stream else self.meaning.asks if self.meaning else ()

    @property
    def stem(self) -> str:
        """A name for the log's body."""
        return without_frame(self._name)

    @property
    def place(self) -> str:
        return ": ".join(filter(None, (self.file, self.stream.name if self.stream else None, self.tool)))

    @property
    def _name(self) -> str:
        if self.stream is not None:
            return self.stream.body or re.sub(r"[^A-Za-z0-9]+", "_", self.stream.name).strip("_")
        if self.tool is not None:
            name = re.sub(r"[^A-Za-z0-9]+", "_", self.tool).strip("_")
            return name if name[:1].isalpha() else f"tool_{name}"
        return Path(self.file).stem

    def lines(self) -> list[str]:
        given = [("file", self.file), ("stream", self.stream.name if self.stream else None), ("tool", self.tool)]
        return [f"{key}: {_scalar(value)}" for key, value in given if value is not None]


@dataclass(kw_only=True)
class _FolderFiles:
    """The files of a folder by their likely kind, as paths relative to it. others: those not used, in words."""

    folder: Path
    videos: list[_Log] = field(default_factory=list)
    images: list[str] = field(default_factory=list)
    lenses: list[str] = field(default_factory=list)
    syncs: list[str] = field(default_factory=list)
    poses: list[tuple[_Log, RecognisedColumns]] = field(default_factory=list)
    joints: list[tuple[_Log, RecognisedColumns, str, str | None]] = field(default_factory=list)
    travels: dict[str, float] = field(default_factory=dict)  # mm, between the extremes of poses, by stream
    values: dict[tuple[str, str], np.ndarray] = field(default_factory=dict)  # `_summary`, by a log's place and column
    calibrations: list[tuple[str, tuple[str, ...]]] = field(default_factory=list)
    others: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)  # of others, those that cannot be read
    image_problems: list[str] = field(default_factory=list)  # of these, those that may be of images
    episodes: str | None = None  # of a data set that holds several, "0-9"

    def leave_out(self, what: str, why: str = "", images: bool = False) -> None:
        """List something as not used. why: what is wrong with it, where anything is; images: may they be in it?"""
        line = visible(f"{what}: {why}" if why else what)
        self.others.append(line)
        self.problems += [line] if why else []
        self.image_problems += [line] if why and images else []


def write_template(
    source: Path, report: Callable[[str], None] = lambda problem: None, stands_still: StandsStill | None = None
) -> str:
    """The text of a recording.yaml for the files in a folder and its subfolders, or for one file or folder that holds
    several streams, to stand next to it; `read_recording` accepts it. report: called with each
    file that cannot be read, which is left out; stands_still: looks at images for `camera: still`.

    Raises NeecoError when there are no images.
    """
    source = Path(source)
    if not source.exists():
        raise NeecoError(f"{source}: no such file or folder; correct the path")
    if (known := format_of(source)) is not None:
        known.require_package(source)
    require_content(source)
    if source.is_file() and (known is None or not known.streams(source)):
        raise NeecoError(f"{source}: is a file of no format that holds images and logs; give the recording's folder")
    found = _find_files(source)
    _leave_out_copies(found)
    if not found.videos and not found.images:
        if found.image_problems:
            first, *rest = found.image_problems
            first, more = first.removeprefix(f"{source.name}: "), f" (and {len(rest)} more)" if rest else ""
            raise NeecoError(f"{source}: holds no images that can be read: {first}{more}")
        raise NeecoError(f"{source}: holds no video and no folder of images; put the recording's video there")
    for problem in found.problems:
        report(problem)
    frames = [
        FoundFrames(f"video: {_scalar(log.file)}", log.file, found.folder / log.file)
        if log.stream is None
        else FoundFrames(f"video: {{{', '.join(log.lines())}}}", log.file, found.folder / log.file, log.stream.name)
        for log in found.videos
    ]
    frames += [
        FoundFrames(f"images: {{folder: {_scalar(folder)}, fps: 25}}", folder, found.folder / folder)
        for folder in found.images
    ]
    poses = [(log, columns) for log, columns in found.poses if not _SCOPE.search(log.stem)]
    scopes = [(log, columns) for log, columns in found.poses if _SCOPE.search(log.stem)]
    own = scopes[0][0].stream if scopes else None
    scope = draft_scope(frames, found.lenses, None if own is None else found.travels.get(own.name), stands_still)
    guess = "" if found.videos else "   # the rate is a guess: correct it"
    environment = Environment(
        loader=PackageLoader("neeco.ingest.recording", ""),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["scalar"] = _scalar
    return environment.get_template("recording.yaml.j2").render(
        frames=[f"{frames[0].line}{guess}", *(item.line for item in frames[1:] if item.line != scope.right)],
        camera=scope,
        lenses=found.lenses,
        instruments=_instruments(found, poses, scope.still or not scopes),
        scope=_pose_lines(*scopes[0]) if scopes else None,
        scope_hints=scopes[0][0].hints if scopes else (),
        other_scopes=[", ".join(log.lines()) for log, _ in scopes[1:]],
        sync=next(iter(found.syncs), None),
        shares_clock=any(log.stream is not None and log.file == frames[0].name for log, _ in found.poses),
        others=found.others[:MAX_OTHERS],
        episodes=found.episodes,
    )


def holds_streams(source: Path) -> bool:
    """Return whether the path is a recording in itself (a bag, a data set's folder), not a folder of its files."""
    return source.is_file() or format_of(source) is not None


def _find_files(source: Path) -> _FolderFiles:
    found = _FolderFiles(folder=source if source.is_dir() and format_of(source) is None else source.parent)
    if _add_streams(found, source, source.name):
        return found
    folder = source
    for inner in sorted(entry for pattern in ("*", "*/*") for entry in folder.glob(pattern) if entry.is_dir()):
        _add_streams(found, inner, inner.relative_to(folder).as_posix())
    held = [folder / log.file for log in [*found.videos, *(log for log, _ in found.poses)]]
    files = sorted(
        file for pattern in ("*", "*/*") for file in folder.glob(pattern) if file.is_file() or placeholder(file)
    )
    files = [file for file in files if not any(part.startswith(".") for part in file.relative_to(folder).parts)]
    files = [file for file in files if not any(other in file.parents for other in held)]
    for parent, count in Counter(file.parent for file in files if file.suffix.lower() in IMAGES).items():
        if count >= MIN_IMAGES:
            found.images.append(parent.relative_to(folder).as_posix())
    for file in [file for file in files if file.suffix.lower() not in IMAGES][:MAX_FILES]:
        name, suffix = file.relative_to(folder).as_posix(), file.suffix.lower()
        if problem := placeholder(file):
            found.leave_out(name, problem, images=True)
        elif suffix in VIDEOS:
            found.videos.append(_Log(name))
        elif format_of(file) is not None:
            if not _add_streams(found, file, name):
                _classify_table(found, _Log(name), file)
        elif suffix == ".json" and _is_sync(file):
            found.syncs.append(name)
        elif suffix in (".yaml", ".yml", ".xml", ".json") and _is_lens(file):
            found.lenses.append(name)
    return found


def _add_streams(found: _FolderFiles, path: Path, name: str) -> bool:
    """Add the streams of what holds several, and all of them as a list to choose from."""
    known = format_of(path)
    if known is None:
        return False
    try:
        known.require_package(path)
        streams = known.streams(path)
    except NeecoError as error:
        found.leave_out(name, _without_place(str(error), path, name), images=True)
        return path.is_dir()
    for stream in streams:
        log = _Log(name, stream)
        used = stream.offered and stream.count > 0 and stream.problem is None
        if used and stream.kind == IMAGE_STREAMS:
            found.videos.append(log)
        elif used and stream.kind in (POSES, READINGS):
            try:
                _classify_stream(found, log, stream, path)
            except NeecoError as error:
                found.leave_out(f"{name}: {stream.name}", _without_place(str(error), path, stream.name))
        elif stream.problem is not None:
            why, images = _without_place(stream.problem, path, stream.name), stream.kind == IMAGE_STREAMS
            found.leave_out(f"{name}: {stream.name}", why, images)
        else:
            rate = "" if stream.rate_hz is None else f" at {stream.rate_hz:.3g} a second"
            found.leave_out(f"{name}: {stream.name}: {stream.type}, {stream.count}{rate}")
            if (several := _EPISODES.fullmatch(stream.name)) and known.of_episode(stream.name, 0) is not None:
                found.episodes = f"{several[1]}-{several[2]}"
    return bool(streams)


def _classify_stream(found: _FolderFiles, log: _Log, stream: Stream, path: Path) -> None:
    table = read_table(path, stream.name)
    when = recognise_time(table.header)
    if stream.kind == POSES:
        header = table.header if stream.columns is None else (*(when.time or ()), *stream.columns)
        pose = recognise_pose(header)
        unit = split_unit(pose.position[0], "length")[1] if pose.position else None
        places = _summary(found, log, table, pose.position or ())
        if unit and np.isfinite(places).all():
            found.travels[stream.name] = UNITS["length"][unit] * float(np.linalg.norm(places[2] - places[0]))
        found.poses.append((replace(log, in_base=table.frame in (None, BASE) and not stream.asks), pose))
        for joint, column in stream.joints or ():
            _summary(found, log, table, [column])
            found.joints.append((log, when, column, joint))
        return
    angles = [column for column in table.header if split_unit(column, "angle")[1]]  # every angle is a joint
    named = [(None, column) for column in angles] if stream.joints is None else stream.joints
    for _, column in named:
        _summary(found, log, table, [column])
    found.joints += [(log, when, column, joint) for joint, column in named]


def _leave_out_copies(found: _FolderFiles) -> None:
    """List as not used what holds the values of another file's stream, in any unit."""
    originals: list[tuple[_Log, str]] = []
    found.poses.sort(key=lambda item: item[0].stream is None)
    found.joints.sort(key=lambda item: item[0].stream is None)

    def copied(log: _Log, column: str) -> bool:
        values = found.values[log.place, column]
        for other, of in originals:
            if other.stream and other.file != log.file and _same(values, found.values[other.place, of]):
                found.leave_out(f"{log.place}: {column} as in {other.place}: another copy of it")
                return True
        originals.append((log, column))
        return False

    found.poses = [item for item in found.poses if not copied(item[0], (item[1].position or ("",))[0])]
    found.joints = [item for item in found.joints if not copied(item[0], item[2])]


def _same(one: np.ndarray, other: np.ndarray) -> bool:
    """Return whether summaries [3, C] agree but for their unit."""
    ratios = {a / b for kind in ("length", "angle") for a in UNITS[kind].values() for b in UNITS[kind].values()}
    close = SAME_VALUES * (np.ptp(other, axis=0).max() or np.abs(other).max())
    return one.shape == other.shape and any(np.allclose(ratio * one, other, rtol=0, atol=close) for ratio in ratios)


def _summary(found: _FolderFiles, log: _Log, table: Table, columns: Sequence[str]) -> np.ndarray:
    """Note and return the least, mean and greatest values [3, C] of columns over the rows that have all; NaN where none
    has."""
    values = numbers(table, columns)[0] if columns else np.empty((0, 1))
    values = values[np.isfinite(values).all(axis=1)]
    empty = np.full((3, values.shape[1]), np.nan)
    summary = np.stack([values.min(0), values.mean(0), values.max(0)]) if len(values) else empty
    found.values[log.place, next(iter(columns), "")] = summary
    return summary


def _without_place(message: str, path: Path, name: str) -> str:
    """A message without the file and the stream that it begins with."""
    return message.removeprefix(f"{path}: ").removeprefix(f"{name}: ").replace(str(path), path.name)


def _classify_table(found: _FolderFiles, log: _Log, file: Path) -> None:
    name = log.file
    try:
        table = read_table(file)
        meaning = with_named_frame(table, recognise_pose(table.header).position or ()).meaning
    except NeecoError as error:
        found.leave_out(name, _without_place(str(error), file, name))
        return
    if tools := tool_names(table):
        for tool in tools:
            try:
                own = tool_columns(table, PoseColumns(file, tool=tool))
            except NeecoError as error:
                found.leave_out(f"{name}: {tool}", _without_place(str(error), file, name))
                continue
            found.poses.append((_Log(name, tool=tool), recognise_pose(own.header)))
            _summary(found, _Log(name, tool=tool), own, found.poses[-1][1].position or ())
        return
    pose = recognise_pose(table.header)
    value, when = recognise_value(table.header)
    columns = [column for column in table.header if column]
    angles = [column for column in columns if split_unit(column, "angle")[1] or column.lower().startswith("angle")]
    if pose.rotation or "rotation" in pose.unclear:
        _summary(found, log, table, pose.position or ())
        found.poses.append((replace(log, meaning=meaning), pose))
        joints = joint_columns(columns, pose_bodies(columns))
        found.joints += [(log, when, column, _joint_of(column)) for column in joints]
    elif value and when.time:
        found.joints.append((log, when, value, None))
    elif when.time and len(angles) > 1:
        found.joints += [(log, when, column, _joint_of(column)) for column in angles]
    elif len(columns) == 2 and angles and not when.time and len(table.rows) <= MAX_CALIBRATION_ROWS:
        found.calibrations.append((name, table.header))
    elif not (when.time and len(columns) <= 2):
        found.leave_out(f"{name}: columns {', '.join(columns[:10])[:100]}")
    for column in [column for one, _, column, _ in found.joints if one == log]:
        _summary(found, log, table, [column])


def _is_sync(file: Path) -> bool:
    with suppress(NeecoError):
        held = document if isinstance(document := read_json(file), dict) else {}
        offsets = held.get("clocks") or {key: held[key] for key in held if key.endswith("_minus_video_s")}
        return isinstance(offsets, dict) and bool(offsets) and {*map(type, offsets.values())} <= {int, float}
    return False


def _is_lens(file: Path) -> bool:
    with suppress(NeecoError):
        return read_lens(file) is not None
    return False


def _instruments(
    found: _FolderFiles, poses: Sequence[tuple[_Log, RecognisedColumns]], to_camera: bool
) -> list[dict[str, Any]]:
    """Name, lines of the pose log and (name, lines) of the joints of every instrument. to_camera: do the poses of a
    base have to be related to a still camera?"""
    if not poses and not found.joints:
        return []
    names = _unique([log.stem for log, _ in poses]) or ["instrument"]
    # a joint's log belongs to the instrument of its body or that its name begins with, else to the first
    owners = {
        log: next((name for name in names if log.stem == name), None)
        or next((name for name in names if log.stem.startswith(name.split("_")[0])), names[0])
        for log, *_ in found.joints
    }
    instruments = []
    for index, name in enumerate(names):
        logs = [log for log in found.joints if owners[log[0]] == name]
        chain = [joint for *_, joint in logs]
        if all(joint in DVRK_WRIST for joint in chain):
            logs.sort(key=lambda log: DVRK_WRIST.index(str(log[3])))
        joints = _unique([joint or _joint_name(log, value) for log, _, value, joint in logs])
        instruments.append(
            {
                "name": name,
                "poses": _pose_lines(*poses[index]) if poses else None,
                "joints": [(joint, _joint_lines(found, *log)) for joint, log in zip(joints, logs, strict=True)],
                "hints": poses[index][0].hints if poses else (),
                "in_base": to_camera and bool(poses) and poses[index][0].in_base,
                "wristed": set(DVRK_WRIST) <= set(joints),
            }
        )
    return instruments


def _pose_lines(log: _Log, columns: RecognisedColumns) -> list[str]:
    of_length = (columns.rotation or ())[3:4] if columns.form == MATRIX else columns.position
    clock = "em" if log.stream is None else log.stream.clock
    lines = [*log.lines(), *([f"clock: {clock}"] if clock else [])]
    lines += [f"# {ask}" for ask in log.asks if not ask.startswith(" ")]
    known_again = log.tool is not None or (log.stream is not None and log.stream.columns is None)
    if known_again and columns.time and of_length and columns.rotation:
        return [*lines, *_unit_lines(columns, {"length": of_length})]  # recognised again when read
    given = [
        ("time", columns.time),
        ("position", columns.position),
        (columns.form or "", columns.rotation),
        ("state", (columns.state,) if columns.state else None),
    ]
    known = [f"  {key}: {_list(names)}" for key, names in given if names and not (log.stream and key == "time")]
    known += [f"  # {ask.strip()}" for ask in log.asks if ask.startswith(" ")]
    lines += ["columns:", *known] if known else []
    lines += ["  good: [OK]"] if columns.state else []
    lines += [f"# columns: {what} is not clear: {why}" for what, why in columns.unclear.items()]
    return lines + _unit_lines(columns, {"length": of_length})


def _joint_lines(found: _FolderFiles, log: _Log, when: RecognisedColumns, value: str, named: str | None) -> list[str]:
    time = [f"  time: {_list(when.time)}"] if when.time and log.stream is None else []
    # a table of several joints is a robot's, as its poses are
    clock = ["clock: em   # that of the poses: correct it where another computer logged it"]
    own = [] if found.syncs else ["# clock: em   # left out, it is its own, whose offset nothing states"]
    lines = [*log.lines(), *([] if log.stream else clock if named else own), "columns:", *time]
    lines.append(f"  value: {_scalar(value)}")
    stem = log.stem.lower()
    tables = [name for name, header in found.calibrations if value in header]
    tables += [name for name, _ in found.calibrations if Path(name).stem.lower().startswith(stem)]
    if tables:
        lines.append(f"calibration: {_scalar(tables[0])}")
    elif log.stream is None:
        lines.append("# calibration: table.csv   # of counts and angle_rad, where the values are counts")
    lines += _unit_lines(when, {} if tables else {"angle": (value,)})
    least, _, most = found.values[log.place, value][:, 0].tolist()
    if log.stream is None or not least < most:
        return [*lines, "# limits: [0, 1.5]   # rad, of the joint"]
    low, high = math.floor(10 * least) / 10, math.ceil(10 * most) / 10
    return [*lines, f"# limits: [{low:g}, {high:g}]   # how far it goes; its readings are {least:.2f} to {most:.2f}"]


def _unit_lines(columns: RecognisedColumns, wanted: dict[str, tuple[str, ...] | None]) -> list[str]:
    """A line asking for the units that neither the columns' names nor their format say."""
    lines = []
    if columns.counts_frames:
        lines.append("rate_hz: 40   # time counts frames, and this rate is a guess: correct it")
    elif columns.time is None:
        lines.append("rate_hz: 40   # nothing says when its rows were taken, and this rate is a guess: correct it")
    elif columns.time and len(columns.time) == 1 and not (columns.time_unit or split_unit(columns.time[0], "time")[1]):
        wanted = {"time": columns.time} | wanted
    implied = {"length": columns.length_unit}
    unsaid = [
        kind for kind, names in wanted.items() if names and not implied.get(kind) and not split_unit(names[0], kind)[1]
    ]
    if unsaid:
        choices = {"time": "s", "length": "mm", "angle": "rad"}
        values = ", ".join(f"{kind}: {choices[kind]}" for kind in unsaid)
        lines.append(f"# units: {{{values}}}   # nothing says them: correct, and remove the #")
    return lines


def _joint_name(log: _Log, value: str) -> str:
    if log.stream is not None:
        return _joint_of(value)
    stem = re.sub(r"[^A-Za-z0-9_]+", "_", log.stem)
    return stem if stem.endswith("angle") else f"{stem}_angle"


def _joint_of(column: str) -> str:
    return re.sub(r"[^A-Za-z0-9_]+", "_", split_unit(column, "angle")[0]).strip("_")


def _unique(names: list[str]) -> list[str]:
    return [name if names.index(name) == i else f"{name}_{names[:i].count(name) + 1}" for i, name in enumerate(names)]


def _scalar(text: str) -> str:
    """A name as YAML: in quotes where it needs them."""
    words = ("yes", "no", "on", "off", "true", "false", "null")
    plain = re.fullmatch(r"[A-Za-z][A-Za-z0-9_./\-]*", text) and text.lower() not in words
    return text if plain else json.dumps(text)


def _list(names: Sequence[str]) -> str:
    return _scalar(names[0]) if len(names) == 1 else f"[{', '.join(_scalar(name) for name in names)}]"
