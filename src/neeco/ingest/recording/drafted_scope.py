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

from neeco.base.errors import NeecoError
from neeco.ingest.calibration.stereo import read_stereo
from neeco.ingest.readers import IMAGES, VideoSource, format_of
from neeco.ingest.recording.model import STILL, ImageFolder, VideoFile

StandsStill = Callable[[VideoSource], bool]  # does a scope stand still, by its images?
_LEFT = re.compile("left", re.IGNORECASE)


@dataclass(frozen=True)
class FoundFrames:
    """Images of one camera, as a draft names them. line: `video: …` or `images: …`; name: of their file in the draft;
    file: the video, the folder of images or the file of which `stream` is one."""

    line: str
    name: str
    file: Path
    stream: str | None = None

    def open(self) -> VideoSource:
        """Return the images; those of a folder at an assumed rate. Raises NeecoError."""
        is_folder = self.line.startswith("images")
        source = ImageFolder(self.file, fps=25.0) if is_folder else VideoFile(self.file, stream=self.stream)
        return source.open()


def draft_scope(
    frames: Sequence[FoundFrames], calibrations: Sequence[str], stands_still: StandsStill | None
) -> tuple[list[str], str | None, bool]:
    """Return the lines on the scope whose images are the first of `frames`, the line that names the second camera's
    images, and whether the scope is stated to stand still. calibrations: files of lenses in the folder of the frames'
    files, as YAML; stands_still: judges images, None: they are not looked at."""
    source = frames[0]
    right, stereo, problem = _second_camera(source, frames[1:], calibrations)
    still, camera = False, "# camera: still   # or moving"
    if stands_still is not None and (source.stream is not None or stereo):
        with suppress(NeecoError):
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
    lens, known = None, None if source.stream is None else format_of(source.file)
    with suppress(NeecoError):
        lens = known and known.lens(source.file, source.stream)
    if lens:
        lines.append(f"# intrinsics: left out, {source.name} states the lens")
    elif not calibrations and not (stereo and still):
        lines.append("# intrinsics: [290, 290, 160, 128]   # fl_x, fl_y, cx, cy px; no calibration was found")
    lines += [f"{'# ' if index else ''}intrinsics: {name}" for index, name in enumerate(calibrations)]
    return lines, right, still


def _second_camera(
    left: FoundFrames, others: Sequence[FoundFrames], calibrations: Sequence[str]
) -> tuple[str | None, str, str]:
    """Return the line of the right camera's images, the line `stereo: …` where a calibration states both cameras, else
    the reason why it does not."""
    namesake = _LEFT.sub(_right_like, left.stream or left.name)
    if left.stream is None:
        line = next((item.line for item in others if item.name == namesake), None)
        folder = left.file.parents[left.name.count("/")]
        for name in calibrations if line else ():
            with suppress(NeecoError):
                apart = float(np.linalg.norm(read_stereo(folder / name)[2][:3, 3]))
                return line, f"stereo: {{{line}, calibration: {name}}}   # whose lenses are {apart:.2f} mm apart", ""
        return line, "", ""
    known = format_of(left.file)
    assert known is not None
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
            apart = float(np.linalg.norm(found[2][:3, 3]))
            return line, f"stereo: {{{line}}}   # {left.name} states both lenses, {apart:.2f} mm apart", ""
    return (left.line.replace(left.stream, namesake) if namesake in names else None), "", problem


def _right_like(match: re.Match[str]) -> str:
    word = match[0]
    return "RIGHT" if word.isupper() else "Right" if word[0].isupper() else "right"
