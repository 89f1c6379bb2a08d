"""Sessions of the dVRK's data_collection: videos with the time of every frame, topics in a bag or as CSV.

A session is a folder with `index.json`, videos, next to each a JSON file with its frames' times, and a bag; its
`extract` writes images named by their times, and a CSV file of each topic. Both count Unix time.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from neeco.base.errors import NeecoError
from neeco.base.files import read_json, visible_entries
from neeco.base.placeholders import read_head
from neeco.capture.documents import printable
from neeco.capture.images import open_image
from neeco.ingest.readers import Kind, RecordingFormat, Stream, Table, VideoSource, compare_counts, numbers, rate_of
from neeco.ingest.readers.delimited import DelimitedText, unique_names
from neeco.ingest.readers.frame_names import camera_order, meaning_of
from neeco.ingest.readers.rosbag import DVRK_HINT, POSE_HEADER, RosBag, joint_column, wrist_joints
from neeco.ingest.readers.video import ChosenFrames, ImageFiles, open_video

INDEX, TYPES = "index.json", ("dc_index_v1", "dc::index@", "dvrk_data:index@")
TOPIC = "# Topic: /"  # begins a CSV file of `extract`
EXTRACTED = "extracted"
UNLIKE = 0.02  # share by which a video's frames and their times may differ in number
_STAMPED = re.compile(r"(?P<name>.+)_(?P<time>\d{9,11}\.\d{3,9})\.(?:jpg|jpeg|png)", re.IGNORECASE)
_POSE_PARTS = (("pose.position.", "pose.orientation."), ("transform.translation.", "transform.rotation."))
_POSES = re.compile(r"/(PSM\d)/measured_cp")  # an instrument's; the endoscope's arm reports in another base
_JOINTS = re.compile(r"/(PSM\d)/(?:jaw/)?measured_js")
HALVES = {"LR": ("left", "right"), "RL": ("right", "left")}  # what the halves of a video show, from the left on


@dataclass(frozen=True)
class _Film:
    """Images of a camera: a video, or half of one, or files; times [N] s, Unix."""

    times: np.ndarray
    files: tuple[Path, ...]
    half: int | None = None  # 0: the left one, 1: the right one


class DvrkSession(RecordingFormat):
    """A stream is a topic, or a video by its name, with `.left` and `.right` where it shows both. Times count from the
    first image on."""

    format = "dVRK data_collection"
    holds = "videos with times, poses and joints by topic: folders of a session, or of its extract"

    def claims(self, path: Path) -> bool:
        if not path.is_dir():
            return False
        index = read_head(path / INDEX, 1 << 16)
        return any(kind.encode() in index for kind in TYPES) or any(_topic_of(file) for file in _tables_in(path)[:1])

    def streams(self, path: Path) -> tuple[Stream, ...]:
        films, absent = _films(path)
        streams = [Stream(name, Kind.IMAGES, "video", 0, problem=why) for name, why in absent.items()]
        if not films and not absent and visible_entries(path, "*.mp4"):
            raise NeecoError(f"{path}: nothing says the times of its videos' frames; give the session's own folder")
        # the left camera's are the frames; others are listed
        for number, name in enumerate(sorted(films, key=camera_order)):
            times = films[name].times
            streams.append(Stream(name, Kind.IMAGES, "video", len(times), rate_of(times), offered=number == 0))
        bag = _bag(path)
        if bag is not None:
            RosBag().require_package(bag)
            try:
                return (*streams, *RosBag().streams(bag))
            except NeecoError as error:
                return (*streams, Stream(bag.name, Kind.OTHER, "bag", 0, problem=str(error)))
        for topic, file in _topics(path).items():
            try:
                kind, columns, table = _topic(file)
            except NeecoError as error:
                streams.append(Stream(topic, Kind.OTHER, "table", 0, problem=str(error)))
                continue
            match = (_POSES if kind == Kind.POSES else _JOINTS).fullmatch(topic)
            stream = Stream(topic, kind, kind, len(table.rows), offered=match is not None, body=match and match[1])
            if kind == Kind.POSES:
                frames = _frames(table)
                meaning = meaning_of(frames[0] if len(frames) == 1 else "", dvrk=True)
                streams.append(replace(stream, hints=(*meaning.hints, DVRK_HINT), asks=meaning.asks))
            elif kind == Kind.READINGS:
                streams.append(replace(stream, joints=wrist_joints(_joint_names(table, columns), "/jaw/" in topic)))
        return tuple(streams)

    def read(self, path: Path, stream: str | None = None) -> Table:
        start, bag = _start(path), _bag(path)
        if bag is not None:
            table = RosBag().read(bag, stream)
            rows = np.array(table.rows, np.float64)
            rows[:, 0] += RosBag().origin_s(bag) - start
            return replace(table, path=path, rows=rows)
        name = self.choose(path, stream, Kind.POSES, Kind.READINGS).name
        kind, columns, table = _topic(_topics(path)[name])
        stamps = ["header.stamp.sec", "header.stamp.nanosec"]
        times = numbers(table, ["timestamp"])[:, 0] * 1e-9  # of receipt
        if set(stamps) <= set(table.header):
            stated = numbers(table, stamps) @ [1.0, 1e-9]
            times = np.where(stated == 0, times, stated)
        frames = _frames(table) if kind == Kind.POSES else []
        if len(frames) > 1:
            listed = ", ".join(frames[:4])
            raise NeecoError(f"{table.path}: header.frame_id: several frames ({listed}); record one arm in one frame")
        joints = (joint_column(name) for name in _joint_names(table, columns))
        return Table(
            path, POSE_HEADER if kind == Kind.POSES else unique_names(["t_s", *joints]),
            np.column_stack([times - start, numbers(table, columns)]), table.lines, stream=name,
            stated_in=frames[0] if frames else None, meaning=meaning_of(frames[0], dvrk=True) if frames else None,
        )  # fmt: skip

    def open_images(self, path: Path, stream: str | None = None) -> VideoSource:
        films, absent = _films(path)
        if (why := absent.get(re.sub(r"\.(left|right)$", "", stream or ""))) is not None:
            raise NeecoError(why)
        name = self.choose(path, stream, Kind.IMAGES).name
        if name not in films:
            raise NeecoError(f"{path}: stream: {printable(name)} is in the bag; name the bag as the video's file")
        film, times = films[name], films[name].times - _start(path)
        keep = np.diff(np.maximum.accumulate(times), prepend=-np.inf) > 0
        early = f"{name}: {int((~keep).sum())} frames are no later than the one before; left out"
        notes: tuple[str, ...] = () if keep.all() else (early,)
        if film.files[0].suffix.lower() != ".mp4":
            files = tuple(file for file, good in zip(film.files, keep, strict=True) if good)
            return ImageFiles(path, open_image(files[0]).size, notes, times[keep], files=files)
        video = open_video(film.files[0])
        notes += compare_counts(film.files[0], len(video.times), len(times), "times", UNLIKE)
        usable = np.flatnonzero(keep[: len(video.times)])
        width, height = video.size
        return ChosenFrames(
            path, (width if film.half is None else width // 2, height), (*video.notes, *notes), times[usable],
            video=video, frames=tuple(usable.tolist()), half=film.half, pixel_aspect=video.pixel_aspect,
        )  # fmt: skip


def _films(path: Path) -> tuple[dict[str, _Film], dict[str, str]]:
    """Images by stream, of a session's videos, else of files named by their times; and why other videos cannot be
    used."""
    if not (path / INDEX).is_file():
        return _stamped_files(path), {}
    document = read_json(path / INDEX)
    videos = [video for entry in [document, *_list(document, "streams")] for video in _list(entry, "videos")]
    names = [video.get("file") for video in videos if isinstance(video, dict)]
    films: dict[str, _Film] = {}
    absent: dict[str, str] = {}
    for file in (path / str(name) for name in names if str(name).lower().endswith(".mp4") and _is_plain(name)):
        if not file.is_file():
            absent[file.stem] = f"{path / INDEX}: videos: {printable(file.name)} is not there; put it next to {INDEX}"
            continue
        try:
            times, layout = _frame_times(file.with_suffix(".json"))
        except NeecoError as error:
            absent[file.stem] = str(error)
            continue
        for half, side in enumerate(HALVES.get(layout, ())):
            films[f"{file.stem}.{side}"] = _Film(times, (file,), half)
        if layout not in HALVES:
            films[file.stem] = _Film(times, (file,))
    return films, absent


def _is_plain(name: Any) -> bool:
    return isinstance(name, str) and bool(name) and Path(name).name == name


def _frame_times(sidecar: Path) -> tuple[np.ndarray, str]:
    """Unix times [N] s of a video's frames, less the camera's latency, and how it shows two cameras."""
    document = read_json(sidecar)
    frames = _list(document, "frames")
    stamps = _list(document, "timestamps_ns") or [_entry(frame, "cpu_ts") for frame in frames]
    latency = _entry(document, "estimated_latency") or 0.0
    if len(stamps) < 2 or not all(type(stamp) is int and 0 < stamp < 1 << 62 for stamp in stamps):
        raise NeecoError(f"{sidecar}: frames: expected a cpu_ts (ns) of each frame of the video; record again")
    if not isinstance(latency, int | float) or not abs(latency) < 60:
        raise NeecoError(f"{sidecar}: estimated_latency: must be under 60 s (got {printable(latency)}); correct it")
    return np.array(stamps, np.int64) * 1e-9 - float(latency), str(_entry(document, "side_by_side"))


def _entry(document: Any, name: str) -> Any:
    return document.get(name) if isinstance(document, dict) else None


def _list(document: Any, name: str) -> list[Any]:
    value = _entry(document, name)
    return value if isinstance(value, list) else []


def _stamped_files(path: Path) -> dict[str, _Film]:
    times_and_files: dict[str, list[tuple[float, Path]]] = {}
    for file in visible_entries(path):
        if match := _STAMPED.fullmatch(file.name):
            times_and_files.setdefault(match["name"], []).append((float(match["time"]), file))
    films = {}
    for name, stamped in times_and_files.items():
        stamped.sort()
        films[name] = _Film(np.array([time for time, _ in stamped]), tuple(file for _, file in stamped))
    return films


def _start(path: Path) -> float:
    """Unix time s from which the times of all streams count: the first image's, else 0."""
    return min((float(film.times[0]) for film in _films(path)[0].values()), default=0.0)


def _bag(path: Path) -> Path | None:
    """The session's bag, where it is there."""
    try:
        document = read_json(path / INDEX) if (path / INDEX).is_file() else {}
    except NeecoError:
        return None
    name = _entry(document, "rosbags") or _entry(document, "rosbag")
    name = _entry(name, "name") or name
    return path / name if _is_plain(name) and (path / name).exists() else None


def _tables_in(path: Path) -> list[Path]:
    """CSV files of an extract: of this folder, else of the session's first."""
    return visible_entries(path, "*.csv") or visible_entries(path / EXTRACTED / "full_session", "*.csv")


def _topics(path: Path) -> dict[str, Path]:
    return {topic: file for file in _tables_in(path) if (topic := _topic_of(file))}


def _topic_of(file: Path) -> str | None:
    line = read_head(file, 400).decode("utf-8", "replace").partition("\n")[0]
    return "/" + line.removeprefix(TOPIC).strip() if line.startswith(TOPIC) else None


def _topic(file: Path) -> tuple[Kind, list[str], Table]:
    """Kind.POSES, Kind.READINGS or Kind.OTHER, the columns that hold them, and the table of a topic's CSV file."""
    table = DelimitedText().read(file)
    for position, rotation in _POSE_PARTS:
        wanted = [*(position + axis for axis in "xyz"), *(rotation + axis for axis in "xyzw")]
        if set(wanted) <= set(table.header):
            return Kind.POSES, wanted, table
    joints: list[str] = []
    while f"position.{len(joints)}" in table.header:
        joints.append(f"position.{len(joints)}")
    return Kind.READINGS if joints else Kind.OTHER, joints, table


def _joint_names(table: Table, columns: list[str]) -> list[str]:
    """Return the joints of columns position.0, position.1, ..., by the first row's name.0, name.1, ..."""
    first = dict(zip(table.header, table.rows[0], strict=True))
    return [first.get(f"name.{number}") or f"joint_{number + 1}" for number in range(len(columns))]


def _frames(table: Table) -> list[str]:
    """Names of the frames that a topic's poses are stated in."""
    if "header.frame_id" not in table.header:
        return []
    return sorted({cell.lstrip("/") for cell in table.rows[:, table.header.index("header.frame_id")]})
