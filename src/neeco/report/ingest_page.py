"""The page that tells how good an ingest is, before anyone trains on it: one file, offline."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neeco.capture import read_capture
from neeco.capture.model import Capture
from neeco.ingest.pipeline import IngestResult
from neeco.report.charts import residual_chart
from neeco.report.coverage import (
    SPLIT_COLORS,
    Degree,
    degrees_of_freedom,
    extrapolations,
    histogram,
    unvisited,
)
from neeco.report.ingest_figures import (
    AXIS_COLORS,
    MAIN_AXIS_COLOR,
    OUTLINE_COLOR,
    MainAxis,
    axis_length,
    in_view,
    main_axes,
    sample_figures,
)
from neeco.report.page import split_counts, write_page
from neeco.report.tracks import LINE_COLORS, read_tracks, turning_data, view
from neeco.report.verdict import clock_cost_mm, give_verdict, rms

_NUMBER = re.compile(r"\d+(?:\.\d+)?")


def write_ingest_page(result: IngestResult, path: Path, capture: Capture | None = None) -> None:
    """Write one HTML file about an ingest: style, pictures, curves and the view in 3D are inside it.

    capture: what lies at `result.capture`, read here unless given. Raises NeecoError when it or one of the images shown
    cannot be read, or the page cannot be written.
    """
    capture = capture or read_capture(result.capture)
    axes = main_axes(capture, result.shapes)
    write_page(
        path,
        "ingest.html",
        title=f"{result.capture.name}: ingest",
        name=result.capture.name,
        subtitle=f"from {result.recording}",
        stamps=[result.capture],
        result=result,
        capture=capture,
        verdict=give_verdict(result, capture),
        splits=split_counts(capture),
        tiles=_tiles(result, capture),
        residuals=_residuals(result),
        clocks=_clocks(result, capture),
        **_frames(result, capture, axes),
        **_tracks(capture),
        **_coverage(capture, axes),
        dropped=_dropped(result),
        facts=_facts(result, capture),
    )


def _tiles(result: IngestResult, capture: Capture) -> list[tuple[str, str]]:
    """(number, what it is) of the few that matter most."""
    tiles = [(f"{len(result.kept)}", f"frames kept of {result.video_frames}")]
    registration = result.registration
    if registration is not None:
        tiles.append((f"{rms(registration.position_residual):.2f} mm", "cameras against tracker, rms"))
        tiles.append((f"{np.degrees(rms(registration.rotation_residual)):.2f}°", "cameras against tracker, rms"))
        tiles.append((f"±{registration.scale_sd:.2%}", "scale of lengths"))
    if result.reprojection_px is not None:
        tiles.append((f"{result.reprojection_px:.2f} px", "reprojection of tissue points"))
    tiles.append((f"{result.points:,}", "tissue points"))
    for instrument in capture.instruments if capture.registered else ():
        inside, count = in_view(capture, instrument.name)
        tiles.append(
            (f"{inside / max(count, 1):.0%}", f"of frames have the tracked origin of {instrument.name} in view")
        )
    return tiles


def _residuals(result: IngestResult) -> list[str]:
    """Charts of how far each camera is from where the laparoscope's tracker puts it."""
    registration = result.registration
    if registration is None:
        return []
    rows = result.registered_frames.astype(int)
    shown = rows >= 0  # frames that helped to register but were left out of the capture afterwards have no row
    times = result.kept_times[rows[shown]] - result.kept_times.min()
    positions, turns = registration.position_residual, np.degrees(registration.rotation_residual)
    return [
        residual_chart(times, positions[shown], "position residual, mm", rms(positions)),
        residual_chart(times, turns[shown], "rotation residual, deg", rms(turns)),
    ]


def _clocks(result: IngestResult, capture: Capture) -> list[list[str]]:
    rows = []
    for name, clock in result.clocks.items():
        sure = f"±{clock.sd * 1000:.1f}" if np.isfinite(clock.sd) and clock.sd > 0 else "–"
        moved = clock_cost_mm(name, clock.sd, result, capture)
        cost = f"{moved:.2f}" if moved else "–"
        offset = f"{clock.seconds * 1000:+.1f}".replace("-", "−")
        rows.append([name, offset, sure, cost, clock.source])
    return rows


def _frames(result: IngestResult, capture: Capture, axes: dict[str, MainAxis]) -> dict[str, Any]:
    """Sample frames as (picture, which frame, its second, its split), and the key to what is drawn over them."""
    length = axis_length(capture)
    numbers = dict(zip(np.round(result.kept_times, 6).tolist(), result.kept.tolist(), strict=True))
    start = min(frame.state.time for frame in capture.frames)
    samples = []
    for picture, frame in sample_figures(capture, result.shapes, axes, length):
        number = numbers.get(round(frame.state.time, 6))
        place = frame.name if number is None else f"video frame {number}"
        samples.append((picture, place, f"{frame.state.time - start:.2f}", frame.split))
    return {
        "samples": samples,
        "axis_mm": f"{length:g}",
        "axis_colors": list(zip("xyz", AXIS_COLORS, strict=True)),
        "shaped": any(name in result.shapes for name in axes),
        "shape_colors": (OUTLINE_COLOR, MAIN_AXIS_COLOR),
    }


def _tracks(capture: Capture) -> dict[str, Any]:
    """Two fixed views of the tracks, what the one that turns needs, and whose line has which colour."""
    tracks = read_tracks(capture)
    right, down, forward = np.eye(3)
    return {
        "views": [
            view(tracks, "from above (away from the camera is up)", right, -forward),
            view(tracks, "from the side (away from the camera is right)", forward, down),
        ],
        "turning": turning_data(tracks),
        "lines": [(LINE_COLORS[index % len(LINE_COLORS)], name) for index, name in enumerate(tracks.instruments)],
        "measured": tracks.measured,
    }


def _coverage(capture: Capture, axes: dict[str, MainAxis]) -> dict[str, Any]:
    """Which states there are: sentences on where training ends, and the charts of every instrument."""
    degrees = degrees_of_freedom(capture, {name: axis.direction for name, axis in axes.items()})
    named = [name for name in capture.splits if name in SPLIT_COLORS]
    others = ", ".join(name for name in capture.splits if name not in named)
    return {
        "degrees": degrees,
        "trained": any(degree.trained is not None for degree in degrees),
        "extrapolations": extrapolations(degrees),
        "unvisited": unvisited(degrees),
        "split_colors": [*((SPLIT_COLORS[name], name) for name in named), *([("soft", others)] if others else [])],
        "instruments": [_instrument(item.name, bool(item.joints), degrees, axes) for item in capture.instruments],
    }


def _instrument(name: str, jointed: bool, degrees: list[Degree], axes: dict[str, MainAxis]) -> dict[str, Any]:
    charts = [histogram(degree) for degree in degrees if degree.instrument == name]
    about = "its long axis" if name in axes else "the z axis of its tracked frame"
    return {"name": name, "jointed": jointed, "about": about, "charts": charts}


def _dropped(result: IngestResult) -> list[list[str]]:
    """Rows of reason, count and frames; reasons that differ in a number only are one."""
    groups: dict[str, list[tuple[int, str]]] = {}
    for frame, why in result.dropped:
        groups.setdefault(_NUMBER.sub("…", why), []).append((frame, why))
    rows = []
    for pattern, members in sorted(groups.items(), key=lambda group: -len(group[1])):
        reasons = {why for _, why in members}
        reason = next(iter(reasons)) if len(reasons) == 1 else pattern
        rows.append([reason, str(len(members)), _ranges(sorted(frame for frame, _ in members))])
    return rows


def _ranges(frames: Sequence[int]) -> str:
    """`3, 7–12, 40` of increasing numbers."""
    runs: list[list[int]] = []
    for frame in frames:
        if runs and frame == runs[-1][1] + 1:
            runs[-1][1] = frame
        else:
            runs.append([frame, frame])
    return ", ".join(f"{first}" if first == last else f"{first}–{last}" for first, last in runs)


def _facts(result: IngestResult, capture: Capture) -> list[tuple[str, str]]:
    width, height = result.size
    facts = [
        ("recording", result.recording),
        ("capture", str(result.capture)),
        ("video", f"{result.video_frames} frames, {width} x {height} px, {result.video_fps:.4g} per second"),
        ("cameras", "given" if result.reprojection_px is None else "found by structure from motion"),
    ]
    registration = result.registration
    if registration is not None:
        lever = ", ".join(f"{value:.1f}" for value in registration.camera_from_sensor[:3, 3])
        facts.append(("scale", f"{registration.scale:.6g} mm per unit of the reconstruction"))
        facts.append(("sensor on the scope", f"at {lever} mm in the camera's frame"))
    for name, shape in result.shapes.items():
        told = f"{len(shape.points):,} points {shape.spacing:.2g} mm apart, {shape.agreement:.0%} of frames agree"
        facts.append((f"shape of {name}", told))
    instruments = ", ".join(_described(item.name, item.joints) for item in capture.instruments) or "none"
    return [*facts, ("instruments", instruments)]


def _described(name: str, joints: Iterable[str]) -> str:
    names = ", ".join(joints)
    return f"{name} ({names})" if names else f"{name} (no joints)"
