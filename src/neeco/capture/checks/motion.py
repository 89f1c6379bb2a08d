"""Check by the images that instruments are where their states say, and try what may be wrong where they are not.

`motion_evidence` tells how well poses explain what moves. A mistake is named only where the poses without it explain
that clearly better than those given. Where poses explain no more than those of other frames would, and no known mistake
explains it, only that is said.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.capture.checks._mistakes import placement_mistakes, rotation_mistakes
from neeco.capture.checks.motion_evidence import Rays, Timeline
from neeco.capture.documents import printable
from neeco.capture.model import Instrument, InstrumentState
from neeco.capture.readers.parsed import Parsed

SHORT_SHIFT = 16  # steps of time, at most a fifth of a recording's: shifts so small explain much even where wrong
MOST_SHIFTS = 600  # that are tried over a whole recording
LONGEST_SHIFT = 1 / 2  # of a recording
RATES = (0.5, *np.geomspace(0.75, 1 / 0.75, 116), 2.0)  # of a clock
BEST = 3  # of each kind are compared with all rays
# An alternative is named when it explains more than the poses given do by a factor, with a certainty in standard errors
# over the blocks, and has this mean evidence. A shift changes much at once; transposed rotations only as much as the
# instrument turns; where all else is wrong, nearly nothing is explained. Of many one may fit by chance.
TURNED, SHIFTED, ELSEWHERE = (1.1, 3.0, 0.15), (1.15, 5.0, 0.2), (1.5, 5.0, 0.2)
CHANGED_TURNED = 1.25  # the factor for rotations, where they change the evidence most
TURNING = 25.0  # deg, root mean square: who turns less is explained by transposed rotations nearly as well, or better
CONTRADICTED = 0.15  # mean evidence below which poses explain too little
BY_CHANCE = 3.0  # factor by which poses without a mistake explain more than the same in another order
# the same, of the poses given, below which they explain too little; in few frames chance explains much
CONTRADICTED_BY_CHANCE, FEW_FRAMES_BY_CHANCE = 4.0, 1.5
SHUFFLES = 6
MIN_FRAMES_ELSEWHERE = 45  # of many alternatives one explains the motion in fewer frames
FEW_FRAMES = 36  # in which chance explains much
AS_LIKELY = 0.9  # share of the most evidence from which another mistake is as likely
NEAR_SHIFTS = 5  # steps to either side of the likeliest shift, which are compared on the same frames
TRAVEL = 0.055  # of the image's width: who moves less is explained by the poses of any frame
STATES, POSES = "frames[*].instruments[*]", "frames[*].instruments[*].pose"


@dataclass(frozen=True)
class _Alternative:
    """Poses [F, 4, 4] without a mistake, and which frames have them, [F]."""

    message: str
    remedy: str
    poses: np.ndarray
    inside: np.ndarray
    needed: tuple[float, float, float]  # factor, certainty and evidence that make it clear
    kind: str
    steps: int = 0  # by which states are shifted
    in_time: bool = False  # by so many median steps of time, not by rows


@dataclass(frozen=True)
class MotionFault:
    """What the images tell against an instrument's states, where it is said, and what to do."""

    field: str
    message: str
    remedy: str
    named: bool = False  # by a mistake that explains it


@dataclass(frozen=True)
class MotionVerdict:
    """What the images tell of an instrument's states. fault: against them; supported: what moves lies where they say;
    neither where too little moves."""

    fault: MotionFault | None
    supported: bool


def check_motion(parsed: Parsed, known: Mapping[str, MotionVerdict]) -> None:
    """Report instruments whose states the images contradict, with the mistake that explains it if one does.

    known: verdicts by instrument that were reached before. Says nothing of a capture without registered poses or
    without measured points, or where too little moves. `parsed` must be free of errors.
    """
    asked = [instrument for instrument in parsed.instruments if instrument.name not in known]
    rays = Rays.of(parsed) if asked else None
    found = {} if rays is None else {instrument.name: judge_motion(parsed, instrument, rays) for instrument in asked}
    for verdict in {**known, **found}.values():
        if (fault := verdict.fault) is not None:
            parsed.header(fault.field).warning(fault.message, fault.remedy, contradicted=True)


def judge_motion(parsed: Parsed, instrument: Instrument, rays: Rays) -> MotionVerdict:
    """What the images tell of the states of an instrument, which every frame has."""
    states = [frame.state.instruments[instrument.name] for frame in parsed.frames]
    poses = _of_root(instrument, np.stack([state.pose.numpy() for state in states]), states)
    fault = _fault(parsed, instrument, states, poses, rays)
    given = rays.mean(poses[rays.views.rows])
    return MotionVerdict(fault, fault is None and given > CONTRADICTED)


def _fault(
    parsed: Parsed, instrument: Instrument, states: list[InstrumentState], poses: np.ndarray, rays: Rays
) -> MotionFault | None:
    """What speaks against an instrument's states and poses [N, 4, 4] of its root; None where nothing does."""
    name, rows = printable(instrument.name), rays.views.rows
    found = _likeliest_mistake(parsed, instrument, states, poses, rays)
    if found is not None:
        field = POSES if found.kind in ("poses", "positions", "rotations") else STATES
        return MotionFault(field, found.message, found.remedy, named=True)
    given = rays.mean(poses[rows])
    if given > CONTRADICTED and _turns_better(instrument, states, poses[rows], rays):
        message = f"rotations of {name} do not turn as the instrument does in the images"
        return MotionFault(
            POSES, message, "are they transposed, or are quaternions in another order (w x y z, x y z w)?"
        )
    if given > CONTRADICTED or rays.travel(poses[rows]) < TRAVEL:
        return None
    by_chance = _by_chance(rays, poses[rows])
    if given > (FEW_FRAMES_BY_CHANCE if len(rows) < FEW_FRAMES else CONTRADICTED_BY_CHANCE) * by_chance:
        return None
    message = (
        f"the images contradict the poses of {name}: what moves in them does not lie where the poses say (evidence "
        f"{given:.2f}, {by_chance:.2f} by chance)"
    )
    remedy = "shifts, other axes, frames and units were tried; states, cameras and images must be of one recording"
    return MotionFault(POSES, message, remedy)


def _likeliest_mistake(
    parsed: Parsed, instrument: Instrument, states: list[InstrumentState], poses: np.ndarray, rays: Rays
) -> _Alternative | None:
    """The mistake without which the poses of an instrument explain clearly, and most, more of what moves."""
    rows = rays.views.rows
    given, few = rays.evidence(poses[rows]), rays.thinned()
    tried = [*_turned(instrument, states, poses[rows], rows)]
    tried += _likeliest(_placed(instrument, parsed, poses, rows), few)
    shifts = _Shifts(instrument, poses, Timeline(np.array([frame.state.time for frame in parsed.frames])), rows)
    tried += shifts.likeliest(few)
    clear, other = [], []
    for one in tried:
        if one.needed == ELSEWHERE and one.inside.sum() < MIN_FRAMES_ELSEWHERE:
            continue
        found = rays.compare(given, one.poses, one.inside)
        if found[0] > ELSEWHERE[0]:
            other.append((found[2], one))
        enough = all(value > least for value, least in zip(found, one.needed, strict=True))
        if enough and one.kind == "rotations":
            enough = _clearly_turned(rays, given, one)
        if enough and found[2] > BY_CHANCE * _by_chance(few, one.poses, one.inside):
            clear.append((found[2], one))
    if not clear:
        return None
    most, best = max(clear, key=lambda found: found[0])
    rivals = [one for evidence, one in other if evidence > AS_LIKELY * most and not _same(one, best)]
    if rivals and any(one is best for _, one in other):
        return None  # nothing tells which of them it is
    best = shifts.refined(best, rays) if best.steps else best
    # at the end of what was tried there is no telling whether another shift is the right one
    return None if abs(best.steps) >= shifts.longest > 0 else best


def _same(one: _Alternative, other: _Alternative) -> bool:
    """Whether two alternatives are one mistake, at most of another amount."""
    near = abs(one.steps - other.steps) <= 2 * NEAR_SHIFTS
    return one.kind == other.kind and near and (one.kind != "poses" or np.allclose(one.poses, other.poses, atol=0.1))


def _by_chance(rays: Rays, poses: np.ndarray, inside: np.ndarray | None = None) -> float:
    """Mean evidence of poses [F, 4, 4] in another order: of where the instrument usually is, whenever."""
    rows = np.arange(len(poses)) if inside is None else np.flatnonzero(inside)
    generator, shuffled = np.random.default_rng(0), poses.copy()
    found = []
    for _ in range(SHUFFLES):
        shuffled[rows] = poses[generator.permutation(rows)]
        found.append(rays.mean(shuffled, inside))
    return float(np.mean(found))


def _likeliest(tried: Iterable[_Alternative], few: Rays) -> list[_Alternative]:
    return sorted(tried, key=lambda one: few.mean(one.poses, one.inside), reverse=True)[:BEST]


def _turned(
    instrument: Instrument, states: list[InstrumentState], poses: np.ndarray, rows: np.ndarray
) -> Iterator[_Alternative]:
    """Other rotations than those recorded, of an instrument whose poses [F, 4, 4] turn enough to tell."""
    if _turning(poses) < TURNING:
        return
    seen = [states[row] for row in rows]
    recorded = np.stack([state.pose.numpy() for state in seen])
    for mistake in rotation_mistakes(recorded):
        turned = _of_root(instrument, mistake.poses, seen)
        message = f"{mistake.what.format(of=_of(instrument))}: turned back, they fit what moves in the images better"
        yield _Alternative(message, mistake.remedy, turned, np.ones(len(rows), dtype=bool), TURNED, "rotations")


def _turns_better(instrument: Instrument, states: list[InstrumentState], poses: np.ndarray, rays: Rays) -> bool:
    """Whether other rotations explain more where they explain most otherwise, without telling which."""
    given = rays.evidence(poses)
    return any(_clearly_turned(rays, given, other) for other in _turned(instrument, states, poses, rays.views.rows))


def _clearly_turned(rays: Rays, given: np.ndarray, other: _Alternative) -> bool:
    """Whether other rotations explain more where they change the evidence `given` most: elsewhere, on the shaft of a
    thin instrument, any rotation explains nearly as much."""
    factor, certainty, _ = rays.compare(given, other.poses, other.inside, most_changed=True)
    return factor > CHANGED_TURNED and certainty > TURNED[1]


def _placed(instrument: Instrument, parsed: Parsed, poses: np.ndarray, rows: np.ndarray) -> Iterator[_Alternative]:
    """Poses of other frames, axes and units."""
    cameras = np.stack([parsed.frames[row].camera.world_from_camera.double().numpy() for row in rows])
    for mistake in placement_mistakes(poses[rows], cameras):
        message = f"{mistake.what.format(of=_of(instrument))}: corrected, they lie on what moves in the images"
        yield _Alternative(
            message, mistake.remedy, mistake.poses, np.ones(len(rows), dtype=bool), ELSEWHERE, mistake.what.split()[0]
        )


class _Shifts:
    """Poses [N, 4, 4] of other frames than those they are listed with, for frames `rows` [F]."""

    def __init__(self, instrument: Instrument, poses: np.ndarray, timeline: Timeline, rows: np.ndarray) -> None:
        self.instrument, self.poses, self.timeline, self.rows = instrument, poses, timeline, rows
        self.longest = int(timeline.longest * LONGEST_SHIFT)

    def likeliest(self, few: Rays) -> list[_Alternative]:
        """The likeliest few of all shifts, in steps and, where uneven, in time; and of all rates of a clock."""
        every = max(1, 2 * self.longest // MOST_SHIFTS)
        steps = [step for step in range(-self.longest, self.longest + 1, every) if step]
        found = _likeliest((self._by_steps(step) for step in steps), few)
        if not self.timeline.is_even:  # frames were left out: then a wrong clock is another shift than wrong rows
            near = _likeliest((self._by_time(step, nearest=True) for step in steps), few)
            found += [self._by_time(one.steps) for one in near]
        rates = _likeliest((self._by_rate(rate) for rate in RATES), few)
        backwards, inside = self.timeline.backwards(self.poses, self.rows)
        message = f"states {_of(self.instrument)} are in reverse order: turned round, they fit the images"
        return [
            *found,
            *rates,
            _Alternative(message, "list them in the images' order", backwards, inside, ELSEWHERE, "backwards"),
        ]

    def refined(self, found: _Alternative, rays: Rays) -> _Alternative:
        """The best of the shifts near to one, on the frames for which all of them have poses."""
        build = self._by_time if found.in_time else self._by_steps
        near = [build(step) for step in range(found.steps - NEAR_SHIFTS, found.steps + NEAR_SHIFTS + 1) if step]
        common = np.all([one.inside for one in near], axis=0)
        means = [rays.mean(one.poses, common) for one in near]
        return near[int(np.argmax(means))] if max(means) > 0 else found

    def _by_steps(self, steps: int) -> _Alternative:
        amount = f"{abs(steps)} frame{'s' * (abs(steps) > 1)}"
        return self._alternative(steps, amount, *self.timeline.by_steps(self.poses, self.rows, steps))

    def _by_time(self, steps: int, nearest: bool = False) -> _Alternative:
        delay = steps * self.timeline.gap
        moved = self.timeline.by_time(self.poses, self.rows, delay, nearest=nearest)
        return replace(self._alternative(steps, f"{abs(delay):.2g} s", *moved), in_time=True)

    def _by_rate(self, rate: float) -> _Alternative:
        poses, inside = self.timeline.by_time(self.poses, self.rows, rate=rate, nearest=True)
        message = f"states {_of(self.instrument)} fit the images better on a clock that runs {rate:.3g} times as fast"
        remedy = "correct their times, or the images' (24, 25 or 30 frames a second?)"
        return _Alternative(message, remedy, poses, inside, SHIFTED, "rate")

    def _alternative(self, steps: int, amount: str, poses: np.ndarray, inside: np.ndarray) -> _Alternative:
        direction = "earlier" if steps > 0 else "later"  # than the images they are listed with
        message = f"states {_of(self.instrument)} fit the images better {amount} {direction}"
        remedy = f"move them {amount} {direction} (a clock's offset, frames dropped or counted from another one?)"
        short = abs(steps) <= min(SHORT_SHIFT, self.timeline.longest // 5)
        return _Alternative(message, remedy, poses, inside, SHIFTED if short else ELSEWHERE, "shift", steps)


def _of(instrument: Instrument) -> str:
    return f"of {printable(instrument.name)}"


def _of_root(instrument: Instrument, poses: np.ndarray, states: list[InstrumentState]) -> np.ndarray:
    """Poses [N, 4, 4] of the part that shows most, from those recorded, which may be another link's."""
    tree = instrument.kinematics
    if tree is None or tree.pose_of is None:
        return poses
    return np.stack([tree.world_from_root(pose, state.joints) for pose, state in zip(poses, states, strict=True)])


def _turning(poses: np.ndarray) -> float:
    """Root mean square deg by which poses [F, 4, 4] are turned from their mean; the same for transposed rotations."""
    turns = Rotation.from_matrix(poses[:, :3, :3])
    return float(np.degrees(np.sqrt(((turns.mean().inv() * turns).magnitude() ** 2).mean())))
