"""Sample frames of an ingested capture with what the tracker says drawn over them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFilter
from torch import Tensor

from neeco.capture.model import Capture, Frame
from neeco.evaluation.image_metrics import outline
from neeco.ingest.motion import RoughShape
from neeco.raster.pinhole import project_world
from neeco.raster.types import Camera
from neeco.report.page import MAX_WIDTH, jpeg, to_bytes
from neeco.report.tracks import round_length

FIGURES = 8
AXIS_COLORS = ("#ff5252", "#4cd964", "#4aa8ff")  # x, y, z
MAIN_AXIS_COLOR = "#ff6bff"
OUTLINE_COLOR = "#ffe14a"
NEAR = 1.0  # mm: nearer points are not drawn
ORIGIN = np.zeros((1, 3))
AXIS_SHARE = 0.16  # of the image's width: how long the drawn frame axes are


@dataclass(frozen=True)
class MainAxis:
    """An instrument's long axis in its own frame, mm: from the far end of its rough shape to the tip."""

    tail: np.ndarray  # [3]
    tip: np.ndarray  # [3]

    @property
    def direction(self) -> np.ndarray:
        return (self.tip - self.tail) / np.linalg.norm(self.tip - self.tail)


def main_axes(capture: Capture, shapes: Mapping[str, RoughShape]) -> dict[str, MainAxis]:
    """The long axis of each shape, through its points' mean along their first principal component.

    An instrument comes in from outside the image, so the tip is the end that more frames have in view, or else the one
    nearer to the image's middle. Shapes without an instrument in the capture, or of fewer than 3 points, have none.
    """
    axes = {}
    for name, shape in shapes.items():
        seen = [frame for frame in capture.frames if name in frame.state.instruments]
        if not seen or len(shape.points) < 3:
            continue
        middle = shape.points.mean(axis=0)
        direction = np.linalg.eigh(np.cov((shape.points - middle).T))[1][:, -1]
        along = (shape.points - middle) @ direction
        ends = [middle + direction * np.quantile(along, share) for share in (0.02, 0.98)]
        if np.linalg.norm(ends[1] - ends[0]) < 1e-6:
            continue
        if _visibility(ends[0], name, seen) > _visibility(ends[1], name, seen):
            ends.reverse()
        axes[name] = MainAxis(ends[0], ends[1])
    return axes


def sample_figures(
    capture: Capture, shapes: Mapping[str, RoughShape], axes: Mapping[str, MainAxis], length: float
) -> list[tuple[str, Frame]]:
    """(data URI, frame) of up to FIGURES frames, evenly spread over time. Frame axes are `length` mm long; unregistered
    poses are not drawn.

    Raises NeecoError when an image cannot be read.
    """
    frames = sorted(capture.frames, key=lambda frame: frame.state.time)
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(FIGURES, len(frames))).round().astype(int))
    return [(_draw(frames[index], capture, shapes, axes, length), frames[index]) for index in chosen]


def axis_length(capture: Capture) -> float:
    """A round number of mm that spans about AXIS_SHARE of the image at the instruments' median depth."""
    sizes = []
    for frame in capture.frames:
        for state in frame.state.instruments.values():
            _, (depth,) = _project(ORIGIN, state.pose, frame.camera)
            if depth > NEAR:
                sizes.append(AXIS_SHARE * frame.camera.width / frame.camera.fx * depth)
    return round_length(float(np.median(sizes)) if sizes else 10.0)


def in_view(capture: Capture, name: str) -> tuple[int, int]:
    """In how many frames an instrument's tracked origin lies inside the image, and how many have the instrument."""
    frames = [frame for frame in capture.frames if name in frame.state.instruments]
    inside = 0
    for frame in frames:
        ((x, y),), (depth,) = _project(ORIGIN, frame.state.instruments[name].pose, frame.camera)
        inside += bool(depth > NEAR and 0 <= x < frame.camera.width and 0 <= y < frame.camera.height)
    return inside, len(frames)


def _visibility(point: np.ndarray, name: str, frames: list[Frame]) -> float:
    """How well a point of an instrument is in view over the frames: more is better."""
    score = 0.0
    for frame in frames:
        (place,), (depth,) = _project(point[None], frame.state.instruments[name].pose, frame.camera)
        off = np.abs(place / [frame.camera.width, frame.camera.height] - 0.5).max()  # 0.5 at the border
        score += 0.0 if depth <= NEAR else float(off < 0.5) + 0.1 * max(0.0, 1 - off)
    return score


def _draw(
    frame: Frame, capture: Capture, shapes: Mapping[str, RoughShape], axes: Mapping[str, MainAxis], length: float
) -> str:
    pixels = to_bytes(frame.load_image().numpy())
    # drawn at twice the size shown, then shrunk: smooth lines
    camera = _resized(frame.camera, 2 * MAX_WIDTH)
    image = Image.fromarray(pixels).resize((camera.width, camera.height), Image.Resampling.BICUBIC)
    if capture.registered:
        for name, state in frame.state.instruments.items():
            if name in shapes:
                _draw_outline(image, shapes[name], state.pose, camera)
            painter = ImageDraw.Draw(image)
            if name in axes:
                _draw_main_axis(painter, axes[name], state.pose, camera)
            _draw_frame(painter, state.pose, camera, length)
    return jpeg(np.asarray(image))


def _resized(camera: Camera, width: int) -> Camera:
    """The camera of an image scaled to so many px across."""
    scale = width / camera.width
    fx, fy, cx, cy = (scale * value for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    return Camera(camera.world_from_camera, fx, fy, cx, cy, width, round(camera.height * scale))


def _draw_outline(image: Image.Image, shape: RoughShape, pose: Tensor, camera: Camera) -> None:
    """The outline of the shape's points, each as large as the grid cell it stands for."""
    mask = Image.new("L", image.size)
    painter = ImageDraw.Draw(mask)
    for (x, y), z in zip(*_project(shape.points, pose, camera), strict=True):
        radius = 0.75 * shape.spacing * camera.fx / z if z > NEAR else 0.0
        if radius and -radius < x < image.width + radius and -radius < y < image.height + radius:
            painter.ellipse((x - radius, y - radius, x + radius, y + radius), fill=255)
    edge = Image.fromarray(outline(np.asarray(mask) > 0).astype(np.uint8) * 255).filter(ImageFilter.MaxFilter(3))
    image.paste(OUTLINE_COLOR, (0, 0), edge)


def _draw_main_axis(painter: ImageDraw.ImageDraw, axis: MainAxis, pose: Tensor, camera: Camera) -> None:
    pixels, depth = _project(np.linspace(axis.tail, axis.tip, 33), pose, camera)
    visible = [tuple(place) for place, z in zip(pixels, depth, strict=True) if z > NEAR]
    if len(visible) > 1:
        painter.line(visible, fill="#000000", width=7)
        painter.line(visible, fill=MAIN_AXIS_COLOR, width=4)
    if depth[-1] > NEAR:
        x, y = pixels[-1]
        painter.ellipse((x - 10, y - 10, x + 10, y + 10), outline="#000000", width=7)
        painter.ellipse((x - 9, y - 9, x + 9, y + 9), outline=MAIN_AXIS_COLOR, width=4)


def _draw_frame(painter: ImageDraw.ImageDraw, pose: Tensor, camera: Camera, length: float) -> None:
    pixels, depth = _project(np.concatenate([ORIGIN, length * np.eye(3)]), pose, camera)
    if depth[0] <= NEAR:
        return
    x, y = start = tuple(pixels[0])
    for width, colors in ((10, ("#000000",) * 3), (6, AXIS_COLORS)):
        for end, z, color in zip(pixels[1:], depth[1:], colors, strict=True):
            if z > NEAR:
                painter.line([start, tuple(end)], fill=color, width=width)
    painter.ellipse((x - 7, y - 7, x + 7, y + 7), fill="#ffffff", outline="#000000", width=2)


def _project(points: np.ndarray, pose: Tensor, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """[N, 2] px and [N] depth of points [N, 3] of an instrument at `pose`; pixels behind the camera mean nothing."""
    world_from_instrument = pose.numpy()
    world = points @ world_from_instrument[:3, :3].T + world_from_instrument[:3, 3]
    return project_world(world, camera, nearest=NEAR)
