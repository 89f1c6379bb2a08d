"""Start the links of a stated kinematic tree: carve each in its own frame, and check the readings that move it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import torch
from torch import Tensor, nn

from neeco.capture.model import Instrument
from neeco.evidence.carving import (
    CARVING,
    CarvedShape,
    Evidence,
    PosedViews,
    camera_from_instrument,
    carve_along,
    frame_along,
    posed_views,
    score_points,
)
from neeco.geometry.rotations import rotate_about
from neeco.methods.kinematic.articulation import Articulation
from neeco.training.session import GaussianSession


@dataclass(frozen=True, kw_only=True)
class LinkSearchSettings:
    """Settings of carving links and of the check of readings."""

    link_logit: float = 2.0  # initial logit of a seed for the link that it was carved on
    shaft_share: float = 0.4  # of the seeds
    reach_radii: float = 7.0  # shaft radii beyond its pivot within which an end link is searched
    margin_radii: float = 2.0  # shaft radii about the pivots beyond it within which another link is searched
    candidates_per_seed: int = 20  # sampled about a link
    evidence_tolerance: float = 0.03  # by which the evidence of another link may be larger
    # tolerances within which a carved shaft agrees with the line of the links at rest
    min_cosine: float = 0.85  # between both directions
    max_offset_radii: float = 1.5  # of the line from the first pivot, in shaft radii
    max_offset_mm: float = 4.0  # the same, if larger
    # of the best evidence of a link's points: stated axes may be off, and all points with them
    min_relative_level: float = 0.85
    min_radius_ratio: float = 0.33  # of the shaft's radius to the distance between the first two pivots
    max_shaft_radius_mm: float = 6.5  # of instruments that pass a trocar
    # shaft radii behind the first pivot: with less evidence, the shaft is seeded about its line
    min_evident_radii: float = 3.0
    shaft_length: float = 0.3  # of the distance to the tissue: the shaft that is seeded about its line
    side_tolerance_radii: float = 0.3  # by which a link that is searched on one side of its pivot may lie on the other
    min_visible_share: float = 0.05  # of the frames, that must observe a seed
    heading_sigma: float = 0.5  # rad, of stated headings
    heading_weight: float = 0.02  # of evidence, by which a heading one such deviation off may be less likely
    # over half way open and straight on: where jaws move, any opening has some evidence
    min_evidence_gain: float = 0.25
    # check of the readings
    check_points: int = 1500  # per link
    check_reach_radii: float = 4.0  # shaft radii about the pivots of end links within which they lie
    check_margin_radii: float = 2.0  # shaft radii about the pivots of other links within which they lie
    max_check_frames: int = 80  # evenly spaced
    min_volume_ratio: float = 1.15  # of the volume on evidence with other readings, from which a warning is given
    check_min_visible_share: float = 0.1  # of the frames, that must observe a point


LINKS = LinkSearchSettings()

# jaws whose opening was not recorded: openings (of the limits' range) and headings (rad) that are tried, and the points
# that must be evident next to the plane between them, in radii from the pivot, along the axis and from the plane
OPENINGS = torch.linspace(0, 1, 9)
HEADINGS = torch.linspace(-1.2, 1.2, 13)
PLANE_OFFSETS = torch.cartesian_prod(torch.linspace(1, 4, 7), torch.linspace(-0.3, 0.3, 3), torch.linspace(0.1, 0.3, 3))


@torch.no_grad()
def align_to_links(
    session: GaussianSession,
    links: Articulation,
    evidence: Evidence,
    name: str,
    shape: CarvedShape,
    generator: torch.Generator,
) -> CarvedShape:
    """Return `shape`, or one carved about the line of the links at rest where its line is another.

    An instrument that hardly turns leaves evidence along its lines of sight, too. The radius is at least a share of the
    distance of the first pivots: where the tissue's fit absorbed a dark shaft, little evidence of it is left."""
    line = links.rest_line()
    if line is None:
        return shape
    pivot, step = line
    direction = nn.functional.normalize(step, dim=0)
    thickness = min(LINKS.min_radius_ratio * float(step.norm()), LINKS.max_shaft_radius_mm)
    origin, along = shape.instrument_from_shaft[:3, 3], shape.instrument_from_shaft[:3, 2]
    apart = pivot - origin
    off = float((apart - (apart @ along) * along).norm())
    if float(along @ direction) > LINKS.min_cosine and off < max(
        LINKS.max_offset_radii * shape.radius, LINKS.max_offset_mm
    ):
        return replace(shape, radius=max(shape.radius, thickness))
    session.report(f"{name}: the shaft is searched along the stated links: carving found another line")
    base = frame_along(pivot, direction)
    carved = carve_along(evidence, name, base, shape.level, generator, session.config.deformation.carving)
    found = shape if carved is None else carved
    found = replace(found, radius=max(found.radius, thickness))
    if (
        carved is not None
        and carved.near < -LINKS.min_evident_radii * found.radius
        and found.radius < LINKS.max_shaft_radius_mm
    ):
        return found
    return _shaft_about_line(found, base, thickness, LINKS.shaft_length * evidence.distance, generator)


def _shaft_about_line(
    shape: CarvedShape, base: Tensor, radius: float, length: float, generator: torch.Generator
) -> CarvedShape:
    """Return `shape` with a full cylinder of seeds behind the origin of `base` [4, 4] (z along the shaft): where the
    tissue's fit absorbed a shaft that hardly moves, or what is evident is not on its line."""
    count = len(shape.seeds)
    random = torch.rand(count, 3, generator=generator, device=generator.device).to(shape.seeds)
    across, angle = radius * random[:, 0].sqrt(), 2 * math.pi * random[:, 1]
    points = torch.stack([across * angle.cos(), across * angle.sin(), -length * random[:, 2]], 1)
    return replace(
        shape,
        instrument_from_shaft=base,
        near=-length,
        tip=LINKS.reach_radii * radius,
        radius=radius,
        seeds=points @ base[:3, :3].T + base[:3, 3],
    )


@torch.no_grad()
def start_links(
    session: GaussianSession,
    links: Articulation,
    evidence: Evidence,
    name: str,
    shape: CarvedShape,
    *,
    columns: int,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Return seeds [M, 3] mm at rest on every link, and their link logits [M, columns].

    A point belongs to the link with which it must move to stay on evidence. Where the opening of two links was not
    recorded, each is searched on the side to which it opens: mirrored, both would fit as well.
    """
    settings = session.config.deformation.carving
    sides = _open_links(session, links, evidence, name, shape.radius)
    links.wrist_start.fill_(float(links.first_joint()) - shape.radius)
    moved = link_motions(links, readings_of(session, evidence, name))  # [F, L, 4, 4]
    views = [posed_views(evidence, name, settings, moved[:, k]) for k in range(links.link_count)]
    behind = links.along_shaft(shape.seeds) < links.first_joint()
    of_shaft = shape.seeds[behind] if bool(behind.any()) else shape.seeds
    count = round(LINKS.shaft_share * settings.seeds)
    chosen = torch.randint(len(of_shaft), (count,), generator=generator, device=generator.device).to(of_shaft.device)
    seeds, owners = [of_shaft[chosen]], [torch.zeros(count, dtype=torch.long)]
    each = (settings.seeds - count) // max(links.link_count - 1, 1)
    for link in range(1, links.link_count):
        found = _on_link(views, links, link, shape.radius, count=each, generator=generator, side=sides.get(link))
        seeds.append(found)
        owners.append(torch.full((len(found),), link))
    points, owner = torch.cat(seeds), torch.cat(owners).to(shape.seeds.device)
    logits = 0.3 * torch.randn(len(points), columns, generator=generator).to(points)
    return points, logits + LINKS.link_logit * nn.functional.one_hot(owner, columns)


def _open_links(
    session: GaussianSession, links: Articulation, evidence: Evidence, name: str, radius: float
) -> dict[int, tuple[Tensor, Tensor]]:
    """Return, by link whose opening was not recorded, the half spaces in which it lies at rest: a point [3] mm and unit
    directions [K, 3], to the side to which it opens and, where its heading is found, beyond its pivot.

    Tools are held closed, or open by the same angle, for much of a recording, and the zero of what turns both is not
    learned. So the opening and heading are taken at which both links have most evidence next to the plane between
    them; the reading is estimated from that opening on. Without a clear maximum: half way open and straight on.
    """
    instrument = next(item for item in session.scene.instruments if item.name == name)
    sides: dict[int, tuple[Tensor, Tensor]] = {}
    for reading in instrument.unrecorded:
        opening = _opened_by(links, reading)
        if not opening:
            continue
        low, high = instrument.joints[reading] or (0.0, 0.0)
        values, turned, found = low + (high - low) * OPENINGS, 0.0, False
        recorded = readings_of(session, evidence, name)
        scores = torch.stack(
            [
                _plane_evidence(
                    links, evidence, name, radius, opening, [given | {reading: value} for given in recorded]
                )
                for value in values.tolist()
            ]
        )  # [openings, headings]
        likely = scores - LINKS.heading_weight * (HEADINGS / LINKS.heading_sigma).square()
        best, heading = divmod(int(likely.argmax()), len(HEADINGS))
        if float(scores[best, heading] - scores[len(OPENINGS) // 2, len(HEADINGS) // 2]) > LINKS.min_evidence_gain:
            turned, found = float(HEADINGS[heading]), True
            column = session.refinement.readings.index((name, reading))
            session.refinement.joints[:, column] = values[best] - instrument.halfway(reading)
        for link, (joint, sense) in opening.items():
            pivot, ahead, towards = _plane_between(links, joint, turned)
            opens_to = sense * towards
            sides[link] = (pivot, torch.stack([ahead, opens_to]) if found else opens_to[None])
    return sides


def _opened_by(links: Articulation, reading: str) -> dict[int, tuple[int, float]]:
    """Return {link: (joint, sense)} of links that a reading turns about one axis in opposite directions."""
    found: dict[int, tuple[int, float]] = {}
    for joint, own in enumerate(links.gains[:, :, links.reading_names.index(reading)]):  # [L - 1]
        if bool((own > 0).any()) and bool((own < 0).any()) and not links.slides[joint]:
            found |= {k + 1: (joint, 1.0 if gain > 0 else -1.0) for k, gain in enumerate(own.tolist()) if gain}
    return found


@torch.no_grad()
def _plane_between(links: Articulation, joint: int, heading: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return (pivot [3] mm, unit directions [3] of the links beyond and of positive rotation) at rest, for links turned
    by `heading` (rad) about the joint's axis from the line of those before."""
    pivots, axes = links.axes()
    line = links.rest_line()
    along = links.shaft()[1] if line is None else line[1]
    turn = along.new_tensor([heading])
    ahead = rotate_about(along[None], axes[joint], torch.zeros_like(along), turn)[0]
    towards = torch.linalg.cross(axes[joint], ahead)
    return pivots[joint], nn.functional.normalize(ahead, dim=0), nn.functional.normalize(towards, dim=0)


def _plane_evidence(
    links: Articulation,
    evidence: Evidence,
    name: str,
    radius: float,
    opening: dict[int, tuple[int, float]],
    readings: list[dict[str, float]],
) -> Tensor:
    """Return the mean evidence [headings] of links that open, each next to the plane between them."""
    moved = link_motions(links, readings)  # [F, L, 4, 4]
    own = camera_from_instrument(evidence, name)
    far, along_axis, aside = (radius * PLANE_OFFSETS.to(own)).split(1, 1)  # [P, 1] each
    scores = []
    for link, (joint, sense) in opening.items():
        points = []
        for heading in HEADINGS.tolist():
            pivot, ahead, towards = (part.to(own) for part in _plane_between(links, joint, heading))
            axis = torch.linalg.cross(ahead, towards)
            points.append(pivot + far * ahead + along_axis * axis + sense * aside * towards)
        found, _ = score_points(evidence, own @ moved[:, link], torch.cat(points))
        scores.append(found.reshape(len(HEADINGS), -1).mean(1))
    return torch.stack(scores).mean(0).cpu()


def readings_of(session: GaussianSession, evidence: Evidence, name: str) -> list[dict[str, float]]:
    """Return the readings of every frame of the evidence; those of unrecorded joints as estimated so far."""
    recorded = session.refinement.found(session.scene.recorded, session.scene.instruments)
    by_name = dict(zip(recorded.names, recorded.states, strict=True))
    return [dict(by_name[frame.name].instruments[name].joints) for frame in evidence.frames]


def link_motions(links: Articulation, readings: list[dict[str, float]]) -> Tensor:
    """Return the motion [F, L, 4, 4] of every link from rest, instrument frame, at each frame's readings."""
    frame = torch.eye(4, device=links.points.device)[:, :3]  # origin and axes, as points
    corners = torch.cat([frame[3:4], frame[:3]])  # [4, 3]
    moved = []
    for joints in readings:
        for link in range(links.link_count):
            origin, *ends = links.place(corners, link, joints)
            rigid = torch.eye(4, device=corners.device)
            rigid[:3, :3], rigid[:3, 3] = torch.stack(ends, 1) - origin[:, None], origin
            moved.append(rigid)
    return torch.stack(moved).reshape(len(readings), links.link_count, 4, 4)


def _extent_of(links: Articulation, link: int, reach: float, margin: float) -> tuple[Tensor, Tensor]:
    """Return cubes at rest that contain a link: centres [K, 3] mm, half sizes [K] mm. They reach `reach` from its pivot
    where no link follows, else to the pivots beyond plus `margin`."""
    pivots, own = links.axes()[0], links.joint_of(link)
    beyond = [j for j, group in enumerate(links.joint_groups) if links.link_of(group[0].parent) == link]
    if not beyond:
        return pivots[own][None], pivots.new_tensor([reach])
    middle = torch.stack([(pivots[own] + pivots[j]) / 2 for j in beyond])
    half = torch.stack([(pivots[own] - pivots[j]).norm() / 2 + margin for j in beyond])
    return middle, half


def _on_link(
    views: list[PosedViews],
    links: Articulation,
    link: int,
    radius: float,
    *,
    count: int,
    generator: torch.Generator,
    side: tuple[Tensor, Tensor] | None,
) -> Tensor:
    """Sample points [count, 3] mm at rest that stay on evidence when moved with a link, and better than with any other;
    in the half spaces `side` (point mm, unit directions) where given."""
    device = links.points.device
    centers, reaches = (
        part.to(device) for part in _extent_of(links, link, LINKS.reach_radii * radius, LINKS.margin_radii * radius)
    )
    total = LINKS.candidates_per_seed * count
    random = torch.rand(total, 4, generator=generator, device=generator.device).to(device)
    which = (random[:, 3] * len(centers)).long().clamp_max(len(centers) - 1)
    points = centers[which] + (2 * random[:, :3] - 1) * reaches[which, None]
    if side is not None:
        place, directions = (part.to(device) for part in side)
        outside = ((points - place) @ directions.T + LINKS.side_tolerance_radii * radius).clamp_max(0)  # [Q, K]
        points = points - 2 * outside @ directions  # mirrored into the half spaces
    own, visible = views[link].scores(points)
    likely = torch.nonzero((own > 0.5 * CARVING.min_level) & (visible > LINKS.min_visible_share))[:, 0]
    others = torch.stack([view.scores(points[likely])[0] for k, view in enumerate(views) if k != link]).amax(0)
    fits = own[likely] >= others - LINKS.evidence_tolerance
    likely, score = likely[fits], own[likely][fits]
    if not len(likely):  # no evidence: about its pivot; training moves them
        return points[:count] * 0 + centers[:1] + 0.5 * (points[:count] - centers[which[:count]])
    best = likely[score >= LINKS.min_relative_level * float(score.max())]
    again = torch.randint(len(best), (max(0, count - len(best)),), generator=generator, device=generator.device)
    jitter = 0.1 * radius * torch.randn(len(again), 3, generator=generator, device=generator.device).to(points)
    order = torch.randperm(len(best), generator=generator, device=generator.device).to(device)[:count]
    return torch.cat([points[best[order]], points[best[again.to(device)]] + jitter])


Readings = dict[str, float]


@dataclass(frozen=True)
class DoubtedReadings:
    """Readings with which the links fit the images less well than with others."""

    names: tuple[str, ...]
    ratio: float  # of the volume on evidence with other readings to that with the given ones
    words: str  # what is other
    change: Callable[[Readings], Readings]


@torch.no_grad()
def doubted_readings(
    session: GaussianSession, links: Articulation, evidence: Evidence, instrument: Instrument, readings: list[Readings]
) -> DoubtedReadings | None:
    """Return what to doubt where the links keep more of their volume on evidence with two readings exchanged or one's
    sign reversed. `readings`: those of every frame of the evidence.

    Swapped logs and reversed signs pass every check of numbers, but not the images."""
    volumes = _Volumes(links, evidence, instrument.name, readings, session.config.seed)
    named = volumes.with_readings(dict)
    recorded = [name for name in links.reading_names if name not in instrument.unrecorded]
    changes: list[tuple[tuple[str, ...], str, Callable[[Readings], Readings]]] = []
    for one, other in combinations(recorded, 2):
        if instrument.slides(one) == instrument.slides(other):
            words = f"with the readings of {one} and {other} exchanged: which log is which?"
            changes.append(((one, other), words, partial(_changed, {one: (1.0, other), other: (1.0, one)})))
    for name in recorded:
        words = f"with the sign of {name} reversed: is its axis, or its gain, the wrong way round?"
        changes.append(((name,), words, partial(_changed, {name: (-1.0, name)})))
    found = [(volumes.with_readings(change), index) for index, (_, _, change) in enumerate(changes)]
    most, index = max(found, default=(0.0, 0))
    if most <= LINKS.min_volume_ratio * named:
        return None
    names, words, change = changes[index]
    return DoubtedReadings(names, most / max(named, 1), words, change)


def _changed(taken: dict[str, tuple[float, str]], readings: Readings) -> Readings:
    """Return `readings` with some `taken` as (sign, of which reading)."""
    return {**readings, **{name: sign * readings[source] for name, (sign, source) in taken.items()}}


class _Volumes:
    """Volume that stays on evidence, counted in sample points of all links together."""

    def __init__(self, links: Articulation, evidence: Evidence, name: str, readings: list[Readings], seed: int) -> None:
        step = max(1, len(readings) // LINKS.max_check_frames)
        self.links, self.readings = links, readings[::step]
        self.evidence = evidence.subset(torch.arange(0, len(readings), step))
        self.camera_from_instrument = camera_from_instrument(self.evidence, name)  # [F, 4, 4]
        generator = torch.Generator().manual_seed(seed)
        self.points = [self._about(link, generator) for link in range(1, links.link_count)]

    def _about(self, link: int, generator: torch.Generator) -> Tensor:
        """Sample points [`check_points`, 3] mm about a link at rest."""
        radius = float(self.links.radius)
        centers, half = (
            part.cpu()
            for part in _extent_of(
                self.links, link, LINKS.check_reach_radii * radius, LINKS.check_margin_radii * radius
            )
        )
        which = torch.randint(len(centers), (LINKS.check_points,), generator=generator)
        away = 2 * torch.rand(LINKS.check_points, 3, generator=generator) - 1
        return (centers[which] + away * half[which, None]).to(self.evidence.device)

    def with_readings(self, change: Callable[[Readings], Readings]) -> float:
        """Return the volume on evidence, in points, with the readings changed by `change`."""
        moved = link_motions(self.links, [change(given) for given in self.readings])  # [F, L, 4, 4]
        total = 0.0
        for link, points in enumerate(self.points, 1):
            score, visible = score_points(self.evidence, self.camera_from_instrument @ moved[:, link], points)
            total += float(
                (
                    ((score - CARVING.min_level) / (1 - CARVING.min_level)).clamp(0, 1)
                    * (visible > LINKS.check_min_visible_share)
                ).sum()
            )
        return total
