"""The verdict on an ingested capture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from neeco.capture.documents import Problem
from neeco.capture.model import UNKNOWN_DEG, Capture
from neeco.ingest.result import IngestResult
from neeco.plausible import FEW_TRAIN_FRAMES

# Limits above which there is a warning: conventions, not measurements.
POSITION_MM, ROTATION_DEG, REPROJECTION_PX, SCALE, CLOCK_MM = 1.0, 0.5, 1.0, 0.015, 0.5
SEVERE = 3.0  # times the limit
MIN_POINTS = 100
MIN_OVERLAP = 0.8  # of a base's outline with what moves: nine tenths are usual, half is another instrument or time
MIN_PLAUSIBLE_OVERLAP = 0.6
MAX_SHOWN = 5  # warnings listed by `lines`
VERDICTS = {"good": "good", "careful": "usable", "bad": "doubtful"}


@dataclass(frozen=True)
class Assessment:
    """headline: one sentence; warnings: why it is not better, one sentence each, the worst first."""

    level: Literal["good", "careful", "bad"]
    headline: str
    warnings: tuple[str, ...]

    def lines(self) -> list[str]:
        """Return the verdict for a terminal: headline (in capitals if doubtful) and the first MAX_SHOWN warnings."""
        verdict, _, rest = self.headline.partition(":")
        words = {"good": f"good. {self.headline}", "careful": self.headline, "bad": f"{verdict.upper()}:{rest}"}
        shown = [words[self.level]]
        others = [warning for warning in self.warnings if not self.headline.endswith(_lower(warning))]
        shown += [f"  - {warning}" for warning in others[:MAX_SHOWN]]
        return shown + ([f"  - and {len(others) - MAX_SHOWN} more warnings"] if len(others) > MAX_SHOWN else [])

    def as_json(self) -> dict[str, Any]:
        """Return the verdict for scripts (`--json`)."""
        return {"verdict": VERDICTS[self.level], "headline": self.headline, "doubts": list(self.warnings)}


def rms(values: np.ndarray) -> float:
    """Return the root mean square; 0 of nothing."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0


def assess_ingest(result: IngestResult, capture: Capture, problems: Sequence[Problem] = ()) -> Assessment:
    """Judge a finished ingest by its own numbers, by contradictions in its recording, and by the problems that `check`
    found in its capture; nothing here knows the truth."""
    severe = [_sentence(item.sentence) for item in result.contradictions if item.severe]
    grave = [problem for problem in problems if problem.severity == "error" or problem.contradicted]
    severe += [_sentence(str(problem)) for problem in grave]
    mild = [_sentence(item.sentence) for item in result.contradictions if not item.severe]
    for value, limit, sentence in _measured(result, capture):
        if value > limit:
            (severe if value > SEVERE * limit else mild).append(sentence)
    for name, base in result.bases.items():
        if base.overlap < MIN_OVERLAP:
            sentence = f"The outline of {name} and what moves overlap by {base.overlap:.2f} only: is its clock right?"
            (severe if base.overlap < MIN_PLAUSIBLE_OVERLAP else mild).append(sentence)
    train = len(capture.split("train"))
    if train < FEW_TRAIN_FRAMES:
        severe.append(f"Only {train} frames are left to train on.")
    unusable = sum(not reason.frame_usable for _, reason in result.dropped)
    if unusable > 0.5 * result.video_frames:
        mild.append(f"{unusable} of {result.video_frames} video frames were dropped as unusable.")
    if result.points < MIN_POINTS:
        mild.append(f"Only {result.points} tissue points were found.")
    mild += [
        f"Clock {name} was neither given nor found: {clock.source}."
        for name, clock in result.clocks.items()
        if not np.isfinite(clock.sd)
    ]
    if result.in_video and not _rolls_known(capture):
        mild.append("The instrument's roll is not known: log it, or pose frames by hand, before training.")
    mild += [_sentence(str(problem)) for problem in problems if problem not in grave]
    if not capture.instruments:
        mild.append("No instrument was tracked: only methods without states, such as 3dgs, can be trained.")
        if not severe:
            return Assessment("careful", "Cameras only: there is no instrument to pose.", tuple(mild))
    elif not capture.registered:
        severe.append(
            "Cameras and instrument do not meet: instrument poses are in a frame of their own, so that it cannot be "
            "rendered where it was."
        )
    if severe:
        return Assessment("bad", "Doubtful: " + _lower(severe[0]), (*severe, *mild))
    if mild:
        return Assessment("careful", "Usable, with care: " + _lower(mild[0]), tuple(mild))
    fit = "no measurement contradicts it" if result.registration is None else "cameras and instrument fit together"
    return Assessment("good", f"Ready to train: {fit}.", ())


def _sentence(text: str) -> str:
    return text[0].upper() + text[1:] + ("" if text.endswith((".", "?")) else ".")


def _rolls_known(capture: Capture) -> bool:
    """Return whether every state's roll has a standard deviation below UNKNOWN_DEG."""
    deviations = [state.uncertainty for frame in capture.frames for state in frame.state.instruments.values()]
    return all(item is None or item.rotation_deg[2] < UNKNOWN_DEG for item in deviations)


def _lower(sentence: str) -> str:
    return sentence[0].lower() + sentence[1:]


def _measured(result: IngestResult, capture: Capture) -> list[tuple[float, float, str]]:
    """Return (value, limit, sentence for a value above the limit)."""
    measured = []
    if (pixels := result.reprojection_px) is not None:
        sentence = f"Tissue points are off by {pixels:.2f} px on average in the images they were found in."
        measured.append((pixels, REPROJECTION_PX, sentence))
    registration = result.registration
    if registration is not None:
        position = rms(registration.position_residual)
        rotation = float(np.degrees(rms(registration.rotation_residual)))
        scale = registration.scale_sd
        measured += [
            (position, POSITION_MM, f"Cameras and laparoscope tracker disagree by {position:.2f} mm rms."),
            (rotation, ROTATION_DEG, f"Cameras and laparoscope tracker disagree by {rotation:.2f}° rms."),
            (scale, SCALE, f"Lengths are known to {scale:.1%} only: the scope travelled too little."),
        ]
    for name, clock in result.clocks.items():
        moved = clock_cost_mm(name, clock.sd, capture)
        if moved is not None:
            sentence = f"Clock {name} is known to ±{clock.sd * 1000:.0f} ms, up to {moved:.1f} mm of instrument motion."
            measured.append((moved, CLOCK_MM, sentence))
    return measured


def clock_cost_mm(name: str, sd: float, capture: Capture) -> float | None:
    """Return the mm that an instrument moves within a clock's standard deviation, at its 90th percentile of speed.

    None for a joint's clock, and where the deviation is not known.
    """
    joints = {joint for instrument in capture.instruments for joint in instrument.joints}
    speeds = [instrument_speed(capture, instrument.name) for instrument in capture.instruments]
    if name in joints or not speeds or not np.isfinite(sd):
        return None
    return sd * max(speeds)


def instrument_speed(capture: Capture, name: str) -> float:
    """Return the 90th percentile of an instrument's speed between consecutive frames, mm/s; 0 for fewer than two."""
    frames = sorted((f for f in capture.frames if name in f.state.instruments), key=lambda frame: frame.state.time)
    if len(frames) < 2:
        return 0.0
    steps = np.diff([frame.state.time for frame in frames])
    places = np.stack([frame.state.instruments[name].pose.numpy()[:3, 3] for frame in frames])
    moved, usable = np.linalg.norm(np.diff(places, axis=0), axis=1), steps > 0
    return float(np.quantile(moved[usable] / steps[usable], 0.9)) if usable.any() else 0.0
