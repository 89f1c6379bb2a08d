"""Verdicts of the images on cameras and instruments.

A mistake is named only where the images agree clearly better without it. Where they contradict what is recorded and no
candidate explains it, only the contradiction is reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.capture.checks.candidates import (
    Candidate,
    camera_candidates,
    instrument_candidates,
    likeliest,
    offset_candidates,
    resampled,
)
from neeco.capture.checks.evidence import ColorEvidence, MotionEvidence
from neeco.capture.checks.pictures import Picture
from neeco.capture.checks.settings import SETTINGS
from neeco.capture.documents import errors_only, printable
from neeco.capture.model import Instrument
from neeco.capture.readers.parsed import Parsed

STATES, POSES = "frames[*].instruments[*]", "frames[*].instruments[*].pose"


class Verdict(NamedTuple):
    """Verdict on cameras or an instrument's states, with the fault that the images contradict."""

    status: Literal["undecided", "supported", "contradicted"]
    field: str = ""
    message: str = ""
    remedy: str = ""
    wrong_poses: bool = False  # the fault is a named mistake in poses

    @classmethod
    def of(cls, mistake: Candidate, poses_field: str, field: str) -> Verdict:
        wrong_poses = mistake.kind in ("pose", "rotation", "unit")
        place = poses_field if wrong_poses else field
        return cls("contradicted", place, mistake.message, mistake.remedy, wrong_poses)


class ImageVerdicts:
    """Verdicts on a capture. There are none while it has errors, nor on instruments where the images contradict the
    cameras."""

    def __init__(self, parsed: Parsed, pictures: Sequence[Picture]) -> None:
        self.parsed, self.pictures = parsed, pictures
        self._instruments: dict[str, Verdict] = {}  # by name, of those that were asked for

    def report(self) -> None:
        """Report all contradictions as warnings."""
        for verdict in (self.cameras, *map(self.instrument, self.parsed.instruments)):
            if verdict.status == "contradicted":
                self.parsed.header(verdict.field).warning(verdict.message, verdict.remedy, contradicted=True)

    @cached_property
    def cameras(self) -> Verdict:
        """Images and cameras belong together, by the sparse points' colours."""
        has_errors = bool(errors_only(self.parsed.places[0].report.problems))
        colors = None if has_errors else ColorEvidence.of(self.parsed, self.pictures)
        if colors is None:
            return Verdict("contradicted" if has_errors else "undecided")
        fine = float(colors.recorded.mean())
        candidates = list(offset_candidates(colors.all_cameras.poses, colors.rows))
        candidates += camera_candidates(colors.cameras.poses) if fine < SETTINGS.good_colors else []
        if (mistake := likeliest(candidates, colors)) is not None:
            return Verdict.of(mistake, "frames[*].transform_matrix", "frames")
        coarse = float(colors.agreement(coarse=True).mean())
        if fine < SETTINGS.contradicted_colors and coarse < SETTINGS.contradicted_coarsely:
            message = (
                "the images contradict the cameras: sparse points do not have the colours of the pixels they project "
                f"to (correlation {fine:.2f})"
            )
            remedy = "images, cameras, intrinsics and points must be of one recording, in one order, and nothing turned"
            return Verdict("contradicted", "frames", message, remedy)
        given, swapped = (colors.color_difference(order) for order in ((0, 1, 2), (2, 1, 0)))
        if swapped < SETTINGS.max_swapped * given:
            message = f"(they differ by {given:.0f} of 255, swapped by {swapped:.0f})"
            message = f"red and blue of the images are swapped against the sparse points' {message}"
            return Verdict("contradicted", "frames", message, "write both as RGB (OpenCV reads and writes BGR)")
        return Verdict("supported")

    @cached_property
    def _motion(self) -> MotionEvidence | None:
        contradicted = self.cameras.status == "contradicted"
        return None if contradicted else MotionEvidence.of(self.parsed, self.pictures)

    def instrument(self, instrument: Instrument) -> Verdict:
        """The instrument is where its states say, by what moves in the images. All frames must have its state."""
        if instrument.name not in self._instruments:
            self._instruments[instrument.name] = self._find(instrument)
        return self._instruments[instrument.name]

    def _find(self, instrument: Instrument) -> Verdict:
        poses = dict(self._poses)
        found = poses.pop(instrument.name)
        if found is None or self._motion is None:
            return Verdict("undecided")
        rows, (recorded, root_from_recorded) = self._motion.rows, found
        roots = recorded @ root_from_recorded
        others = [(other[0] @ other[1])[rows] for other in poses.values() if other is not None]
        motion = self._motion.without(others, roots[rows])
        if motion is None:
            return Verdict("undecided")
        name, motion = printable(instrument.name), motion.with_recorded(roots[rows])
        if (mistake := self._mistake(name, recorded, root_from_recorded, motion)) is not None:
            return Verdict.of(mistake, POSES, STATES)
        evidence = motion.mean(roots[rows])
        if evidence > SETTINGS.contradicted_poses:
            return Verdict("supported")
        by_chance = motion.by_chance(roots[rows])
        factor = SETTINGS.by_chance_few if len(rows) < SETTINGS.few_frames else SETTINGS.by_chance
        mostly_others = len(motion.ray_views) < len(self._motion.ray_views) / 2  # these explain most of what moves
        if evidence > factor * by_chance or mostly_others or motion.travel(roots[rows]) < SETTINGS.min_travel:
            return Verdict("undecided")
        message = (
            f"the images contradict the poses of {name}: what moves in them does not lie where the poses say (evidence "
            f"{evidence:.2f}, {by_chance:.2f} by chance)"
        )
        remedy = "shifts, other axes, frames and units were tried; states, cameras and images must be of one recording"
        return Verdict("contradicted", POSES, message, remedy)

    @cached_property
    def _poses(self) -> dict[str, tuple[np.ndarray, np.ndarray] | None]:
        """Recorded poses [N, 4, 4] of each instrument, and what makes them those of the root [N, 4, 4], which shows
        most; None where a frame has no state."""
        return {instrument.name: self._poses_of(instrument) for instrument in self.parsed.instruments}

    def _poses_of(self, instrument: Instrument) -> tuple[np.ndarray, np.ndarray] | None:
        name, tree = instrument.name, instrument.kinematics
        if not all(name in frame.state.instruments for frame in self.parsed.frames):
            return None
        states = [frame.state.instruments[name] for frame in self.parsed.frames]
        back = [np.eye(4) if tree is None else tree.world_from_root(np.eye(4), state.joints) for state in states]
        return np.stack([state.pose.numpy() for state in states]), np.stack(back)

    def _mistake(self, name: str, recorded: np.ndarray, back: np.ndarray, motion: MotionEvidence) -> Candidate | None:
        """The mistake in the poses [N, 4, 4] of an instrument that the images confirm."""
        rows, roots = motion.rows, recorded @ back
        turns = Rotation.from_matrix(roots[rows, :3, :3])
        turning = np.degrees(np.sqrt(((turns.mean().inv() * turns).magnitude() ** 2).mean()))
        candidates = [
            replace(candidate, poses=candidate.poses @ back[rows])
            for candidate in instrument_candidates(recorded[rows], motion.cameras.poses, name)
            if candidate.kind != "rotation" or turning >= SETTINGS.min_turning_deg
        ]
        times = np.array([frame.state.time for frame in self.parsed.frames])
        at = partial(resampled, roots, rows, times, name)
        longest = int(len(times) * SETTINGS.max_shift)
        every = max(1, 2 * longest // SETTINGS.max_shifts)
        candidates += [at(steps=steps) for steps in range(-longest, longest + 1, every) if steps]
        candidates += [at(rate=rate) for rate in np.geomspace(*SETTINGS.rates) if rate != 1]
        best = likeliest(candidates, motion)
        if best is None or not best.steps:
            return best
        near = range(best.steps - SETTINGS.shift_radius, best.steps + SETTINGS.shift_radius + 1)
        shifts = [at(steps=steps) for steps in near if steps]
        common = np.prod([shift.available for shift in shifts if shift.available is not None], axis=0, dtype=bool)
        agreement = [motion.mean(shift.poses, common) for shift in shifts if shift.poses is not None]
        best = shifts[int(np.argmax(agreement))] if max(agreement) > 0 else best
        # at the end of the range that was tried another shift may be the right one
        return None if abs(best.steps) >= longest else best
