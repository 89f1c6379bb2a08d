"""Units in column names and in recordings, and the scale of each to mm, rad and s."""

from __future__ import annotations

import re

from neeco.errors import NeecoError

LENGTHS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 1e-3}
ANGLES = {"rad": 1.0, "deg": 0.017453292519943295}
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
KINDS = {"length": LENGTHS, "angle": ANGLES, "time": TIMES}

_ALIASES = {
    "millimeter": "mm", "millimeters": "mm", "millimetre": "mm", "millimetres": "mm",
    "meter": "m", "meters": "m", "metre": "m", "metres": "m", "centimeters": "cm", "centimetres": "cm",
    "radian": "rad", "radians": "rad", "degree": "deg", "degrees": "deg", "°": "deg",
    "sec": "s", "secs": "s", "second": "s", "seconds": "s", "msec": "ms", "millis": "ms", "milliseconds": "ms",
    "usec": "us", "microseconds": "us", "nsec": "ns", "nsecs": "ns", "nanosec": "ns", "nanoseconds": "ns",
}  # fmt: skip
_SUFFIX = re.compile(r"^(?P<base>.*?)(?:[\s_\-/]+|[\s_]*[\[(]\s*)(?P<unit>[a-zµ°]+)\s*[\])]?$")


def canonical_unit(text: str) -> str:
    """`mm` for millimetres, `deg` for degrees ...; the text itself, in small letters, when it is no known unit."""
    lower = text.strip().lower().replace("µ", "u")
    return _ALIASES.get(lower, lower)


def split_unit(name: str, kind: str) -> tuple[str, str | None]:
    """A column's name without its unit, and the unit of that kind ("length", "angle", "time") or None."""
    match = _SUFFIX.match(name.strip().lower())
    if match:
        unit = canonical_unit(match["unit"])
        if unit in KINDS[kind]:
            return match["base"].strip("_ "), unit
    return name.strip().lower(), None


def scale_of(place: str, names: tuple[str, ...], kind: str, said: str | None, implied: str | None, hint: str) -> float:
    """The factor to mm, rad or s of some columns: by the unit in their names, else as the recording says, else as
    their format implies.

    place: the file, for messages; said: `units.<kind>` of the recording; implied: by a known format; hint: added to
    the question. Raises NeecoError when nothing says the unit or two sayings disagree.
    """
    found = {unit for name in names if (unit := split_unit(name, kind)[1])}
    shown = ", ".join(names)
    if len(found) > 1:
        raise NeecoError(f"{place}: columns {shown}: named in different units; write them in one {kind} unit")
    unit = next(iter(found), None)
    if unit and said and unit != said:
        raise NeecoError(
            f"{place}: columns {shown}: named in {unit}, but units.{kind} says {said}; correct whichever is wrong"
        )
    unit = unit or said or implied
    if unit is None:
        choices = ", ".join(KINDS[kind])
        raise NeecoError(
            f"{place}: columns {shown}: in which {kind} unit?{hint} Say it in the header (for example "
            f"{names[0]}_{next(iter(KINDS[kind]))}) or in the recording's units.{kind} ({choices})"
        )
    return KINDS[kind][unit]
