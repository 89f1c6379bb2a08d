"""Check by the images that instruments are where their states say, and try known mistakes where they are not.

`motion_evidence` measures how well poses explain what moves. A mistake is named only where the poses without it explain
that clearly better than those given. Where poses explain no more than those of other frames would, and no known mistake
explains it, only the contradiction is reported.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.capture.checks.mistakes import placement_mistakes, rotation_mistakes
from neeco.capture.checks.motion_evidence import MotionEvidence, TimeSteps
from neeco.capture.checks.pictures import Pictures, in_threads
from neeco.capture.documents import printable
from neeco.capture.model import Instrument, InstrumentState
from neeco.capture.readers.parsed import Parsed

STATES, POSES = "frames[*].instruments[*]", "frames[*].instruments[*].pose"
# shifts of states in time
SMALL_SHIFT = 16  # steps of time, at most a fifth of a recording's: shifts so small explain much even where wrong
MAX_SHIFTS = 600  # that are tried over a whole recording
MAX_SHIFT = 1 / 2  # of a recording
SHIFT_RADIUS = 5  # steps to either side of the likeliest shift, which are compared on the same frames
RATES = (0.5, *np.geomspace(0.75, 1 / 0.75, 116), 2.0)  # of a clock
# what makes a hypothesis clear
MAX_HYPOTHESES = 3  # of each kind that are compared with all rays
MIN_FACTOR_CHANGED = 1.25  # for rotations, on the rays that they change most
MIN_TURNING_DEG = 25.0  # root mean square: transposed rotations explain smaller turns nearly as well, or better
MIN_FACTOR_BY_CHANCE = 3.0  # by which poses without a mistake explain more than the same in another order
MIN_FRAMES_ELSEWHERE = 45  # in fewer frames one of many hypotheses explains the motion by chance
EQUALLY_LIKELY = 0.9  # share of the most evidence from which another mistake is as likely
# what makes poses contradicted
CONTRADICTED = 0.15  # mean evidence below which poses explain too little
FACTOR_BY_CHANCE, FACTOR_BY_CHANCE_FEW = 4.0, 1.5  # times the evidence by chance below which they do, in many and in
FEW_FRAMES = 36  # frames, in which chance explains much
N_SHUFFLES = 6
MIN_TRAVEL = 0.055  # of the image's width: the poses of any frame explain an instrument that moves less


class _Threshold(NamedTuple):
    """Margin by which poses without a mistake must explain more than the given ones."""

    factor: float  # on the mean evidence
    certainty: float  # standard errors over blocks of frames
    evidence: float
    min_frames: int = 0  # that have these poses

    def exceeded_by(self, factor: float, certainty: float, evidence: float) -> bool:
        return factor > self.factor and certainty > self.certainty and evidence > self.evidence


# A shift changes much at once; transposed rotations only as much as the instrument turns; where all else is wrong,
# nearly nothing is explained. Of many hypotheses one may fit by chance.
TURNED, SHIFTED = _Threshold(1.1, 3.0, 0.15), _Threshold(1.15, 5.0, 0.2)
ELSEWHERE = _Threshold(1.5, 5.0, 0.2, MIN_FRAMES_ELSEWHERE)


@dataclass(frozen=True)
class _PoseHypothesis:
    """Poses [F, 4, 4] without a mistake, and which frames have them, [F]."""

    message: str
    remedy: str
    poses: np.ndarray
    available: np.ndarray
    threshold: _Threshold
    kind: Literal["poses", "positions", "rotations", "shift", "rate", "backwards"]
    _: KW_ONLY
    steps: int = 0  # by which states are shifted
    in_time: bool = False  # by so many median steps of time, not by rows


@dataclass(frozen=True)
class MotionFault:
    """Contradiction between the images and an instrument's states: the field of these, and the remedy."""

    field: str
    message: str
    remedy: str
    named: bool = False  # by a mistake that explains it


@dataclass(frozen=True)
class MotionVerdict:
    """Evidence of the images on an instrument's states: a fault, or support; neither where too little moves."""

    fault: MotionFault | None
    supported: bool


def check_motion(parsed: Parsed, known: Mapping[str, MotionVerdict], pictures: Pictures) -> None:
    """Report instruments whose states the images contradict, with the mistake that explains it if one does.

    known: verdicts by instrument that were reached before. Says nothing of a capture without registered poses or
    without measured points, or where too little moves. `parsed` must be free of errors.
    """
    unknown = [instrument for instrument in parsed.instruments if instrument.name not in known]
    motion = MotionEvidence.of(parsed, pictures) if unknown else None
    verdicts = dict(known)
    if motion is not None:
        verdicts |= {instrument.name: judge_motion(parsed, instrument, motion) for instrument in unknown}
    for verdict in verdicts.values():
        if (fault := verdict.fault) is not None:
            parsed.header(fault.field).warning(fault.message, fault.remedy, contradicted=True)


def judge_motion(parsed: Parsed, instrument: Instrument, motion: MotionEvidence) -> MotionVerdict:
    """Compare the states of an instrument, which every frame has, with the motion in the images."""
    states, poses = _recorded(parsed, instrument)
    rows = motion.views.rows
    others = [_recorded(parsed, item)[1][rows] for item in parsed.instruments if item.name != instrument.name]
    own = motion.without(others, poses[rows])
    if own is None:
        return MotionVerdict(None, False)
    judged = _Judged(parsed, instrument, states, poses, own)
    given = own.mean(judged.given)
    fault = _fault(judged, given)
    if fault is not None and not fault.named and len(own.ray_views) < len(motion.ray_views) / 2:
        fault = None  # the others explain most of what moves
    return MotionVerdict(fault, fault is None and given > CONTRADICTED)


def _recorded(parsed: Parsed, instrument: Instrument) -> tuple[list[InstrumentState], np.ndarray]:
    """Return the states of an instrument, which every frame has, and the poses [N, 4, 4] of its root."""
    states = [frame.state.instruments[instrument.name] for frame in parsed.frames]
    return states, root_poses(instrument, np.stack([state.pose.numpy() for state in states]), states)


@dataclass(frozen=True)
class _Judged:
    """An instrument's states in all frames of a capture, and the motion in its images."""

    parsed: Parsed
    instrument: Instrument
    states: list[InstrumentState]
    poses: np.ndarray  # [N, 4, 4] of its root
    motion: MotionEvidence

    @property
    def rows(self) -> np.ndarray:
        """[F] frames whose images are compared."""
        return self.motion.views.rows

    @property
    def given(self) -> np.ndarray:
        """[F, 4, 4] poses of these frames."""
        return self.poses[self.rows]

    @property
    def everywhere(self) -> np.ndarray:
        """[F] True: all of these frames."""
        return np.ones(len(self.rows), dtype=bool)

    @property
    def of(self) -> str:
        return f"of {printable(self.instrument.name)}"


def root_poses(instrument: Instrument, poses: np.ndarray, states: Sequence[InstrumentState]) -> np.ndarray:
    """Poses [N, 4, 4] of the instrument's root, which shows most, from recorded poses, which may be another link's."""
    tree = instrument.kinematics
    if tree is None or tree.pose_of is None:
        return poses
    return np.stack([tree.world_from_root(pose, state.joints) for pose, state in zip(poses, states, strict=True)])


def evidence_by_chance(motion: MotionEvidence, poses: np.ndarray, available: np.ndarray | None = None) -> float:
    """Mean evidence of poses [F, 4, 4] in random order: the instrument where it usually is, at other times."""
    rows = np.arange(len(poses)) if available is None else np.flatnonzero(available)
    generator, shuffled = np.random.default_rng(0), poses.copy()
    found = []
    for _ in range(N_SHUFFLES):
        shuffled[rows] = poses[generator.permutation(rows)]
        found.append(motion.mean(shuffled, available))
    return float(np.mean(found))


def _fault(judged: _Judged, given: float) -> MotionFault | None:
    """Return how the images contradict an instrument's states of mean evidence `given`; None where they do not."""
    name, motion = printable(judged.instrument.name), judged.motion
    found = _likeliest_mistake(judged)
    if found is not None:
        field = POSES if found.kind in ("poses", "positions", "rotations") else STATES
        return MotionFault(field, found.message, found.remedy, named=True)
    if given > CONTRADICTED:
        evidence = motion.evidence(judged.given)
        if not any(_clearly_turned(motion, evidence, other) for other in _turned(judged)):
            return None
        message = f"rotations of {name} do not turn as the instrument does in the images"
        remedy = "are they transposed, or are quaternions in another order (w x y z, x y z w)?"
        return MotionFault(POSES, message, remedy)
    if motion.travel(judged.given) < MIN_TRAVEL:
        return None
    by_chance = evidence_by_chance(motion, judged.given)
    if given > (FACTOR_BY_CHANCE_FEW if len(judged.rows) < FEW_FRAMES else FACTOR_BY_CHANCE) * by_chance:
        return None
    message = (
        f"the images contradict the poses of {name}: what moves in them does not lie where the poses say (evidence "
        f"{given:.2f}, {by_chance:.2f} by chance)"
    )
    remedy = "shifts, other axes, frames and units were tried; states, cameras and images must be of one recording"
    return MotionFault(POSES, message, remedy)


def _likeliest_mistake(judged: _Judged) -> _PoseHypothesis | None:
    """The mistake without which the poses of an instrument explain clearly, and most, more of what moves."""
    motion = judged.motion
    given, few = motion.evidence(judged.given), motion.thinned()
    shifts = _Shifts(judged)
    tried = [*_turned(judged), *_likeliest_few(_placed(judged), few), *shifts.likeliest(few)]
    clear, others = [], []
    for one in tried:
        if one.available.sum() < one.threshold.min_frames:
            continue
        found = motion.compare(given, one.poses, one.available)
        if found[0] > ELSEWHERE.factor:
            others.append((found[2], one))
        enough = one.threshold.exceeded_by(*found)
        if enough and one.kind == "rotations":
            enough = _clearly_turned(motion, given, one)
        if enough and found[2] > MIN_FACTOR_BY_CHANCE * evidence_by_chance(few, one.poses, one.available):
            clear.append((found[2], one))
    if not clear:
        return None
    most, best = max(clear, key=lambda found: found[0])
    rivals = [one for evidence, one in others if evidence > EQUALLY_LIKELY * most and not _same(one, best)]
    if rivals and any(one is best for _, one in others):
        return None  # one of them, but which cannot be decided
    best = shifts.refined(best) if best.steps else best
    # at the end of the range that was tried another shift may be the right one
    return None if abs(best.steps) >= shifts.longest > 0 else best


def _same(one: _PoseHypothesis, other: _PoseHypothesis) -> bool:
    """Return True if two hypotheses are one mistake, at most of another amount."""
    near = abs(one.steps - other.steps) <= 2 * SHIFT_RADIUS
    return one.kind == other.kind and near and (one.kind != "poses" or np.allclose(one.poses, other.poses, atol=0.1))


def _likeliest_few(tried: Iterable[_PoseHypothesis], few: MotionEvidence) -> list[_PoseHypothesis]:
    listed = list(tried)
    means = in_threads(lambda one: few.mean(one.poses, one.available), listed)
    order = sorted(range(len(listed)), key=means.__getitem__, reverse=True)  # of equal ones the first
    return [listed[index] for index in order[:MAX_HYPOTHESES]]


def _turned(judged: _Judged) -> Iterator[_PoseHypothesis]:
    """Other rotations than those recorded, of an instrument whose poses turn enough to compare them."""
    turns = Rotation.from_matrix(judged.given[:, :3, :3])
    turning = np.degrees(np.sqrt(((turns.mean().inv() * turns).magnitude() ** 2).mean()))
    if turning < MIN_TURNING_DEG:
        return
    states = [judged.states[row] for row in judged.rows]
    for mistake in rotation_mistakes(np.stack([state.pose.numpy() for state in states])):
        message = f"{mistake.what.format(of=judged.of)}: turned back, they fit what moves in the images better"
        poses = root_poses(judged.instrument, mistake.poses, states)
        yield _PoseHypothesis(message, mistake.remedy, poses, judged.everywhere, TURNED, mistake.kind)


def _clearly_turned(motion: MotionEvidence, given: np.ndarray, other: _PoseHypothesis) -> bool:
    """Return True if other rotations explain more where they change the evidence `given` most: on the shaft of a thin
    instrument any rotation explains nearly as much."""
    factor, certainty, _ = motion.compare(given, other.poses, other.available, most_changed=True)
    return factor > MIN_FACTOR_CHANGED and certainty > TURNED.certainty


def _placed(judged: _Judged) -> Iterator[_PoseHypothesis]:
    """Poses of other frames, axes and units."""
    frames = [judged.parsed.frames[row] for row in judged.rows]
    cameras = np.stack([frame.camera.world_from_camera.double().numpy() for frame in frames])
    for mistake in placement_mistakes(judged.given, cameras):
        message = f"{mistake.what.format(of=judged.of)}: corrected, they lie on what moves in the images"
        yield _PoseHypothesis(message, mistake.remedy, mistake.poses, judged.everywhere, ELSEWHERE, mistake.kind)


class _Shifts:
    """Poses of other frames than those they are listed with."""

    def __init__(self, judged: _Judged) -> None:
        self.judged, self.poses, self.rows = judged, judged.poses, judged.rows
        self.timeline = TimeSteps(np.array([frame.state.time for frame in judged.parsed.frames]))
        self.longest = int(self.timeline.longest * MAX_SHIFT)

    def likeliest(self, few: MotionEvidence) -> list[_PoseHypothesis]:
        """The likeliest few of all shifts, in steps and, where uneven, in time; and of all rates of a clock."""
        every = max(1, 2 * self.longest // MAX_SHIFTS)
        steps = [step for step in range(-self.longest, self.longest + 1, every) if step]
        found = _likeliest_few((self._by_steps(step) for step in steps), few)
        if not self.timeline.is_even:  # frames were left out: then a wrong clock is another shift than wrong rows
            near = _likeliest_few((self._by_time(step, nearest=True) for step in steps), few)
            found += [self._by_time(one.steps) for one in near]
        found += _likeliest_few((self._by_rate(rate) for rate in RATES), few)
        message = f"states {self.judged.of} are in reverse order: turned round, they fit the images"
        remedy, backwards = "list them in the images' order", self.timeline.backwards(self.poses, self.rows)
        return [*found, _PoseHypothesis(message, remedy, *backwards, ELSEWHERE, "backwards")]

    def refined(self, found: _PoseHypothesis) -> _PoseHypothesis:
        """The best of the shifts near to one, on the frames for which all of them have poses."""
        build = self._by_time if found.in_time else self._by_steps
        near = [build(step) for step in range(found.steps - SHIFT_RADIUS, found.steps + SHIFT_RADIUS + 1) if step]
        common = np.all([one.available for one in near], axis=0)
        means = [self.judged.motion.mean(one.poses, common) for one in near]
        return near[int(np.argmax(means))] if max(means) > 0 else found

    def _by_steps(self, steps: int) -> _PoseHypothesis:
        amount = f"{abs(steps)} frame{'s' * (abs(steps) > 1)}"
        return self._shift(steps, amount, *self.timeline.by_steps(self.poses, self.rows, steps))

    def _by_time(self, steps: int, nearest: bool = False) -> _PoseHypothesis:
        delay = steps * self.timeline.gap
        moved = self.timeline.by_time(self.poses, self.rows, delay, nearest=nearest)
        return replace(self._shift(steps, f"{abs(delay):.2g} s", *moved), in_time=True)

    def _shift(self, steps: int, amount: str, poses: np.ndarray, available: np.ndarray) -> _PoseHypothesis:
        direction = "earlier" if steps > 0 else "later"  # than the images they are listed with
        small = abs(steps) <= min(SMALL_SHIFT, self.timeline.longest // 5)
        message = f"states {self.judged.of} fit the images better {amount} {direction}"
        remedy = f"move them {amount} {direction} (a clock's offset, frames dropped or counted from another one?)"
        return _PoseHypothesis(message, remedy, poses, available, SHIFTED if small else ELSEWHERE, "shift", steps=steps)

    def _by_rate(self, rate: float) -> _PoseHypothesis:
        found = self.timeline.by_time(self.poses, self.rows, rate=rate, nearest=True)
        message = f"states {self.judged.of} fit the images better on a clock that runs {rate:.3g} times as fast"
        remedy = "correct their times, or the images' (24, 25 or 30 frames a second?)"
        return _PoseHypothesis(message, remedy, *found, SHIFTED, "rate")
