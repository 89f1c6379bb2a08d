"""The bases of a recording's instruments: as the recording states them, or found from what moves in the images."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.capture.model import evenly_spaced
from neeco.geometry.projection import project
from neeco.geometry.rotations import rigid
from neeco.ingest.frames.images import StageProgress, Views, reduced
from neeco.ingest.readers.interpolate import poses_at, readings_at
from neeco.ingest.readers.logs import ReadingLog
from neeco.ingest.readers.names import CAMERA
from neeco.ingest.recording.base import StatedBase
from neeco.ingest.recording.model import InstrumentLogs
from neeco.ingest.registration.articulated import LoggedMotion, find_base
from neeco.ingest.registration.base import BASES, BaseRegistration, Prior
from neeco.ingest.registration.hand_eye import HAND_EYE, Registration
from neeco.ingest.timing.clock_search import ASSUMED, GIVEN, SCOPE_MOTION, VIDEOS_OWN, ClockOffset
from neeco.ingest.timing.episodes import Episode, Episodes


@dataclass(frozen=True, kw_only=True)
class FindBasesSettings:
    """Thresholds of what is corrected by images."""

    n_frames: int = 140  # maximum number of frames that are searched, evenly spaced
    nearest_mm: float = 5.0  # minimum depth at which an arm's place in the image is known
    min_overlap: float = 0.85  # minimum overlap of an instrument's outline with what moves, to correct its place
    min_overlap_gain: float = 0.2  # minimum gain of that overlap over the one before
    max_prior_mm: float = 8.0  # maximum standard deviation of a place that outlines find
    max_prior_deg: float = 5.0  # maximum standard deviation of its turn
    min_travel_mm: float = 2.0  # minimum RMS travel of an arm that moves


PLACING = FindBasesSettings()

KNOWN, FOUND = (GIVEN, SCOPE_MOTION, VIDEOS_OWN), "found with the base"  # sources of clocks


def check_reference_frames(data: Episodes, *, moving: bool) -> None:
    """Raise NeecoError for poses, or bases, that are stated to what does not stand still. moving: whether the scope
    does."""
    path = data.recording.path
    for name, log in data.parts[0].poses.items():
        if moving and log.frame == CAMERA:
            raise NeecoError(
                f"{path}: instruments: {name}: poses in the camera's frame need a scope that stands still, and this "
                "one moves; give poses in a frame that stays, and the scope's own (laparoscope)"
            )
    for item in data.recording.instruments:
        if item.base is None or item.base.matrix is None or item.base.to_world == moving:
            continue
        if moving:
            raise NeecoError(
                f"{path}: camera_from_base: the scope moves, and the base of {item.name} not with it; state it to the "
                "frame of the laparoscope's poses, as world_from_base, or write unknown"
            )
        raise NeecoError(
            f"{path}: world_from_base: the scope stands still; state the base of {item.name} to its camera, as "
            "camera_from_base, or write unknown"
        )


def find_bases(
    data: Episodes,
    views: Views,
    moving: Callable[[np.ndarray], np.ndarray],
    progress: StageProgress,
    registration: Registration | None = None,
) -> tuple[Episodes, dict[str, BaseRegistration]]:
    """Find the bases of all instruments of which the recording states something; take those stated exactly.

    views: in mm; moving(rows): masks bool [R, h, w] of what moves in rows of them, reduced to REFERENCE_PIXELS;
    registration: what placed the cameras in the frame that bases are stated to, where the scope moves. Images show a
    base among the cameras: what is stated of it is known there less well by the error of their place. Lengths of a
    robot are taken as they are. Return the episodes with these bases and the clocks that come with them, and what was
    found by instrument, from no frame where a base stays as given. Notes state standard deviations and what stays
    undetermined. Raises NeecoError where nothing moves with an instrument.
    """
    unknown, logs = [], data.parts[0].poses
    for item in data.recording.instruments:
        if item.base is None or item.name not in logs or logs[item.name].frame == CAMERA:
            continue
        if item.base.exact:
            data = data.with_base(item.name, _in_world(item.base, views.world_from_camera))
        else:
            unknown.append(item)
    if not unknown:
        return data, {}
    progress("finding the robot's base", 0, 0)
    observed = _Observed(views, moving)
    arms = [_among_cameras(_arm(data, item, observed), registration) for item in unknown]
    bases = {}
    for number, arm in enumerate(arms):
        progress("finding the robot's base", number, len(arms) if number else 0)
        name, clock = arm.item.name, arm.clock
        if len(arms) > 1 and arm.prior is not None and arm.travel < PLACING.min_travel_mm:
            stated, sd_mm, sd_deg = arm.prior
            data = data.with_base(name, stated)
            data.notes.add(
                f"instrument {name!r}: it moves by {arm.travel:.1f} mm only, too little to find its base, "
                f"which stays as given, with standard deviations {sd_mm:.1f} mm and {sd_deg:.1f} deg"
            )
            bases[name] = BaseRegistration(
                world_from_base=stated,
                clock_s=0.0,
                clock_sd_s=clock.sd,
                covariance=np.diag(np.repeat([np.radians(sd_deg) ** 2, sd_mm**2], 3)),
                open_directions=(),
                frames=0,
            )
            continue
        base = _find(data, arm, observed, arms)
        if clock.source not in KNOWN:
            clock = replace(clock.later(base.clock_s), sd=base.clock_sd_s, source=FOUND)
        data = data.with_base(name, base.world_from_base).with_moved_clock(logs[name].clock, clock)
        if arm.item.kinematics is not None:  # found with readings of the same clock, where they have none of their own
            for clock_name in {log.clock for log in data.parts[0].joints[name].values()}:
                data = data if data.clock(clock_name) is not None else data.with_moved_clock(clock_name, clock)
        data.notes.add(describe(name, base))
        for place, doubt in enumerate(base.doubts):
            data.notes.contradict(f"base of {name}, {place}", f"instrument {name!r}: {doubt}", severe=True)
        bases[name] = base
    return data, bases


def correct_placement(
    data: Episodes,
    views: Views,
    registration: Registration,
    moving: Callable[[np.ndarray], np.ndarray],
    progress: StageProgress,
) -> tuple[Episodes, dict[str, BaseRegistration]]:
    """Correct the place of a single tracked instrument among the cameras, as far as the scope's hand-eye calibration
    leaves it open, from what moves in the images: as the base of a robot that is known so well (see `find_bases`).

    Nothing is corrected where the calibration is usual or the log's clock is not known, nor where images do not show
    the instrument at its place clearly better.
    """
    logs, items = data.parts[0].poses, data.recording.instruments
    if len(items) != 1 or items[0].name not in logs or items[0].base is not None or logs[items[0].name].frame == CAMERA:
        return data, {}
    name = items[0].name
    if data.clock(logs[name].clock) is None:
        return data, {}
    poses, valid = data.instrument_poses(name, views.times)
    if valid.sum() < BASES.min_frames:
        return data, {}
    sds = registration.placement_sd(poses[valid, :3, 3])
    if (
        (sds[0] <= HAND_EYE.placed_mm and sds[1] <= HAND_EYE.placed_deg)
        or sds[0] > PLACING.max_prior_mm
        or sds[1] > PLACING.max_prior_deg
    ):
        return data, {}
    progress("correcting the instrument's place", 0, 0)
    stated = StatedBase(np.eye(4), 0.0, 0.0, to_world=True)
    observed = _Observed(views, moving)
    arm = _among_cameras(_arm(data, replace(items[0], world_from_base=stated), observed), registration)
    try:
        base = _find(data, arm, observed, [arm])
    except NeecoError:  # the images do not determine it
        return data, {}
    least = max(PLACING.min_overlap, base.overlap_before + PLACING.min_overlap_gain)
    if base.doubts or not base.overlap > least:
        return data, {}
    data.notes.add(
        f"instrument {name!r}: its place was corrected by {base.moved_mm:.1f} mm and {base.turned_deg:.1f} deg from "
        f"what moves in {base.frames} frames, as the hand-eye calibration is known to {sds[0]:.1f} mm and "
        f"{sds[1]:.1f} deg only; its outline and what moves overlap by {base.overlap:.2f} "
        f"({base.overlap_before:.2f} before)"
    )
    return data.with_base(name, base.world_from_base), {name: replace(base, tracked=True)}


def follow_cameras(
    data: Episodes, bases: Mapping[str, BaseRegistration], before: Views, after: Views
) -> tuple[Episodes, dict[str, BaseRegistration]]:
    """Move bases found among cameras, `before`, with these to where a later calibration places them, `after`: there
    the images show them. Both in mm, of the same frames or fewer afterwards. Those that stay as given stay."""
    followed = dict(bases)
    _, old, new = np.intersect1d(before.frames, after.frames, return_indices=True)
    motions = after.world_from_camera[new] @ np.linalg.inv(before.world_from_camera[old])
    turn = Rotation.from_matrix(motions[:, :3, :3]).mean().as_matrix()
    for name, base in bases.items():
        if not base.frames:
            continue
        poses, valid = data.instrument_poses(name, before.times[old])
        middle = np.append(poses[valid, :3, 3].mean(0), 1.0)
        moved = rigid(turn, (motions @ middle).mean(0)[:3] - turn @ middle[:3]) @ base.world_from_base
        data, followed[name] = data.with_base(name, moved), replace(base, world_from_base=moved)
    return data, followed


class _Observed:
    """Evenly spaced rows [F] of the views, at most `n_frames`, with their masks of what moves, bool [F, h, w]."""

    def __init__(self, views: Views, moving: Callable[[np.ndarray], np.ndarray]) -> None:
        rows = np.array(evenly_spaced(len(views.times), PLACING.n_frames))
        self.times, self.cameras, self.masks = views.times[rows], views.world_from_camera[rows], moving(rows)
        # pixels at least in part beyond the field of view, bool [h, w]
        self.hidden = None if views.visible is None else reduced(views.visible.astype(np.uint8) * 255) < 255
        self.intrinsics = views.reduced_pinhole.intrinsics  # of the reduced images


@dataclass(frozen=True, eq=False, kw_only=True)
class _Arm:
    """An instrument whose base is to be found, and its log's poses and readings."""

    item: InstrumentLogs
    clock: ClockOffset
    prior: Prior | None
    motion: LoggedMotion
    places: np.ndarray  # [F, 3] mm in the base's frame, where the frame is that is logged

    @property
    def travel(self) -> float:
        """Root mean square distance from its mean place, mm."""
        places = self.motion.poses_at(0.0)[:, :3, 3]
        places = places[np.isfinite(places[:, 0])]
        return float(np.sqrt(places.var(0).sum())) if len(places) else 0.0


def _arm(data: Episodes, item: InstrumentLogs, observed: _Observed) -> _Arm:
    log, times, stated = data.joint_log(lambda part: part.poses[item.name]), observed.times, item.base
    assert stated is not None
    clock = data.clock(log.clock) or ClockOffset(0.0, float("nan"), ASSUMED)

    def readings_later(shift: float) -> dict[str, np.ndarray]:
        later_readings = {}
        for joint in item.joints:

            def of_joint(part: Episode, joint: str = joint) -> ReadingLog:
                return part.joints[item.name][joint]

            reading = data.joint_log(of_joint)
            reading_clock = data.clock(reading.clock) or clock
            # a clock that is known does not move with the pose's
            later = 0.0 if reading_clock.source in KNOWN else shift
            later_readings[joint] = readings_at(reading, reading_clock.at(times) + later)[0]
        return later_readings

    tree = None if item.kinematics is None or item.kinematics.pose_of is None else item.kinematics

    def base_from_root(shift: float) -> np.ndarray:
        poses, _ = poses_at(log, clock.at(times) + shift)
        if tree is None:
            return poses
        values = readings_later(shift)  # NaN where one is missing
        states = ({name: float(read[row]) for name, read in values.items()} for row in range(len(times)))
        return poses @ np.linalg.inv([tree.root_from_recorded(state) for state in states])

    prior = None
    if stated.matrix is not None:
        assert stated.sd_mm is not None
        assert stated.sd_deg is not None
        prior = (_in_world(stated, observed.cameras), stated.sd_mm, stated.sd_deg)
    motion = LoggedMotion(tree=item.kinematics, poses_at=base_from_root, readings_at=readings_later)
    places = poses_at(log, clock.at(times))[0][:, :3, 3]
    return _Arm(item=item, clock=clock, prior=prior, motion=motion, places=places)


def _among_cameras(arm: _Arm, registration: Registration | None) -> _Arm:
    """Return the arm with the error of the cameras' place added to its prior, the same in all directions."""
    if registration is None or arm.prior is None:
        return arm
    base, sd_mm, sd_deg = arm.prior
    places = (base @ arm.motion.poses_at(0.0))[:, :3, 3]
    places = places[np.isfinite(places).all(1)]
    if not len(places):
        return arm
    variances = np.diag(registration.uncertainty(places).covariance).reshape(2, 3).mean(1)  # rad^2, mm^2
    placed_deg, placed_mm = np.degrees(np.sqrt(variances[0])), np.sqrt(variances[1])
    return replace(arm, prior=(base, float(np.hypot(sd_mm, placed_mm)), float(np.hypot(sd_deg, placed_deg))))


def _find(data: Episodes, arm: _Arm, observed: _Observed, arms: Sequence[_Arm]) -> BaseRegistration:
    """Find a base from the outlines of what moves, of several arms from what is nearest to its own."""
    masks = _own_masks(arm, observed, arms)
    cameras = np.linalg.inv(observed.cameras)
    known = arm.clock.source in KNOWN
    try:
        return find_base(
            masks, observed.intrinsics, cameras, arm.motion, arm.prior, hidden=observed.hidden, clock_known=known
        )
    except NeecoError as error:
        key = arm.item.base and arm.item.base.key
        raise NeecoError(f"{data.recording.path}: instrument {arm.item.name!r}: {key}: {error}") from error


def _own_masks(arm: _Arm, observed: _Observed, arms: Sequence[_Arm]) -> np.ndarray:
    """Masks bool [F, h, w] of the pieces of what moves that are nearest to where an arm is logged, of all whose base is
    known roughly; of one whose base is not, all of them."""
    known = [other for other in arms if other.prior is not None]
    if arm.prior is None or len(known) < 2:
        return observed.masks
    camera_from_world = np.linalg.inv(observed.cameras)
    pixels = []  # of each arm [F, 2]
    for other in known:
        assert other.prior is not None
        bases = camera_from_world @ other.prior[0]
        places = np.einsum("fij,fj->fi", bases[:, :3, :3], other.places) + bases[:, :3, 3]
        pixels.append(np.stack(project(places, *observed.intrinsics, nearest=PLACING.nearest_mm), -1))
    own = np.zeros_like(observed.masks)
    for row, mask in enumerate(observed.masks):
        count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
        for label in range(1, count):
            piece = labels == label
            corners = np.argwhere(piece)[:, ::-1] + 0.5
            distances = [np.linalg.norm(corners - of[row], axis=1).min() for of in pixels]
            if known[int(np.argmin(np.nan_to_num(distances, nan=np.inf)))] is arm:
                own[row] |= piece
    return own


def _in_world(stated: StatedBase, cameras: np.ndarray) -> np.ndarray:
    """Return world_from_base [4, 4] as stated: to the world, or to the cameras, which then are all in one place."""
    assert stated.matrix is not None
    return stated.matrix if stated.to_world else np.asarray(cameras[0] @ stated.matrix)


def describe(name: str, base: BaseRegistration) -> str:
    """Return a sentence on a base that was found: its standard deviations, and what the recording leaves open."""

    def listed(values: np.ndarray) -> str:
        return ", ".join(f"{value:.1f}" for value in values)

    words = f"instrument {name!r}: its base was found from what moves in {base.frames} frames"
    if np.isfinite(base.moved_mm):
        words += f", {base.moved_mm:.1f} mm and {base.turned_deg:.1f} deg from what was given"
    words += (
        f"; standard deviations {listed(base.sd_mm)} mm and {listed(base.sd_deg)} deg (right, down, forward of the "
        f"camera); its outline and what moves overlap by {base.overlap:.2f}"
    )
    if np.isfinite(base.overlap_before):
        words += f" ({base.overlap_before:.2f} as given)"
    if base.open_directions:
        what = "as given" if np.isfinite(base.moved_mm) else "as first guessed"
        words += f"; its motion does not determine {', nor '.join(base.open_directions)}: there it stays about {what}"
    return words
