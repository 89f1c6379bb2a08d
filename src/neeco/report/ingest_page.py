"""A finished ingest: its verdicts, and the self-contained page on its quality."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neeco.base.errors import counted
from neeco.base.files import finite
from neeco.capture import read_capture
from neeco.capture.checks import inspect_capture
from neeco.capture.documents import Problem, errors_only
from neeco.capture.model import Capture, evenly_spaced
from neeco.ingest.frames.images import StageProgress
from neeco.ingest.pipeline import ingest
from neeco.ingest.recording.model import Recording
from neeco.ingest.result import VERDICTS, Assessment, IngestResult, assess_ingest, clock_cost_mm, rms
from neeco.report import ingest_figures as figures
from neeco.report.page import split_counts, write_page

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
        numbers: dict[str, Any] = finite(self.result.as_json() | self.assessment.as_json())
        return numbers

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
    write_page(
        path,
        "ingest.html",
        title=f"{result.capture.name}: ingest",
        name=result.capture.name,
        subtitle=f"from {result.recording}",
        stamps=[result.capture],
        result=result,
        capture=capture,
        verdict=verdict,
        splits=split_counts(capture),
        second=len(capture.frames) - len(result.selected),  # images of a stereo partner, which are training frames
        in_view=[
            (item.name, figures.in_view(capture, item.name)) for item in capture.instruments if capture.registered
        ],
        registration=registration,
        clocks=_clocks(result, capture),
        **_frames(result, capture),
        **_coverage(capture),
        dropped=_dropped(result),
    )


def _clocks(result: IngestResult, capture: Capture) -> list[list[str]]:
    rows = []
    for name, clock in result.clocks.items():
        sd = f"±{clock.sd * 1000:.1f}" if np.isfinite(clock.sd) and clock.sd > 0 else "–"
        moved = clock_cost_mm(name, clock.sd, capture)
        cost = f"{moved:.2f}" if moved else "–"
        offset = f"{clock.seconds * 1000:+.1f}".replace("-", "−")
        rate = "1" if clock.rate == 1 else f"{clock.rate:.5f} ±{clock.rate_sd:.5f}"
        rows.append([name, offset, sd, rate, cost, clock.source])
    return rows


def _frames(result: IngestResult, capture: Capture) -> dict[str, Any]:
    """Return sample frames as (picture, picture before registration or "", frame, its time, its split), and the legend
    of the overlays."""
    length = figures.axis_length(capture)
    rows = {time: row for row, time in enumerate(np.round(result.selected_times, 6).tolist())}
    start = min(frame.state.time for frame in capture.frames)
    samples, shown_before = [], 0
    in_video = {item.name: item.from_video for item in capture.instruments}
    shafts = {name: video.shaft_diameter_mm for name, video in in_video.items() if video is not None}
    ordered = sorted(capture.frames, key=lambda frame: frame.state.time)
    for frame in (ordered[index] for index in evenly_spaced(len(ordered), figures.SETTINGS.samples)):
        row = rows.get(round(frame.state.time, 6))
        poses = {name: state.pose for name, state in frame.state.instruments.items() if capture.registered}
        before = {}  # world_from_instrument by the trackers alone
        for name, tracked in result.unregistered.items() if row is not None else ():
            if np.isfinite(tracked[row]).all():
                before[name] = frame.camera.world_from_camera.double() @ torch.from_numpy(tracked[row])
        shown_before += any(figures.shows(frame, pose) for pose in before.values())
        samples.append(
            (
                figures.posed_picture(frame, poses, result.shapes, length, shafts),
                figures.posed_picture(frame, before, result.shapes, length, {}) if before else "",
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
        "axis_colors": list(zip("xyz", figures.AXIS_COLORS, strict=True)),
        "shafts": bool(shafts),
        "shaped": any(item.name in result.shapes for item in capture.instruments),
        "shape_color": figures.OUTLINE_COLOR,
    }


def _coverage(capture: Capture) -> dict[str, Any]:
    """Return the range of states: intervals without a training frame, and charts by instrument."""
    degrees = figures.degrees_of_freedom(capture)
    named = [name for name in capture.splits if name in figures.SPLIT_COLORS]
    rest = ", ".join(name for name in capture.splits if name not in named)
    return {
        "degrees": degrees,
        "trained": any(degree.trained is not None for degree in degrees),
        "unvisited": figures.unvisited(degrees),
        "split_colors": [(figures.SPLIT_COLORS[name], name) for name in named] + ([("soft", rest)] if rest else []),
        "instruments": [
            {
                "name": item.name,
                "jointed": bool(item.joints),
                "charts": [figures.histogram(degree) for degree in degrees if degree.instrument == item.name],
            }
            for item in capture.instruments
        ],
    }


def _dropped(result: IngestResult) -> list[list[str]]:
    """Return rows of reason, count and frames; reasons that differ only in a number are merged."""
    groups: dict[str, list[tuple[int, str]]] = {}
    for frame, reason in result.dropped:
        groups.setdefault(_NUMBER.sub("…", reason.why), []).append((frame, reason.why))
    rows = []
    for pattern, members in sorted(groups.items(), key=lambda group: -len(group[1])):
        reasons = {why for _, why in members}
        frames = np.array(sorted(frame for frame, _ in members))
        runs = np.split(frames, np.flatnonzero(np.diff(frames) != 1) + 1)
        ranges = ", ".join(f"{run[0]}" if len(run) == 1 else f"{run[0]}–{run[-1]}" for run in runs)
        rows.append([reasons.pop() if len(reasons) == 1 else pattern, str(len(members)), ranges])
    return rows
