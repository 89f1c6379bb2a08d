"""Which columns of a log hold what: as a recording says, and as common loggers name them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from neeco.ingest.units import split_unit

QUATERNION_WXYZ, QUATERNION_XYZW = "quaternion_wxyz", "quaternion_xyzw"
ROTATION_VECTOR, EULER, ROTATION_MATRIX, MATRIX = "rotation_vector", "euler", "rotation_matrix", "matrix"
FORMS = {
    QUATERNION_WXYZ: (4,),
    QUATERNION_XYZW: (4,),
    ROTATION_VECTOR: (3,),
    EULER: (3,),
    ROTATION_MATRIX: (9,),
    MATRIX: (12, 16),
}  # how many columns each takes; matrices row by row


@dataclass(frozen=True)
class Units:
    """Units as a recording says them; None: the columns' names say it."""

    time: str | None = None
    length: str | None = None
    angle: str | None = None


@dataclass(frozen=True)
class PoseColumns:
    """A log of poses (tracker_from_sensor) in a CSV file. What is None is recognised from the header.

    time: one column, or two (whole seconds, nanoseconds); position: x, y, z (not with a 4x4 matrix); rotation: as
    many columns as `form` takes; euler_convention: as scipy names it, "XYZ" intrinsic, "xyz" extrinsic; state: a
    column of which only the values `good` mark measured rows; rate_hz: where time counts frames.
    """

    path: Path
    clock: str = "em"
    time: tuple[str, ...] | None = None
    position: tuple[str, ...] | None = None
    rotation: tuple[str, ...] | None = None
    form: str | None = None
    euler_convention: str | None = None
    state: str | None = None
    good: tuple[str, ...] = ("OK",)
    units: Units = field(default_factory=Units)
    rate_hz: float | None = None


@dataclass(frozen=True)
class JointColumns:
    """A log of one joint sensor in a CSV file. `calibration`: a table from its counts to angles; None: the column
    holds angles. limits: of the joint, rad, for the capture."""

    path: Path
    clock: str
    time: tuple[str, ...] | None = None
    value: str | None = None
    units: Units = field(default_factory=Units)
    rate_hz: float | None = None
    calibration: Path | None = None
    limits: tuple[float, float] | None = None


@dataclass(frozen=True)
class Recognised:
    """The columns a header seems to name. None: not found; `unclear`: found in more ways than one, or only in part."""

    time: tuple[str, ...] | None = None
    position: tuple[str, ...] | None = None
    rotation: tuple[str, ...] | None = None
    form: str | None = None
    state: str | None = None
    counts_frames: bool = False
    time_unit: str | None = None
    length_unit: str | None = None
    unclear: dict[str, str] = field(default_factory=dict)


# names without their unit, in order of preference; a name also matches behind a prefix ("tool_timestamp")
_TIMES = (
    "header_stamp", "timestamp", "time_stamp", "stamp", "time", "t", "elapsed", "secs", "sec", "seconds", "__time",
)  # fmt: skip
_LONG = ("position_", "translation_", "pos_", "trans_")  # may follow any prefix: "field.pose.position.x"
_SHORT = ("t", "p", "")
_QUATERNION_LONG = ("orientation_", "rotation_", "quaternion_", "quat_", "q_", "q")
_ROS = re.compile(r"(^|[._/])(pose|transform|transforms\d*)[._/]")


def recognise_time(header: Sequence[str]) -> Recognised:
    """The column of times."""
    plain = {_plain(split_unit(name, "time")[0]): name for name in reversed(header) if name}
    seconds = [name for name in plain if name.endswith("stamp_sec")]
    fraction = [name for name in plain if name.endswith(("stamp_nanosec", "stamp_nsec"))]
    if not seconds:  # `header.stamp.sec` reads as a stamp in seconds beside its nanoseconds
        split = {_plain(name): name for name in header}
        seconds = [name for name in split if name.endswith(("stamp_sec", "stamp_secs"))]
        fraction = [name for name in split if name.endswith(("stamp_nanosec", "stamp_nsec", "stamp_nsecs"))]
        plain = plain | {name: split[name] for name in seconds + fraction}
    if len(seconds) == len(fraction) == 1:
        return Recognised(time=(plain[seconds[0]], plain[fraction[0]]))
    for wanted in _TIMES:
        if wanted in plain:
            found = plain[wanted]
            break
        behind = [name for name in plain if len(wanted) > 1 and name.endswith("_" + wanted)]
        if len(behind) == 1:
            found = plain[behind[0]]
            break
    else:
        frames = [name for name in header if _plain(name) in ("frame", "frame_number", "frame_id", "frame_no")]
        return Recognised(time=(frames[0],), counts_frames=True) if frames else Recognised()
    # `rostopic echo -p` writes %time and field.header.stamp in ns
    ros = found == "%time" or (found.lower().endswith("header.stamp") and found.lower().startswith("field."))
    spelled_out = _plain(found) in ("secs", "sec", "seconds", "__time")
    return Recognised(time=(found,), time_unit="ns" if ros else "s" if spelled_out else None)


def recognise_pose(header: Sequence[str]) -> Recognised:
    """The columns of time, position and rotation in a log of poses."""
    when = recognise_time(header)
    unclear: dict[str, str] = {}
    matrix = _matrix(header)
    position = None if matrix and len(matrix) > 9 else _group(header, _position_names(), "length", "position", unclear)
    rotation, form = _rotation(header, matrix, unclear)
    if position and rotation and set(position) & set(rotation):
        rotation = form = None
    lower = [_plain(name) for name in header]
    ndi = {"state", "q0", "tx", "ty", "tz"} <= set(lower)
    ros = bool(position and _ROS.search(position[0].lower()))
    return Recognised(
        time=when.time,
        position=position,
        rotation=rotation,
        form=form,
        state=header[lower.index("state")] if ndi else None,
        counts_frames=when.counts_frames,
        time_unit=when.time_unit,
        length_unit="mm" if ndi else "m" if ros else None,
        unclear=unclear,
    )


def recognise_value(header: Sequence[str]) -> tuple[str | None, Recognised]:
    """The one column beside the time that can be a joint's reading (None when there are none or several)."""
    when = recognise_time(header)
    counters = {"frame", "seq", "index", "header_seq", "field_header_seq", "frame_id", "header_frame_id", "state"}
    others = [name for name in header if name and name not in (when.time or ()) and _plain(name) not in counters]
    others = [name for name in others if not _plain(name).startswith(("field_header", "header_"))]
    return (others[0] if len(others) == 1 else None), when


def quaternion_form(names: Sequence[str]) -> str | None:
    """Whether four columns are named in the order w x y z or x y z w; None when their names do not say."""
    last = "".join(_plain(name)[-1:] for name in names)
    first = _plain(names[0])
    if last == "wxyz" or (last[1:] == "xyz" and first.endswith("q0")):
        return QUATERNION_WXYZ
    return QUATERNION_XYZW if last == "xyzw" else None


def _plain(name: str) -> str:
    return re.sub(r"[.\s/:\-]+", "_", name.strip().lower()).strip("%_" if name[:2] != "__" else "")


def _position_names() -> list[tuple[bool, list[str]]]:
    """(may follow a prefix, names of x y z) in order of preference."""
    return [
        *((True, [stem + axis for axis in "xyz"]) for stem in _LONG),
        *((prefixed, [stem + axis for axis in "xyz"]) for prefixed in (False, True) for stem in _SHORT),
    ]


def _rotation(
    header: Sequence[str], matrix: tuple[str, ...] | None, unclear: dict[str, str]
) -> tuple[tuple[str, ...] | None, str | None]:
    if matrix:
        return matrix, ROTATION_MATRIX if len(matrix) == 9 else MATRIX
    names = [
        *((True, [stem + axis for axis in "wxyz"]) for stem in _QUATERNION_LONG),
        *((prefixed, ["q0", "qx", "qy", "qz"]) for prefixed in (False, True)),
        (False, ["w", "x", "y", "z"]),
    ]
    quaternion = _group(header, names, "length", "quaternion", unclear)
    if quaternion:
        return quaternion, QUATERNION_WXYZ
    stems = ("rotvec_", "rotation_vector_", "rodrigues_", "rv", "rvec_", "rotvec", "rvec")
    vector = _group(header, [(True, [stem + axis for axis in "xyz"]) for stem in stems], "angle", "rotation", unclear)
    if vector:
        return vector, ROTATION_VECTOR
    for triple in (["roll", "pitch", "yaw"], ["rx", "ry", "rz"], ["alpha", "beta", "gamma"]):
        if _group(header, [(True, triple)], "angle", "rotation", {}):
            unclear["rotation"] = (
                f"{', '.join(triple)} have no one meaning; name them under columns.euler with an euler_convention "
                "(or under columns.rotation_vector)"
            )
    if {"q0", "q1", "q2", "q3"} <= {_plain(name) for name in header}:
        unclear["rotation"] = "q0, q1, q2, q3 come in two orders; name them under columns.quaternion_wxyz or _xyzw"
    return None, None


def _group(
    header: Sequence[str], choices: list[tuple[bool, list[str]]], kind: str, what: str, unclear: dict[str, str]
) -> tuple[str, ...] | None:
    """The columns of the first choice of names that is there, behind one prefix if it may be."""
    plain: dict[str, str] = {}
    for name in header:
        plain.setdefault(_plain(split_unit(name, kind)[0]), name)
    for prefixed, names in choices:
        if all(name in plain for name in names):
            return tuple(plain[name] for name in names)
        if not prefixed:
            continue
        ends = "_" + names[0]
        prefixes = [name[: -len(ends)] for name in plain if name.endswith(ends)]
        prefixes = [prefix for prefix in prefixes if all(f"{prefix}_{name}" in plain for name in names)]
        if len(prefixes) == 1:
            return tuple(plain[f"{prefixes[0]}_{name}"] for name in names)
        if prefixes:
            unclear[what] = f"several bodies ({', '.join(prefixes[:4])}); name the columns of one under columns.{what}"
            return None
    return None


def _matrix(header: Sequence[str]) -> tuple[str, ...] | None:
    """Columns m00 ... m33 (or from 1; or m, t, r, mat, matrix): 16, 12 or, for a rotation alone, 9."""
    plain: dict[str, str] = {}
    for name in header:
        plain.setdefault(re.sub(r"[_\[\](),]", "", _plain(split_unit(name, "length")[0])), name)
    for stem in ("m", "t", "r", "mat", "matrix", "pose", "rot"):
        for first in (0, 1):
            for rows, columns in ((4, 4), (3, 4), (3, 3)):
                names = [f"{stem}{first + i}{first + j}" for i in range(rows) for j in range(columns)]
                if all(name in plain for name in names):
                    return tuple(plain[name] for name in names)
    return None
