"""Where cameras and instruments went, over the tissue's points: two fixed views, and one that can be turned."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes

from neeco.capture.model import Capture
from neeco.report.charts import PALETTE, draw_dots, inline_svg, new_axes, page_style
from neeco.report.page import to_bytes

WIDTH, HEIGHT, MARGIN = 420, 320, 16  # view box units
SVG_POINTS, CANVAS_POINTS = 1500, 4000
STRAY = 0.01  # share of the points at either end that may lie outside the picture
GAP = 4.0  # median time steps: a longer one breaks the line
RAYS = 10  # cameras drawn with the direction they look in
LINE_COLORS = ("phase", "good", "bad")  # of the instruments; the camera's is accent


@dataclass(frozen=True)
class Tracks:
    """Everything in one frame: x right, y down, z forward as the cameras look on average; mm."""

    points: np.ndarray  # [P, 3]
    colors: np.ndarray  # [P, 3] in [0, 1]
    camera: np.ndarray  # [F, 3] in order of time
    looking: np.ndarray  # [F, 3] unit
    breaks: np.ndarray  # [F - 1] bool: time jumps after this frame
    instruments: dict[str, np.ndarray]  # name -> [F, 3], NaN where a frame lacks it
    measured: bool  # the points are real


def read_tracks(capture: Capture) -> Tracks:
    """The tracks of a capture. Unregistered instruments are left out: their frame is not the cameras'."""
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
        (capture.points.positions.astype(np.float64) - middle) @ axes,
        np.asarray(capture.points.colors, dtype=np.float64),
        (poses[:, :3, 3] - middle) @ axes,
        poses[:, :3, 2] @ axes,
        steps > GAP * max(float(np.median(steps)), 1e-9) if len(steps) else np.zeros(0, dtype=bool),
        instruments,
        capture.points.measured,
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
    """The tracks seen along across x down, as inline SVG; both [3] in the tracks' frame."""
    plane = np.stack([across, down], axis=1).astype(np.float64)  # [3, 2]
    low, high = _extent(tracks, plane)
    scale = min((WIDTH - 2 * MARGIN) / max(high[0] - low[0], 1e-9), (HEIGHT - 3 * MARGIN) / max(high[1] - low[1], 1e-9))
    offset = np.array([WIDTH, HEIGHT + MARGIN]) / 2 - scale * (low + high) / 2

    def place(positions: np.ndarray) -> np.ndarray:
        return scale * (positions @ plane) + offset

    axes = new_axes((WIDTH, HEIGHT), 0, 0, 0, 0)
    axes.set_axis_off()
    axes.set(xlim=(0, WIDTH), ylim=(HEIGHT, 0))
    axes.text(12, 18, title, color=PALETTE["ink"], fontsize=12)
    step = -(-len(tracks.points) // SVG_POINTS) or 1
    dots = place(tracks.points[::step])
    inside = ((dots > 0) & (dots < [WIDTH, HEIGHT])).all(axis=1)
    draw_dots(axes, dots[inside], gid="points", color=PALETTE["soft"], linewidth=1.7, alpha=0.55)
    _draw_line(axes, place(tracks.camera), tracks.breaks, "accent", 1.8)
    chosen = np.unique(np.linspace(0, len(tracks.camera) - 1, RAYS).round().astype(int))
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


def _extent(tracks: Tracks, plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[2] low and high of the picture: all tracks, and the points but for strays."""
    seen = [tracks.camera @ plane, *(track[np.isfinite(track[:, 0])] @ plane for track in tracks.instruments.values())]
    if len(tracks.points):
        seen.append(np.quantile(tracks.points @ plane, [STRAY, 1 - STRAY], axis=0))
    all_of = np.concatenate(seen)
    return all_of.min(axis=0), all_of.max(axis=0)


def _draw_line(axes: Axes, places: np.ndarray, breaks: np.ndarray, color: str, width: float) -> None:
    """A line through [F, 2], interrupted at breaks [F - 1] and where a place is unknown."""
    line = np.insert(places, np.flatnonzero(breaks) + 1, np.nan, axis=0)
    axes.plot(line[:, 0], line[:, 1], color=PALETTE[color], linewidth=width, clip_on=False)


def round_length(wanted: float) -> float:
    """The greatest of 1, 2, 5, 10, 20, ... that is not above `wanted`."""
    power = 10.0 ** np.floor(np.log10(max(wanted, 1e-9)))
    return float(max(step * power for step in (1, 2, 5) if step * power <= wanted * 1.000001))


def turning_data(tracks: Tracks) -> dict[str, object]:
    """What the canvas needs that turns when it is dragged (templates/turning.js)."""
    step = -(-len(tracks.points) // CANVAS_POINTS) or 1
    low, high = _extent(tracks, np.eye(3))
    centre, size = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-9)

    def packed(positions: np.ndarray) -> str:
        """Little-endian int16 of positions in units of size / 16000; unknown ones as -32768."""
        units = np.clip((positions - centre) / size * 16000, -32000, 32000)
        whole = np.where(np.isfinite(units), np.rint(np.nan_to_num(units)), -32768).astype("<i2")
        return base64.b64encode(whole.tobytes()).decode("ascii")

    colors = to_bytes(tracks.colors[::step])
    return {
        "points": packed(tracks.points[::step]),
        "colors": base64.b64encode(colors.tobytes()).decode("ascii"),
        "lines": [packed(tracks.camera), *(packed(track) for track in tracks.instruments.values())],
        "breaks": np.flatnonzero(tracks.breaks).tolist(),
        "names": ["--accent", *(f"--{color}" for color in LINE_COLORS)],
    }
