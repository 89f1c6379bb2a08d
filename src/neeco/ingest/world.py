"""One world of an ingest: cameras, tissue and instruments, found by a still or a moving scope."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from neeco.capture.model import PointCloud
from neeco.ingest.cameras.still_scene import RightCamera
from neeco.ingest.foreground.residual_flow import ResidualFlow
from neeco.ingest.foreground.rough_shape import RoughShape
from neeco.ingest.frames.images import ChosenImages
from neeco.ingest.frames.views import SfmResult, Views
from neeco.ingest.registration.base import BaseRegistration
from neeco.ingest.registration.hand_eye import Registration
from neeco.ingest.shaft.from_video import FoundShaft
from neeco.ingest.timing.episodes import Episodes, States


@dataclass(frozen=True, eq=False, kw_only=True)
class World:
    """Lengths in mm. Rows are those of `views`."""

    data: Episodes  # with all clocks, bases and instruments in the video
    images: ChosenImages
    views: Views
    states: States
    usable: np.ndarray  # [M] bool, where the states of all instruments are known
    tissue: PointCloud
    shapes: Mapping[str, RoughShape]  # by instrument
    bases: Mapping[str, BaseRegistration]  # by instrument, of those found from what moves
    still: bool  # the scope stood still
    shaft: FoundShaft | None = None  # the instrument found in the video
    masks: np.ndarray | None = None  # bool [M, h, w], what moves, where an instrument was found in the video
    # of a scope that moves
    registration: Registration | None = None  # None: instrument poses stay in their tracker's frame
    reprojection_px: float | None = None
    search: tuple[str, ...] = ()  # what was tried to find cameras, one sentence each
    moving: Mapping[int, np.ndarray] = field(default_factory=dict)  # video frame -> [h, w] how often pixels moved
    # of a scope that stands still
    depth_source: str | None = None  # how the tissue's depth was found, after "the tissue's depth is"
    right: RightCamera | None = None


def residual_flow(sfm: SfmResult, views: Views) -> ResidualFlow:
    """Return the optical flow between the views that a still scene does not explain."""
    return ResidualFlow(views.load, sfm, views.times, views.pinhole, visible=views.visible, episodes=views.episodes)


def longest_lag(data: Episodes) -> float:
    """Return the s by which the poses of a log may be off its clock: what is longer leaves half of the frames none."""
    return float(max(np.ptp(part.times) for part in data.parts)) / 2


def note_motion_contradiction(data: Episodes, name: str, moves: bool, lag: float) -> None:
    """Note an instrument with whose poses nothing in the images moves, or something moves at another time."""
    logs = data.parts[0].poses
    clock, sentence = logs[name].clock if name in logs else "", ""
    if lag and not data.notes.is_contradicted(f"sync {clock}"):
        after = "later" if lag > 0 else "earlier"
        sentence = (
            f"what moves in the images fits the poses of {name} that its log has {abs(lag):.1f} s {after}: is its "
            f"clock {clock!r} that of the other logs? Give it one of its own (poses: clock), or correct `sync`"
        )
    elif lag or not moves:
        sentence = (
            f"nothing in the images moves with the tracked pose of {name}: check its log, its frame and its clock"
        )
    data.notes.contradict(f"motion of {name}", sentence, severe=True)
