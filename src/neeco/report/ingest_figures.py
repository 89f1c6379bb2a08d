"""Pictures of an ingested capture: sample frames with the tracked poses over them, and the tracks in 3D."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from PIL import Image, ImageDraw, ImageFilter
from torch import Tensor

from neeco.capture.model import Capture, Frame, evenly_spaced
from neeco.evaluation.image_metrics import outline
from neeco.geometry.camera import Camera
from neeco.geometry.projection import project_world
from neeco.ingest.foreground.rough_shape import RoughShape
from neeco.report.charts import PALETTE, draw_dots, inline_svg, new_axes, page_style
from neeco.report.page import MAX_WIDTH, jpeg, to_bytes

N_SAMPLES = 12  # frames shown
AXIS_COLORS = ("#ff5252", "#4cd964", "#4aa8ff")  # x, y, z
MAIN_AXIS_COLOR = "#ff6bff"
OUTLINE_COLOR = "#ffe14a"
MIN_DEPTH_MM = 1.0  # of points that are shown
AXIS_SHARE = 0.16  # of the image's width: length of the frame axes
ORIGIN = np.zeros((1, 3))
SHAFT_DIAMETERS = 30.0  # length shown of a shaft found in video

WIDTH, HEIGHT, MARGIN = 420, 320, 16  # of a view of the tracks, view box units
MAX_SVG_POINTS = 1500
STRAY = 0.01  # share of the points at either end that may lie outside the view
GAP = 4.0  # median time steps: a longer one breaks the line
N_RAYS = 10  # cameras shown with their viewing direction
LINE_COLORS = ("phase", "good", "bad")  # of the instruments; the camera's is accent


@dataclass(frozen=True)
class MainAxis:
    """An instrument's long axis in its own frame, mm: from the far end of its rough shape to the tip."""

    tail: np.ndarray  # [3]
    tip: np.ndarray  # [3]

    @property
    def direction(self) -> np.ndarray:
        return (self.tip - self.tail) / np.linalg.norm(self.tip - self.tail)


def main_axes(capture: Capture, shapes: Mapping[str, RoughShape]) -> dict[str, MainAxis]:
    """Return the long axis of each shape, through its points' mean along their first principal component.

    An instrument comes in from outside the image, so the tip is the end that more frames have in view, or else the one
    nearer to the image's middle. Shapes without an instrument in the capture, or of fewer than 3 points, have none.
    """
    axes = {}
    for name, shape in shapes.items():
        showing = [frame for frame in capture.frames if name in frame.state.instruments]
        if not showing or len(shape.points) < 3:
            continue
        middle = shape.points.mean(axis=0)
        direction = np.linalg.eigh(np.cov((shape.points - middle).T))[1][:, -1]
        along = (shape.points - middle) @ direction
        ends = [middle + direction * np.quantile(along, share) for share in (0.02, 0.98)]
        if np.linalg.norm(ends[1] - ends[0]) < 1e-6:
            continue
        if _visibility(ends[0], name, showing) > _visibility(ends[1], name, showing):
            ends.reverse()
        axes[name] = MainAxis(ends[0], ends[1])
    return axes


def sample_frames(capture: Capture) -> list[Frame]:
    """Return up to N_SAMPLES frames, evenly spread over time."""
    frames = sorted(capture.frames, key=lambda frame: frame.state.time)
    return [frames[index] for index in evenly_spaced(len(frames), N_SAMPLES)]


def axis_length(capture: Capture) -> float:
    """Return a round number of mm that spans about AXIS_SHARE of the image at the instruments' median depth."""
    sizes = []
    for frame in capture.frames:
        for state in frame.state.instruments.values():
            _, (depth,) = _project(ORIGIN, state.pose, frame.camera)
            if depth > MIN_DEPTH_MM:
                sizes.append(AXIS_SHARE * frame.camera.width / frame.camera.fx * depth)
    return round_length(float(np.median(sizes)) if sizes else 10.0)


def in_view(capture: Capture, name: str) -> float:
    """Return the share of an instrument's frames in which its tracked origin lies inside the image."""
    frames = [frame for frame in capture.frames if name in frame.state.instruments]
    return sum(shows(frame, frame.state.instruments[name].pose) for frame in frames) / max(len(frames), 1)


def shows(frame: Frame, pose: Tensor) -> bool:
    """Return whether the origin of an instrument at `pose`, world_from_instrument [4, 4], lies inside the image."""
    ((x, y),), (depth,) = _project(ORIGIN, pose, frame.camera)
    return bool(depth > MIN_DEPTH_MM and 0 <= x < frame.camera.width and 0 <= y < frame.camera.height)


def _visibility(point: np.ndarray, name: str, frames: list[Frame]) -> float:
    """Return a score of how well a point of an instrument is in view over the frames: more is better."""
    score = 0.0
    for frame in frames:
        (place,), (depth,) = _project(point[None], frame.state.instruments[name].pose, frame.camera)
        off = np.abs(place / [frame.camera.width, frame.camera.height] - 0.5).max()  # 0.5 at the border
        score += 0.0 if depth <= MIN_DEPTH_MM else float(off < 0.5) + 0.1 * max(0.0, 1 - off)
    return score


def posed_picture(
    frame: Frame,
    poses: Mapping[str, Tensor],
    shapes: Mapping[str, RoughShape],
    axes: Mapping[str, MainAxis],
    length: float,
    shafts: Mapping[str, float],
) -> str:
    """Draw instruments at poses, world_from_instrument [4, 4], over a frame; return a data URI.

    length: of their axes, mm; shafts: diameters in mm, of those whose z goes along a shaft that ends at their origin.
    Raises NeecoError when the image cannot be read.
    """
    # at twice the size shown, then shrunk: smooth lines
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
        if name in axes:
            _draw_main_axis(painter, axes[name], pose, camera)
        _draw_frame(painter, pose, camera, length)
    return jpeg(np.asarray(image))


def _draw_outline(image: Image.Image, shape: RoughShape, pose: Tensor, camera: Camera) -> None:
    """Draw the outline of the shape's points, each as large as its grid cell."""
    mask = Image.new("L", image.size)
    painter = ImageDraw.Draw(mask)
    for (x, y), z in zip(*_project(shape.points, pose, camera), strict=True):
        radius = 0.75 * shape.spacing * camera.fx / z if z > MIN_DEPTH_MM else 0.0
        if radius and -radius < x < image.width + radius and -radius < y < image.height + radius:
            painter.ellipse((x - radius, y - radius, x + radius, y + radius), fill=255)
    edge = Image.fromarray(outline(np.asarray(mask) > 0).astype(np.uint8) * 255).filter(ImageFilter.MaxFilter(3))
    image.paste(OUTLINE_COLOR, (0, 0), edge)


def _draw_shaft(painter: ImageDraw.ImageDraw, diameter: float, pose: Tensor, camera: Camera) -> None:
    """Draw the two contours of a shaft and its end."""
    along = np.linspace(-SHAFT_DIAMETERS, 0, 61)[:, None] * diameter * np.array([0.0, 0.0, 1.0])  # [61, 3]
    centre = np.linalg.inv(pose.numpy()) @ camera.world_from_camera.double().numpy()[:, 3]  # of the camera, [4] mm
    aside = np.cross(centre[:3] - along, [0.0, 0.0, 1.0])
    aside *= diameter / 2 / np.linalg.norm(aside, axis=1, keepdims=True)
    pixels, depth = zip(*(_project(along + side * aside, pose, camera) for side in (-1, 1)), strict=True)
    lines = [
        [tuple(place) for place, z in zip(places, depths, strict=True) if z > MIN_DEPTH_MM]
        for places, depths in zip(pixels, depth, strict=True)
    ]
    for line in (*lines, [line[-1] for line in lines if line]):
        if len(line) > 1:
            painter.line(line, fill=OUTLINE_COLOR, width=4)


def _draw_main_axis(painter: ImageDraw.ImageDraw, axis: MainAxis, pose: Tensor, camera: Camera) -> None:
    pixels, depth = _project(np.linspace(axis.tail, axis.tip, 33), pose, camera)
    visible = [tuple(place) for place, z in zip(pixels, depth, strict=True) if z > MIN_DEPTH_MM]
    if len(visible) > 1:
        painter.line(visible, fill="#000000", width=7)
        painter.line(visible, fill=MAIN_AXIS_COLOR, width=4)
    if depth[-1] > MIN_DEPTH_MM:
        x, y = pixels[-1]
        painter.ellipse((x - 10, y - 10, x + 10, y + 10), outline="#000000", width=7)
        painter.ellipse((x - 9, y - 9, x + 9, y + 9), outline=MAIN_AXIS_COLOR, width=4)


def _draw_frame(painter: ImageDraw.ImageDraw, pose: Tensor, camera: Camera, length: float) -> None:
    pixels, depth = _project(np.concatenate([ORIGIN, length * np.eye(3)]), pose, camera)
    if depth[0] <= MIN_DEPTH_MM:
        return
    x, y = start = tuple(pixels[0])
    for width, colors in ((10, ("#000000",) * 3), (6, AXIS_COLORS)):
        for end, z, color in zip(pixels[1:], depth[1:], colors, strict=True):
            if z > MIN_DEPTH_MM:
                painter.line([start, tuple(end)], fill=color, width=width)
    painter.ellipse((x - 7, y - 7, x + 7, y + 7), fill="#ffffff", outline="#000000", width=2)


def _project(points: np.ndarray, pose: Tensor, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return px [N, 2] (undefined behind the camera) and depth [N] of points [N, 3] of an instrument at `pose`."""
    world_from_instrument = pose.numpy()
    world = points @ world_from_instrument[:3, :3].T + world_from_instrument[:3, 3]
    return project_world(world, camera, nearest=MIN_DEPTH_MM)


@dataclass(frozen=True, kw_only=True)
class Tracks:
    """Tracks and points in the mean camera's axes (x right, y down, z forward), mm."""

    points: np.ndarray  # [P, 3]
    camera: np.ndarray  # [F, 3] in order of time
    looking: np.ndarray  # [F, 3] unit
    breaks: np.ndarray  # [F - 1] bool: time jumps after this frame
    instruments: dict[str, np.ndarray]  # name -> [F, 3], NaN where a frame lacks it
    measured: bool  # the points are real


def read_tracks(capture: Capture) -> Tracks:
    """Return the tracks of a capture, without unregistered instruments: their frame is not the cameras'."""
    frames = sorted(capture.frames, key=lambda frame: frame.state.time)
    poses = np.stack([frame.camera.world_from_camera.double().numpy() for frame in frames])
    axes = _mean_axes(poses)  # [3, 3] columns right, down, forward
    times = np.array([frame.state.time for frame in frames])
    steps = np.diff(times)
    middle = np.median(capture.points.positions.astype(np.float64), axis=0) if len(capture.points.positions) else 0.0
    instruments = {}
    for instrument in capture.instruments if capture.registered else ():
        track = np.full((len(frames), 3), np.nan)
        for index, frame in enumerate(frames):
            if instrument.name in frame.state.instruments:
                track[index] = frame.state.instruments[instrument.name].pose.numpy()[:3, 3]
        instruments[instrument.name] = (track - middle) @ axes
    return Tracks(
        points=(capture.points.positions.astype(np.float64) - middle) @ axes,
        camera=(poses[:, :3, 3] - middle) @ axes,
        looking=poses[:, :3, 2] @ axes,
        breaks=steps > GAP * max(float(np.median(steps)), 1e-9) if len(steps) else np.zeros(0, dtype=bool),
        instruments=instruments,
        measured=capture.points.measured,
    )


def _mean_axes(poses: np.ndarray) -> np.ndarray:
    forward = poses[:, :3, 2].mean(axis=0)
    if np.linalg.norm(forward) < 1e-6:  # cameras all around: any view is as good
        return np.eye(3)
    forward /= np.linalg.norm(forward)
    right = poses[:, :3, 0].mean(axis=0)
    right -= forward * (right @ forward)
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(np.eye(3)[np.abs(forward).argmin()], forward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward], axis=1)


@page_style()
def view(tracks: Tracks, title: str, across: np.ndarray, down: np.ndarray) -> str:
    """Return the tracks projected along across x down, as inline SVG; both [3] in the tracks' frame."""
    plane = np.stack([across, down], axis=1).astype(np.float64)  # [3, 2]
    shown = [tracks.camera @ plane, *(track[np.isfinite(track[:, 0])] @ plane for track in tracks.instruments.values())]
    if len(tracks.points):  # but for strays
        shown.append(np.quantile(tracks.points @ plane, [STRAY, 1 - STRAY], axis=0))
    low, high = np.concatenate(shown).min(axis=0), np.concatenate(shown).max(axis=0)
    scale = min((WIDTH - 2 * MARGIN) / max(high[0] - low[0], 1e-9), (HEIGHT - 3 * MARGIN) / max(high[1] - low[1], 1e-9))
    offset = np.array([WIDTH, HEIGHT + MARGIN]) / 2 - scale * (low + high) / 2

    def place(positions: np.ndarray) -> np.ndarray:
        return scale * (positions @ plane) + offset

    axes = new_axes((WIDTH, HEIGHT), 0, 0, 0, 0)
    axes.set_axis_off()
    axes.set(xlim=(0, WIDTH), ylim=(HEIGHT, 0))
    axes.text(12, 18, title, color=PALETTE["ink"], fontsize=12)
    step = -(-len(tracks.points) // MAX_SVG_POINTS) or 1
    dots = place(tracks.points[::step])
    inside = ((dots > 0) & (dots < [WIDTH, HEIGHT])).all(axis=1)
    draw_dots(axes, dots[inside], gid="points", color=PALETTE["soft"], linewidth=1.7, alpha=0.55)
    _draw_line(axes, place(tracks.camera), tracks.breaks, "accent", 1.8)
    chosen = np.unique(np.linspace(0, len(tracks.camera) - 1, N_RAYS).round().astype(int))
    ends = tracks.camera[chosen] + 0.12 * float(np.linalg.norm(high - low)) * tracks.looking[chosen]
    rays = np.stack([place(tracks.camera[chosen]), place(ends)], axis=1).reshape(-1, 2)
    _draw_line(axes, rays, np.arange(1, len(rays)) % 2 == 0, "accent", 1.0)
    for index, track in enumerate(tracks.instruments.values()):
        _draw_line(axes, place(track), tracks.breaks, LINE_COLORS[index % len(LINE_COLORS)], 1.8)
    length = round_length(0.25 * (WIDTH - 2 * MARGIN) / scale)
    end = WIDTH - 12
    axes.plot([end - length * scale, end], [HEIGHT - 10] * 2, color=PALETTE["ink"], linewidth=2, clip_on=False)
    axes.text(end, HEIGHT - 16, f"{length:g} mm", ha="right")
    return inline_svg(axes, title)


def _draw_line(axes: Axes, places: np.ndarray, breaks: np.ndarray, color: str, width: float) -> None:
    """Draw a line through [F, 2], interrupted at breaks [F - 1] and where a place is unknown."""
    line = np.insert(places, np.flatnonzero(breaks) + 1, np.nan, axis=0)
    axes.plot(line[:, 0], line[:, 1], color=PALETTE[color], linewidth=width, clip_on=False)


def round_length(wanted: float) -> float:
    """Return the greatest of 1, 2, 5, 10, 20, ... that is not above `wanted`."""
    power = 10.0 ** np.floor(np.log10(max(wanted, 1e-9)))
    return float(max(step * power for step in (1, 2, 5) if step * power <= wanted * 1.000001))
