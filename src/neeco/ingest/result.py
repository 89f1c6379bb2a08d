"""What an ingest found, for the page and for scripts."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from neeco.ingest.foreground.motion import RoughShape
from neeco.ingest.registration.base import BaseRegistration
from neeco.ingest.registration.hand_eye import Registration
from neeco.ingest.timing.clock_search import ClockOffset
from neeco.ingest.timing.notes import Doubt


@dataclass(frozen=True)
class IngestResult:
    """Everything about one ingest. The capture itself (images, cameras, states, points) is read from `capture`."""

    capture: Path
    recording: str  # where it came from, in words
    video_frames: int
    video_fps: float
    size: tuple[int, int]  # width, height px
    selected: np.ndarray  # [K] indices of the video frames in the capture
    selected_times: np.ndarray  # [K] s, video clock
    dropped: tuple[tuple[int, str], ...]  # video frame, why
    clocks: dict[str, ClockOffset]  # by the clock's name: "em", or a joint's
    registration: Registration | None  # None: instrument poses stay in their tracker's frame
    registered_frames: np.ndarray  # [R] row of `selected` of each entry of `registration.used`; -1: not in the capture
    reprojection_px: float | None  # None: cameras were not found by SfM
    points: int
    shapes: dict[str, RoughShape] = field(default_factory=dict)  # rough shape of each instrument, its own frame
    tissue: str | None = None  # how a still scope's tissue got its depth, after "the tissue's depth is"
    split_rule: str = ""
    notes: tuple[str, ...] = ()  # what was lost, dropped or doubtful, one sentence each
    search: tuple[str, ...] = ()  # what was tried to find cameras and what was taken, one sentence each
    # camera_from_instrument [K, 4, 4] mm of each instrument before registration: the laparoscope's sensor taken for its
    # camera. NaN where a log has a gap; empty where there was no registration
    unregistered: dict[str, np.ndarray] = field(default_factory=dict)
    # video frame -> [h, w] how often pixels were seen to move
    moving: dict[int, np.ndarray] = field(default_factory=dict)
    registered: bool = True  # instrument poses are in the cameras' world
    bases: dict[str, BaseRegistration] = field(default_factory=dict)  # found from what moves, by instrument
    episodes: dict[str, tuple[int, int]] = field(default_factory=dict)  # frames (first, last) of several recordings
    in_video: tuple[str, ...] = ()  # instruments that nothing tracked, found in the images
    # s of the capture's time at which each of several recordings has its own 0
    episode_starts: dict[str, float] = field(default_factory=dict)
    doubts: tuple[Doubt, ...] = ()  # that parts of the recording contradict each other

    @property
    def still(self) -> bool:
        """Whether the scope stood still, so that cameras were not looked for."""
        return self.tissue is not None

    def frame_words(self, frame: int) -> str:
        """What a video frame is called: its number, and of several recordings which is meant."""
        name = self._episode_of(frame)
        return f"video frame {frame}" if name is None else f"{name}: video frame {frame - self.episodes[name][0]}"

    def log_times(self, frame: int, seconds: float) -> dict[str, float]:
        """What the logs' clocks show, s, as a video frame is taken at `seconds` of the capture's time: of several
        recordings, those of the frame's own."""
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
        """The name of the one of several recordings that a video frame is of."""
        return next((name for name, (first, last) in self.episodes.items() if first <= frame <= last), None)

    def as_json(self) -> dict[str, Any]:
        """Numbers for scripts (`--json`): mm, degrees, px, s."""
        clocks = {
            name: {
                "offset_s": clock.seconds,
                "sd_s": clock.sd if np.isfinite(clock.sd) else None,  # nobody knows
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
            "dropped": [{"frame": frame, "why": why} for frame, why in self.dropped],
            "clocks": clocks,
            "registration": registration,
            "reprojection_px": self.reprojection_px,
            "points": self.points,
            "still": self.still,
            "registered": self.registered,
            "episodes": {name: {"first": first, "last": last} for name, (first, last) in self.episodes.items()},
            "bases": {name: base.as_json() for name, base in self.bases.items()},
            "tissue_depth": self.tissue,
            "split_rule": self.split_rule,
            "notes": list(self.notes),
            "search": list(self.search),
        }
