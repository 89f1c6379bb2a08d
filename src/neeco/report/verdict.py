"""What an ingest is worth, in words."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from neeco.capture.model import Capture, Frame
from neeco.ingest.pipeline import IngestResult

# Where the page begins to doubt: conventions, not measurements.
POSITION_MM, ROTATION_DEG, REPROJECTION_PX, SCALE, CLOCK_MM = 1.0, 0.5, 1.0, 0.015, 0.5
SEVERE = 3.0  # times the limit
FEW_TRAIN, FEW_POINTS = 20, 100
USABLE = ("not among the", "beside an unseen frame")  # how reasons begin that do not speak against a frame

Level = Literal["good", "careful", "bad"]


@dataclass(frozen=True)
class Verdict:
    """headline: one sentence; doubts: why it is not better, one sentence each."""

    level: Level
    headline: str
    doubts: tuple[str, ...]


def rms(values: np.ndarray) -> float:
    """Root mean square; 0 of nothing."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0


def give_verdict(result: IngestResult, capture: Capture) -> Verdict:
    """Judge a finished ingest by its own numbers; nothing here knows the truth."""
    severe: list[str] = []
    doubts: list[str] = []
    for value, limit, sentence in _measured(result, capture):
        if value > limit:
            (severe if value > SEVERE * limit else doubts).append(sentence)
    train = len(capture.split("train"))
    if train < FEW_TRAIN:
        severe.append(f"Only {train} frames are left to train on.")
    judged = [why for _, why in result.dropped if not why.startswith(USABLE)]
    if len(judged) > 0.5 * result.video_frames:
        doubts.append(f"{len(judged)} of {result.video_frames} video frames were dropped as unusable.")
    if result.points < FEW_POINTS:
        doubts.append(f"Only {result.points} tissue points were found.")
    doubts += [
        f"Clock {name} was neither given nor found: {clock.source}."
        for name, clock in result.clocks.items()
        if not np.isfinite(clock.sd)
    ]
    if not capture.instruments:
        severe.append("No instrument was tracked: only methods without states, such as 3dgs, can be trained.")
    elif not capture.registered:
        severe.append("The instrument's poses are not in the cameras' frame, so it cannot be drawn where it was.")
    if severe:
        headline = "Doubtful: " + _lower(severe[0]) if capture.instruments and capture.registered else _poor(capture)
        return Verdict("bad", headline, (*severe, *doubts))
    if doubts:
        return Verdict("careful", "Usable, with care: " + _lower(doubts[0]), tuple(doubts))
    if result.registration is None:
        return Verdict("good", "Ready to train: nothing measured speaks against it.", ())
    return Verdict("good", "Ready to train: cameras and instrument fit together.", ())


def _poor(capture: Capture) -> str:
    if not capture.instruments:
        return "Cameras only: there is no instrument to pose."
    return "Cameras and instrument do not meet: instrument poses are in a frame of their own."


def _lower(sentence: str) -> str:
    return sentence[0].lower() + sentence[1:]


def _measured(result: IngestResult, capture: Capture) -> list[tuple[float, float, str]]:
    """(value, limit, what to say when it is above the limit)."""
    judged = []
    if result.reprojection_px is not None:
        said = f"Tissue points are off by {result.reprojection_px:.2f} px on average in the images they were found in."
        judged.append((result.reprojection_px, REPROJECTION_PX, said))
    registration = result.registration
    if registration is not None:
        position = rms(registration.position_residual)
        rotation = float(np.degrees(rms(registration.rotation_residual)))
        judged += [
            (position, POSITION_MM, f"Cameras and laparoscope tracker disagree by {position:.2f} mm rms."),
            (rotation, ROTATION_DEG, f"Cameras and laparoscope tracker disagree by {rotation:.2f}° rms."),
            (
                registration.scale_sd,
                SCALE,
                f"Lengths are known to {registration.scale_sd:.1%} only: the scope travelled too little.",
            ),
        ]
    for name, clock in result.clocks.items():
        moved = clock_cost_mm(name, clock.sd, result, capture)
        if moved is not None:
            said = f"Clock {name} is known to ±{clock.sd * 1000:.0f} ms, up to {moved:.1f} mm of instrument motion."
            judged.append((moved, CLOCK_MM, said))
    return judged


def clock_cost_mm(name: str, sd: float, result: IngestResult, capture: Capture) -> float | None:
    """How far an instrument moves in the clock's standard deviation, at its 90th percentile of speed; None for a
    joint's clock or where it cannot be said."""
    joints = {joint for instrument in capture.instruments for joint in instrument.joints}
    speeds = [instrument_speed(capture, instrument.name) for instrument in capture.instruments]
    if name in joints or not speeds or not np.isfinite(sd):
        return None
    return sd * max(speeds)


def instrument_speed(capture: Capture, name: str) -> float:
    """mm/s, 90th percentile over frames next to each other in time; 0 for fewer than two frames."""
    frames = sorted((frame for frame in capture.frames if name in frame.state.instruments), key=_time)
    if len(frames) < 2:
        return 0.0
    times = np.array([_time(frame) for frame in frames])
    places = np.stack([frame.state.instruments[name].pose.numpy()[:3, 3] for frame in frames])
    steps, moved = np.diff(times), np.linalg.norm(np.diff(places, axis=0), axis=1)
    usable = steps > 0
    return float(np.quantile(moved[usable] / steps[usable], 0.9)) if usable.any() else 0.0


def _time(frame: Frame) -> float:
    return frame.state.time
