"""The page that tells how good an ingest is, before anyone trains on it: one file, offline."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from datetime import datetime
from html import escape
from pathlib import Path

import numpy as np

import neeco
from neeco.capture import read_capture
from neeco.capture.model import Capture
from neeco.files import write_text
from neeco.ingest.result import IngestResult
from neeco.report.coverage import Degree, degrees_of_freedom, extrapolations, histogram, unvisited
from neeco.report.ingest_figures import MainAxis, axis_length, in_view, main_axes, sample_figures
from neeco.report.ingest_style import INGEST_STYLE
from neeco.report.residuals import scatter
from neeco.report.style import STYLE, html_page
from neeco.report.tracks import read_tracks, turning_view, view
from neeco.report.verdict import clock_cost_mm, give_verdict, rms

_NUMBER = re.compile(r"\d+(?:\.\d+)?")


def write_ingest_page(result: IngestResult, path: Path, capture: Capture | None = None) -> None:
    """Write one HTML file about an ingest: style, pictures, curves and the view in 3D are inside it.

    capture: what lies at `result.capture`, read here unless given. Raises NeecoError when it or one of the images shown
    cannot be read, or the page cannot be written.
    """
    capture = capture or read_capture(result.capture)
    axes = main_axes(capture, result.shapes)
    degrees = degrees_of_freedom(capture, {name: axis.direction for name, axis in axes.items()})
    sections = [
        _header(result, capture),
        _tiles(result, capture),
        _residuals(result),
        _clocks(result, capture),
        _frames(result, capture, axes),
        _tracks(result, capture),
        _coverage(result, capture, degrees, axes),
        _dropped(result),
        _notes(result),
        _made(result, capture),
    ]
    write_text(path, html_page(f"{capture.root.name}: ingest", STYLE + INGEST_STYLE, sections))


def _header(result: IngestResult, capture: Capture) -> str:
    verdict = give_verdict(result, capture)
    doubts = "".join(f"<li>{escape(doubt)}</li>" for doubt in verdict.doubts)
    splits = ", ".join(f"{len(capture.split(name))} {escape(name)}" for name in capture.splits)
    return (
        f"<header><h1>{escape(capture.root.name)} <span class='soft'>from {escape(result.recording)}</span></h1>"
        f"<p class='verdict {verdict.level}'><b>{escape(verdict.headline)}</b></p>"
        + (f"<ul class='note'>{doubts}</ul>" if doubts else "")
        + f"<p>{len(result.kept)} of {result.video_frames} video frames became the capture ({splits}). Every number "
        "below compares parts of the recording with each other; none of them knows the truth.</p>"
        f"<p class='soft'>{datetime.now().astimezone():%Y-%m-%d %H:%M %Z} · neeco {escape(neeco.__version__)} · "
        f"{escape(str(result.capture))}</p></header>"
    )


def _tiles(result: IngestResult, capture: Capture) -> str:
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
    cells = "".join(f"<div class='tile'><b>{value}</b><span>{escape(name)}</span></div>" for value, name in tiles)
    return f"<div class='tiles'>{cells}</div>"


def _residuals(result: IngestResult) -> str:
    if result.registration is None:
        if result.reprojection_px is None:
            return ""
        return (
            "<h2>Registration</h2><p>There is none: no laparoscope was tracked, or the two could not be tied together "
            "(see the notes). Cameras have the reconstruction's own frame and unit; the tracker has another.</p>"
        )
    registration = result.registration
    rows = result.registered_frames.astype(int)
    shown = rows >= 0  # frames that helped to register but were left out of the capture afterwards have no row
    times = result.kept_times[rows[shown]] - result.kept_times.min()
    positions, turns = registration.position_residual, np.degrees(registration.rotation_residual)
    charts = scatter(times, positions[shown], "position residual, mm", rms(positions))
    charts += scatter(times, turns[shown], "rotation residual, deg", rms(turns))
    return (
        "<h2>Registration</h2><p>Where the laparoscope's tracker puts each camera, against where the images put it, "
        "after one similarity, hand-eye transform and clock offset for the whole recording. Even scatter is the "
        "tracker's noise; a slow wave is its drift or a bent scale; single spikes are frames to distrust.</p>"
        f"<div class='curves'>{charts}</div><p class='soft'>Over seconds since the first frame; the line is the root "
        "mean square.</p>"
    )


def _clocks(result: IngestResult, capture: Capture) -> str:
    if not result.clocks:
        return ""
    rows = []
    for name, clock in result.clocks.items():
        sure = f"±{clock.sd * 1000:.1f}" if np.isfinite(clock.sd) and clock.sd > 0 else "–"
        moved = clock_cost_mm(name, clock.sd, result, capture)
        cost = f"{moved:.2f}" if moved else "–"
        offset = f"{clock.seconds * 1000:+.1f}".replace("-", "−")
        rows.append(
            f"<tr><td>{escape(name)}</td><td>{offset}</td><td>{sure}</td><td>{cost}</td><td>{escape(clock.source)}</td></tr>"
        )
    return (
        "<h2>Clocks</h2><p>How far each log's clock is ahead of the video's. What the doubt costs is how far the "
        "instrument travels in that time when it is fast (90th percentile of its speed); a dash: nobody knows.</p>"
        "<div class='scroll'><table><thead><tr><th>clock</th><th>ahead, ms</th><th>sd, ms</th><th>costs, mm</th>"
        f"<th>from</th></tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
    )


def _frames(result: IngestResult, capture: Capture, axes: dict[str, MainAxis]) -> str:
    length = axis_length(capture)
    figures = sample_figures(capture, result.shapes, axes, length)
    numbers = dict(zip(np.round(result.kept_times, 6).tolist(), result.kept.tolist(), strict=True))
    cells, start = [], min(frame.state.time for frame in capture.frames)
    for figure in figures:
        number = numbers.get(round(figure.frame.state.time, 6))
        place = figure.frame.name if number is None else f"video frame {number}"
        cells.append(
            f"<figure><img src='{figure.picture}' alt='{escape(place)}'><figcaption>{escape(place)}, "
            f"{figure.frame.state.time - start:.2f} s <span class='tag'>{escape(figure.frame.split)}</span>"
            "</figcaption></figure>"
        )
    return f"<h2>Frames</h2>{_frames_key(result, capture, axes, length)}<div class='samples'>{''.join(cells)}</div>"


def _frames_key(result: IngestResult, capture: Capture, axes: dict[str, MainAxis], length: float) -> str:
    if not capture.instruments:
        return "<p>No instrument was tracked, so nothing is drawn over the frames.</p>"
    if not capture.registered:
        return "<p>The instrument's poses are not in the cameras' frame, so nothing can be drawn over the frames.</p>"
    drawn = [
        f"Each tracked frame has its axes drawn, {length:g} mm long: "
        "<span class='key'><i class='x'></i>x<i class='y'></i>y<i class='z'></i>z</span>. They should ride on the "
        "instrument in every picture, always at the same place of it."
    ]
    if any(name in result.shapes for name in axes):
        drawn.append(
            "<span class='key'><i class='shape'></i>outline</span> of the rough shape that the images' motion gave, "
            "and its <span class='key'><i class='main'></i>long axis</span> with the tip circled (of its two ends, the "
            "one more often in view)."
        )
    else:
        drawn.append("The instrument's rough shape was not found in the images.")
    return f"<p>{' '.join(drawn)}</p>"


def _tracks(result: IngestResult, capture: Capture) -> str:
    tracks = read_tracks(capture)
    right, down, forward = np.eye(3)
    names = ["<i class='camera'></i>camera, and where it looks"]
    names += [f"<i class='line{index % 3}'></i>{escape(name)}" for index, name in enumerate(tracks.instruments)]
    notes = "" if tracks.measured else " The points are random stand-ins: none were measured."
    if result.registration is None and result.reprojection_px is not None:
        notes += " No tracker gives the scale, so lengths here are proportions only."
    if capture.instruments and not capture.registered:
        notes += " The instrument is left out: its poses are in another frame."
    return (
        "<h2>Tracks</h2><p>The tissue's points with the tracks, as the cameras stand on average."
        f"{notes}</p><p class='soft key'>{''.join(names)}</p><div class='curves'>"
        + view(tracks, "from above (away from the camera is up)", right, -forward)
        + view(tracks, "from the side (away from the camera is right)", forward, down)
        + f"{turning_view(tracks)}</div>"
    )


def _coverage(result: IngestResult, capture: Capture, degrees: list[Degree], axes: dict[str, MainAxis]) -> str:
    if not degrees:
        return (
            "<h2>States</h2><p>There are no instrument states: only methods that need none, such as 3dgs, can be "
            "trained, and nothing can be drawn in a new state.</p>"
        )
    parts = ["<h2>States</h2>", _extrapolating(degrees), _splits_key(capture, result.split_rule)]
    for instrument in capture.instruments:
        charts = "".join(histogram(degree) for degree in degrees if degree.instrument == instrument.name)
        if not charts:
            continue
        about = "its long axis" if instrument.name in axes else "the z axis of its tracked frame"
        where = "in the cameras' world" if capture.registered else "in the tracker's frame"
        parts.append(
            f"<h3>{escape(instrument.name)}</h3><p class='soft'>Position {where}; pitch, yaw and roll away from the "
            f"mean direction of the training frames, roll about {about}."
            f"{'' if instrument.joints else ' No joint was read.'}</p><div class='histograms'>{charts}</div>"
        )
    return "".join(parts)


def _extrapolating(degrees: list[Degree]) -> str:
    if all(degree.trained is None for degree in degrees):
        return "<p class='verdict bad'>There is no training frame: the model would be extrapolating everywhere.</p>"
    said = extrapolations(degrees)
    holes = unvisited(degrees)
    sentence = (
        "The model will be extrapolating wherever a state to draw leaves the range of its training frames (ground that "
        "is shaded below). "
    )
    if said:
        sentence += "Frames of this capture's own test splits do:"
    else:
        sentence += "No frame of this capture's other splits does, so nothing here will tell how well it extrapolates."
    listing = "".join(f"<li>{escape(item)}</li>" for item in said)
    text = f"<p>{sentence}</p>" + (f"<ul class='note'>{listing}</ul>" if said else "")
    if holes:
        listing = "".join(f"<li>{escape(item)}</li>" for item in holes)
        text += (
            "<p>Inside the range it will have to bridge these stretches without a training frame:</p>"
            f"<ul class='note'>{listing}</ul>"
        )
    return text


def _splits_key(capture: Capture, rule: str) -> str:
    shown = [name for name in capture.splits if name in ("train", "test", "unseen")]
    items = "".join(f"<i class='s-{name}'></i>{name}" for name in shown)
    if len(shown) < len(capture.splits):
        others = ", ".join(name for name in capture.splits if name not in shown)
        items += f"<i class='s-other'></i>{escape(others)}"
    return f"<p class='soft key'>{items}</p>" + (f"<p class='soft'>Splits: {escape(rule)}.</p>" if rule else "")


def _dropped(result: IngestResult) -> str:
    if not result.dropped:
        return "<h2>Dropped</h2><p>Nothing: every video frame is in the capture.</p>"
    groups: dict[str, list[tuple[int, str]]] = {}
    for frame, why in result.dropped:
        groups.setdefault(_NUMBER.sub("…", why), []).append((frame, why))
    rows = []
    for pattern, members in sorted(groups.items(), key=lambda group: -len(group[1])):
        reasons = {why for _, why in members}
        reason = next(iter(reasons)) if len(reasons) == 1 else pattern
        frames = _ranges(sorted(frame for frame, _ in members))
        rows.append(f"<tr><td>{escape(reason)}</td><td>{len(members)}</td><td class='wide'>{frames}</td></tr>")
    return (
        f"<h2>Dropped</h2><p>{len(result.dropped)} of {result.video_frames} video frames are not in the capture.</p>"
        "<div class='scroll'><table class='dropped'><thead><tr><th>why</th><th>frames</th><th class='wide'>which</th>"
        f"</tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
    )


def _ranges(frames: Sequence[int]) -> str:
    """`3, 7–12, 40` of increasing numbers."""
    runs: list[list[int]] = []
    for frame in frames:
        if runs and frame == runs[-1][1] + 1:
            runs[-1][1] = frame
        else:
            runs.append([frame, frame])
    return ", ".join(f"{first}" if first == last else f"{first}–{last}" for first, last in runs)


def _notes(result: IngestResult) -> str:
    if not result.notes:
        return ""
    return "<h2>Notes</h2><ul class='note'>" + "".join(f"<li>{escape(note)}</li>" for note in result.notes) + "</ul>"


def _made(result: IngestResult, capture: Capture) -> str:
    width, height = result.size
    facts = [
        ("recording", result.recording),
        ("capture", str(result.capture)),
        ("video", f"{result.video_frames} frames, {width} x {height} px, {result.video_fps:.4g} per second"),
        ("cameras", "given" if result.reprojection_px is None else "found by structure from motion"),
    ]
    registration = result.registration
    if registration is not None:
        lever = registration.camera_from_sensor[:3, 3]
        facts.append(("scale", f"{registration.scale:.6g} mm per unit of the reconstruction"))
        facts.append(
            ("sensor on the scope", "at " + ", ".join(f"{value:.1f}" for value in lever) + " mm in the camera's frame")
        )
    for name, shape in result.shapes.items():
        facts.append(
            (
                f"shape of {name}",
                f"{len(shape.points):,} points {shape.spacing:.2g} mm apart, {shape.agreement:.0%} of frames agree",
            )
        )
    facts.append(
        ("instruments", ", ".join(_described(item.name, item.joints) for item in capture.instruments) or "none")
    )
    items = "".join(f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in facts)
    return f"<h2>How it was made</h2><dl class='made'>{items}</dl>"


def _described(name: str, joints: Iterable[str]) -> str:
    names = ", ".join(joints)
    return f"{name} ({names})" if names else f"{name} (no joints)"
