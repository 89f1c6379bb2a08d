"""The bases of a recording's instruments: as the recording states them, or found from what moves before a scope."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from neeco.capture.model import REFERENCE_PIXELS, evenly_spaced
from neeco.errors import NeecoError
from neeco.geometry.lens import Lens
from neeco.ingest.frames.views import reduced
from neeco.ingest.readers.columns import CAMERA
from neeco.ingest.readers.interpolate import poses_at, readings_at
from neeco.ingest.recording.base import StatedBase
from neeco.ingest.recording.model import InstrumentLogs
from neeco.ingest.registration.base import MIN_FRAMES, BaseRegistration, base_from_layers, find_base
from neeco.ingest.registration.layers import ArmImages, covered_by, evenly_lit, fit_layers, line_through_trocar
from neeco.ingest.registration.silhouette_fit import CLOCK_SD_S
from neeco.ingest.registration.silhouette_model import CLOCK_SHIFTS_S
from neeco.ingest.timing.clock_search import ASSUMED, GIVEN, SCOPE_MOTION, ClockOffset
from neeco.ingest.timing.episodes import Episodes

FRAMES = 140  # looked at, evenly spaced
STRAIGHT_MM = 2.0  # from the root to the link that is logged: nearer, nothing bends there
HARDLY_MM = 2.0  # root mean square, from which an arm counts as moving
KNOWN, FOUND = (GIVEN, SCOPE_MOTION), "found with the base"  # sources of clocks


@dataclass(frozen=True, eq=False)
class PlacedBase:
    """world_from_base [4, 4] mm of one instrument, the clock of its log (None: as before), and how they were found
    (None: stated exactly)."""

    world_from_base: np.ndarray
    clock: ClockOffset | None = None
    found: BaseRegistration | None = None


def refuse_frames(data: Episodes, *, moving: bool) -> None:
    """Raise NeecoError for poses, or bases, that are stated to what does not stand still. moving: does the scope?"""
    path = data.recording.path
    for name, log in data.poses.items():
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


def require_no_base(data: Episodes) -> None:
    """Raise NeecoError for a base before a scope that moves and is not registered."""
    for item in data.recording.instruments:
        if item.base is not None:
            raise NeecoError(
                f"{data.recording.path}: world_from_base: where the base of {item.name} stands can be told only to a "
                "scope whose own poses are recorded (laparoscope) and move enough to register it; leave it out"
            )


def take_bases(
    data: Episodes,
    times: np.ndarray,
    cameras: np.ndarray,
    pinhole: Lens,
    load: Callable[[int], np.ndarray],
    moving: Callable[[np.ndarray], np.ndarray],
    hidden: np.ndarray | None,
) -> dict[str, BaseRegistration]:
    """`place_bases`, and from then on all poses and clocks are as these say. Returns those found."""
    found = {}
    for name, base in place_bases(data, times, cameras, pinhole, load, moving, hidden).items():
        data.world_from_base[name] = base.world_from_base
        if base.clock is not None:
            data.move_clock(data.poses[name].clock, base.clock)
        if base.found is not None:
            found[name] = base.found
    return found


def place_bases(
    data: Episodes,
    times: np.ndarray,
    cameras: np.ndarray,
    pinhole: Lens,
    load: Callable[[int], np.ndarray],
    moving: Callable[[np.ndarray], np.ndarray],
    hidden: np.ndarray | None = None,
) -> dict[str, PlacedBase]:
    """The bases of all instruments that say something of theirs.

    times [M] s of the frames, cameras [M, 4, 4] world_from_camera; load(row): their image uint8 [H, W, 3], as `pinhole`
    sees it; moving(rows): masks bool [R, h, w] of what moves in rows of them, reduced to REFERENCE_PIXELS; hidden: bool
    [h, w] of these. Lengths of a robot are taken as they are. Notes what was found, how sure it is and what is open.
    Raises NeecoError where nothing moves with an instrument.
    """
    placed: dict[str, PlacedBase] = {}
    unknown = []
    for item in data.recording.instruments:
        if item.base is None or item.name not in data.poses or data.poses[item.name].frame == CAMERA:
            continue
        if item.base.exact:
            placed[item.name] = PlacedBase(_in_world(item.base, cameras))
        else:
            unknown.append(item)
    if not unknown:
        return placed
    rows = np.array(evenly_spaced(len(times), FRAMES))
    images = np.stack([reduced(load(int(row))) for row in rows])
    lens = Lens.of(pinhole.camera(np.eye(4)).within(REFERENCE_PIXELS))
    seen = _Seen(images, lens, times[rows], cameras[rows], hidden, lambda: moving(rows))
    arms = [_arm(data, item, seen) for item in unknown]
    # what moves most is found most easily, and then out of the way
    for arm in sorted(arms, key=lambda arm: -arm.travel):
        registration, clock = _find(arm, seen, alone=len(arms) == 1), arm.clock
        if registration is None:
            assert arm.prior is not None
            _, sd_mm, sd_deg = arm.prior
            placed[arm.item.name] = PlacedBase(arm.prior[0])
            data.note(
                f"instrument {arm.item.name!r}: it moves by {arm.travel:.1f} mm only, too little to find its base, "
                f"which stays as given, sure to {sd_mm:.1f} mm and {sd_deg:.1f} deg"
            )
            continue
        if clock.source not in KNOWN:
            clock = replace(clock.later(registration.clock_s), sd=registration.clock_sd_s, source=FOUND)
        placed[arm.item.name] = PlacedBase(registration.world_from_base, clock, registration)
        data.note(describe(arm.item.name, registration))
    return placed


class _Seen:
    """Images uint8 [F, h, w, 3] that bases are found from, with their times [F] s and cameras [F, 4, 4], what of them
    lies beyond a round border, and, once it is asked for, what moves in them."""

    def __init__(
        self,
        images: np.ndarray,
        lens: Lens,
        times: np.ndarray,
        cameras: np.ndarray,
        hidden: np.ndarray | None,
        moving: Callable[[], np.ndarray],
    ) -> None:
        self.images, self.lens, self.times, self.cameras, self.hidden = images, lens, times, cameras, hidden
        self.still = float(np.ptp(cameras, axis=0).max()) < 1e-6
        self.usable = np.ones(images.shape[:3], bool) if hidden is None else np.tile(~hidden, (len(images), 1, 1))
        self._moving = moving

    @cached_property
    def masks(self) -> np.ndarray:
        return self._moving()

    @cached_property
    def lit(self) -> np.ndarray:
        return evenly_lit(self.images)


@dataclass(frozen=True, eq=False)
class _Arm:
    """An instrument whose base is to be found, and what its log says."""

    item: InstrumentLogs
    where: str
    clock: ClockOffset
    readings: dict[str, np.ndarray]  # [F] of each joint
    prior: tuple[np.ndarray, float, float] | None  # as `find_base` takes it
    poses_at: Callable[[float], np.ndarray]  # base_from_instrument [F, 4, 4], so many s later; with links, the root's
    wrists: np.ndarray | None  # [F, 3] mm in the root's frame, with links: where the link is whose pose is logged

    @property
    def travel(self) -> float:
        """mm, the root mean square distance from where it is on average."""
        places = self.poses_at(0.0)[:, :3, 3]
        places = places[np.isfinite(places[:, 0])]
        return float(np.sqrt(places.var(0).sum())) if len(places) else 0.0


def _arm(data: Episodes, item: InstrumentLogs, seen: _Seen) -> _Arm:
    log, times, stated = data.poses[item.name], seen.times, item.base
    assert stated is not None
    clock = data.clocks.get(log.clock, ClockOffset(0.0, float("nan"), ASSUMED))
    readings = {
        joint: readings_at(reading, data.clocks.get(reading.clock, clock).at(times))[0]
        for joint, reading in data.joints[item.name].items()
    }
    readings = {joint: values for joint, values in readings.items() if np.isfinite(values).all()}

    tree = item.kinematics
    bends = tree is not None and tree.pose_of is not None and set(tree.readings) <= set(readings)
    states = [{joint: float(values[row]) for joint, values in readings.items()} for row in range(len(times))]

    def base_from_shaft(shift: float) -> np.ndarray:
        poses, _ = poses_at(log, clock.at(times) + shift)
        if not bends:
            return poses
        assert tree is not None
        return np.stack([tree.world_from_root(pose, state) for pose, state in zip(poses, states, strict=True)])

    wrists = None
    if bends:
        assert tree is not None
        assert tree.pose_of is not None
        wrists = np.stack([tree.poses(state)[tree.pose_of][:3, 3] for state in states])
        wrists = wrists if np.linalg.norm(wrists, axis=1).min() > STRAIGHT_MM else None
    prior = None
    if stated.matrix is not None:
        assert stated.sd_mm is not None
        assert stated.sd_deg is not None
        prior = (_in_world(stated, seen.cameras), stated.sd_mm, stated.sd_deg)
    return _Arm(item, str(data.recording.path), clock, readings, prior, base_from_shaft, wrists)


def _find(arm: _Arm, seen: _Seen, *, alone: bool) -> BaseRegistration | None:
    """From outlines of what moves, which are exact, where one arm is there and they show it; else from what stands
    still behind. None for one of several arms that hardly moves: what is given has to do."""
    if not alone and (found := _without_masks(arm, seen)) is not None:
        return found
    readings = np.stack(list(arm.readings.values()), -1) if arm.readings else None
    try:
        return find_base(
            arm.item.name, seen.masks, seen.lens.intrinsics, np.linalg.inv(seen.cameras), arm.poses_at, seen.times,
            prior=arm.prior, readings=readings, hidden=seen.hidden, images=seen.images,
            clock_known=arm.clock.source in KNOWN,
        )  # fmt: skip
    except NeecoError as error:
        if alone and (found := _without_masks(arm, seen)) is not None:
            return found
        if not alone and arm.prior is not None and arm.travel < HARDLY_MM:
            return None
        raise NeecoError(f"{arm.where}: {error}") from error


def _without_masks(arm: _Arm, seen: _Seen) -> BaseRegistration | None:
    """The base by `base_layers`; from then on, what it covers is nobody else's. None where that cannot tell: the scope
    moves, nothing is given, or no line goes through a trocar; or where other moments' poses explain the images as
    well."""
    if arm.prior is None or not seen.still:
        return None
    poses = np.stack([arm.poses_at(float(shift)) for shift in CLOCK_SHIFTS_S])
    known = np.flatnonzero(np.isfinite(poses).all((0, 2, 3)))
    if arm.clock.source in KNOWN:  # no other clock is tried
        poses = np.tile(arm.poses_at(0.0), (len(CLOCK_SHIFTS_S), 1, 1, 1))
        known = np.flatnonzero(np.isfinite(poses[0]).all((1, 2)))
    line = line_through_trocar(poses[len(CLOCK_SHIFTS_S) // 2, known]) if len(known) >= MIN_FRAMES else None
    if line is None:
        return None
    wrists = None if arm.wrists is None else arm.wrists[known]
    world_from_camera, (given, sd_mm, sd_deg) = seen.cameras[0], arm.prior
    prior = (np.linalg.inv(world_from_camera) @ given, sd_mm, sd_deg)
    sd_clock = 0.0 if arm.clock.source in KNOWN else CLOCK_SD_S
    images = ArmImages(
        images=seen.lit[known],
        intrinsics=seen.lens.intrinsics,
        poses=poses[:, known],
        line=line,
        usable=seen.usable[known],
        wrists=wrists,
    )
    found = fit_layers(images, prior, sd_clock, np.random.default_rng(0))
    if not found.found:
        return None
    seen.usable[known] &= ~covered_by(found, images)
    return base_from_layers(arm.prior, found, world_from_camera, poses[len(CLOCK_SHIFTS_S) // 2, known], line)


def _in_world(stated: StatedBase, cameras: np.ndarray) -> np.ndarray:
    """[4, 4] world_from_base: as stated, to the world or to the cameras, which then are all in one place."""
    assert stated.matrix is not None
    return stated.matrix if stated.to_world else np.asarray(cameras[0] @ stated.matrix)


def describe(name: str, found: BaseRegistration) -> str:
    """What was found of a base, how sure that is, and what the recording leaves open, in one sentence."""

    def listed(values: np.ndarray) -> str:
        return ", ".join("open" if not np.isfinite(value) else f"{value:.1f}" for value in values)

    words = f"instrument {name!r}: its base was found from what moves in {found.frames} frames"
    if np.isfinite(found.moved_mm):
        words += f", {found.moved_mm:.1f} mm and {found.turned_deg:.1f} deg from what was given"
    words += f"; sure to {listed(found.sd_mm)} mm and {listed(found.sd_deg)} deg (right, down, forward of the camera); "
    if not found.from_masks:
        words += f"without outlines: its shaft explains {found.explained:.0%} of what changes in the images"
    else:
        words += f"its outline and what moves overlap by {found.overlap:.2f}"
    if np.isfinite(found.overlap_before):
        words += f" ({found.overlap_before:.2f} as given)"
    if found.open_directions:
        what = "as given" if np.isfinite(found.moved_mm) else "as first guessed"
        words += f"; its motion does not determine {', nor '.join(found.open_directions)}: there it stays about {what}"
    return words
