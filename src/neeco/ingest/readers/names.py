"""The meaning of names: of a log's columns, with their units, and of frames, as common loggers write them.

A frame's name does not define its axes: the dVRK's ECM and the optical frame of ROS share an origin and differ by half
a turn. If a name fits several conventions, the user is asked. Names of cameras also determine their order.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from types import MappingProxyType

from neeco.base.errors import NeecoError
from neeco.capture.documents import printable
from neeco.geometry.conventions import CONVENTIONS, DVRK_ECM, OPENCV, ROS_BODY, AxisConvention

TRACKER_CLOCK = "em"  # default name of a tracker's clock
VIDEO_CLOCK = "video"  # clock of the images, and of logs in the same file
QUATERNION_WXYZ, QUATERNION_XYZW = "quaternion_wxyz", "quaternion_xyzw"
CAMERA, BASE = "camera", "base"  # frames of poses: the camera with OpenCV axes, or a base that registration places
ROTATION_VECTOR, EULER, ROTATION_MATRIX, MATRIX = "rotation_vector", "euler", "rotation_matrix", "matrix"
FORMS = (QUATERNION_WXYZ, QUATERNION_XYZW, ROTATION_VECTOR, EULER, ROTATION_MATRIX, MATRIX)  # matrices row by row

UNITS = {
    "length": {"mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 1e-3},
    "angle": {"rad": 1.0, "deg": 0.017453292519943295},
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
}  # kind -> unit -> its scale to mm, rad or s
_ALIASES = {
    "millimeter": "mm", "millimeters": "mm", "millimetre": "mm", "millimetres": "mm",
    "meter": "m", "meters": "m", "metre": "m", "metres": "m", "centimeters": "cm", "centimetres": "cm",
    "radian": "rad", "radians": "rad", "degree": "deg", "degrees": "deg", "°": "deg",
    "sec": "s", "secs": "s", "second": "s", "seconds": "s", "msec": "ms", "millis": "ms", "milliseconds": "ms",
    "usec": "us", "microseconds": "us", "nsec": "ns", "nsecs": "ns", "nanosec": "ns", "nanoseconds": "ns",
}  # fmt: skip
_UNIT_SUFFIX = re.compile(r"^(?P<base>.*?)(?:[\s_\-/]+|[\s_]*[\[(]\s*)(?P<unit>[a-zµ°]+)\s*[\])]?$")


@dataclass(frozen=True, kw_only=True)
class RecognisedColumns:
    """Columns recognised in a header. None: not found; unclear: ambiguous or incomplete quantities, with the reason."""

    time: tuple[str, ...] | None = None
    position: tuple[str, ...] | None = None
    rotation: tuple[str, ...] | None = None
    form: str | None = None
    state: str | None = None
    counts_frames: bool = False
    time_unit: str | None = None
    length_unit: str | None = None
    unclear: dict[str, str] = field(default_factory=dict)


def canonical_unit(text: str) -> str:
    """Return the canonical unit (`mm` for millimetres, `deg` for degrees); the lower-case text if it is unknown."""
    lower = text.strip().lower().replace("µ", "u")
    return _ALIASES.get(lower, lower)


def split_unit(name: str, kind: str) -> tuple[str, str | None]:
    """Return a column's name without its unit, and the unit of that kind ("length", "angle", "time") or None."""
    match = _UNIT_SUFFIX.match(name.strip().lower())
    unit = canonical_unit(match["unit"]) if match else None
    if match and unit in UNITS[kind]:
        return match["base"].strip("_ "), unit
    return name.strip().lower(), None


def scale_of(
    where: Path | str, names: tuple[str, ...], kind: str, stated: str | None, implied: str | None, hint: str
) -> float:
    """Return the factor that converts columns to mm, rad or s. where: prefix of messages.

    The unit is in their names, else `stated` by the recording, else `implied` by the file's format. hint: added to
    the message if there is none. Raises NeecoError if the unit is unknown or two sources disagree.
    """
    units = {unit for name in names if (unit := split_unit(name, kind)[1])}
    listed = ", ".join(names)
    if len(units) > 1:
        raise NeecoError(f"{where}: columns {listed}: names have different units; use one {kind} unit")
    unit = next(iter(units), None)
    if unit and stated and unit != stated:
        raise NeecoError(f"{where}: columns {listed}: names state {unit}, units.{kind} states {stated}; correct one")
    unit = unit or stated or implied
    if unit is None:
        raise NeecoError(
            f"{where}: columns {listed}: unknown {kind} unit{hint}; state it in the header (for example "
            f"{names[0]}_{next(iter(UNITS[kind]))}) or as units.{kind} in the recording ({', '.join(UNITS[kind])})"
        )
    return UNITS[kind][unit]


# column names without their unit, in order of preference; a name also matches behind a prefix ("tool_timestamp")
_TIMES: tuple[str, ...] = ("header_stamp", "timestamp", "time_stamp", "stamp", "time", "t", "elapsed")
_TIMES += ("secs", "sec", "seconds", "__time")
_NamedColumns = Mapping[str, Sequence[str]]  # columns by what they mean
_NOTHING: _NamedColumns = MappingProxyType({})
_Choices = list[tuple[bool, list[str]]]  # (may all stand behind one prefix, names)


def _choices(axes: str, prefixed: bool, stems: Sequence[str]) -> _Choices:
    return [(prefixed, [stem + axis for axis in axes]) for stem in stems]


_POSITIONS = _choices("xyz", True, ["position_", "translation_", "pos_", "trans_"])
_POSITIONS += _choices("xyz", False, ["t", "p", ""]) + _choices("xyz", True, ["t", "p", ""])
_QUATERNIONS = _choices("wxyz", True, ["orientation_", "rotation_", "quaternion_", "quat_", "q_", "q"])
_QUATERNIONS += [(prefixed, ["q0", "qx", "qy", "qz"]) for prefixed in (False, True)] + _choices("wxyz", False, [""])
_ROTATION_VECTORS = _choices(
    "xyz", True, ["rotvec_", "rotation_vector_", "rodrigues_", "rv", "rvec_", "rotvec", "rvec"]
)
_EULER_ANGLES = (["roll", "pitch", "yaw"], ["rx", "ry", "rz"], ["alpha", "beta", "gamma"])
_POSE_WORDS = ("pose", "cp", "tcp", "ee", "eef", "tip", "measured", "state")  # of columns, next to their body's name
_JOINT = re.compile(
    r"(^|[_.\-/\s])(jaws?|grip(per)?|fingers?|wrist|joint|opening|aperture|angle)([_.\-/\s\[(0-9]|$)", re.IGNORECASE
)
_ROS = re.compile(r"(^|[._/])(pose|transform|transforms\d*)[._/]")


def recognise_time(header: Sequence[str]) -> RecognisedColumns:
    """Return the column of times."""
    plain, whole = _by_plain_name(header, "time"), {_plain(name): name for name in header}
    # `header.stamp.sec` reads as a stamp in seconds next to its nanoseconds
    seconds = [name for name in whole if name.endswith(("stamp_sec", "stamp_secs"))]
    fraction = [name for name in whole if name.endswith(("stamp_nanosec", "stamp_nsec", "stamp_nsecs"))]
    if len(seconds) == len(fraction) == 1:
        return RecognisedColumns(time=(whole[seconds[0]], whole[fraction[0]]))
    for candidate in _TIMES:
        prefixed = [name for name in plain if len(candidate) > 1 and name.endswith("_" + candidate)]
        if candidate in plain or len(prefixed) == 1:
            column = plain[candidate if candidate in plain else prefixed[0]]
            break
    else:
        frames = [name for name in header if _plain(name) in ("frame", "frame_number", "frame_id", "frame_no")]
        return RecognisedColumns(time=(frames[0],), counts_frames=True) if frames else RecognisedColumns()
    # `rostopic echo -p` writes %time and field.header.stamp in ns
    ros = column == "%time" or re.fullmatch(r"\.?field\..*header\.stamp", column.lower()) is not None
    spelled_out = _plain(column) in ("secs", "sec", "seconds", "__time")
    return RecognisedColumns(time=(column,), time_unit="ns" if ros else "s" if spelled_out else None)


def recognise_pose(header: Sequence[str], named: _NamedColumns = _NOTHING) -> RecognisedColumns:
    """Return the columns of time, position and rotation in a pose log, each with one meaning. named: columns that the
    recording names, by meaning, which are not searched."""
    taken = {name for names in named.values() for name in names}
    free = [name for name in header if name not in taken]
    when = RecognisedColumns() if "time" in named else recognise_time(free)
    free = [name for name in free if name not in (when.time or ())]
    unclear: dict[str, str] = {}
    position, rotation, form = None, None, None
    matrix = None if "rotation" in named else _matrix(free)
    if matrix:
        rotation, form = matrix, ROTATION_MATRIX if len(matrix) == 9 else MATRIX
    elif "rotation" in named:
        pass
    elif rotation := _group(free, _QUATERNIONS, "length", "quaternion", unclear):
        form = QUATERNION_WXYZ
    elif rotation := _group(free, _ROTATION_VECTORS, "angle", "rotation", unclear):
        form = ROTATION_VECTOR
    else:
        for angles in _EULER_ANGLES:
            if _group(free, [(True, angles)], "angle", "rotation", {}):
                unclear["rotation"] = (
                    f"{', '.join(angles)} are ambiguous; name them under columns.euler with an euler_convention "
                    "(or under columns.rotation_vector)"
                )
        if {"q0", "q1", "q2", "q3"} <= {_plain(name) for name in free}:
            unclear["rotation"] = "the order of q0, q1, q2, q3 is ambiguous; use columns.quaternion_wxyz or _xyzw"
    if "position" not in named and not (matrix and len(matrix) > 9):
        position = _group(free, _POSITIONS, "length", "position", unclear)
    if shared := [name for name in position or () if name in (rotation or ())]:
        why = f"{', '.join(shared)} may belong to the position or the quaternion; name both under columns"
        unclear |= {"position": why, "rotation": why}
        position = rotation = form = None
    lower = [_plain(name) for name in header]
    ndi = {"state", "q0", "tx", "ty", "tz"} <= set(lower)
    ros = bool(position and _ROS.search(position[0].lower()))
    states = [name for name in free if (ndi and _plain(name) == "state") or name.endswith("TransformStatus")]  # of PLUS
    state = next(iter(states), None)
    unit = "mm" if ndi else "m" if ros else None
    return replace(
        when, position=position, rotation=rotation, form=form, state=state, length_unit=unit, unclear=unclear
    )


def pose_bodies(header: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return the columns of every body that has a position, by the body's name: the words that distinguish the column
    prefixes, or the words before `pose` and similar; "" for one body without a prefix."""
    plain = _by_plain_name(header, "length")
    _, prefixes = _first_choice(plain, _POSITIONS)
    if prefixes == [""]:
        return {"": tuple(header)}
    words = [set(prefix.split("_")) for prefix in prefixes]
    shared = set.intersection(*words) if len(words) > 1 else set(_POSE_WORDS)
    return {
        "_".join(word for word in prefix.split("_") if word not in shared) or prefix: tuple(
            name for key, name in plain.items() if key.startswith(prefix + "_")
        )
        for prefix in prefixes
    }


def _first_choice(plain: Mapping[str, str], choices: _Choices) -> tuple[list[str], list[str]]:
    """Return the first choice of names that is complete, and the prefixes under which it occurs: [""] without a
    prefix."""
    for prefixed, names in choices:
        if all(name in plain for name in names):
            return names, [""]
        firsts = [name.removesuffix("_" + names[0]) for name in plain if prefixed and name.endswith("_" + names[0])]
        if prefixes := [prefix for prefix in firsts if all(f"{prefix}_{name}" in plain for name in names)]:
            return names, prefixes
    return [], []


def recognise_value(header: Sequence[str], named: _NamedColumns = _NOTHING) -> tuple[str | None, RecognisedColumns]:
    """Return the only column, besides time, that can be a joint reading; None if there is none or several. named: as
    for `recognise_pose`."""
    taken = {name for names in named.values() for name in names}
    header = [name for name in header if name not in taken]
    when = RecognisedColumns() if "time" in named else recognise_time(header)
    counters = {"frame", "seq", "index", "header_seq", "field_header_seq", "frame_id", "header_frame_id", "state"}
    values = [name for name in header if name and name not in (when.time or ()) and _plain(name) not in counters]
    values = [name for name in values if not _plain(name).startswith(("field_header", "header_"))]
    return (values[0] if len(values) == 1 else None), when


def joint_columns(header: Sequence[str], bodies: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the columns of a pose table that are named like joint readings and belong to no pose of its `bodies`
    (`pose_bodies`). The names of the bodies are ignored: `gripper_vx` is not a joint reading."""
    posing: set[str] = set()
    for columns in bodies.values():
        pose, words = recognise_pose(columns), [_plain(name).split("_") for name in columns]
        start = next((place for place, group in enumerate(zip(*words, strict=False)) if len(set(group)) > 1), 0)
        moving = [name for name in columns if not _JOINT.search("_".join(_plain(name).split("_")[start:]))]
        posing |= {*(pose.position or ()), *(pose.rotation or ()), *moving}
    return [name for name in header if _JOINT.search(name) and name not in posing]


def quaternion_form(names: Sequence[str]) -> str | None:
    """Return the quaternion order of four columns by their names, w x y z or x y z w; None if unclear."""
    last = "".join(_plain(name)[-1:] for name in names)
    if last == "wxyz" or (last[1:] == "xyz" and _plain(names[0]).endswith("q0")):
        return QUATERNION_WXYZ
    return QUATERNION_XYZW if last == "xyzw" else None


def _plain(name: str) -> str:
    """Return a name in lower case, its words joined by _, without the number of a repeated column."""
    name = re.sub(r"\s*#\d*$", "", name)
    return re.sub(r"[.\s/:\-]+", "_", name.strip().lower()).strip("%_" if name[:2] != "__" else "")


def _by_plain_name(header: Sequence[str], kind: str) -> dict[str, str]:
    """Return columns by their plain names without the unit; the first of duplicates."""
    plain: dict[str, str] = {}
    for name in header:
        plain.setdefault(_plain(split_unit(name, kind)[0]), name)
    return plain


def _group(
    header: Sequence[str], choices: _Choices, kind: str, what: str, unclear: dict[str, str]
) -> tuple[str, ...] | None:
    """Return the columns of the first choice of names that is complete, with at most one prefix."""
    plain = _by_plain_name(header, kind)
    names, prefixes = _first_choice(plain, choices)
    if len(prefixes) > 1:
        unclear[what] = f"several bodies ({', '.join(prefixes[:4])}); name the columns of one under columns.{what}"
    if len(prefixes) != 1:
        return None
    return tuple(plain[f"{prefixes[0]}_{name}" if prefixes[0] else name] for name in names)


def _matrix(header: Sequence[str]) -> tuple[str, ...] | None:
    """Columns m00 ... m33 (or from 1; or m, t, r, mat, matrix): 16, 12 or, for a rotation alone, 9."""
    plain = {re.sub(r"[_\[\](),]", "", key): name for key, name in reversed(_by_plain_name(header, "length").items())}
    for stem, first, (rows, columns) in product(
        ("m", "t", "r", "mat", "matrix", "pose", "rot"), (0, 1), ((4, 4), (3, 4), (3, 3))
    ):
        names = [f"{stem}{first + i}{first + j}" for i in range(rows) for j in range(columns)]
        if all(name in plain for name in names):
            return tuple(plain[name] for name in names)
    return None


CAMERA_FRAMES: dict[str, AxisConvention] = {CAMERA: OPENCV, **CONVENTIONS}  # what `frame` in recording.yaml may say
FRAMES = (*CAMERA_FRAMES, BASE)
_ECM = re.compile(r"(^|[/_.\-])ecm([/_.\-]|$)")
_BASE = re.compile(r"(^|[/_.\-])(base|setup|rcm|remote_center|tracker)([/_.\-]|\d|$)")
_OPTICAL = re.compile(r"(^|[/_.\-])optical([/_.\-]|$)")
_BODY = re.compile(r"[/_.\-](link|body)$")
_WORDS = "camera|cam|endoscope|laparoscope|scope|ecm"
_SIDES = "left|right|rgb|colou?r|stereo|mono|front|head"
_CAMERA = re.compile(rf"(.*/)?(({_SIDES})_?)*({_WORDS})(_?({_SIDES}|\d+))*(_(link|frame|body))?")
_DVRK = re.compile(r"(^|[/_.\-:\s])(psm\d?|ecm|dvrk|mtm[lr])([/_.\-:\s]|$)", re.IGNORECASE)
# a frame in the name of a column, feature or file: `pose_in_ecm`, `camera_frame`
_NAMED_IN = (
    r"(?:^|[_.\-/])(?:(?:in|wrt|relative_to)[_.\-/](?:(?:the|left|right)[_.\-/])*({0})|({0})[_.\-/]?frame)(?:[_.\-/]|$)"
)
_CAMERA_IN = re.compile(_NAMED_IN.format("camera|cam|ecm|endoscope"), re.IGNORECASE)
_BASE_IN = re.compile(_NAMED_IN.format(r"(?:robot[_.\-/]?)?base"), re.IGNORECASE)


@dataclass(frozen=True)
class NamedFrame:
    """The meaning of a frame's name. frame: a key of CAMERA_FRAMES or BASE, None if the user must decide; why: the
    reason, or the ambiguity; choices: the possible frames, the most likely first."""

    frame: str | None
    why: str = ""
    choices: tuple[str, ...] = ()

    @property
    def question(self) -> str:
        """Text of the error message if the frame is ambiguous, else ""."""
        if self.frame is not None:
            return ""
        meanings = {name: f"the camera's, {axes.words}" for name, axes in CAMERA_FRAMES.items()}
        meanings |= {BASE: "a robot's base or a tracker"}
        *choices, last = [f"frame: {name} ({meanings[name]})" for name in self.choices]
        return f"{self.why}; set it in the recording, under poses: {', '.join(choices)}, or {last}"

    @property
    def hints(self) -> tuple[str, ...]:
        """The assumed frame and the reason, as lines of a template."""
        return (f"poses are expressed in {self.why}",) if self.frame is not None and self.why else ()

    @property
    def asks(self) -> tuple[str, ...]:
        """The ambiguity as a line of a template."""
        if self.frame is not None:
            return ()
        first, *alternatives = self.choices
        return (f"frame: {first}   # or {', '.join(alternatives)}: {self.why}",)


def meaning_of(name: str, images: Collection[str] = (), *, dvrk: bool = False) -> NamedFrame:
    """Return the meaning of a frame's name. images: the frames of the images of the same file; dvrk: whether the poses
    are from a dVRK."""
    plain, image_frames = name.strip("/").lower(), {image.strip("/").lower() for image in images}
    name = printable(name).strip("'")
    last = plain.rpartition("/")[2]
    camera = (CAMERA, DVRK_ECM.name) if dvrk or _ECM.search(plain) else (CAMERA,)
    if plain in image_frames:
        if (dvrk or _ECM.search(plain)) and not _OPTICAL.search(plain):
            why = f"{name} is the frame of the images, and poses of a dVRK in it may use the dVRK's axes or OpenCV's"
            return NamedFrame(None, why, (DVRK_ECM.name, CAMERA, BASE))
        if _BODY.search(plain):
            why = f"{name} is the frame of the images, but its name suggests the axes of a link"
            return NamedFrame(None, why, (CAMERA, ROS_BODY.name, BASE))
        return NamedFrame(CAMERA, f"{name}, the frame of the camera: axes of ROS images ({OPENCV.words})")
    if _OPTICAL.search(plain):
        if image_frames:
            why = f"{name} is an optical frame, but the images are in {printable(', '.join(sorted(images)))}"
            return NamedFrame(None, why, (CAMERA, BASE))
        return NamedFrame(CAMERA, f"{name}, the optical frame of the camera: axes {OPENCV.words}")
    if last == "ecm":
        why = f"{name}, the frame of the camera in the dVRK's axes ({DVRK_ECM.words}): converted to OpenCV's"
        return NamedFrame(DVRK_ECM.name, f"{why} ({OPENCV.words})")
    if _BASE.search(plain):
        return NamedFrame(BASE)
    if _ECM.search(plain) or _CAMERA.fullmatch(plain):
        why = f"{name} may be the camera's frame, with unknown axes"
        body = (ROS_BODY.name,) if not dvrk and not _ECM.search(plain) else ()
        choices = (*body, *camera) if _BODY.search(plain) else (*camera, *body)
        return NamedFrame(None, why, (*choices, BASE))
    return NamedFrame(BASE)


def meaning_in(names: Sequence[str], *, dvrk: bool = False) -> NamedFrame | None:
    """Return the meaning of the frame in the names of columns, features or files (`pose_in_ecm`, `camera_frame`);
    None if they contain none."""
    for pattern in (_CAMERA_IN, _BASE_IN):
        matches = [pattern.search(name) for name in names]
        words = {(match[1] or match[2]).lower() for match in matches if match}
        if not names or not all(matches) or len(words) > 1:
            continue
        word = words.pop()
        if pattern is _BASE_IN:
            return NamedFrame(BASE)
        if word == "ecm":
            return meaning_of("ECM")
        if dvrk:
            why = f"poses of a dVRK in the {word}'s frame may use the dVRK's axes or OpenCV's"
            return NamedFrame(None, why, (CAMERA, DVRK_ECM.name, BASE))
        return NamedFrame(CAMERA, f"the {word}'s frame: OpenCV's axes are assumed ({OPENCV.words})")
    return None


def without_frame(name: str) -> str:
    """Return a name without the frame in it: `psm1` of `psm1_in_ecm`."""
    remainder = name
    for pattern in (_CAMERA_IN, _BASE_IN):
        remainder = pattern.sub(lambda match: "_" if match.end() < len(match.string) else "", remainder)
    return name if remainder == name else remainder.strip("_") or name


def unsaid(*, dvrk: bool = False) -> NamedFrame:
    """Return the ambiguity of a log that names no frame."""
    return NamedFrame(None, "the frame of its poses is not stated", (CAMERA, BASE, *((DVRK_ECM.name,) if dvrk else ())))


def of_dvrk(*names: str) -> bool:
    """Return whether any of the names of topics, columns or files is one of the dVRK."""
    return any(_DVRK.search(name) for name in names)


def camera_order(name: str) -> tuple[bool | str, ...]:
    """Return a sort key of cameras by name: those at a wrist last; the left one first, the right one last; raw images
    before compressed ones."""
    lower = name.lower()
    at_wrist = "wrist" in lower or "psm" in lower
    return at_wrist, "right" in lower, "left" not in lower, lower.endswith("/compressed"), name
