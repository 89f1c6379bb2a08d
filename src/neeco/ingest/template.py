"""`neeco ingest --init`: a commented recording.yaml, by looking at the files in a folder."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from neeco.errors import NeecoError
from neeco.files import read_json
from neeco.ingest.columns import MATRIX, Recognised, recognise_pose, recognise_value
from neeco.ingest.lens import read_lens
from neeco.ingest.tables import read_table
from neeco.ingest.units import split_unit
from neeco.ingest.video import IMAGES

VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".mpg", ".mpeg", ".m4v", ".webm", ".ts", ".wmv", ".mxf")
TABLES = (".csv", ".tsv", ".txt")
MOST_FILES = 400  # looked at; a folder with more is not one recording
SMALL_TABLE = 200  # rows of a calibration table, at most
_SCOPE = re.compile(r"camera|scope|laparo|endo|(^|[_\-])(cam|ecm|lens)([_\-]|$)", re.IGNORECASE)

HEAD = """\
# A recording, for `neeco ingest recording.yaml --output CAPTURE`. Written by looking at the files of this folder:
# check every line. Paths are relative to this file; lines that begin with # say what else there is.
"""
VIDEO = """
# The frames: a video, or a folder of images with their rate or times (a CSV with a column t_s, and one of file names).
"""
LENS = """
# The lens: an OpenCV calibration (YAML), a nerfstudio transforms.json, or [fl_x, fl_y, cx, cy] in pixels with pixel
# centres at +0.5. Without it, focal length and distortion are estimated from the video, which is less exact.
"""
INSTRUMENTS = """
# Every tracked rigid body. poses: tracker_from_sensor. Columns may be named otherwise:
#   time: NAME or [SECONDS, NANOSECONDS]      position: [x, y, z]
#   quaternion_wxyz | quaternion_xyzw: [4 names] | rotation_vector: [3] | rotation_matrix: [9] | matrix: [12 or 16]
#   euler: [3 names] with euler_convention: ZYX (intrinsic) or zyx (extrinsic), as scipy names them
#   state: NAME, good: [OK]                   (only rows in a good state count)
# units: {time: s|ms|us|ns, length: mm|cm|m, angle: rad|deg} where the names do not end in _s, _mm, _deg ...
# rate_hz: 40                                 (where time counts frames)
"""
SCOPE = """
# The laparoscope's tracker, if it had one: gives the scale, and puts cameras and instruments into one frame.
"""
SYNC = """
# Clock offsets s, t_log = t_video + offset, by clock: trackers share `em`, each joint's is named after the joint.
# Or a JSON file {"clocks": {"em": 0.038}}. Clocks not given are estimated from motion where it allows.
"""
REST = """
# frames: 300            # keep this many, chosen by sharpness and by the states and views they add
# splits:                # in numbers of video frames, from 0
#   test_every: 8        # every 8th frame tests (0: none); or given: test: [12, 30-40]
#   unseen_fraction: 0.15   # kept apart, the extreme of a joint (0: none); or given: unseen: [255-299]
#   unseen_by: jaw_angle    # else the first joint that moves, and the instrument's direction
"""


@dataclass
class _Found:
    """What the files of a folder seem to be, as paths relative to it."""

    videos: list[str] = field(default_factory=list)
    images: list[str] = field(default_factory=list)
    lenses: list[str] = field(default_factory=list)
    syncs: list[str] = field(default_factory=list)
    poses: list[tuple[str, Recognised]] = field(default_factory=list)
    joints: list[tuple[str, Recognised, str]] = field(default_factory=list)
    calibrations: list[tuple[str, tuple[str, ...]]] = field(default_factory=list)
    others: list[str] = field(default_factory=list)


def write_template(folder: Path) -> str:
    """The text of a recording.yaml for the files in a folder and its subfolders; `read_recording` accepts it.

    Raises NeecoError when the folder holds no video and no images.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise NeecoError(f"{folder}: {'is a file' if folder.exists() else 'not there'}; give the recording's folder")
    found = _look(folder)
    if not found.videos and not found.images:
        raise NeecoError(f"{folder}: holds no video and no folder of images; put the recording's video there")
    poses = [(file, columns) for file, columns in found.poses if not _SCOPE.search(Path(file).stem)]
    scopes = [(file, columns) for file, columns in found.poses if _SCOPE.search(Path(file).stem)]
    parts = [HEAD, VIDEO, *_frames(found), LENS, *_lens(found), INSTRUMENTS, *_instruments(found, poses), SCOPE]
    if scopes:
        parts += [f"laparoscope:\n{_pose_lines(*scopes[0], '  ')}"]
        parts += [f"# laparoscope: {{file: {_scalar(file)}}}   # another one found\n" for file, _ in scopes[1:]]
    else:
        parts += ["# laparoscope: {file: camera.csv}\n"]
    parts += [SYNC, f"sync: {_scalar(found.syncs[0])}\n" if found.syncs else "# sync: {em: 0.0}\n", REST]
    if found.others:
        parts += ["\n# Not understood, and not used:\n", *(f"#   {line}\n" for line in found.others[:20])]
    return "".join(parts)


def _look(folder: Path) -> _Found:
    found = _Found()
    files = sorted(file for pattern in ("*", "*/*") for file in folder.glob(pattern) if file.is_file())
    files = [file for file in files if not any(part.startswith(".") for part in file.relative_to(folder).parts)]
    pictures = [file.parent for file in files if file.suffix.lower() in IMAGES]
    for parent in dict.fromkeys(pictures):
        if pictures.count(parent) >= 10:
            found.images.append(parent.relative_to(folder).as_posix())
    for file in [file for file in files if file.suffix.lower() not in IMAGES][:MOST_FILES]:
        name, suffix = file.relative_to(folder).as_posix(), file.suffix.lower()
        if suffix in VIDEOS:
            found.videos.append(name)
        elif suffix in TABLES:
            _classify_table(found, name, file)
        elif suffix == ".json" and _is_sync(file):
            found.syncs.append(name)
        elif suffix in (".yaml", ".yml", ".json") and _is_lens(file):
            found.lenses.append(name)
    return found


def _classify_table(found: _Found, name: str, file: Path) -> None:
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
    elif len(columns) == 2 and angles and not when.time and len(table.rows) <= SMALL_TABLE:
        found.calibrations.append((name, table.header))
    elif not (when.time and len(columns) <= 2):
        found.others.append(f"{name}: columns {', '.join(columns[:10])[:100]}")


def _is_sync(file: Path) -> bool:
    try:
        document = read_json(file)
    except NeecoError:
        return False
    return isinstance(document, dict) and any(key == "clocks" or key.endswith("_minus_video_s") for key in document)


def _is_lens(file: Path) -> bool:
    try:
        return read_lens(file) is not None
    except NeecoError:
        return False


def _frames(found: _Found) -> list[str]:
    images = [f"images: {{folder: {_scalar(folder)}, fps: 25}}" for folder in found.images]
    others = [f"video: {_scalar(file)}" for file in found.videos] + images
    guess = "" if found.videos else "   # the rate is a guess: correct it"
    return [f"{others[0]}{guess}\n", *(f"# {line}   # another one found\n" for line in others[1:])]


def _lens(found: _Found) -> list[str]:
    if not found.lenses:
        return ["# intrinsics: [290, 290, 160, 128]\n"]
    first, *others = (f"intrinsics: {_scalar(file)}\n" for file in found.lenses)
    return [first, *(f"# {line}" for line in others)]


def _instruments(found: _Found, poses: Sequence[tuple[str, Recognised]]) -> list[str]:
    if not poses and not found.joints:
        return ["# instruments:\n#   - name: instrument\n#     poses: {file: instrument.csv}\n"]
    lines = ["instruments:\n"]
    names = _unique([Path(file).stem for file, _ in poses]) or ["instrument"]
    owners = {file: _owner(file, names) for file, *_ in found.joints}
    for index, name in enumerate(names):
        lines.append(f"  - name: {_scalar(name)}\n")
        if poses:
            lines.append(f"    poses:\n{_pose_lines(*poses[index], '      ')}")
        mine = [joint for joint in found.joints if owners[joint[0]] == name]
        joints = _unique([_joint_name(file) for file, *_ in mine])
        lines.append(
            "    joints:\n" if mine else "    # joints: {jaw_angle: {file: jaw.csv, calibration: table.csv}}\n"
        )
        for joint, (file, when, value) in zip(joints, mine, strict=True):
            lines.append(_joint_lines(found, joint, file, when, value))
    return lines


def _pose_lines(file: str, columns: Recognised, indent: str) -> str:
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
    lines += _unit_lines(columns, {"length": of_length})
    return "".join(f"{indent}{line}\n" for line in lines)


def _joint_lines(found: _Found, joint: str, file: str, when: Recognised, value: str) -> str:
    lines = [f"file: {_scalar(file)}", "columns:", f"  time: {_list(when.time or ())}", f"  value: {_scalar(value)}"]
    stem = Path(file).stem.lower()
    tables = [name for name, header in found.calibrations if value in header]
    tables += [name for name, _ in found.calibrations if Path(name).stem.lower().startswith(stem)]
    if tables:
        lines.append(f"calibration: {_scalar(tables[0])}")
    else:
        lines.append("# calibration: table.csv   # of counts and angle_rad, where the values are counts")
    lines += _unit_lines(when, {} if tables else {"angle": (value,)})
    lines.append("# limits: [0, 1.5]   # rad, of the joint")
    return f"      {_scalar(joint)}:\n" + "".join(f"        {line}\n" for line in lines)


def _unit_lines(columns: Recognised, wanted: dict[str, tuple[str, ...] | None]) -> list[str]:
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


def _owner(file: str, names: Sequence[str]) -> str:
    """The instrument a joint's log belongs to: the one its name begins with, else the first."""
    return next((name for name in names if Path(file).stem.startswith(name)), names[0])


def _unique(names: list[str]) -> list[str]:
    return [name if names.index(name) == i else f"{name}_{names[:i].count(name) + 1}" for i, name in enumerate(names)]


def _scalar(text: str) -> str:
    words = ("yes", "no", "on", "off", "true", "false", "null")
    plain = re.fullmatch(r"[A-Za-z][A-Za-z0-9_./\-]*", text) and text.lower() not in words
    return text if plain else json.dumps(text)


def _list(names: Sequence[str]) -> str:
    return _scalar(names[0]) if len(names) == 1 else f"[{', '.join(_scalar(name) for name in names)}]"
