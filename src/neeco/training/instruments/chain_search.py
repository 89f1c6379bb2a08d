"""The search for joints whose axes nobody stated: one after the other, from the body outwards, each on what the joints
before it leave unexplained.

A joint is believed where its readings explain more than the same readings exchanged among the frames do.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from neeco.training.instruments.chain_volume import Chain, ChainEvidence, ChainJoint, Part, direction

Array = NDArray[np.float64]

ANGLES = 18  # of an axis about the shaft, that are tried
STEP = 0.5  # radii between two pivots that are tried
REACH = 3.5  # radii beyond a pivot in which they are compared
GRID_POINTS = 500
NEXT = 0.5, 4.5  # radii beyond the last pivot where the next is looked for
BEHIND, BEYOND = 2.0, 7.0  # radii about the first pivot in which all links lie
EXCHANGES = 0.31, 0.57, 0.17, 0.79  # shares of the frames by which readings are shifted against the images
MIN_RATIO = 1.5  # of the volume that a reading explains to what it does when exchanged
MIN_VOLUME, MIN_OPENING = 0.03, 0.01  # radii^3 that it must explain; where it opens jaws about the axis before
OWN_AXIS = 1.2  # times what it explains about the axis before: an axis of its own is believed
# units of what is refined, and the share of the volume that one unit off the line or off right angles costs
UNIT_MM, UNIT_RAD = 2.0, math.radians(10)
STRAY = 0.002
FIRST_STEP, LAST_STEP, CLOSE = 0.8, 0.5, 0.01  # units: first steps of refining one joint and all, and where it ends
EVALUATIONS = 40  # per number that is refined
JAWS = 0.5, -0.5  # of a reading, by which each of two jaws turns that it opens


@dataclass(frozen=True)
class Finding:
    """A joint, the volume mm^3 that it explains, and what it would with its last reading exchanged among the frames."""

    joint: ChainJoint
    explained: float
    by_chance: float

    @property
    def reading(self) -> str:
        """The one that was explained last."""
        return self.joint.parts[0][-1][0]

    @property
    def excess(self) -> float:
        """mm^3 that are no chance."""
        return self.explained - self.by_chance

    @property
    def opens_jaws(self) -> bool:
        """Whether it moves two links."""
        return len(self.joint.parts) > 1

    @property
    def opens(self) -> str | None:
        """The reading that turns the joint as a whole, where the last one opens jaws about its axis."""
        first = self.joint.parts[0][0][0]
        return None if first == self.reading else first


@dataclass(frozen=True)
class ChainFound:
    """The joints of a chain from the shaft outwards, and the readings that explain nothing."""

    findings: tuple[Finding, ...]  # in the order in which they were found
    chain: Chain  # refined together
    left_out: tuple[str, ...]


@torch.no_grad()
def find_chain(
    evidence: ChainEvidence, slides: Sequence[str], near: float, tip: float, report: Callable[[str], None]
) -> ChainFound:
    """The joints that the readings of `evidence` drive; those named in `slides` slide, the others turn. The first is
    looked for from `near` to `tip`, mm along the shaft."""
    left = list(evidence.readings)
    findings: list[Finding] = []
    depths = np.arange(near, tip, STEP * evidence.radius)
    while left and not (findings and findings[-1].opens_jaws):
        report(f"looking for joint {len(findings) + 1}, which {' or '.join(left)} may move")
        search = _Search(evidence, _joints(findings), frozenset(slides))
        best = search.single(left, depths)
        best = search.jaws(left if best is None else [best.reading], depths, best)
        if best is None:
            break
        left.remove(best.reading)
        findings.append(best)
        depths = float(best.joint.pivot[2]) + evidence.radius * np.arange(*NEXT, STEP)
    chain = _joints(findings)
    if len(chain) > 1:
        chain = tuple(_climb(evidence, (), chain, chain[0].pivot, LAST_STEP))
    return ChainFound(tuple(findings), chain, tuple(left))


def _joints(findings: Sequence[Finding]) -> Chain:
    """Of all findings; one that opens jaws about the axis of the joint before takes its place."""
    chain: Chain = ()
    for finding in findings:
        chain = (*(chain[:-1] if finding.opens is not None else chain), finding.joint)
    return chain


@dataclass(frozen=True)
class _Search:
    """For the joint that follows a chain."""

    evidence: ChainEvidence
    chain: Chain
    slides: frozenset[str]

    def single(self, left: Sequence[str], depths: Array) -> Finding | None:
        """The joint of a single link that one of the readings `left` explains most of; None where none explains
        anything."""
        starts = {name: self._start(self._single(name), depths) for name in left}
        for name in sorted(left, key=lambda name: -starts[name][1]):
            finding = self._weighed(starts[name][0])
            if self._believed(finding):
                return finding
        return None

    def jaws(self, left: Sequence[str], depths: Array, single: Finding | None = None) -> Finding | None:
        """Two jaws that one of the readings `left` opens, about the axis of the joint before or one of their own; or a
        `single` link, where they do not explain clearly more: the better of two turns always explains a little more.
        None where nothing explains anything."""
        turning = [name for name in left if name not in self.slides]
        own = [self._weighed(self._start(self._jaws(name), depths)[0]) for name in turning]
        opened = [self._opened(name) for name in turning if self.chain and not self.chain[-1].slides]
        best = max(filter(self._believed, opened), key=lambda finding: finding.excess, default=None)
        others = [] if single is None else [single]
        for other in sorted(filter(self._believed, own), key=lambda finding: -finding.excess)[:1]:
            if single is None or other.excess > OWN_AXIS * single.excess:
                others.append(other)
        for other in others:
            if best is None or other.excess > OWN_AXIS * best.excess:
                best = other
        return best

    def _single(self, name: str) -> tuple[Part, ...]:
        return (((name, 1.0),),)

    def _jaws(self, name: str) -> tuple[Part, ...]:
        return tuple(((name, gain),) for gain in JAWS)

    def _opened(self, name: str) -> Finding:
        """Jaws about the axis of the chain's last joint."""
        last = self.chain[-1]
        parts = tuple((*part, (name, gain)) for part in last.parts for gain in JAWS)
        return self._weighed(replace(last, parts=parts), self.chain[:-1])

    def _believed(self, finding: Finding) -> bool:
        beyond = finding.opens is not None or not self.chain or bool(finding.joint.pivot[2] > self.chain[-1].pivot[2])
        least = (MIN_VOLUME if finding.opens is None else MIN_OPENING) * self.evidence.radius**3
        return beyond and finding.explained > max(least, MIN_RATIO * finding.by_chance)

    def _start(self, parts: tuple[Part, ...], depths: Array) -> tuple[ChainJoint, float]:
        """The best joint on a grid, with how much more mm^3 it turns onto evidence than exchanged readings do."""
        slides = parts[0][0][0] in self.slides
        angles = [0.0, math.pi] if slides else [2 * math.pi * k / ANGLES for k in range(ANGLES)]
        cell = self.evidence.cell(0, REACH, GRID_POINTS)
        score, gain = self._grid(parts, depths, angles, slides, 0)
        _, exchanged = self._grid(parts, depths, angles, slides, self._shifts()[0])
        best = [np.unravel_index(table.argmax(), table.shape) for table in (score, gain)]
        # the first prefers pivots too far back, the second pivots too far forward
        depth = float(depths[best[0][0]] + depths[best[1][0]]) / 2
        axis = direction(slides, angles[best[1][1]])
        start = ChainJoint(slides, self._on_line(depth), axis.to(self.evidence.still), parts)
        return start, cell * float(gain.max() - max(exchanged.max(), 0.0))

    def _grid(
        self, parts: tuple[Part, ...], depths: Array, angles: Sequence[float], slides: bool, shift: int
    ) -> tuple[Array, Array]:
        """[D, A] volume beyond pivots at `depths` mm when moved about axes at `angles`, and less that of the same when
        not moved; in points."""
        evidence, carrier = self.evidence, self.evidence.carrier(self.chain)
        score, gain = np.zeros((2, len(depths), len(angles)))
        for d, depth in enumerate(depths):
            pivot = self._on_line(float(depth))
            points = evidence.box(pivot, 0, REACH, GRID_POINTS)
            still = float(evidence.volume(carrier, points).sum())
            for a, angle in enumerate(angles):
                joint = ChainJoint(slides, pivot, direction(slides, angle).to(pivot), parts)
                moved = [carrier @ joint.motion(evidence.value(part, shift)) for part in parts]
                volumes = [evidence.volume(motion, points) for motion in moved]
                score[d, a] = float(torch.stack(volumes).amax(0).sum())
                gain[d, a] = score[d, a] - still
        return score, gain

    def _on_line(self, depth: float) -> Tensor:
        """[3] mm: at `depth` along the shaft, where across it the last pivot lies."""
        across = self.chain[-1].pivot[:2] if self.chain else self.evidence.still.new_zeros(2)
        return torch.cat([across, across.new_tensor([depth])])

    def _weighed(self, start: ChainJoint, before: Chain | None = None) -> Finding:
        """A joint, refined, with what it explains; `before`: the joints that carry it, where that is not the chain."""
        before = self.chain if before is None else before
        # along a shaft that looks the same everywhere, sliding explains much at any reading
        shift = self._shifts()[0] if start.slides else None
        (joint,) = _climb(self.evidence, before, [start], self._first_pivot(start), FIRST_STEP, shift)
        return self._explains(joint, before)

    def _explains(self, joint: ChainJoint, before: Chain) -> Finding:
        """What a joint explains beyond the chain, and beyond chance."""
        evidence = self.evidence
        points = evidence.box(self._first_pivot(joint), BEHIND, BEYOND)
        unmoved = evidence.volume(evidence.still, points)
        known = evidence.explained(self.chain, points, unmoved)
        base = known if before is self.chain else evidence.explained(before, points, unmoved)
        carrier = evidence.carrier(before)

        def more(shift: int) -> float:
            gained = evidence.explained((joint,), points, base, carrier, shift) - known
            return evidence.cell(BEHIND, BEYOND) * float(gained.double().sum())

        return Finding(joint, more(0), max(0.0, float(np.mean([more(shift) for shift in self._shifts()]))))

    def _first_pivot(self, joint: ChainJoint) -> Tensor:
        return self.chain[0].pivot if self.chain else joint.pivot

    def _shifts(self) -> list[int]:
        return [round(share * len(self.evidence.camera_from_shaft)) for share in EXCHANGES]


def _climb(
    evidence: ChainEvidence,
    before: Chain,
    joints: Sequence[ChainJoint],
    pivot: Tensor,
    step: float,
    shift: int | None = None,
) -> list[ChainJoint]:
    """`joints`, which follow the chain `before`, moved to where they explain most of the volume about `pivot`; most
    beyond what they do with the last reading shifted by `shift` frames, where that is given."""
    points = evidence.box(pivot, BEHIND, BEYOND)
    known = evidence.explained(before, points, evidence.volume(evidence.still, points))
    carrier = evidence.carrier(before)
    starts = [_numbers(joint) for joint in joints]
    places = np.cumsum([0, *map(len, starts)])

    def joints_of(numbers: Array) -> list[ChainJoint]:
        split = [numbers[a:b] for a, b in itertools.pairwise(places)]
        return [_with_numbers(joint, own) for joint, own in zip(joints, split, strict=True)]

    def loss(numbers: Array) -> float:
        moved = joints_of(numbers)
        strayed = 1 - STRAY * sum(_strayed(joint) for joint in moved)
        volume = evidence.explained(tuple(moved), points, known, carrier).double().sum()
        if shift is not None:
            volume = volume - evidence.explained(tuple(moved), points, known, carrier, shift).double().sum()
        return -float(volume) * strayed

    start = np.concatenate(starts)
    simplex = np.vstack([start, start + step * np.eye(len(start))])
    options = {"maxfev": EVALUATIONS * len(start), "initial_simplex": simplex, "xatol": CLOSE, "fatol": 0.05}
    return joints_of(minimize(loss, start, method="Nelder-Mead", options=options).x)


def _numbers(joint: ChainJoint) -> Array:
    """What is refined of a joint, in units: of one that turns the pivot [3], its axis' angle about the shaft and tilt;
    of one that slides the pivot along the shaft, and two tilts."""
    pivot, axis = joint.pivot.double().cpu().numpy(), joint.axis.double().cpu().numpy()
    if joint.slides:
        return np.array([pivot[2] / UNIT_MM, *(axis[:2] / axis[2] / UNIT_RAD)])
    angle, tilt = math.atan2(axis[1], axis[0]), math.asin(np.clip(axis[2], -1, 1))
    return np.array([*(pivot / UNIT_MM), angle / UNIT_RAD, tilt / UNIT_RAD])


def _with_numbers(joint: ChainJoint, numbers: Array) -> ChainJoint:
    pivot = joint.pivot.clone()
    if joint.slides:
        pivot[2] = UNIT_MM * numbers[0]
        tilts = [math.atan(UNIT_RAD * tilt) for tilt in numbers[1:]]
        axis = direction(True, 0.0 if joint.axis[2] > 0 else math.pi, tilts)
    else:
        pivot = pivot.new_tensor(UNIT_MM * numbers[:3])
        axis = direction(False, UNIT_RAD * numbers[3], (UNIT_RAD * numbers[4], 0.0))
    return replace(joint, pivot=pivot, axis=axis.to(pivot))


def _strayed(joint: ChainJoint) -> float:
    """Squared units by which a joint lies off the shaft's line, and its axis off right angles to it (or off it, where
    it slides)."""
    numbers = _numbers(joint)
    off = numbers[1:] if joint.slides else numbers[[0, 1, 4]]
    return float(np.square(off).sum())
