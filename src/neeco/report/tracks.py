"""Where cameras and instruments went, over the tissue's points: two fixed views, and one that can be turned."""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass
from html import escape

import numpy as np

from neeco.capture.model import Capture

WIDTH, HEIGHT, MARGIN = 420, 320, 16  # view box units
SVG_POINTS, CANVAS_POINTS = 1500, 4000
STRAY = 0.01  # share of the points at either end that may lie outside the picture
GAP = 4.0  # median time steps: a longer one breaks the line
RAYS = 10  # cameras drawn with the direction they look in
LINE_CLASSES = ("t-first", "t-second", "t-third")


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


def view(tracks: Tracks, title: str, across: np.ndarray, down: np.ndarray) -> str:
    """An SVG of the tracks seen along across x down; both [3] in the tracks' frame."""
    plane = np.stack([across, down], axis=1).astype(np.float64)  # [3, 2]
    low, high = _extent(tracks, plane)
    scale = min((WIDTH - 2 * MARGIN) / max(high[0] - low[0], 1e-9), (HEIGHT - 3 * MARGIN) / max(high[1] - low[1], 1e-9))
    offset = np.array([WIDTH, HEIGHT + MARGIN]) / 2 - scale * (low + high) / 2

    def place(positions: np.ndarray) -> np.ndarray:
        return scale * (positions @ plane) + offset

    parts = [f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}">']
    parts.append(f'<text class="title" x="12" y="18">{escape(title)}</text>')
    step = -(-len(tracks.points) // SVG_POINTS) or 1
    dots = place(tracks.points[::step])
    inside = ((dots > 0) & (dots < [WIDTH, HEIGHT])).all(axis=1)
    parts.append(f'<path class="t-points" d="{"".join(f"M{x:.0f} {y:.0f}h0" for x, y in dots[inside])}"/>')
    parts.append(f'<path class="t-camera" d="{_line(place(tracks.camera), tracks.breaks)}"/>')
    reach = 0.12 * float(np.linalg.norm(high - low))
    chosen = np.unique(np.linspace(0, len(tracks.camera) - 1, RAYS).round().astype(int))
    ends = place(tracks.camera[chosen] + reach * tracks.looking[chosen])
    rays = "".join(
        f"M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}" for (a, b), (c, d) in zip(place(tracks.camera[chosen]), ends, strict=True)
    )
    parts.append(f'<path class="t-rays" d="{rays}"/>')
    for index, track in enumerate(tracks.instruments.values()):
        line = _line(place(track), tracks.breaks)
        parts.append(f'<path class="{LINE_CLASSES[index % len(LINE_CLASSES)]}" d="{line}"/>')
    length = _round_length(0.25 * (WIDTH - 2 * MARGIN) / scale)
    parts.append(f'<path class="t-scale" d="M{WIDTH - 12 - length * scale:.1f} {HEIGHT - 10}H{WIDTH - 12}"/>')
    parts.append(f'<text x="{WIDTH - 12}" y="{HEIGHT - 16}" text-anchor="end">{length:g} mm</text></svg>')
    return "".join(parts)


def _extent(tracks: Tracks, plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[2] low and high of the picture: all tracks, and the points but for strays."""
    seen = [tracks.camera @ plane, *(track[np.isfinite(track[:, 0])] @ plane for track in tracks.instruments.values())]
    if len(tracks.points):
        seen.append(np.quantile(tracks.points @ plane, [STRAY, 1 - STRAY], axis=0))
    all_of = np.concatenate(seen)
    return all_of.min(axis=0), all_of.max(axis=0)


def _line(places: np.ndarray, breaks: np.ndarray) -> str:
    """An SVG path through [F, 2], interrupted at breaks and where a place is unknown."""
    parts, pen = [], False
    for index, (x, y) in enumerate(places):
        if not np.isfinite(x):
            pen = False
            continue
        if index and breaks[index - 1]:
            pen = False
        parts.append(f"{'L' if pen else 'M'}{x:.1f} {y:.1f}")
        pen = True
    return "".join(parts)


def _round_length(wanted: float) -> float:
    power = 10.0 ** np.floor(np.log10(max(wanted, 1e-9)))
    return float(max(step * power for step in (1, 2, 5) if step * power <= wanted * 1.000001))


def turning_view(tracks: Tracks) -> str:
    """A canvas that turns when it is dragged, with its data and script; without scripts it stays hidden."""
    step = -(-len(tracks.points) // CANVAS_POINTS) or 1
    low, high = _extent(tracks, np.eye(3))
    centre, size = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-9)

    def packed(positions: np.ndarray) -> str:
        """Little-endian int16 of positions in units of size / 16000; unknown ones as -32768."""
        units = np.clip((positions - centre) / size * 16000, -32000, 32000)
        whole = np.where(np.isfinite(units), np.rint(np.nan_to_num(units)), -32768).astype("<i2")
        return base64.b64encode(whole.tobytes()).decode("ascii")

    colors = np.clip(np.rint(tracks.colors[::step] * 255), 0, 255).astype(np.uint8)
    data = {
        "points": packed(tracks.points[::step]),
        "colors": base64.b64encode(colors.tobytes()).decode("ascii"),
        "lines": [packed(tracks.camera), *(packed(track) for track in tracks.instruments.values())],
        "breaks": np.flatnonzero(tracks.breaks).tolist(),
        "names": ["--accent", "--phase", "--good", "--bad"],
    }
    return (
        "<figure class='turning' hidden><canvas></canvas><figcaption>Drag to turn.</figcaption></figure>"
        f"<script>(function () {{ const data = {json.dumps(data)};\n{_SCRIPT}}})();</script>"
    )


_SCRIPT = """
const figure = document.querySelector('.turning'), canvas = figure.querySelector('canvas');
const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0));
const shorts = text => { const b = bytes(text), view = new DataView(b.buffer), out = new Int16Array(b.length / 2);
  for (let i = 0; i < out.length; i++) out[i] = view.getInt16(2 * i, true); return out; };
const points = shorts(data.points), colors = bytes(data.colors), lines = data.lines.map(shorts);
const breaks = new Set(data.breaks);
let yaw = 0.6, pitch = 0.35, held = null, waiting = false;
figure.hidden = false;
function draw() {
  waiting = false;
  const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  canvas.width = width * ratio; canvas.height = height * ratio;
  const pen = canvas.getContext('2d'), style = getComputedStyle(document.documentElement);
  pen.scale(ratio, ratio);
  const zoom = Math.min(width, height) * 0.62 / 16000, cy = Math.cos(yaw), sy = Math.sin(yaw);
  const cp = Math.cos(pitch), sp = Math.sin(pitch);
  const at = (a, i) => { const x = cy * a[i] - sy * a[i + 2], d = sy * a[i] + cy * a[i + 2];
    return [width / 2 + zoom * x, height / 2 + zoom * (cp * a[i + 1] - sp * d)]; };
  for (let i = 0; i < points.length; i += 3) {
    const [x, y] = at(points, i);
    pen.fillStyle = `rgb(${colors[i]},${colors[i + 1]},${colors[i + 2]})`;
    pen.fillRect(x - 1, y - 1, 2, 2);
  }
  lines.forEach((line, index) => {
    pen.strokeStyle = style.getPropertyValue(data.names[index % data.names.length]);
    pen.lineWidth = 1.8; pen.beginPath();
    for (let i = 0, on = false; i < line.length; i += 3) {
      if (line[i] === -32768) { on = false; continue; }
      const [x, y] = at(line, i);
      if (on && !breaks.has(i / 3 - 1)) pen.lineTo(x, y); else pen.moveTo(x, y);
      on = true;
    }
    pen.stroke();
  });
}
const later = () => { if (!waiting) { waiting = true; requestAnimationFrame(draw); } };
canvas.addEventListener('pointerdown', e => { held = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
canvas.addEventListener('pointermove', e => { if (!held) return;
  yaw += (e.clientX - held[0]) * 0.01; pitch += (e.clientY - held[1]) * 0.01;
  pitch = Math.max(-1.5, Math.min(1.5, pitch)); held = [e.clientX, e.clientY]; later(); });
for (const end of ['pointerup', 'pointercancel']) canvas.addEventListener(end, () => { held = null; });
window.addEventListener('resize', later);
matchMedia('(prefers-color-scheme: dark)').addEventListener('change', later);
draw();
"""
