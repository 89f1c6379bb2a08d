"""The report on one ingest, for the page and for scripts, and the verdict on its capture."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from neeco.base.plausible import PLAUSIBLE
from neeco.capture.documents import Problem
from neeco.capture.model import HOW_TO_REGISTER, UNKNOWN_DEG, Capture
from neeco.geometry.lines import frame_about
from neeco.ingest.foreground.rough_shape import RoughShape
from neeco.ingest.frames.images import DropReason
from neeco.ingest.registration.base import BaseRegistration
from neeco.ingest.registration.hand_eye import HAND_EYE, Registration
from neeco.ingest.timing.clock_search import ClockOffset
from neeco.ingest.timing.episodes import Contradiction


@dataclass(frozen=True, kw_only=True)
class IngestResult:
    """Everything about one ingest except the capture (images, cameras, states, points) in `capture`."""

    capture: Path
    recording: str  # description of the source
    video_frames: int
    video_fps: float
    size: tuple[int, int]  # width, height px
    selected: np.ndarray  # [K] indices of the video frames in the capture
    selected_times: np.ndarray  # [K] s, video clock
    dropped: tuple[tuple[int, DropReason], ...]  # video frame, why
    clocks: dict[str, ClockOffset]  # by the clock's name: "em", or a joint's
    registration: Registration | None  # None: instrument poses stay in their tracker's frame
    reprojection_px: float | None  # None: cameras were not found by SfM
    points: int
    shapes: dict[str, RoughShape] = field(default_factory=dict)  # rough shape of each instrument, its own frame
    still: bool = False  # the scope stood still: no cameras were searched
    depth_source: str | None = None  # how a still scope's tissue got its depth, after "the tissue's depth is"
    split_rule: str = ""
    notes: tuple[str, ...] = ()  # losses and assumptions, one sentence each
    search: tuple[str, ...] = ()  # what was tried to find cameras and what was taken, one sentence each
    # camera_from_instrument [K, 4, 4] mm of each instrument before registration: the laparoscope's sensor taken for its
    # camera. NaN where a log has a gap; empty where there was no registration
    unregistered: dict[str, np.ndarray] = field(default_factory=dict)
    # video frame -> [h, w] how often pixels moved
    moving: dict[int, np.ndarray] = field(default_factory=dict)
    registered: bool = True  # instrument poses are in the cameras' world
    bases: dict[str, BaseRegistration] = field(default_factory=dict)  # found from what moves, by instrument
    episodes: dict[str, tuple[int, int]] = field(default_factory=dict)  # frames (first, last) of several recordings
    in_video: tuple[str, ...] = ()  # instruments that nothing tracked, found in the images
    # s of the capture's time at which each of several recordings has its own 0
    episode_starts: dict[str, float] = field(default_factory=dict)
    contradictions: tuple[Contradiction, ...] = ()  # between parts of the recording

    def frame_words(self, frame: int) -> str:
        """Return a video frame's number, with its episode if there are several."""
        name = self._episode_of(frame)
        return f"video frame {frame}" if name is None else f"{name}: video frame {frame - self.episodes[name][0]}"

    def log_times(self, frame: int, seconds: float) -> dict[str, float]:
        """Return the logs' times, s, by clock, of a video frame at `seconds` of the capture's time; with several
        recordings, of the frame's own logs."""
        name = self._episode_of(frame)
        if name is None:
            return {clock: float(ahead.at(np.array(seconds))) for clock, ahead in self.clocks.items()}
        local = seconds - self.episode_starts[name]
        return {
            clock: float(ahead.at(np.array(local)))
            for clock, ahead in self.clocks.items()
            if clock.endswith(f" of {name}")
        }

    def _episode_of(self, frame: int) -> str | None:
        """Return the name of the one of several recordings that holds a video frame."""
        return next((name for name, (first, last) in self.episodes.items() if first <= frame <= last), None)

    def as_json(self) -> dict[str, Any]:
        """Return numbers for scripts (`--json`): mm, degrees, px, s."""
        clocks = {
            name: {
                "offset_s": clock.seconds,
                "sd_s": clock.sd if np.isfinite(clock.sd) else None,  # not known
                "rate": clock.rate,
                "rate_sd": clock.rate_sd,
                "source": clock.source,
            }
            for name, clock in self.clocks.items()
        }
        registration = self.registration and {
            "scale_mm_per_unit": self.registration.scale,
            "scale_sd": self.registration.scale_sd,
            "position_rms_mm": float(np.sqrt(np.mean(self.registration.position_residual**2))),
            "rotation_rms_deg": float(np.degrees(np.sqrt(np.mean(self.registration.rotation_residual**2)))),
            "camera_from_sensor": self.registration.camera_from_sensor.tolist(),
        }
        return {
            "capture": str(self.capture),
            "video_frames": self.video_frames,
            "kept": len(self.selected),
            "dropped": [{"frame": frame, "why": reason.why} for frame, reason in self.dropped],
            "clocks": clocks,
            "registration": registration,
            "reprojection_px": self.reprojection_px,
            "points": self.points,
            "still": self.still,
            "registered": self.registered,
            "episodes": {name: {"first": first, "last": last} for name, (first, last) in self.episodes.items()},
            "bases": {name: base.as_json() for name, base in self.bases.items()},
            "tissue_depth": self.depth_source,
            "split_rule": self.split_rule,
            "notes": list(self.notes),
            "search": list(self.search),
        }

    def lines(self) -> list[str]:
        """Return what was found, for a terminal."""
        numbers = self.as_json()
        lines = [f"{numbers['kept']} of {numbers['video_frames']} video frames kept, {numbers['points']} points"]
        for name, (first, last) in self.episodes.items():
            count = int(((self.selected >= first) & (self.selected <= last)).sum())
            lines.append(f"episode {name}: {count} of {last + 1 - first} frames kept")
        if self.still:
            lines.append(f"still scope: the world is its camera's frame; the tissue's depth is {self.depth_source}")
        if not self.registered:
            lines.append("not registered: instrument poses stay in their tracker's frame")
        elif self.registration is not None:
            fit = numbers["registration"]
            lines.append(f"registered to {fit['position_rms_mm']:.2f} mm, {fit['rotation_rms_deg']:.2f} deg rms")
        lines += [f"clock {name}: {clock} ({clock.source})" for name, clock in self.clocks.items()]
        lines += [f"cameras: {sentence}" for sentence in self.search]
        return lines + [f"note: {note}" for note in self.notes]


@dataclass(frozen=True, kw_only=True)
class VerdictSettings:
    """Limits above which warnings are issued: conventions, not measurements."""

    position_mm: float = 1.0  # RMS position residual of the registration
    rotation_deg: float = 0.5  # RMS rotation residual of the registration
    reprojection_px: float = 1.0
    scale: float = 0.015  # standard deviation of the scale, relative
    clock_mm: float = 0.5  # motion of an instrument within the standard deviation of its clock
    base_mm: float = 2.0  # standard deviation of a base
    base_deg: float = 1.5  # standard deviation of a base's rotation
    severe: float = 3.0  # factor on a limit, above which a capture is doubtful
    min_points: int = 100  # minimum number of tissue points
    min_overlap: float = 0.85  # minimum overlap of a base's outline with what moves: right bases reach 0.92 to 0.97
    min_plausible_overlap: float = 0.7  # minimum overlap; below it, the base is doubtful
    max_shown: int = 5  # maximum number of warnings listed by `lines`
    facts: int = 2  # number of facts of an assessment


LIMITS = VerdictSettings()
VERDICTS = {"good": "good", "careful": "usable", "bad": "doubtful"}
ADVICE = {"good": "good", "careful": "usable", "bad": "do not train"}


@dataclass(frozen=True)
class Assessment:
    """headline: one sentence; warnings: one sentence each, the worst first; facts: the decisive measured values, with
    usual ones."""

    level: Literal["good", "careful", "bad"]
    headline: str
    warnings: tuple[str, ...]
    facts: tuple[str, ...] = ()

    @property
    def conclusion(self) -> str:
        """Advice on training: the facts behind a good verdict; the warnings have those behind another."""
        behind = {"good": "; ".join(self.facts), "careful": "better without what is listed above"}
        return f"{ADVICE[self.level]}: {behind.get(self.level, 'correct what is listed above, and ingest again')}"

    @property
    def others(self) -> list[str]:
        """The warnings that the headline does not state."""
        return [warning for warning in self.warnings if not self.headline.endswith(_lower(warning))]

    def lines(self) -> list[str]:
        """Return the verdict for a terminal: headline (in capitals if doubtful) and the first `max_shown` warnings."""
        verdict, _, rest = self.headline.partition(":")
        more_warnings = self.others
        words = {"good": f"good. {self.headline}", "careful": self.headline, "bad": f"{verdict.upper()}:{rest}"}
        lines = [words[self.level]]
        lines += [f"  - {warning}" for warning in more_warnings[: LIMITS.max_shown]]
        unlisted = len(more_warnings) - LIMITS.max_shown
        return lines + ([f"  - and {unlisted} more warnings"] if unlisted > 0 else [])

    def as_json(self) -> dict[str, Any]:
        """Return the verdict for scripts (`--json`)."""
        verdict = {"verdict": VERDICTS[self.level], "headline": self.headline, "doubts": list(self.warnings)}
        return verdict | {"advice": ADVICE[self.level], "facts": list(self.facts)}


@dataclass(frozen=True)
class _Evidence:
    """Evidence on a capture: a fact, and a warning if it is unusual.

    level: 0 usual, 1 warning, 2 unsuitable for training.
    """

    fact: str
    level: int
    warning: str = ""

    @property
    def reason(self) -> str:
        """The warning, with what is usual."""
        usual = re.search(r"( \(usual: [^()]*\))?$", self.fact)
        assert usual is not None
        return re.sub(r"(\.?)$", lambda end: usual[0] + end[1], self.warning, count=1)

    @classmethod
    def of(cls, text: str, *, severe: bool) -> _Evidence:
        """Evidence without a measured value."""
        begun = text if re.match(r"\S+\.\w+:", text) else text[0].upper() + text[1:]  # a file's name stays
        sentence = begun + ("" if text.endswith((".", "?")) else ".")
        return cls(_lower(sentence).rstrip("."), 2 if severe else 1, sentence)

    @classmethod
    def measured(
        cls, fact: str, value: float, limit: float, warning: str = "", *, usual: str = "", severe: float = LIMITS.severe
    ) -> _Evidence:
        """A measured value that should stay below a limit, and is unsuitable beyond `severe` times that. warning: the
        fact, with `only`, where it is left out."""
        level = 0 if value <= limit else 1 if severe == np.inf or value <= severe * limit else 2
        warning = warning or f"{fact[0].upper()}{fact[1:]} only."
        return cls(f"{fact} (usual: {usual or f'{limit:g}'} or less)", level, warning)


def rms(values: np.ndarray) -> float:
    """Return the root mean square; 0 of nothing."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0


def assess_ingest(result: IngestResult, capture: Capture, problems: Sequence[Problem] = ()) -> Assessment:
    """Assess a finished ingest by its own numbers, contradictions in its recording, and problems that `check` detected
    in its capture; no ground truth is used."""
    grave = [problem for problem in problems if problem.severity == "error" or problem.contradicted]
    evidence = [_Evidence.of(item.sentence, severe=item.severe) for item in result.contradictions]
    evidence += [_Evidence.of(str(problem), severe=True) for problem in grave]
    evidence += _measured(result, capture)
    unusable = sum(not reason.frame_usable for _, reason in result.dropped)
    if unusable > 0.5 * result.video_frames:
        words = f"{unusable} of {result.video_frames} video frames were dropped as unusable."
        evidence.append(_Evidence.of(words, severe=False))
    if result.points < LIMITS.min_points:
        evidence.append(_Evidence.of(f"Only {result.points} tissue points were found.", severe=False))
    evidence += [
        _Evidence.of(f"Clock {name} was neither given nor found: {clock.source}.", severe=False)
        for name, clock in result.clocks.items()
        if not np.isfinite(clock.sd)
    ]
    deviations = [state.uncertainty for frame in capture.frames for state in frame.state.instruments.values()]
    if result.in_video and any(item is not None and item.rotation_deg[2] >= UNKNOWN_DEG for item in deviations):
        words = "The instrument's roll is not known: log it, or pose frames by hand, before training."
        evidence.append(_Evidence.of(words, severe=False))
    minor = [problem for problem in problems if problem not in grave]
    evidence += [_Evidence.of(str(problem), severe=False) for problem in minor]
    if not capture.instruments:
        words = "No instrument was tracked: only methods without states, such as 3dgs, can be trained."
        evidence.append(_Evidence.of(words, severe=False))
    elif not capture.registered:
        words = f"Cameras and instrument do not meet: its poses are in a frame of their own; {HOW_TO_REGISTER}."
        evidence.append(_Evidence.of(words, severe=True))
    ordered = sorted(evidence, key=lambda item: -item.level)
    facts = tuple(item.fact for item in ordered[: LIMITS.facts])
    warnings = tuple(item.reason for item in ordered if item.level)
    worst = ordered[0].level if ordered else 0
    if worst == 2:
        return Assessment("bad", "Doubtful: " + _lower(warnings[0]), warnings, facts)
    if not capture.instruments:
        return Assessment("careful", "Cameras only: there is no instrument to pose.", warnings, facts)
    if worst == 1:
        return Assessment("careful", "Usable, with care: " + _lower(warnings[0]), warnings, facts)
    fit = "no measurement contradicts it" if result.registration is None else "cameras and instrument fit together"
    return Assessment("good", f"Ready to train: {fit}.", (), facts)


def _lower(sentence: str) -> str:
    return sentence[0].lower() + sentence[1:]


def _measured(result: IngestResult, capture: Capture) -> list[_Evidence]:
    """Return the measurements, the most informative first."""
    linked = {item.name for item in capture.instruments if item.kinematics is not None}
    evidence = [item for name, base in result.bases.items() for item in _of_base(name, base, linked=name in linked)]
    registration = result.registration
    if registration is not None:
        position = rms(registration.position_residual)
        agree = f"cameras and laparoscope tracker agree to {position:.2f} mm rms"
        warning = f"Cameras and laparoscope tracker disagree by {position:.2f} mm rms."
        evidence.append(_Evidence.measured(agree, position, LIMITS.position_mm, warning))
    if (pixels := result.reprojection_px) is not None:
        fact = f"tissue points are reprojected to {pixels:.2f} px"
        warning = f"Tissue points are off by {pixels:.2f} px on average in the images they were found in."
        evidence.append(_Evidence.measured(fact, pixels, LIMITS.reprojection_px, warning))
    if registration is not None:
        rotation = float(np.degrees(rms(registration.rotation_residual)))
        agree = f"cameras and laparoscope tracker agree to {rotation:.2f}° rms"
        warning = f"Cameras and laparoscope tracker disagree by {rotation:.2f}° rms."
        evidence.append(_Evidence.measured(agree, rotation, LIMITS.rotation_deg, warning))
        fact, usual = f"lengths are known to {registration.scale_sd:.1%}", f"{LIMITS.scale:.1%}"
        warning = f"Lengths are known to {registration.scale_sd:.1%} only: the scope travelled too little."
        evidence.append(_Evidence.measured(fact, registration.scale_sd, LIMITS.scale, warning, usual=usual))
        # the accuracy of the cameras' positions in the tracker's frame at instruments, except those with estimated
        # bases. Residuals do not show it: if a scope hardly rotates, they are small but extrapolate badly
        places = [
            state.pose[:3, 3].numpy()
            for frame in capture.frames
            for name, state in frame.state.instruments.items()
            if name not in result.bases
        ]
        sds = registration.placement_sd(np.stack(places)) if places else ()
        for sd, unit, limit in zip(sds, (" mm", "°"), (HAND_EYE.placed_mm, HAND_EYE.placed_deg), strict=False):
            fact = f"the place of instruments in the images is known to ±{sd:.1f}{unit}"
            warning = f"{fact[0].upper()}{fact[1:]} only (hand-eye calibration): record more turns of the scope."
            evidence.append(_Evidence.measured(fact, sd, limit, warning, severe=np.inf))
    for name, clock in result.clocks.items():
        moved = clock_cost_mm(name, clock.sd, capture)
        if moved is not None:
            sentence = f"Clock {name} is known to ±{clock.sd * 1000:.0f} ms, up to {moved:.1f} mm of instrument motion."
            evidence.append(_Evidence.measured(_lower(sentence).rstrip("."), moved, LIMITS.clock_mm, sentence))
    train = len(capture.split("train"))
    fact = f"{train} frames to train on (usual: {PLAUSIBLE.few_train_frames} or more)"
    few = train < PLAUSIBLE.few_train_frames
    evidence.append(_Evidence(fact, 2 if few else 0, f"Only {train} frames are left to train on."))
    evidence.append(_Evidence(f"{result.points:,} tissue points (usual: {LIMITS.min_points} or more)", 0))
    return evidence


def _of_base(name: str, base: BaseRegistration, *, linked: bool) -> list[_Evidence]:
    """Return what the images say of a robot's base, or of the place of a tracked instrument, which has to be known as
    well as from a hand-eye calibration.

    linked: its links are stated in its frame, so that every error of the base counts; else a learned shape makes up for
    a constant offset.
    """
    evidence = []
    if np.isfinite(overlap := base.overlap):
        level = 0 if overlap >= LIMITS.min_overlap else 1 if overlap >= LIMITS.min_plausible_overlap else 2
        says = f"the outline of {name} and what moves overlap by {overlap:.2f}"
        warning = f"{says[0].upper()}{says[1:]} only; check its clock."
        evidence.append(_Evidence(f"{says} (usual: {LIMITS.min_overlap:g} or more)", level, warning))
    limit_mm, limit_deg = (
        (HAND_EYE.placed_mm, HAND_EYE.placed_deg) if base.tracked else (LIMITS.base_mm, LIMITS.base_deg)
    )
    quantity = f"the {'place' if base.tracked else 'base'} of {name}"
    measured = [(quantity, "mm", limit_mm, base.sd_mm), (quantity, "deg", limit_deg, base.sd_deg)]
    if base.shaft is not None and linked:
        sd_mm, sd_deg = base.deviations(frame_about(base.shaft).T)
        measured = [
            (f"the place of {name} along its shaft", "mm", limit_mm, sd_mm[2:]),
            (f"the place of {name} across its shaft", "mm", limit_mm, sd_mm[:2]),
            (f"the direction of {name}", "deg", limit_deg, sd_deg),
        ]
    elif np.isfinite(base.sd_motion_mm):
        measured = [(f"the motion of {name}", "mm", limit_mm, np.array(base.sd_motion_mm))]
    for quantity, unit, limit, sds in measured:
        worst = float(np.max(sds))
        size = f"±{worst:.1f} {unit}" if np.isfinite(worst) else f"no {unit}"
        evidence.append(_Evidence.measured(f"{quantity} is known to {size}", worst, limit, severe=np.inf))
    return evidence


def clock_cost_mm(name: str, sd: float, capture: Capture) -> float | None:
    """Return the mm that an instrument moves within a clock's standard deviation, at its 90th percentile of speed.

    None for a joint's clock, and where the deviation is not known.
    """
    if any(name in item.joints for item in capture.instruments) or not capture.instruments or not np.isfinite(sd):
        return None
    fastest = 0.0  # mm/s, of the instruments between consecutive frames
    for item in capture.instruments:
        frames = sorted((f for f in capture.frames if item.name in f.state.instruments), key=lambda f: f.state.time)
        places = np.array([frame.state.instruments[item.name].pose.numpy()[:3, 3] for frame in frames]).reshape(-1, 3)
        steps = np.diff([frame.state.time for frame in frames])
        moved, usable = np.linalg.norm(np.diff(places, axis=0), axis=1), steps > 0
        if usable.any():
            fastest = max(fastest, float(np.quantile(moved[usable] / steps[usable], 0.9)))
    return sd * fastest
