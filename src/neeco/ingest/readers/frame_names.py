"""The meaning of a frame's name: a camera's with known axes, a robot's base or a tracker's, or unknown.

A frame's name does not define its axes: the dVRK's ECM and the optical frame of ROS share an origin and differ by half
a turn. If a name fits several conventions, the user is asked. Names of cameras also determine their order.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from neeco.capture.documents import printable
from neeco.geometry.conventions import CONVENTIONS, DVRK_ECM, OPENCV, ROS_BODY, AxisConvention
from neeco.ingest.readers.columns import BASE, CAMERA

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
