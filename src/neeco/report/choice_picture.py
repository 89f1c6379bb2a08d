"""A draft of a recording.yaml, and a picture of its poses under each choice that the recorded file leaves open."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from neeco.capture.model import evenly_spaced
from neeco.errors import NeecoError
from neeco.files import write_atomically, write_text
from neeco.ingest.cameras.still_scene import video_stands_still
from neeco.ingest.readers import IMAGES, VideoSource, format_of
from neeco.ingest.readers.choices import AXES, OpenPoses, Reading, axis_directions, largest_step, open_poses, shaft_of
from neeco.ingest.readers.columns import BASE
from neeco.ingest.recording.template import write_template
from neeco.ingest.sources import RECORDING
from neeco.report.charts import page_style

N_FRAMES = 3  # shown
MARGIN = 0.15  # of an image's sides, shown around it
AXIS_SHARE = 0.2  # of a body's distance: length of its axes
COLORS = ("#d62728", "#2ca02c", "#1f77b4")  # x, y, z
N_LINES = 24  # along a shaft
MAX_ROWS = 10  # of choices
CHOICES = "recording_choices.png"
# Lines of a draft that leave something open: what marks the first of them, and what to write there
_QUESTIONS = (
    (r"^  - name: ", "what is the instrument called in labels? Correct its name"),
    (r"^ +# kinematics: \{dvrk_tool", "which tool is it? Remove the # and give its file, or write out its links below"),
    (r"^ +# camera_from_base: \{transform", "how does the robot's base stand to the camera? Remove the # of one line"),
    (r"a guess: correct it", "at which rate were these taken? Correct the number"),
    (r"# units: .*nothing says them", "in which units? Correct them and remove the #"),
    (r"is not clear: ", "which columns hold it? Name them"),
    (r"^ +# +(?:frame|quaternion\w*|rotation\w*|euler\w*): ", "what do its poses mean? Correct it, remove the #"),
)


def write_draft(source: Path, report: Callable[[str], None]) -> list[str]:
    """Write a recording.yaml for what lies at `source`, and a picture of the choices that its file leaves open, into
    the folder or next to the file. Return lines on what was written; `report` is called with what is left out.

    Raises NeecoError where a recording.yaml exists, and where there are no images.
    """
    whole = source.is_file() or format_of(source) is not None  # a recording in itself: a bag, a data set's folder
    path = (source.parent if whole else source) / RECORDING
    if path.exists():
        raise NeecoError(f"{path}: already exists; edit it, or move it away first")
    draft = write_template(source, lambda problem: report(f"left out: {problem}"), video_stands_still)
    write_text(path, draft)
    lines, picture = [], path.with_name(CHOICES)
    try:
        if whole and write_choice_picture(source, picture):
            lines.append(f"wrote {picture}: what its poses would be under each choice that the file leaves open")
    except NeecoError as error:  # recording.yaml, which names the choices, is written all the same
        lines.append(f"no picture of the choices that the file leaves open: {error}")
    marked = [
        f"{path}:{number}: {words}"
        for number, line in enumerate(draft.splitlines(), 1)
        for words in [words for marks, words in _QUESTIONS if re.search(marks, line)][:1]
    ]
    lines += ["still open:", *(f"{n}. {question}" for n, question in enumerate(marked, 1))] if marked else []
    return [*lines, f"wrote {path}: look through it, then: neeco ingest {path} --output CAPTURE"]


@page_style()
def write_choice_picture(source: Path, picture: Path) -> bool:
    """Write a PNG of every way to read the poses in `source` of which something is not stated.

    Each is shown on N_FRAMES frames, as in the camera's frame, and by its shaft's lines. Return False where nothing is
    open. Raises NeecoError.
    """
    bodies = open_poses(source)
    rows = [(poses, reading) for poses in bodies for reading in poses.readings]
    if not rows:
        return False
    known = format_of(source)
    assert known is not None
    cameras = [stream.name for stream in known.streams(source) if stream.kind == IMAGES and stream.count]
    scene, how = None, ""
    if cameras:
        video, lens = known.open_images(source, cameras[0]), known.lens(source, cameras[0])
        width, height = video.size
        how = "" if lens else ", focal length assumed to be the image's width"
        scene = _Scene(video, lens.intrinsics if lens else (width, width, width / 2, height / 2))
    shown = rows[:MAX_ROWS]
    columns = N_FRAMES + 1
    figure = Figure(figsize=(3.6 * columns, 3.1 * len(shown) + 0.7), dpi=80, layout="constrained")
    grid = figure.subplots(len(shown), columns, squeeze=False)
    for axes, (poses, reading) in zip(grid, shown, strict=True):
        _draw_frames(axes[:-1], poses, reading, scene)
        _draw_lines(axes[-1], poses, reading)
    figure.suptitle(
        f"Left: the poses as in the camera's frame (x red, y green, z blue{how}).\n"
        "Right: lines along the axis that a trocar holds together best, whatever the frame; the path in black.",
        fontsize=10,
    )
    write_atomically(picture, lambda temporary: figure.savefig(temporary, format="png"))
    return True


def _draw_frames(row: np.ndarray, poses: OpenPoses, reading: Reading, scene: _Scene | None) -> None:
    """Draw the body's axes on N_FRAMES frames."""
    for axes in row:
        axes.set_axis_off()
    row[0].set_title(f"{poses.title}\n{reading.title}, frame: {poses.frame}", fontsize=9, loc="left")
    if scene is None:
        return
    width, height = scene.video.size
    samples = scene.samples(poses)
    numbers = [int(np.abs(scene.video.times - poses.times[sample]).argmin()) for sample in samples]
    pictures = dict(scene.video.read(numbers))
    for axes, number, sample in zip(row, numbers, samples, strict=True):
        axes.imshow(pictures[number])
        if poses.frame == BASE:
            words = "stated in a base's frame"
        else:
            words = f"{_draw_body(axes, poses.positions[sample], reading.quats[sample], scene)}frame: {poses.frame}"
        axes.text(0.02, 0.02, words, transform=axes.transAxes, fontsize=8, color="white", backgroundcolor="#0008")
        axes.set_xlim(-MARGIN * width, (1 + MARGIN) * width)
        axes.set_ylim((1 + MARGIN) * height, -MARGIN * height)


def _draw_body(axes: Axes, place: np.ndarray, quat: np.ndarray, scene: _Scene) -> str:
    """Draw the axes of a body in front of a camera at the origin (OpenCV's axes); return words where it is out of
    view."""
    if place[2] <= 0:
        return "behind the camera in "
    start = scene.pixel(place)
    for axis, color in enumerate(COLORS):
        point = place + AXIS_SHARE * place[2] * axis_directions(quat[None], axis)[0]
        ends = np.stack([start, scene.pixel(point)]).T
        axes.plot(*ends, color="white", linewidth=4)
        axes.plot(*ends, color=color, linewidth=2.2)
    inside = (start >= 0).all() and (start < scene.video.size).all()
    return "" if inside else "outside the image in "


@dataclass(frozen=True)
class _Scene:
    """The images and their lens: fl_x, fl_y, cx, cy px."""

    video: VideoSource
    lens: tuple[float, float, float, float]

    def pixel(self, point: np.ndarray) -> np.ndarray:
        """Return px [2] of a point [3] in front of the camera."""
        return np.array(self.lens[:2]) * point[:2] / max(float(point[2]), 1e-9) + self.lens[2:]

    def samples(self, poses: OpenPoses) -> list[int]:
        """Return the sample of each of N_FRAMES parts of the poses that is nearest to the image's middle; the part's
        middle one where all are behind the camera."""
        depths = np.maximum(poses.positions[:, 2:], 1e-9)
        off = np.linalg.norm(np.array(self.lens[:2]) * poses.positions[:, :2] / depths, axis=1)
        off[poses.positions[:, 2] <= 0] = np.inf
        if not np.isfinite(off).any():
            off = np.abs(np.linspace(-1, 1, len(off)))
        parts = np.array_split(np.arange(len(off)), N_FRAMES)
        return [int(part[off[part].argmin()]) for part in parts if len(part)]


def _draw_lines(axes: Axes, poses: OpenPoses, reading: Reading) -> None:
    """Draw the tool's path, and lines along that of its axes whose lines pass nearest to one point."""
    shaft = shaft_of(poses.positions, reading.quats)
    chosen = evenly_spaced(len(poses.positions), N_LINES)
    directions = axis_directions(reading.quats, shaft.axis)
    middle = poses.positions.mean(0)
    # the plane that shows most of the path and of the lines
    reach = 2 * float(np.linalg.norm(poses.positions - middle, axis=1).max()) or 1.0
    spread = np.concatenate([poses.positions - middle, reach * directions])
    plane = np.linalg.svd(spread, full_matrices=False)[2][:2]
    path = (poses.positions - middle) @ plane.T
    along = directions[chosen] @ plane.T
    for start, direction in zip(path[chosen], along, strict=True):
        ends = np.stack([start - reach * direction, start + reach * direction])
        axes.plot(*ends.T, color=COLORS[shaft.axis], linewidth=0.7, alpha=0.6)
    axes.plot(*path.T, color="black", linewidth=1.2)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_title(
        f"lines along {AXES[shaft.axis]} pass within {shaft.rms:.3g} of one point\n"
        f"largest turn from one frame to the next: {math.degrees(largest_step(reading.quats)):.1f} deg",
        fontsize=8,
    )
