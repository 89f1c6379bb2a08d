"""Initialise the links of a stated kinematic tree: carve each in its own frame, and check the readings that move it."""

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
from neeco.geometry.rotations import rotate_about, rotation_from_vector
from neeco.methods.kinematic.articulation import Articulation
from neeco.methods.kinematic.link_registration import register_links
from neeco.training.session import GaussianSession


@dataclass(frozen=True, kw_only=True)
class LinkSearchSettings:
    """Settings of carving links and of the check of readings."""

    link_logit: float = 2.0  # initial logit of a seed for the link that it was carved on
    shaft_share: float = 0.4  # share of the seeds on the shaft
    reach_radii: float = 7.0  # shaft radii around its pivot in which an end link is searched
    margin_radii: float = 2.0  # shaft radii around the adjacent pivots in which another link is searched
    candidates_per_seed: int = 20  # candidates sampled per seed
    evidence_tolerance: float = 0.03  # margin by which the evidence of another link may be larger
    # tolerances for agreement of a carved shaft with the line of the links at rest
    min_cosine: float = 0.85  # between both directions
    max_offset_radii: float = 1.5  # of the line from the first pivot, in shaft radii
    max_offset_mm: float = 4.0  # the same, if larger
    # of the best evidence of a link's points: stated axes may be off, and all points with them
    min_relative_level: float = 0.85
    min_radius_ratio: float = 0.33  # minimum ratio of the shaft's radius to the distance of the first two pivots
    max_shaft_radius_mm: float = 6.5  # of instruments that fit through a trocar
    # shaft radii behind the first pivot: with less evidence, the shaft is seeded around its line
    min_evident_radii: float = 3.0
    shaft_length: float = 0.3  # length of the shaft seeded around its line, as a share of the distance to the tissue
    side_tolerance_radii: float = 0.3  # tolerance of a link searched on one side of its pivot
    min_visible_share: float = 0.05  # minimum share of frames that observe a seed
    heading_sigma: float = 0.5  # rad, standard deviation of stated headings
    heading_weight: float = 0.02  # evidence penalty of a heading one standard deviation off
    # over half way open and straight on: where jaws move, any opening has some evidence
    min_evidence_gain: float = 0.25
    # check of the readings
    check_points: int = 1500  # per link
    check_reach_radii: float = 4.0  # shaft radii around the pivots of end links that are sampled
    check_margin_radii: float = 2.0  # shaft radii around the pivots of other links that are sampled
    max_check_frames: int = 80  # evenly spaced
    # volume on evidence, changed over original readings, that raises a warning: in 95 % of the samples of frames drawn
    # with replacement, as a few frames with moved tissue or shadows must not decide
    min_volume_ratio: float = 1.1
    n_resamples: int = 40
    resampled_quantile: float = 0.05
    check_min_visible_share: float = 0.1  # minimum share of frames that observe a point


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
    """Return `shape`, or one carved around the line of the links at rest if its own line differs.

    An instrument that hardly rotates leaves evidence along its lines of sight as well. The radius is at least a share
    of the distance of the first pivots: if the tissue's fit absorbed a dark shaft, little evidence of it remains."""
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
    aligned = shape if carved is None else carved
    aligned = replace(aligned, radius=max(aligned.radius, thickness))
    if (
        carved is not None
        and carved.near < -LINKS.min_evident_radii * aligned.radius
        and aligned.radius < LINKS.max_shaft_radius_mm
    ):
        return aligned
    return _shaft_about_line(aligned, base, thickness, LINKS.shaft_length * evidence.distance, generator)


def _shaft_about_line(
    shape: CarvedShape, base: Tensor, radius: float, length: float, generator: torch.Generator
) -> CarvedShape:
    """Return `shape` with a full cylinder of seeds behind the origin of `base` [4, 4] (z along the shaft): the tissue's
    fit absorbed a shaft that hardly moves, or the evidence is not on its line."""
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


def correct_poses(
    session: GaussianSession,
    links: Articulation,
    evidence: Evidence,
    instrument: Instrument,
    shape: CarvedShape,
    readings: list[dict[str, float]],
) -> bool:
    """Correct the links of an instrument, or also its base, if that explains the evidence better; return whether its
    poses moved.

    Warns of its readings if other ones explain the evidence better than any correction.
    """
    scene, name = session.scene, instrument.name
    doubt = doubted_readings(session, links, evidence, instrument, readings)
    stated = instrument.base_uncertainty
    fit = register_links(links, evidence, name, shape, readings, stated=stated)
    if doubt is not None and fit is not None:
        other = register_links(links, evidence, name, shape, [doubt.change(row) for row in readings], stated=stated)
        doubt = doubt if other is not None and other.cost < fit.cost else None
    if doubt is not None:
        session.report(f"warning: {name}: its links fit the images {doubt.ratio:.1f} times as well {doubt.words}")
        doubted = {f"{name}.{reading}": f"the links fit the images better {doubt.words}" for reading in doubt.names}
        scene.diagnostics.setdefault("doubted_readings", {}).update(doubted)
    if doubt is not None or fit is None or not fit.needed:
        return False
    arm = fit.center - scene.center
    turn = rotation_from_vector(fit.base[:3])
    base = torch.cat([fit.base[:3], fit.base[3:] + arm - turn @ arm])  # turning about the scene's centre
    with torch.no_grad():
        scene.base_corrections[scene.instruments.index(instrument)] = base
        links.axis_shifts.copy_(fit.pivots - links.points)
        cosines = (links.directions * fit.axes).sum(1, keepdim=True)
        links.axis_turns.copy_(torch.linalg.cross(links.directions, fit.axes) / cosines)
        links.reading_offsets.copy_(fit.offsets)
    off, sd, degrees = -fit.along_mm, fit.along_sd_mm, float(torch.rad2deg(fit.base[:3].norm()))
    its_base = f", its base by {float(fit.base[3:].norm()):.1f} mm and {degrees:.1f} degrees" if base.any() else ""
    session.report(
        f"{name}: the pose's frame is off along the shaft by {off:.1f} mm (standard deviation {sd:.1f} mm; positive: "
        f"towards the jaws){its_base}; corrected"
    )
    scene.diagnostics.setdefault("registration_of_links", {})[name] = {
        "frame_off_along_shaft_mm": round(off, 3),
        "frame_off_along_shaft_sd_mm": round(sd, 3),
        "base_correction": [round(value, 5) for value in base.tolist()],
    }
    return bool(base.any())


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
        link_points = _on_link(views, links, link, shape.radius, count=each, generator=generator, side=sides.get(link))
        seeds.append(link_points)
        owners.append(torch.full((len(link_points),), link))
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
        opening: dict[int, tuple[int, float]] = {}  # {link: (joint, sign)} that turn in opposite directions
        for joint, gains in enumerate(links.gains[:, :, links.reading_names.index(reading)]):  # [L - 1]
            if bool((gains > 0).any()) and bool((gains < 0).any()) and not links.slides[joint]:
                opening |= {k + 1: (joint, 1.0 if gain > 0 else -1.0) for k, gain in enumerate(gains.tolist()) if gain}
        if not opening:
            continue
        low, high = instrument.joints[reading] or (0.0, 0.0)
        values, turned, headed = low + (high - low) * OPENINGS, 0.0, False
        recorded = readings_of(session, evidence, name)
        scores = torch.stack(
            [
                _plane_evidence(links, evidence, name, radius, opening, [row | {reading: value} for row in recorded])
                for value in values.tolist()
            ]
        )  # [openings, headings]
        likely = scores - LINKS.heading_weight * (HEADINGS / LINKS.heading_sigma).square()
        best, heading = divmod(int(likely.argmax()), len(HEADINGS))
        if float(scores[best, heading] - scores[len(OPENINGS) // 2, len(HEADINGS) // 2]) > LINKS.min_evidence_gain:
            turned, headed = float(HEADINGS[heading]), True
            column = session.refinement.readings.index((name, reading))
            session.refinement.joints[:, column] = values[best] - instrument.halfway(reading)
        for link, (joint, sense) in opening.items():
            pivot, ahead, towards = _plane_between(links, joint, turned)
            opens_to = sense * towards
            sides[link] = (pivot, torch.stack([ahead, opens_to]) if headed else opens_to[None])
    return sides


@torch.no_grad()
def _plane_between(links: Articulation, joint: int, heading: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return (pivot [3] mm, unit directions [3] of the distal links and of positive rotation) at rest, for links
    rotated by `heading` (rad) about the joint's axis from the line of the proximal ones."""
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
    poses = camera_from_instrument(evidence, name)
    far, along_axis, aside = (radius * PLANE_OFFSETS.to(poses)).split(1, 1)  # [P, 1] each
    scores = []
    for link, (joint, sense) in opening.items():
        points = []
        for heading in HEADINGS.tolist():
            pivot, ahead, towards = (part.to(poses) for part in _plane_between(links, joint, heading))
            axis = torch.linalg.cross(ahead, towards)
            points.append(pivot + far * ahead + along_axis * axis + sense * aside * towards)
        evident, _ = score_points(evidence, poses @ moved[:, link], torch.cat(points))
        scores.append(evident.reshape(len(HEADINGS), -1).mean(1))
    return torch.stack(scores).mean(0).cpu()


def readings_of(session: GaussianSession, evidence: Evidence, name: str) -> list[dict[str, float]]:
    """Return the readings of every frame of the evidence; for unrecorded joints, the current estimates."""
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
    """Return cubes at rest that contain a link: centres [K, 3] mm, half sizes [K] mm. They extend `reach` from the
    pivot of an end link, else to the next pivots plus `margin`."""
    pivots, inner = links.axes()[0], links.joint_of(link)
    beyond = [j for j, group in enumerate(links.joint_groups) if links.link_of(group[0].parent) == link]
    if not beyond:
        return pivots[inner][None], pivots.new_tensor([reach])
    middle = torch.stack([(pivots[inner] + pivots[j]) / 2 for j in beyond])
    half = torch.stack([(pivots[inner] - pivots[j]).norm() / 2 + margin for j in beyond])
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
    in the half spaces `side` (point mm, unit directions), if any."""
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
    scores, visible = views[link].scores(points)
    likely = torch.nonzero((scores > 0.5 * CARVING.min_level) & (visible > LINKS.min_visible_share))[:, 0]
    rival = torch.stack([view.scores(points[likely])[0] for k, view in enumerate(views) if k != link]).amax(0)
    fits = scores[likely] >= rival - LINKS.evidence_tolerance
    likely, score = likely[fits], scores[likely][fits]
    if not len(likely):  # no evidence: sampled about its pivot; training moves them
        return points[:count] * 0 + centers[:1] + 0.5 * (points[:count] - centers[which[:count]])
    best = likely[score >= LINKS.min_relative_level * float(score.max())]
    again = torch.randint(len(best), (max(0, count - len(best)),), generator=generator, device=generator.device)
    jitter = 0.1 * radius * torch.randn(len(again), 3, generator=generator, device=generator.device).to(points)
    order = torch.randperm(len(best), generator=generator, device=generator.device).to(device)[:count]
    return torch.cat([points[best[order]], points[best[again.to(device)]] + jitter])


Readings = dict[str, float]


@dataclass(frozen=True)
class DoubtedReadings:
    """Readings for which the links fit the images worse than for others."""

    names: tuple[str, ...]
    ratio: float  # volume on evidence with the changed readings over that with the recorded ones
    words: str  # description of the change
    change: Callable[[Readings], Readings]


@torch.no_grad()
def doubted_readings(
    session: GaussianSession, links: Articulation, evidence: Evidence, instrument: Instrument, readings: list[Readings]
) -> DoubtedReadings | None:
    """Return the readings to doubt: the links keep more of their volume on evidence with two readings exchanged or
    one's sign reversed. `readings`: those of every frame of the evidence.

    Swapped logs and reversed signs pass all numeric checks, but not a comparison with the images."""
    volumes = _Volumes(links, evidence, instrument.name, readings, session.config.seed)
    unchanged = volumes.motions(dict)
    named = volumes.of(unchanged)
    recorded = [name for name in links.reading_names if name not in instrument.unrecorded]
    changes: list[tuple[tuple[str, ...], str, Callable[[Readings], Readings]]] = []
    for one, other in combinations(recorded, 2):
        if instrument.slides(one) == instrument.slides(other):
            words = f"with the readings of {one} and {other} exchanged: which log is which?"
            changes.append(((one, other), words, partial(_changed, {one: (1.0, other), other: (1.0, one)})))
    for name in recorded:
        words = f"with the sign of {name} reversed: is its axis, or its gain, the wrong way round?"
        changes.append(((name,), words, partial(_changed, {name: (-1.0, name)})))
    motions = [volumes.motions(change) for _, _, change in changes]
    most, index = max(((volumes.of(moved), index) for index, moved in enumerate(motions)), default=(0.0, 0))
    if most <= LINKS.min_volume_ratio * named:
        return None
    if volumes.resampled_ratio(unchanged, motions[index]) <= LINKS.min_volume_ratio:
        return None
    names, words, change = changes[index]
    return DoubtedReadings(names, most / max(named, 1), words, change)


def _changed(taken: dict[str, tuple[float, str]], readings: Readings) -> Readings:
    """Return `readings` with some replaced by others, `taken` as (sign, name of the source)."""
    return {**readings, **{name: sign * readings[source] for name, (sign, source) in taken.items()}}


class _Volumes:
    """Volume that stays on evidence, as a number of sample points over all links."""

    def __init__(self, links: Articulation, evidence: Evidence, name: str, readings: list[Readings], seed: int) -> None:
        step = max(1, len(readings) // LINKS.max_check_frames)
        self.links, self.readings = links, readings[::step]
        self.evidence = evidence.subset(torch.arange(0, len(readings), step))
        self.camera_from_instrument = camera_from_instrument(self.evidence, name)  # [F, 4, 4]
        generator = torch.Generator().manual_seed(seed)
        radius = float(links.radius)
        reach, margin = LINKS.check_reach_radii * radius, LINKS.check_margin_radii * radius
        self.points: list[Tensor] = []  # [`check_points`, 3] mm about every link at rest
        for link in range(1, links.link_count):
            centers, half = (part.cpu() for part in _extent_of(links, link, reach, margin))
            which = torch.randint(len(centers), (LINKS.check_points,), generator=generator)
            away = 2 * torch.rand(LINKS.check_points, 3, generator=generator) - 1
            self.points.append((centers[which] + away * half[which, None]).to(self.evidence.device))

    def motions(self, change: Callable[[Readings], Readings]) -> Tensor:
        """Return the poses [F, L, 4, 4] of all links in the camera's frame after `change` of the readings."""
        moved = link_motions(self.links, [change(row) for row in self.readings])
        return self.camera_from_instrument[:, None] @ moved

    def of(self, motions: Tensor, frames: Tensor | None = None) -> float:
        """Return the volume on evidence, in points, of links at `motions`; of `frames` [F] alone, where given."""
        evidence = self.evidence if frames is None else self.evidence.subset(frames)
        motions = motions if frames is None else motions[frames]
        total = 0.0
        for link, points in enumerate(self.points, 1):
            score, visible = score_points(evidence, motions[:, link], points)
            on_evidence = ((score - CARVING.min_level) / (1 - CARVING.min_level)).clamp(0, 1)
            total += float((on_evidence * (visible > LINKS.check_min_visible_share)).sum())
        return total

    def resampled_ratio(self, recorded: Tensor, changed: Tensor) -> float:
        """Return a low quantile, over samples of frames, of the volume with changed motions over that with recorded
        ones (bootstrap)."""
        generator = torch.Generator().manual_seed(0)
        count = len(self.readings)
        ratios = []
        for _ in range(LINKS.n_resamples):
            frames = torch.randint(count, (count,), generator=generator)
            ratios.append(self.of(changed, frames) / max(self.of(recorded, frames), 1.0))
        return float(torch.tensor(ratios).quantile(LINKS.resampled_quantile))
