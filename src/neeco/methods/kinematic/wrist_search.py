"""Links of an unstated wrist, estimated from the images: those whose capsules explain the evidence best.

Wristed instruments share one structure: the shaft carries a wrist that turns about an axis across it, and the wrist
carries two jaws that turn about a second axis, perpendicular to the wrist and the first axis. Unknown are the positions
of the axes, and which reading drives what.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np
import torch

from neeco.capture.kinematics import REVOLUTE, KinematicTree, Link
from neeco.evidence.carving import CarvedShape, Evidence
from neeco.geometry.rotations import rigid
from neeco.methods.kinematic.articulation import Articulation
from neeco.methods.kinematic.link_registration import CAPSULES, SilhouetteProblem


@dataclass(frozen=True, kw_only=True)
class WristSearchSettings:
    """Candidate wrists, and the criterion for accepting one."""

    max_joints: int = 3  # joints that drive the links: wrist, both jaws, and one jaw against the other
    max_others: int = 4  # joints that correlate with the poses, one of which may be the wrist's
    n_headings: int = 8  # headings of the first axis, about the shaft
    first_radii: tuple[float, ...] = (2.0, 3.5, 5.0, 6.5, 8.0)  # shaft radii from the first axis to the tip
    apart_radii: float = 2.0  # shaft radii from the first to the second axis
    shares: tuple[float, ...] = (0.0, 0.3, 0.7, 1.0)  # share of the opening by which the first jaw turns, if not half
    n_fitted: int = 8  # number of trees that are fitted
    turn_sd: float = 0.25  # rad, prior of an axis of the grid
    shift_sd_mm: float = 4.0  # prior of a pivot of the grid
    min_gain: float = 3.0  # minimum gain in -log likelihood by either axis, over the same links at rest


WRISTS = WristSearchSettings()

Readings = Mapping[str, float]
FITTED = ("shaft", "radii", "ends", "turns", "shifts", "offsets")


@dataclass(frozen=True, kw_only=True)
class _Wrist:
    """A hypothesis: readings that drive the wrist, both jaws, and one jaw against the other (None: no reading), and the
    positions of both axes."""

    first: str
    second: str | None
    jaw: str | None
    heading: float  # rad, of the first axis about the shaft
    back: float  # mm from the first axis to the shape's tip
    sense: float  # 1 or -1, of the second reading
    share: float = 0.5  # share of the opening by which the first jaw turns

    def tree(self, shape: CarvedShape, closed: Readings) -> KinematicTree:
        """Return the links in the instrument's frame; closed: readings at which the jaws are parallel to the wrist."""
        base = shape.instrument_from_shaft.double().cpu().numpy()
        across = base[:3, 0] * math.cos(self.heading) + base[:3, 1] * math.sin(self.heading)
        pivot = base[:3, 3] + (shape.tip - self.back) * base[:3, 2]
        step, axis = WRISTS.apart_radii * shape.radius * base[:3, 2], np.cross(base[:3, 2], across)
        links = [Link("shaft"), Link("wrist", "shaft", REVOLUTE, rigid(np.eye(3), pivot), across, {self.first: 1.0})]
        for name, gain in (("jaw_left", -self.share), ("jaw_right", 1 - self.share)):
            value = {} if self.second is None else {self.second: self.sense}
            if self.jaw is not None and gain:
                value[self.jaw] = gain
            offset = -gain * closed[self.jaw] if self.jaw is not None else 0.0
            place = rigid(np.eye(3), step)
            moving = Link(name, "wrist", REVOLUTE, place, axis, value, offset=offset)
            links.append(moving if value else Link(name, "wrist", origin=place))
        return KinematicTree(tuple(links))


@torch.no_grad()
def search_wrist(
    evidence: Evidence,
    name: str,
    shape: CarvedShape,
    readings: Sequence[Mapping[str, float]],
    joints: Sequence[str],
    others: Sequence[str] = (),
) -> KinematicTree | None:
    """Return the wrist and two jaws that explain the evidence best, in the instrument's frame; None if the wrist, or
    the jaws' common rotation, explains hardly anything.

    readings: of every frame of the evidence; joints: two or three of them, all of which drive a link; others:
    candidates for a third where there are two.
    """
    closed = {joint: min(frame_readings[joint] for frame_readings in readings) for joint in (*joints, *others)}

    def problem_of(wrist: _Wrist, readings: Sequence[Mapping[str, float]] = readings) -> SilhouetteProblem:
        links = Articulation(wrist.tree(shape, closed)).to(evidence.device)
        line = links.rest_line()
        assert line is not None
        problem = SilhouetteProblem(links, evidence, name, shape, line, readings)
        problem.layout["turns"].fill_(WRISTS.turn_sd)
        problem.layout["shifts"].fill_(WRISTS.shift_sd_mm)
        problem.fit_only(FITTED)
        return problem

    def first_cost(wrist: _Wrist) -> float:
        problem = problem_of(wrist)
        problem.compare_at(CAPSULES.widths[0])
        return problem.cost(np.zeros(problem.size))

    def fitted_cost(wrist: _Wrist) -> float:
        problem = problem_of(wrist)
        return problem.cost(problem.minimised(coarse=True))

    likely = sorted(_hypotheses(shape, joints, others), key=first_cost)[: WRISTS.n_fitted]
    costs = {wrist: fitted_cost(wrist) for wrist in likely}
    best = min(costs, key=costs.__getitem__)
    if best.jaw is not None:
        unequal = [replace(best, share=share) for share in WRISTS.shares]
        costs |= {wrist: fitted_cost(wrist) for wrist in unequal}
        best = min(costs, key=costs.__getitem__)
    problem = problem_of(best)
    parameters = problem.minimised()
    for joint in filter(None, (best.first, best.second)):
        rest = {joint: float(np.mean([frame_readings[joint] for frame_readings in readings]))}
        resting = problem_of(best, [{**frame_readings, **rest} for frame_readings in readings])
        if resting.cost(resting.minimised()) - problem.cost(parameters) < WRISTS.min_gain:
            return None
    pivots, axes = (part.double().cpu().numpy() for part in problem.corrected_axes(problem.parts(parameters)))
    return _placed(best.tree(shape, closed), best.jaw, pivots, axes)


def _hypotheses(shape: CarvedShape, joints: Sequence[str], others: Sequence[str]) -> Iterator[_Wrist]:
    """Generate the grid's hypotheses: which reading drives what, both axes, and the second's direction."""
    roles: list[tuple[str, str | None, str | None]] = []
    if len(joints) == 2:
        roles += [role for one, other in permutations(joints) for role in ((one, other, None), (one, None, other))]
    for three in [joints] if len(joints) == 3 else [(*joints, other) for other in others]:
        roles += [(first, second, jaw) for first, second, jaw in permutations(three)]
    headings = np.arange(WRISTS.n_headings) * (2 * math.pi / WRISTS.n_headings)
    for (first, second, jaw), heading, back in product(roles, headings, WRISTS.first_radii):
        for sense in (1.0,) if second is None else (1.0, -1.0):
            yield _Wrist(
                first=first, second=second, jaw=jaw, heading=float(heading), back=back * shape.radius, sense=sense
            )


def _placed(tree: KinematicTree, jaw: str | None, pivots: np.ndarray, axes: np.ndarray) -> KinematicTree:
    """Return the tree with its fitted axes, outermost first. The sign of the second makes its largest component
    positive; the left jaw opens towards (shaft x axis), as in `Hinges`."""
    (outer, inner), (second, first) = pivots, axes
    sign = float(np.sign(second[np.abs(second).argmax()]))
    shaft, wrist, left, right = tree.links
    if sign < 0 and jaw is not None:
        left, right = replace(right, name=left.name), replace(left, name=right.name)
    placed = [shaft, replace(wrist, origin=rigid(np.eye(3), inner), axis=first)]
    for link in (left, right):
        value = {reading: sign * gain for reading, gain in link.value.items()}
        axis = sign * second if value else link.axis
        offset = sign * link.offset
        placed.append(replace(link, origin=rigid(np.eye(3), outer - inner), axis=axis, value=value, offset=offset))
    return KinematicTree(tuple(placed))
