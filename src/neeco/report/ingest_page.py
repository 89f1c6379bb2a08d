"""A finished ingest: its verdicts, and the self-contained page on its quality.

Figures: sample frames with overlaid poses, and the coverage of the states, of every degree of freedom of every
instrument, by split, with the range of the training frames.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFilter
from scipy.spatial.transform import Rotation
from torch import Tensor

from neeco.base.errors import counted
from neeco.base.files import finite
from neeco.capture import read_capture
from neeco.capture.checks import inspect_capture
from neeco.capture.documents import Problem, errors_only
from neeco.capture.model import Capture, Frame, evenly_spaced
from neeco.evaluation.image_metrics import outline, to_uint8
from neeco.geometry.camera import Camera
from neeco.geometry.projection import project_world
from neeco.ingest.foreground.rough_shape import RoughShape
from neeco.ingest.frames.images import StageProgress
from neeco.ingest.pipeline import ingest
from neeco.ingest.recording.model import Recording
from neeco.ingest.result import VERDICTS, Assessment, IngestResult, assess_ingest, clock_cost_mm, rms
from neeco.report.page import (
    MAX_WIDTH,
    PAGES,
    PALETTE,
    inline_svg,
    jpeg,
    new_axes,
    page_style,
    round_ticks,
    split_counts,
    write_page,
)

AXIS_COLORS = ("#ff5252", "#4cd964", "#4aa8ff")  # x, y, z
OUTLINE_COLOR = "#ffe14a"
ORIGIN = np.zeros((1, 3))
SPLIT_COLORS = {"train": "accent", "test": "good", "unseen": "phase"}


def in_view(capture: Capture, name: str) -> float:
    """Return the share of an instrument's frames in which its tracked origin lies inside the image."""
    frames = [frame for frame in capture.frames if name in frame.state.instruments]
    return sum(shows(frame, frame.state.instruments[name].pose) for frame in frames) / max(len(frames), 1)


def shows(frame: Frame, pose: Tensor) -> bool:
    """Return whether the origin of an instrument at `pose`, world_from_instrument [4, 4], lies inside the image."""
    ((x, y),), (depth,) = _project(ORIGIN, pose, frame.camera)
    return bool(depth > PAGES.min_depth_mm and 0 <= x < frame.camera.width and 0 <= y < frame.camera.height)


def posed_picture(
    frame: Frame,
    poses: Mapping[str, Tensor],
    shapes: Mapping[str, RoughShape],
    length: float,
    shafts: Mapping[str, float],
) -> str:
    """Draw instruments at poses, world_from_instrument [4, 4], over a frame; return a data URI.

    length: of the axes, mm; shafts: diameters in mm of instruments with z along a shaft that ends at their origin.
    Raises NeecoError if the image cannot be read.
    """
    # supersampled by 2 for smooth lines
    scale = 2 * MAX_WIDTH / frame.camera.width
    fx, fy, cx, cy = (scale * value for value in (frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy))
    size = (2 * MAX_WIDTH, round(frame.camera.height * scale))
    camera = Camera(frame.camera.world_from_camera, fx, fy, cx, cy, *size)
    image = Image.fromarray(to_uint8(frame.load_image().numpy() * 255)).resize(size, Image.Resampling.BICUBIC)
    for name, pose in poses.items():
        if name in shapes:  # the outline of the shape's points, each as large as its grid cell
            mask = Image.new("L", image.size)
            painter = ImageDraw.Draw(mask)
            for (x, y), z in zip(*_project(shapes[name].points, pose, camera), strict=True):
                radius = 0.75 * shapes[name].spacing * camera.fx / z if z > PAGES.min_depth_mm else 0.0
                if radius and -radius < x < image.width + radius and -radius < y < image.height + radius:
                    painter.ellipse((x - radius, y - radius, x + radius, y + radius), fill=255)
            edge = Image.fromarray(outline(np.asarray(mask) > 0).astype(np.uint8) * 255)
            image.paste(OUTLINE_COLOR, (0, 0), edge.filter(ImageFilter.MaxFilter(3)))
        painter = ImageDraw.Draw(image)
        if name in shafts:  # its two contours, and its end
            diameter = shafts[name]
            z_axis = np.array([0.0, 0.0, 1.0])
            along = np.linspace(-PAGES.shaft_diameters, 0, 61)[:, None] * diameter * z_axis  # [61, 3]
            centre = np.linalg.inv(pose.numpy()) @ camera.world_from_camera.double().numpy()[:, 3]  # [4] mm
            aside = np.cross(centre[:3] - along, z_axis)
            aside *= diameter / 2 / np.linalg.norm(aside, axis=1, keepdims=True)
            lines = [
                [tuple(place) for place, z in zip(places, depths, strict=True) if z > PAGES.min_depth_mm]
                for places, depths in (_project(along + side * aside, pose, camera) for side in (-1, 1))
            ]
            for line in (*lines, [line[-1] for line in lines if line]):
                if len(line) > 1:
                    painter.line(line, fill=OUTLINE_COLOR, width=4)
        pixels, depth = _project(np.concatenate([ORIGIN, length * np.eye(3)]), pose, camera)
        if depth[0] > PAGES.min_depth_mm:  # its frame
            x, y = start = tuple(pixels[0])
            for width, colors in ((10, ("#000000",) * 3), (6, AXIS_COLORS)):
                for end, z, color in zip(pixels[1:], depth[1:], colors, strict=True):
                    if z > PAGES.min_depth_mm:
                        painter.line([start, tuple(end)], fill=color, width=width)
            painter.ellipse((x - 7, y - 7, x + 7, y + 7), fill="#ffffff", outline="#000000", width=2)
    return jpeg(np.asarray(image))


def _project(points: np.ndarray, pose: Tensor, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return px [N, 2] (undefined behind the camera) and depth [N] of points [N, 3] of an instrument at `pose`."""
    world_from_instrument = pose.numpy()
    world = points @ world_from_instrument[:3, :3].T + world_from_instrument[:3, 3]
    return project_world(world, camera, nearest=PAGES.min_depth_mm)


def round_length(limit: float) -> float:
    """Return the largest of 1, 2, 5, 10, 20, ... not above `limit`."""
    power = 10.0 ** np.floor(np.log10(max(limit, 1e-9)))
    return float(max(step * power for step in (1, 2, 5) if step * power <= limit * 1.000001))


@dataclass(frozen=True)
class Degree:
    """One degree of freedom over the frames that have it. values [N] in `unit`; splits: N names."""

    instrument: str
    name: str
    unit: str  # mm or deg
    values: np.ndarray
    splits: tuple[str, ...]

    def of(self, split: str) -> np.ndarray:
        return self.values[np.array(self.splits) == split]

    @property
    def trained(self) -> tuple[float, float] | None:
        """Return the minimum and maximum of the training frames; None without any."""
        values = self.of("train")
        return (float(values.min()), float(values.max())) if len(values) else None


def degrees_of_freedom(capture: Capture) -> list[Degree]:
    """Return position x, y, z mm; pitch, yaw, roll deg about the mean direction of the training frames; each joint.

    Pitch, yaw and roll are intrinsic rotations in that order about the tracked frame's x, y and z axis, from the mean.
    """
    degrees = []
    for instrument in capture.instruments:
        frames = [frame for frame in capture.frames if instrument.name in frame.state.instruments]
        if not frames:
            continue
        states = [frame.state.instruments[instrument.name] for frame in frames]
        splits = tuple(frame.split for frame in frames)
        poses = np.stack([state.pose.numpy() for state in states])
        columns = [(f"position {axis}", "mm", poses[:, row, 3]) for row, axis in enumerate("xyz")]
        rotations, trained = Rotation.from_matrix(poses[:, :3, :3]), np.array([split == "train" for split in splits])
        mean = (rotations[trained] if trained.any() else rotations).mean()
        turns = (mean.inv() * rotations).as_euler("XYZ", degrees=True)
        columns += [(name, "deg", turns[:, index]) for index, name in enumerate(("pitch", "yaw", "roll"))]
        for joint in instrument.joints:
            values = np.array([state.joints.get(joint, np.nan) for state in states])
            sliding = instrument.slides(joint)
            columns.append((joint, "mm" if sliding else "deg", values if sliding else np.degrees(values)))
        for name, unit, values in columns:
            valid = np.isfinite(values)
            valid_splits = tuple(split for split, keep in zip(splits, valid, strict=True) if keep)
            if valid.any():
                degrees.append(Degree(instrument.name, name, unit, values[valid], valid_splits))
    return degrees


def unvisited(degrees: Sequence[Degree]) -> list[str]:
    """Return intervals inside the trained range, of at least a tenth of it, without a training frame."""
    sentences = []
    several = len({degree.instrument for degree in degrees}) > 1
    for degree in degrees:
        name = f"{degree.instrument} {degree.name}" if several else degree.name
        values = np.sort(degree.of("train"))
        if len(values) < 2 or np.ptp(values) < PAGES.constant:
            continue
        steps = np.diff(values)
        sentences += [
            f"{name}: no frames between {_number(values[place])} and {_number(values[place + 1])} {degree.unit}."
            for place in np.flatnonzero(steps > 0.1 * np.ptp(values))
        ]
    return sentences


@page_style()
def histogram(degree: Degree) -> str:
    """Return stacked bars of a degree of freedom, coloured by split, as inline SVG; gaps in training are shaded."""
    low, high = float(degree.values.min()), float(degree.values.max())
    trained = degree.trained
    caption = "never trained" if trained is None else f"trained {_number(trained[0])} … {_number(trained[1])}"
    label = f"frames over {degree.name}, {degree.unit}; {caption}"
    axes = new_axes((340, 150), 12, 12, 28, 22)
    axes.set_title(f"{degree.name}, {degree.unit}")
    axes.set_yticks([])
    if high - low < PAGES.constant:
        axes.text(0, 0.5, f"always {_number(low)}", transform=axes.transAxes)
        axes.set_xticks([])
        return inline_svg(axes, label)
    axes.set_title(caption, loc="right", fontsize=11, color=PALETTE["soft"])
    left, right = low - 0.02 * (high - low), high + 0.02 * (high - low)
    axes.set_xlim(left, right)
    for start, end in [(left, right)] if trained is None else [(left, trained[0]), (trained[1], right)]:
        if end - start > 0.0125 * (right - left):  # thinner ones would look like lines
            axes.axvspan(start, end, color=PALETTE["phase"], alpha=0.13, linewidth=0, gid="beyond")
    edges, floor = np.linspace(low, high, PAGES.bins + 1), np.zeros(PAGES.bins)
    for name in sorted(set(degree.splits), key=lambda name: [*SPLIT_COLORS, name].index(name)):
        top = floor + np.histogram(degree.of(name), edges)[0]
        axes.stairs(top, edges, baseline=floor, fill=True, color=PALETTE[SPLIT_COLORS.get(name, "soft")])
        floor = top
    axes.set_ylim(0, max(1.0, floor.max()))
    axes.axhline(0, color=PALETTE["edge"], linewidth=1)
    round_ticks(axes.xaxis, 4, _number)
    return inline_svg(axes, label)


def _number(value: float) -> str:
    text = f"{value:.0f}" if abs(value) >= 20 else f"{value:.1f}" if abs(value) >= 2 else f"{value:.2g}"
    return "0" if float(text) == 0 else text.replace("-", "−")


PAGE = "ingest.html"


@dataclass(frozen=True)
class Ingested:
    """Result of `ingest`: the capture in folder `output`, the report on it, and the verdict.

    A folder converted from another format has neither, but `notes` on missing data."""

    output: Path
    result: IngestResult | None = None
    assessment: Assessment | None = None
    problems: list[Problem] = field(default_factory=list)  # found by `check`
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> str | None:
        """ "good", "usable" or "doubtful"; None for a converted folder."""
        return None if self.assessment is None else VERDICTS[self.assessment.level]

    @cached_property
    def capture(self) -> Capture:
        """The capture, read from its folder."""
        return read_capture(self.output)

    def __repr__(self) -> str:
        return f"Ingested({str(self.output)!r}, verdict={self.verdict!r})"

    def as_json(self) -> dict[str, Any]:
        """Return numbers and the verdict for scripts."""
        if self.result is None or self.assessment is None:
            return {}
        return finite(self.result.as_json() | self.assessment.as_json())

    def lines(self) -> list[str]:
        """Return results, paths and the verdict, for a terminal."""
        lines = [] if self.result is None else self.result.lines()
        lines += [f"error: {problem}" for problem in errors_only(self.problems)]
        lines.append(f"capture: {self.output}  ({counted(len(self.problems), 'problem')} in `neeco check`)")
        verdict: list[str] = []
        if self.assessment is not None:
            lines.append(f"page: {self.output / PAGE}")
            first, *caveats = self.assessment.lines()
            verdict = [f"verdict: {first}", *caveats, self.assessment.conclusion]
        verdict_text = " ".join(verdict).casefold()

        def repeats(line: str) -> bool:
            kind, _, text = line.partition(": ")
            return kind in ("note", "error") and text.rstrip(".").casefold() in verdict_text

        return [line for line in lines if not repeats(line)] + verdict


def ingest_and_report(recordings: Sequence[Recording], output: Path, progress: StageProgress) -> Ingested:
    """Make the capture `output` from recordings, with a page on it inside. Raises NeecoError."""
    done: list[Ingested] = []

    def complete(result: IngestResult, folder: Path) -> None:
        progress("writing the page", 0, 0)
        checked = inspect_capture(folder)
        capture = checked.capture or read_capture(folder)
        assessment = assess_ingest(result, capture, checked.problems)
        write_ingest_page(result, assessment, folder / PAGE, capture)
        done.append(Ingested(output, result, assessment, checked.problems))

    ingest(recordings, output, progress, complete)
    return done[0]


_NUMBER = re.compile(r"\d+(?:\.\d+)?")


def write_ingest_page(result: IngestResult, verdict: Assessment, path: Path, capture: Capture | None = None) -> None:
    """Write a self-contained HTML page about an ingest.

    verdict: of `assess_ingest`; capture: of `result.capture`, read here if None. Raises NeecoError if it or a displayed
    image cannot be read, or the page cannot be written.
    """
    capture, fit = capture or read_capture(result.capture), result.registration
    registration = None
    if fit is not None:  # root mean squares of cameras against the laparoscope's tracker; the sensor's place
        rotation_deg = float(np.degrees(rms(fit.rotation_residual)))
        residuals = {"position_rms": rms(fit.position_residual), "rotation_rms": rotation_deg}
        registration = {**residuals, "sensor_mm": fit.camera_from_sensor[:3, 3]}
    clocks = []
    for name, clock in result.clocks.items():
        sd = f"±{clock.sd * 1000:.1f}" if np.isfinite(clock.sd) and clock.sd > 0 else "–"
        moved = clock_cost_mm(name, clock.sd, capture)
        cost = f"{moved:.2f}" if moved else "–"
        offset = f"{clock.seconds * 1000:+.1f}".replace("-", "−")
        rate = "1" if clock.rate == 1 else f"{clock.rate:.5f} ±{clock.rate_sd:.5f}"
        clocks.append([name, offset, sd, rate, cost, clock.source])
    alike: dict[str, list[tuple[int, str]]] = {}  # reasons that differ only in a number are merged
    for frame, reason in result.dropped:
        alike.setdefault(_NUMBER.sub("…", reason.why), []).append((frame, reason.why))
    dropped = []  # reason, count and frames
    for pattern, members in sorted(alike.items(), key=lambda group: -len(group[1])):
        reasons = {why for _, why in members}
        frames = np.array(sorted(frame for frame, _ in members))
        runs = np.split(frames, np.flatnonzero(np.diff(frames) != 1) + 1)
        ranges = ", ".join(f"{run[0]}" if len(run) == 1 else f"{run[0]}–{run[-1]}" for run in runs)
        dropped.append([reasons.pop() if len(reasons) == 1 else pattern, str(len(members)), ranges])
    write_page(
        path,
        "ingest.html",
        result.capture.name,
        "ingest",
        subtitle=f"from {result.recording}",
        stamps=[result.capture],
        result=result,
        capture=capture,
        verdict=verdict,
        splits=split_counts(capture),
        second=len(capture.frames) - len(result.selected),  # images of a stereo partner, which are training frames
        in_view=[(item.name, in_view(capture, item.name)) for item in capture.instruments if capture.registered],
        registration=registration,
        clocks=clocks,
        **_frames(result, capture),
        **_coverage(capture),
        dropped=dropped,
    )


def _frames(result: IngestResult, capture: Capture) -> dict[str, Any]:
    """Return sample frames as (picture, picture before registration or "", frame, its time, its split), and the legend
    of the overlays."""
    sizes = []  # mm that span `axis_share` of the image at the instruments' depths
    for frame in capture.frames:
        for state in frame.state.instruments.values():
            _, (depth,) = _project(ORIGIN, state.pose, frame.camera)
            if depth > PAGES.min_depth_mm:
                sizes.append(PAGES.axis_share * frame.camera.width / frame.camera.fx * depth)
    length = round_length(float(np.median(sizes)) if sizes else 10.0)
    rows = {time: row for row, time in enumerate(np.round(result.selected_times, 6).tolist())}
    start = min(frame.state.time for frame in capture.frames)
    samples, shown_before = [], 0
    in_video = {item.name: item.from_video for item in capture.instruments}
    shafts = {name: video.shaft_diameter_mm for name, video in in_video.items() if video is not None}
    ordered = sorted(capture.frames, key=lambda frame: frame.state.time)
    for frame in (ordered[index] for index in evenly_spaced(len(ordered), PAGES.samples)):
        row = rows.get(round(frame.state.time, 6))
        poses = {name: state.pose for name, state in frame.state.instruments.items() if capture.registered}
        before = {}  # world_from_instrument by the trackers alone
        for name, tracked in result.unregistered.items() if row is not None else ():
            if np.isfinite(tracked[row]).all():
                before[name] = frame.camera.world_from_camera.double() @ torch.from_numpy(tracked[row])
        shown_before += any(shows(frame, pose) for pose in before.values())
        samples.append(
            (
                posed_picture(frame, poses, result.shapes, length, shafts),
                posed_picture(frame, before, result.shapes, length, {}) if before else "",
                frame.name if row is None else result.frame_words(int(result.selected[row])),
                f"{frame.state.time - start:.2f}",
                frame.split,
            )
        )
    return {
        "samples": samples,
        "compared": any(before for _, before, *_ in samples),
        "shown_before": shown_before,
        "axis_mm": f"{length:g}",
        "axis_colors": list(zip("xyz", AXIS_COLORS, strict=True)),
        "shafts": bool(shafts),
        "shaped": any(item.name in result.shapes for item in capture.instruments),
        "shape_color": OUTLINE_COLOR,
    }


def _coverage(capture: Capture) -> dict[str, Any]:
    """Return the range of states: intervals without a training frame, and charts by instrument."""
    degrees = degrees_of_freedom(capture)
    named = [name for name in capture.splits if name in SPLIT_COLORS]
    rest = ", ".join(name for name in capture.splits if name not in named)
    return {
        "degrees": degrees,
        "trained": any(degree.trained is not None for degree in degrees),
        "unvisited": unvisited(degrees),
        "split_colors": [(SPLIT_COLORS[name], name) for name in named] + ([("soft", rest)] if rest else []),
        "instruments": [
            {
                "name": item.name,
                "jointed": bool(item.joints),
                "charts": [histogram(degree) for degree in degrees if degree.instrument == item.name],
            }
            for item in capture.instruments
        ],
    }
