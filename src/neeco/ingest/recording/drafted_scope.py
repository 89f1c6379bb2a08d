"""Lines of a drafted recording.yaml on the scope: whether it stands still, its second camera and the lens.

A line counts only where something was measured or read that says so; else it is a comment with the reason.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from neeco.errors import NeecoError
from neeco.geometry.lens import Lens
from neeco.ingest.calibration.stereo import read_stereo
from neeco.ingest.readers import IMAGES, VideoSource, format_of
from neeco.ingest.recording.model import STILL, ImageFolder, VideoFile

StandsStill = Callable[[VideoSource], bool]  # does a scope stand still, by its images?
MAX_TRAVEL_MM = 1.0  # of the log of a scope that stands still
_LEFT = re.compile("left", re.IGNORECASE)


@dataclass(frozen=True)
class FoundFrames:
    """Images of one camera, as a draft names them. line: `video: …` or `images: …`; file: the video, the folder of
    images or the file of which `stream` is one; name: of that file in the draft."""

    line: str
    name: str
    file: Path
    stream: str | None = None

    def open(self) -> VideoSource:
        """Return the images; those of a folder at an assumed rate. Raises NeecoError."""
        source = ImageFolder(self.file, fps=25.0) if self.line.startswith("images") else VideoFile(self.file)
        return source.open() if self.stream is None else VideoFile(self.file, stream=self.stream).open()


@dataclass(frozen=True, kw_only=True)
class DraftedScope:
    """Lines on the scope. right: the line that names the second camera's images, where there is one; lens: a remark on
    the lens, "" where nothing is known of it; still: is it stated to stand still?"""

    camera: str
    stereo: str
    right: str | None
    lens: str
    still: bool


def draft_scope(
    frames: Sequence[FoundFrames],
    calibrations: Sequence[str],
    travel_mm: float | None,
    stands_still: StandsStill | None,
) -> DraftedScope:
    """Return the lines on the scope whose images are the first of `frames`.

    calibrations: files of lenses in the folder of the frames' files; travel_mm: of the scope's own log, where there is
    one; stands_still: judges images, None: they are not looked at.
    """
    source = frames[0]
    right, stereo, problem = _second_camera(source, frames[1:], calibrations)
    still, camera = False, "# camera: still          # or moving"
    looked = None
    if stands_still is not None and (source.stream is not None or stereo):
        with suppress(NeecoError):
            looked = stands_still(source.open())
    if looked is False:
        camera += "; in frames spread over the recording, the background does not keep its place"
    elif looked and travel_mm is not None and travel_mm > MAX_TRAVEL_MM:
        camera += f"; the background keeps its place, but the laparoscope's log moves by {travel_mm:.0f} mm"
    elif looked:
        still, camera = True, f"camera: {STILL}   # in frames spread over the recording, the background keeps its place"
    if stereo and still:
        line = stereo
    elif stereo:
        line = f"# {stereo}; for a scope that stands still"
    else:
        example = f"# stereo: {{{(right or 'video: right.mp4')}, calibration: stereo.yaml}}"
        line = f"{example}   # {problem or 'its second camera, begun together: measures the depth of the tissue'}"
    return DraftedScope(
        camera=camera, stereo=line, right=right, lens=_lens_remark(source, still), still=still,
    )  # fmt: skip


def _second_camera(
    left: FoundFrames, others: Sequence[FoundFrames], calibrations: Sequence[str]
) -> tuple[str | None, str, str]:
    """Return the line of the right camera's images, the line `stereo: …` where a calibration states both cameras, else
    the reason why it does not."""
    if left.stream is None:
        return _second_video(left, others, calibrations)
    known = format_of(left.file)
    assert known is not None
    namesake = _LEFT.sub(_right_like, left.stream)
    streams = [stream for stream in known.streams(left.file) if stream.kind == IMAGES and not stream.problem]
    names = [stream.name for stream in streams if stream.count and stream.name != left.stream]
    problem = ""
    for name in sorted(names, key=lambda name: name != namesake):
        line = left.line.replace(left.stream, name)
        try:
            found = known.stereo(left.file, left.stream, name)
        except NeecoError as error:
            if name == namesake:
                problem = " ".join(str(error).removeprefix(f"{left.file}: ").split())
            continue
        if found is not None:
            millimetres = float(np.linalg.norm(found[2][:3, 3]))
            return line, f"stereo: {{{line}}}   # {left.name} states both lenses, {millimetres:.2f} mm apart", ""
    likely = next((name for name in names if name == namesake and name != left.stream), None)
    return (left.line.replace(left.stream, likely) if likely else None), "", problem


def _second_video(
    left: FoundFrames, others: Sequence[FoundFrames], calibrations: Sequence[str]
) -> tuple[str | None, str, str]:
    """The same of files in a folder."""
    namesake = _LEFT.sub(_right_like, left.name)
    right = next((item for item in others if item.name == namesake), None)
    likely = right or next((item for item in others if item.stream is None), None)
    folder = left.file.parents[left.name.count("/")]
    for name in calibrations if right else ():
        try:
            pose = read_stereo(folder / name)[2]
        except NeecoError:
            continue
        assert right is not None
        apart = f"{float(np.linalg.norm(pose[:3, 3])):.2f} mm apart"
        return right.line, f"stereo: {{{right.line}, calibration: {name}}}   # whose lenses are {apart}", ""
    return (likely.line if likely else None), "", ""


def _right_like(match: re.Match[str]) -> str:
    word = match[0]
    return "RIGHT" if word.isupper() else "Right" if word[0].isupper() else "right"


def _lens_remark(frames: FoundFrames, still: bool) -> str:
    """Return a remark on the lens that the file of the images states."""
    known = None if frames.stream is None else format_of(frames.file)
    if known is None:
        return ""
    try:
        lens = known.lens(frames.file, frames.stream)
    except NeecoError as error:
        return " ".join(str(error).removeprefix(f"{frames.file}: ").split())
    if lens is None:
        return f"{frames.name} states no lens{': give it, a scope that stands still needs it' if still else ''}"
    return f"Left out, it is the one that {frames.name} states: {_words(lens)}."


def _words(lens: Lens) -> str:
    intrinsics = ", ".join(f"{value:.6g}" for value in lens.intrinsics)
    return f"[{intrinsics}], {'with distortion' if lens.distorted else 'no distortion'}"
