"""The report on one ingest, for the page and for scripts."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from neeco.ingest.foreground.rough_shape import RoughShape
from neeco.ingest.frames.images import DropReason
from neeco.ingest.registration.base import BaseRegistration
from neeco.ingest.registration.hand_eye import Registration
from neeco.ingest.timing.clock_search import ClockOffset
from neeco.ingest.timing.episodes import Contradiction


@dataclass(frozen=True, kw_only=True)
class IngestResult:
    """Everything about one ingest but the capture itself (images, cameras, states, points), which lies at `capture`."""

    capture: Path
    recording: str  # where it came from, in words
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
        """Return a video frame's number, and of several recordings which is meant."""
        name = self._episode_of(frame)
        return f"video frame {frame}" if name is None else f"{name}: video frame {frame - self.episodes[name][0]}"

    def log_times(self, frame: int, seconds: float) -> dict[str, float]:
        """Return the logs' times, s, of a video frame that is taken at `seconds` of the capture's time, by clock: of
        several recordings, those of the frame's own."""
        name = self._episode_of(frame)
        if name is None:
            return {clock: float(ahead.at(np.array(seconds))) for clock, ahead in self.clocks.items()}
        own = seconds - self.episode_starts[name]
        return {
            clock: float(ahead.at(np.array(own)))
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
        shown = [f"{numbers['kept']} of {numbers['video_frames']} video frames kept, {numbers['points']} points"]
        for name, (first, last) in self.episodes.items():
            count = int(((self.selected >= first) & (self.selected <= last)).sum())
            shown.append(f"episode {name}: {count} of {last + 1 - first} frames kept")
        if self.still:
            shown.append(f"still scope: the world is its camera's frame; the tissue's depth is {self.depth_source}")
        if not self.registered:
            shown.append("not registered: instrument poses stay in their tracker's frame")
        elif self.registration is not None:
            fit = numbers["registration"]
            shown.append(f"registered to {fit['position_rms_mm']:.2f} mm, {fit['rotation_rms_deg']:.2f} deg rms")
        shown += [f"clock {name}: {clock} ({clock.source})" for name, clock in self.clocks.items()]
        shown += [f"cameras: {sentence}" for sentence in self.search]
        return shown + [f"note: {note}" for note in self.notes]
