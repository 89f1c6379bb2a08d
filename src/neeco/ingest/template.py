"""`neeco ingest --init`: a commented recording.yaml, by looking at the files in a folder."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from neeco.errors import NeecoError
from neeco.files import read_json
from neeco.ingest.columns import MATRIX, RecognisedColumns, recognise_pose, recognise_value, split_unit
from neeco.ingest.formats import log_formats, read_table
from neeco.ingest.lens import read_lens
from neeco.ingest.video import IMAGES

VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".mpg", ".mpeg", ".m4v", ".webm", ".ts", ".wmv", ".mxf")
MAX_FILES = 400  # looked at; a folder with more is not one recording
MIN_IMAGES = 10  # in a folder of frames
MAX_CALIBRATION_ROWS = 200
_SCOPE = re.compile(r"camera|scope|laparo|endo|(^|[_\-])(cam|ecm|lens)([_\-]|$)", re.IGNORECASE)


@dataclass
class _FolderFiles:
    """What the files of a folder seem to be, as paths relative to it."""

    videos: list[str] = field(default_factory=list)
    images: list[str] = field(default_factory=list)
    lenses: list[str] = field(default_factory=list)
    syncs: list[str] = field(default_factory=list)
    poses: list[tuple[str, RecognisedColumns]] = field(default_factory=list)
    joints: list[tuple[str, RecognisedColumns, str]] = field(default_factory=list)
    calibrations: list[tuple[str, tuple[str, ...]]] = field(default_factory=list)
    others: list[str] = field(default_factory=list)


def write_template(folder: Path) -> str:
    """The text of a recording.yaml for the files in a folder and its subfolders; `read_recording` accepts it.

    Raises NeecoError when the folder holds no video and no images.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise NeecoError(f"{folder}: {'is a file' if folder.exists() else 'not there'}; give the recording's folder")
    found = _find_files(folder)
    if not found.videos and not found.images:
        raise NeecoError(f"{folder}: holds no video and no folder of images; put the recording's video there")
    frames = [f"video: {_scalar(file)}" for file in found.videos]
    frames += [f"images: {{folder: {_scalar(folder)}, fps: 25}}" for folder in found.images]
    if not found.videos:
        frames[0] += "   # the rate is a guess: correct it"
    poses = [(file, columns) for file, columns in found.poses if not _SCOPE.search(Path(file).stem)]
    scopes = [(file, columns) for file, columns in found.poses if _SCOPE.search(Path(file).stem)]
    environment = Environment(
        loader=PackageLoader("neeco.ingest", ""),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["scalar"] = _scalar
    return environment.get_template("recording.yaml.j2").render(
        frames=frames,
        lenses=found.lenses,
        instruments=_instruments(found, poses),
        scope=_pose_lines(*scopes[0]) if scopes else None,
        other_scopes=[file for file, _ in scopes[1:]],
        sync=next(iter(found.syncs), None),
        others=found.others[:20],
    )


def _find_files(folder: Path) -> _FolderFiles:
    found = _FolderFiles()
    files = sorted(file for pattern in ("*", "*/*") for file in folder.glob(pattern) if file.is_file())
    files = [file for file in files if not any(part.startswith(".") for part in file.relative_to(folder).parts)]
    for parent, count in Counter(file.parent for file in files if file.suffix.lower() in IMAGES).items():
        if count >= MIN_IMAGES:
            found.images.append(parent.relative_to(folder).as_posix())
    for file in [file for file in files if file.suffix.lower() not in IMAGES][:MAX_FILES]:
        name, suffix = file.relative_to(folder).as_posix(), file.suffix.lower()
        if suffix in VIDEOS:
            found.videos.append(name)
        elif suffix in log_formats():
            _classify_table(found, name, file)
        elif suffix == ".json" and _is_sync(file):
            found.syncs.append(name)
        elif suffix in (".yaml", ".yml", ".json") and _is_lens(file):
            found.lenses.append(name)
    return found


def _classify_table(found: _FolderFiles, name: str, file: Path) -> None:
    try:
        table = read_table(file)
    except NeecoError as error:
        found.others.append(" ".join(str(error).replace(str(file), name).split()))
        return
    pose = recognise_pose(table.header)
    value, when = recognise_value(table.header)
    columns = [column for column in table.header if column]
    angles = [column for column in columns if split_unit(column, "angle")[1] or column.lower().startswith("angle")]
    if pose.rotation or "rotation" in pose.unclear:
        found.poses.append((name, pose))
    elif value and when.time:
        found.joints.append((name, when, value))
    elif len(columns) == 2 and angles and not when.time and len(table.rows) <= MAX_CALIBRATION_ROWS:
        found.calibrations.append((name, table.header))
    elif not (when.time and len(columns) <= 2):
        found.others.append(f"{name}: columns {', '.join(columns[:10])[:100]}")


def _is_sync(file: Path) -> bool:
    with suppress(NeecoError):
        document = read_json(file)
        return isinstance(document, dict) and any(key == "clocks" or key.endswith("_minus_video_s") for key in document)
    return False


def _is_lens(file: Path) -> bool:
    with suppress(NeecoError):
        return read_lens(file) is not None
    return False


def _instruments(found: _FolderFiles, poses: Sequence[tuple[str, RecognisedColumns]]) -> list[dict[str, Any]]:
    """Name, lines of the pose log and (name, lines) of the joints of every instrument."""
    if not poses and not found.joints:
        return []
    names = _unique([Path(file).stem for file, _ in poses]) or ["instrument"]
    # a joint's log belongs to the instrument that its name begins with, else to the first
    owners = {
        file: next((name for name in names if Path(file).stem.startswith(name)), names[0]) for file, *_ in found.joints
    }
    instruments = []
    for index, name in enumerate(names):
        logs = [log for log in found.joints if owners[log[0]] == name]
        joints = _unique([_joint_name(file) for file, *_ in logs])
        instruments.append(
            {
                "name": name,
                "poses": _pose_lines(*poses[index]) if poses else None,
                "joints": [(joint, _joint_lines(found, *log)) for joint, log in zip(joints, logs, strict=True)],
            }
        )
    return instruments


def _pose_lines(file: str, columns: RecognisedColumns) -> list[str]:
    lines = [f"file: {_scalar(file)}", "clock: em"]
    given = [
        ("time", columns.time),
        ("position", columns.position),
        (columns.form or "", columns.rotation),
        ("state", (columns.state,) if columns.state else None),
    ]
    known = [f"  {key}: {_list(names)}" for key, names in given if names]
    lines += ["columns:", *known] if known else []
    lines += ["  good: [OK]"] if columns.state else []
    lines += [f"# columns: {what} is not clear: {why}" for what, why in columns.unclear.items()]
    of_length = (columns.rotation or ())[3:4] if columns.form == MATRIX else columns.position
    return lines + _unit_lines(columns, {"length": of_length})


def _joint_lines(found: _FolderFiles, file: str, when: RecognisedColumns, value: str) -> list[str]:
    lines = [f"file: {_scalar(file)}", "columns:", f"  time: {_list(when.time or ())}", f"  value: {_scalar(value)}"]
    stem = Path(file).stem.lower()
    tables = [name for name, header in found.calibrations if value in header]
    tables += [name for name, _ in found.calibrations if Path(name).stem.lower().startswith(stem)]
    if tables:
        lines.append(f"calibration: {_scalar(tables[0])}")
    else:
        lines.append("# calibration: table.csv   # of counts and angle_rad, where the values are counts")
    lines += _unit_lines(when, {} if tables else {"angle": (value,)})
    return [*lines, "# limits: [0, 1.5]   # rad, of the joint"]


def _unit_lines(columns: RecognisedColumns, wanted: dict[str, tuple[str, ...] | None]) -> list[str]:
    """A line asking for the units that neither the columns' names nor their format say."""
    lines = []
    if columns.counts_frames:
        lines.append("rate_hz: 40   # time counts frames, and this rate is a guess: correct it")
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


def _joint_name(file: str) -> str:
    stem = re.sub(r"[^A-Za-z0-9_]+", "_", Path(file).stem)
    return stem if stem.endswith("angle") else f"{stem}_angle"


def _unique(names: list[str]) -> list[str]:
    return [name if names.index(name) == i else f"{name}_{names[:i].count(name) + 1}" for i, name in enumerate(names)]


def _scalar(text: str) -> str:
    """A name as YAML: in quotes where it needs them."""
    words = ("yes", "no", "on", "off", "true", "false", "null")
    plain = re.fullmatch(r"[A-Za-z][A-Za-z0-9_./\-]*", text) and text.lower() not in words
    return text if plain else json.dumps(text)


def _list(names: Sequence[str]) -> str:
    return _scalar(names[0]) if len(names) == 1 else f"[{', '.join(_scalar(name) for name in names)}]"
