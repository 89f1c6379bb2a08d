"""Figures of an ingested capture: sample frames with overlaid poses, and the coverage of its states.

Coverage is of every degree of freedom of every instrument, by split, with the range of the training frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFilter
from scipy.spatial.transform import Rotation
from torch import Tensor

from neeco.capture.model import Capture, Frame
from neeco.evaluation.image_metrics import outline
from neeco.geometry.camera import Camera
from neeco.geometry.projection import project_world
from neeco.ingest.foreground.rough_shape import RoughShape
from neeco.report.charts import PALETTE, inline_svg, new_axes, page_style, round_ticks
from neeco.report.page import MAX_WIDTH, jpeg, to_bytes

AXIS_COLORS = ("#ff5252", "#4cd964", "#4aa8ff")  # x, y, z
OUTLINE_COLOR = "#ffe14a"
ORIGIN = np.zeros((1, 3))
SPLIT_COLORS = {"train": "accent", "test": "good", "unseen": "phase"}


@dataclass(frozen=True)
class FigureSettings:
    """Sizes of overlays and charts."""

    samples: int = 12  # number of frames shown
    min_depth_mm: float = 1.0  # minimum depth in mm of points that are drawn
    axis_share: float = 0.16  # length of the frame axes as a share of the image's width
    shaft_diameters: float = 30.0  # drawn length of a shaft from video, in diameters
    bins: int = 24  # bins of a histogram
    constant: float = 1e-6  # maximum range in mm or deg of a constant value


SETTINGS = FigureSettings()


def axis_length(capture: Capture) -> float:
    """Return a round number of mm that spans about `axis_share` of the image at the instruments' median depth."""
    sizes = []
    for frame in capture.frames:
        for state in frame.state.instruments.values():
            _, (depth,) = _project(ORIGIN, state.pose, frame.camera)
            if depth > SETTINGS.min_depth_mm:
                sizes.append(SETTINGS.axis_share * frame.camera.width / frame.camera.fx * depth)
    return round_length(float(np.median(sizes)) if sizes else 10.0)


def in_view(capture: Capture, name: str) -> float:
    """Return the share of an instrument's frames in which its tracked origin lies inside the image."""
    frames = [frame for frame in capture.frames if name in frame.state.instruments]
    return sum(shows(frame, frame.state.instruments[name].pose) for frame in frames) / max(len(frames), 1)


def shows(frame: Frame, pose: Tensor) -> bool:
    """Return whether the origin of an instrument at `pose`, world_from_instrument [4, 4], lies inside the image."""
    ((x, y),), (depth,) = _project(ORIGIN, pose, frame.camera)
    return bool(depth > SETTINGS.min_depth_mm and 0 <= x < frame.camera.width and 0 <= y < frame.camera.height)


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
    image = Image.fromarray(to_bytes(frame.load_image().numpy())).resize(size, Image.Resampling.BICUBIC)
    for name, pose in poses.items():
        if name in shapes:
            _draw_outline(image, shapes[name], pose, camera)
        painter = ImageDraw.Draw(image)
        if name in shafts:
            _draw_shaft(painter, shafts[name], pose, camera)
        _draw_frame(painter, pose, camera, length)
    return jpeg(np.asarray(image))


def _draw_outline(image: Image.Image, shape: RoughShape, pose: Tensor, camera: Camera) -> None:
    """Draw the outline of the shape's points, each as large as its grid cell."""
    mask = Image.new("L", image.size)
    painter = ImageDraw.Draw(mask)
    for (x, y), z in zip(*_project(shape.points, pose, camera), strict=True):
        radius = 0.75 * shape.spacing * camera.fx / z if z > SETTINGS.min_depth_mm else 0.0
        if radius and -radius < x < image.width + radius and -radius < y < image.height + radius:
            painter.ellipse((x - radius, y - radius, x + radius, y + radius), fill=255)
    edge = Image.fromarray(outline(np.asarray(mask) > 0).astype(np.uint8) * 255).filter(ImageFilter.MaxFilter(3))
    image.paste(OUTLINE_COLOR, (0, 0), edge)


def _draw_shaft(painter: ImageDraw.ImageDraw, diameter: float, pose: Tensor, camera: Camera) -> None:
    """Draw the two contours of a shaft and its end."""
    along = np.linspace(-SETTINGS.shaft_diameters, 0, 61)[:, None] * diameter * np.array([0.0, 0.0, 1.0])  # [61, 3]
    centre = np.linalg.inv(pose.numpy()) @ camera.world_from_camera.double().numpy()[:, 3]  # of the camera, [4] mm
    aside = np.cross(centre[:3] - along, [0.0, 0.0, 1.0])
    aside *= diameter / 2 / np.linalg.norm(aside, axis=1, keepdims=True)
    pixels, depth = zip(*(_project(along + side * aside, pose, camera) for side in (-1, 1)), strict=True)
    lines = [
        [tuple(place) for place, z in zip(places, depths, strict=True) if z > SETTINGS.min_depth_mm]
        for places, depths in zip(pixels, depth, strict=True)
    ]
    for line in (*lines, [line[-1] for line in lines if line]):
        if len(line) > 1:
            painter.line(line, fill=OUTLINE_COLOR, width=4)


def _draw_frame(painter: ImageDraw.ImageDraw, pose: Tensor, camera: Camera, length: float) -> None:
    pixels, depth = _project(np.concatenate([ORIGIN, length * np.eye(3)]), pose, camera)
    if depth[0] <= SETTINGS.min_depth_mm:
        return
    x, y = start = tuple(pixels[0])
    for width, colors in ((10, ("#000000",) * 3), (6, AXIS_COLORS)):
        for end, z, color in zip(pixels[1:], depth[1:], colors, strict=True):
            if z > SETTINGS.min_depth_mm:
                painter.line([start, tuple(end)], fill=color, width=width)
    painter.ellipse((x - 7, y - 7, x + 7, y + 7), fill="#ffffff", outline="#000000", width=2)


def _project(points: np.ndarray, pose: Tensor, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return px [N, 2] (undefined behind the camera) and depth [N] of points [N, 3] of an instrument at `pose`."""
    world_from_instrument = pose.numpy()
    world = points @ world_from_instrument[:3, :3].T + world_from_instrument[:3, 3]
    return project_world(world, camera, nearest=SETTINGS.min_depth_mm)


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
        if len(values) < 2 or np.ptp(values) < SETTINGS.constant:
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
    if high - low < SETTINGS.constant:
        axes.text(0, 0.5, f"always {_number(low)}", transform=axes.transAxes)
        axes.set_xticks([])
        return inline_svg(axes, label)
    axes.set_title(caption, loc="right", fontsize=11, color=PALETTE["soft"])
    left, right = low - 0.02 * (high - low), high + 0.02 * (high - low)
    axes.set_xlim(left, right)
    for start, end in [(left, right)] if trained is None else [(left, trained[0]), (trained[1], right)]:
        if end - start > 0.0125 * (right - left):  # thinner ones would look like lines
            axes.axvspan(start, end, color=PALETTE["phase"], alpha=0.13, linewidth=0, gid="beyond")
    edges, floor = np.linspace(low, high, SETTINGS.bins + 1), np.zeros(SETTINGS.bins)
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
