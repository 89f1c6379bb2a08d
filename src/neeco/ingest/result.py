"""What `ingest` found out, for the page that shows it and for scripts."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from neeco.ingest.clocks import ClockOffset
from neeco.ingest.moving import RoughShape
from neeco.ingest.registration import Registration


@dataclass(frozen=True)
class IngestResult:
    """Everything about one ingest. The capture itself (images, cameras, states, points) is read from `capture`."""

    capture: Path
    recording: str  # where it came from, in words
    video_frames: int
    video_fps: float
    size: tuple[int, int]  # width, height px
    kept: np.ndarray  # [K] indices of the video frames in the capture
    kept_times: np.ndarray  # [K] s, video clock
    dropped: tuple[tuple[int, str], ...]  # video frame, why
    clocks: dict[str, ClockOffset]  # by the clock's name: "em", or a joint's
    registration: Registration | None  # None: instrument poses stay in their tracker's frame
    registered_frames: np.ndarray  # [R] row of `kept` of each entry of `registration.used`; -1: not in the capture
    reprojection_px: float | None  # None: cameras were not found by SfM
    points: int
    shapes: dict[str, RoughShape] = field(default_factory=dict)  # rough shape of each instrument, its own frame
    split_rule: str = ""
    notes: tuple[str, ...] = ()  # what was lost, dropped or doubtful, one sentence each

    def as_json(self) -> dict[str, Any]:
        """Numbers for scripts (`--json`): mm, degrees, px, s."""
        registration = self.registration
        return {
            "capture": str(self.capture),
            "video_frames": self.video_frames,
            "kept": len(self.kept),
            "dropped": [{"frame": frame, "why": why} for frame, why in self.dropped],
            "clocks": {
                name: {
                    "offset_s": clock.seconds,
                    "sd_s": clock.sd if np.isfinite(clock.sd) else None,  # nobody knows
                    "source": clock.source,
                }
                for name, clock in self.clocks.items()
            },
            "registration": None
            if registration is None
            else {
                "scale_mm_per_unit": registration.scale,
                "scale_sd": registration.scale_sd,
                "position_rms_mm": float(np.sqrt(np.mean(registration.position_residual**2))),
                "rotation_rms_deg": float(np.degrees(np.sqrt(np.mean(registration.rotation_residual**2)))),
                "camera_from_sensor": registration.camera_from_sensor.tolist(),
            },
            "reprojection_px": self.reprojection_px,
            "points": self.points,
            "split_rule": self.split_rule,
            "notes": list(self.notes),
        }
