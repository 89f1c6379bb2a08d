"""Find each instrument and its joints from training frames alone, and seed its Gaussians (of a method with hinges)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from neeco.errors import NeecoError
from neeco.scene.breathing import Breathing, BreathingTissue
from neeco.scene.canonical import join_bodies, seed_gaussians
from neeco.scene.deformations.static import Static
from neeco.scene.drawable import Recorded
from neeco.scene.instruments import PART_LOGITS, HingedInstruments, Hinges, SweptVolume
from neeco.scene.scene import Scene
from neeco.scene.training_views import TrainingViews
from neeco.training.config import RefineConfig, SearchConfig, TrainConfig, method_defaults
from neeco.training.instruments.breathing import find_breathing
from neeco.training.instruments.evidence import (
    CarvedShape,
    Evidence,
    camera_from_instrument,
    carve,
    center_line,
    gather_evidence,
    posed_views,
    score_points,
)
from neeco.training.session import GaussianSession, new_session

MIN_SHARE_INSIDE = 0.01  # of the Gaussians in a bounded volume: with fewer the network cannot form an instrument
SEED_SPREAD = (
    0.05  # of the distance to the tissue: standard deviation of seeds about the tracked frame, without a shape
)
BODY_LOGIT = 2.0  # initial part logit of seeds on the body's side of the hinge
GAINS = ((0.5, -0.5), (1.0, 0.0))  # part angle per reading: two jaws share the opening, or one takes it all
SMALL_GAIN = 0.3  # a smaller turn, which tolerates rough evidence
MIN_READING_RANGE = 0.05  # rad: the hinge of a joint that moves less is not searched
STICK_POINTS = 16


def find_instruments(session: GaussianSession, hinged: HingedInstruments) -> None:
    """Add every instrument's body to the session's scene, whose canonical set holds the tissue alone, and start its
    hinges.

    `hinged` is the scene's deformation. Raises NeecoError when an instrument leaves no evidence in its own frame: its
    poses do not match the images.
    """
    scene, report, search = session.scene, session.report, session.config.search
    if not scene.instruments:
        return
    report("looking for the instruments: fitting the tissue alone")
    tissue = fit_tissue(scene, session.views, session.config)
    if isinstance(hinged, BreathingTissue) and hinged.may_breathe and session.timed:
        tissue = _learn_breathing(session, hinged, tissue)
    evidence = tissue_evidence(scene, session.views, session.config, tissue)
    generator = torch.Generator().manual_seed(session.config.seed)
    bodies = [scene.canonical]
    for index, instrument in enumerate(scene.instruments):
        shape = carve(evidence, instrument.name, generator, search)
        if shape is None:
            raise NeecoError(
                f"instrument {instrument.name!r}: nothing in the images moves with its recorded pose; check that its "
                "poses are in the cameras' world frame and in mm (`neeco check`), or train with --method neeco"
            )
        if not moves_with_pose(session, evidence, instrument.name, shape):
            shape = shape_around_frame(shape, evidence.distance, search.seeds, generator)
        hinges = hinged.hinges_of(index)
        start_hinges(session, hinges, evidence, instrument.name, shape)
        seeds = shape.seeds.to(scene.center.device)
        logits = seed_logits(hinges, seeds, hinged.logit_count, generator)
        seeds = unbend_seeds(hinges, seeds, logits)
        count = len(seeds)
        body = seed_gaussians(seeds, seeds.new_full((count, 3), 0.4), seeds.new_full((count,), 0.4 * shape.radius))
        bodies.append(body.with_extras(**{PART_LOGITS: logits}))
    scene.canonical = join_bodies(bodies)


def bound_volume(session: GaussianSession, volume: SweptVolume) -> None:
    """Bound `volume`, outside which the paper's network is not evaluated, by what the carved instruments sweep in the
    training frames.

    Where carving cannot be trusted the volume stays unbounded: slow, but never wrong. Raises NeecoError when hardly any
    Gaussian lies inside: the network moves tissue onto the instrument, so the volume has to reach the tissue.
    """
    scene, views, config, report = session.scene, session.views, session.config, session.report
    report("looking for the instruments, to bound where the network is evaluated")
    evidence = tissue_evidence(scene, views, config)
    generator = torch.Generator().manual_seed(config.seed)
    swept = []
    for instrument in scene.instruments:
        shape = carve(evidence, instrument.name, generator, config.search)
        if shape is None or not moves_with_pose(session, evidence, instrument.name, shape):
            report(f"warning: {instrument.name}: its shape cannot be carved; the network is evaluated everywhere")
            return
        recorded = [frame.state.instruments[instrument.name].pose.float() for frame in views.frames]
        poses = torch.stack(recorded).to(shape.seeds)  # [F, 4, 4]
        swept.append((shape.seeds @ poses[:, :3, :3].transpose(1, 2) + poses[:, None, :3, 3]).reshape(-1, 3))
    volume.cover(torch.cat(swept).to(scene.canonical.means))
    inside = volume.contains(scene.canonical.means)
    if int(inside.sum()) < MIN_SHARE_INSIDE * len(inside):
        raise NeecoError(
            f"deformation.gate_mm: only {int(inside.sum())} of {len(inside)} Gaussians lie within {volume.margin_mm} "
            "mm of the instruments' path; give a greater distance"
        )
    report(f"the network is evaluated on {int(inside.sum())} of {len(inside)} Gaussians")


def moves_with_pose(session: GaussianSession, evidence: Evidence, name: str, shape: CarvedShape) -> bool:
    """Whether the evidence moves with the instrument: with poses exchanged among frames it must be weaker.

    Where it is not (an instrument that hardly moves, say), carving cannot separate the instrument from static parts of
    the scene.
    """
    search = session.config.search
    views = posed_views(evidence, name, search)
    own, _ = score_points(evidence, views.own, shape.seeds)
    other = views.exchanged_scores(shape.seeds)
    moves = float(own.mean()) > search.motion_ratio * float(other.mean())
    session.scene.diagnostics.setdefault("instruments", {})[name] = {
        "evidence": round(float(own.mean()), 4),
        "evidence_of_other_poses": round(float(other.mean()), 4),
        "moves_with_its_pose": moves,
    }
    if not moves:
        session.report(
            f"warning: {name}: the images hardly depend on its recorded pose; its shape is searched around the "
            "tracked frame, and its labels may be wrong (record more motion, or check that poses are registered)"
        )
    return moves


def shape_around_frame(shape: CarvedShape, distance: float, count: int, generator: torch.Generator) -> CarvedShape:
    """The initial shape where carving cannot be trusted: `count` seeds around the tracked frame, which is on the
    body."""
    spread = SEED_SPREAD * distance
    seeds = (torch.randn(count, 3, generator=generator, device=generator.device) * spread).to(shape.seeds)
    frame = torch.eye(4, device=seeds.device)
    return replace(shape, instrument_from_shaft=frame, near=-spread, tip=spread, radius=0.1 * spread, seeds=seeds)


def _learn_breathing(session: GaussianSession, hinged: BreathingTissue, tissue: Scene) -> Scene:
    """`tissue`, a fit of still tissue, or where that breathes one that was fitted anew with its breathing, with which
    `hinged` begins then."""
    scene, views, config = session.scene, session.views, session.config
    begun = find_breathing(tissue, views)
    if begun is None:
        return tissue
    breathing, found = begun
    session.report(f"the tissue breathes with a period of {found.period:.2f} s: fitting it again")
    tissue = fit_tissue(scene, views, config, breathing=breathing)
    deformation = tissue.deformation
    assert isinstance(deformation, BreathingTissue)
    assert deformation.breathing is not None
    hinged.start_breathing(deformation.breathing)
    scene.diagnostics["breathing"] = deformation.breathing.describe() | {"explained": round(found.explained, 3)}
    return tissue


def tissue_evidence(scene: Scene, views: TrainingViews, config: TrainConfig, tissue: Scene | None = None) -> Evidence:
    """Fit a copy of the tissue without motion but that of breathing; the residual is the evidence. `tissue`: that fit,
    where it was made before.

    A few hundred steps suffice on textured tissue with enough sparse points. Where the residual is large, a longer fit
    may add Gaussians.
    """
    tissue = tissue or fit_tissue(scene, views, config)
    evidence = gather_evidence(tissue, views, config.search)
    if float(evidence.hits.mean()) <= config.search.max_evidence:
        return evidence
    breathing = tissue.deformation.breathing if isinstance(tissue.deformation, BreathingTissue) else None
    longer = fit_tissue(scene, views, config, config.search.long_tissue_steps, 200, breathing)
    return gather_evidence(longer, views, config.search)


def fit_tissue(
    scene: Scene,
    views: TrainingViews,
    config: TrainConfig,
    steps: int | None = None,
    density_start: int = 10**9,
    breathing: Breathing | None = None,
) -> Scene:
    """A copy of the tissue of `scene`, which holds it alone, after `steps` steps (None: `tissue_steps`), with density
    control from `density_start` on; still, or breathing as it begins to with `breathing`."""
    steps = config.search.tissue_steps if steps is None else steps
    canonical = scene.canonical.map(lambda tensor: tensor.clone())
    deformation = Static()
    if breathing is not None:
        deformation.start_breathing(breathing)
    tissue = Scene(Static.method, canonical, deformation, (), Recorded(), scene.center)
    tissue.background = scene.background  # or the background of transparent images would be evidence
    short = replace(
        config,
        iterations=steps,
        minutes=None,
        schedule=method_defaults(Static.method).schedule,
        refine=RefineConfig(),
        density_start=density_start,
        density_stop=0.8,
    )
    session = new_session(tissue, views, short)
    session.start()
    while session.iteration < steps:
        session.step()
    tissue.requires_grad_(False)
    return tissue


def start_hinges(session: GaussianSession, hinges: Hinges, evidence: Evidence, name: str, shape: CarvedShape) -> None:
    """Put the shaft where it was carved and each joint at the best hypothesis of the search."""
    hinges.base.copy_(shape.instrument_from_shaft)
    hinges.extent.copy_(torch.tensor([shape.near, shape.tip]))
    for index, joint in enumerate(hinges.joint_names):
        found = search_hinge(evidence, name, joint, shape, session.config.search)
        if found is None:
            session.report(f"{name}: joint {joint} hardly moves in the training frames; its hinge cannot be found")
            continue
        with torch.no_grad():
            hinges.hinge_angle[index] = found.angle
            hinges.hinge_depth[index] = found.depth
            hinges.share[index] = 1.0 if found.gains[1] == 0 else 0.5
            readings = [frame.state.instruments[name].joints[joint] for frame in evidence.frames]
            hinges.middle[index] = sum(readings) / len(readings)
            hinges.closed[index] = min(readings)
            hinges.offsets[index] = (hinges.middle[index] - min(readings)) * hinges.gains[index]
    hinges.radius.fill_(shape.radius)
    if hinges.joint_names:
        hinges.wrist_start.fill_(float(hinges.hinge_depth[0].detach()) - 5 * shape.radius)


@torch.no_grad()
def unbend_seeds(hinges: Hinges, seeds: Tensor, logits: Tensor) -> Tensor:
    """Seeds [M, 3] mm, carved with the joints at their offsets, turned to the pose of zero offsets, to which the
    hinges are set: there a change of hinge or gains moves nothing."""
    weights = torch.softmax(logits[:, : hinges.part_count], -1)
    middle = {name: float(hinges.middle[joint]) for joint, name in enumerate(hinges.joint_names)}
    turned = hinges.bend(seeds, weights, middle)
    hinges.offsets.zero_()
    return turned


def seed_logits(hinges: Hinges, seeds: Tensor, columns: int, generator: torch.Generator) -> Tensor:
    """[M, columns] part logits: behind the first hinge the body, beyond it one of the moving parts at random."""
    logits = 0.3 * torch.randn(len(seeds), columns, generator=generator).to(seeds)
    if not hinges.joint_names:
        return logits
    with torch.no_grad():
        along = hinges.along_shaft(seeds)
        beyond = along > hinges.hinge_depth[0]
        logits[:, 0] += torch.where(beyond, 0.0, BODY_LOGIT)
        side = torch.randint(1, hinges.part_count, (len(seeds),), generator=generator).to(seeds.device)
        lean = nn.functional.one_hot(side, columns) * (BODY_LOGIT / 2)
        return logits + torch.where(beyond[:, None], lean, lean.new_zeros(()))


@dataclass(frozen=True)
class HingeScores:
    """Scores of hinges at A angles (rad around the carved shaft), D depths (mm along it) and all GAINS."""

    angles: list[float]
    depths: list[float]
    score: np.ndarray  # [D, GAINS, A] mean evidence on the turned sticks, in [0, 1]
    over_rigid: np.ndarray  # [D, GAINS, A] score less that of unturned sticks, times the share of the length they cover

    @property
    def depth(self) -> float:
        """Half way between the best by score and the best over rigid sticks, mm.

        The first prefers pivots too far back (short turns stay on the body), the second pivots too far forward.
        """
        best = [np.unravel_index(score.argmax(), score.shape)[0] for score in (self.score, self.over_rigid)]
        return (self.depths[best[0]] + self.depths[best[1]]) / 2

    @property
    def angle(self) -> float:
        """Phase of the score's second harmonic over the hinge angle, rad in [0, pi): uses the whole landscape, not its
        peak alone."""
        best = self.score.max((0, 1)).tolist()
        wave = sum(s * complex(math.cos(2 * a), math.sin(2 * a)) for a, s in zip(self.angles, best, strict=True))
        return (math.atan2(wave.imag, wave.real) / 2) % math.pi

    @property
    def gains(self) -> tuple[float, float]:
        """Those of the best score."""
        return GAINS[np.unravel_index(self.score.argmax(), self.score.shape)[1]]


def search_hinge(
    evidence: Evidence, name: str, joint: str, shape: CarvedShape, search: SearchConfig
) -> HingeScores | None:
    """Scores of all hinges on a grid, by a search over stick figures; None when the reading hardly varies.

    A joint moves two parts symmetrically or one alone. Its parts are sticks: the instrument's centre line beyond the
    pivot, turned about the hinge by the reading. The right hinge keeps both sticks on evidence in every frame, above
    all where the reading is large, and leaves tissue visible between them.
    """
    recorded = [frame.state.instruments[name].joints[joint] for frame in evidence.frames]
    readings = torch.tensor(recorded, dtype=torch.float32, device=evidence.device)
    opening = readings - readings.min()
    if float(opening.max()) < MIN_READING_RANGE:
        return None
    closed = evidence.subset(torch.nonzero(readings <= readings.quantile(0.35))[:, 0])
    line = center_line(closed, name, shape, search)
    if len(line) < 2:
        line = shape.center_line
    camera_from_shaft = camera_from_instrument(evidence, name) @ shape.instrument_from_shaft  # [F, 4, 4]
    angles = torch.arange(search.hinge_angles, device=evidence.device) * (math.pi / search.hinge_angles)
    length = shape.tip - shape.near
    depths = np.linspace(shape.near + 0.4 * length, shape.tip - 0.15 * length, search.hinge_depths).tolist()
    score, over_rigid = [], []
    for depth in depths:
        stick = _stick(line, depth, shape.tip)
        scores = {
            gain: _stick_scores(evidence, camera_from_shaft, stick, depth, angles, gain * opening, opening)
            for gain in {0.0, SMALL_GAIN, -SMALL_GAIN, *GAINS[0], *GAINS[1]}
        }
        turned = torch.stack([(scores[first] + scores[second]) / 2 for first, second in GAINS])
        score.append(torch.maximum(turned, (scores[SMALL_GAIN] + scores[-SMALL_GAIN]) / 2))
        over_rigid.append((turned - scores[0.0]) * ((shape.tip - depth) / length))
    return HingeScores(angles.tolist(), depths, *(torch.stack(s).cpu().numpy() for s in (score, over_rigid)))


def _stick(line: Tensor, depth: float, tip: float) -> Tensor:
    """[Q, 3] shaft-frame points of the centre line [Z, 3] from just beyond the pivot at `depth` to just before the
    tip."""
    known = line.cpu().numpy()
    along = np.linspace(depth + 0.15 * (tip - depth), tip - 0.1 * (tip - depth), STICK_POINTS)
    across = [np.interp(along, known[:, 0], known[:, k]) for k in (1, 2)]
    return torch.from_numpy(np.stack([*across, along], -1)).to(line)


def _stick_scores(
    evidence: Evidence,
    camera_from_shaft: Tensor,
    stick: Tensor,
    depth: float,
    angles: Tensor,
    turns: Tensor,
    weight: Tensor,
) -> Tensor:
    """[A] mean evidence on `stick` [Q, 3] for hinges at `angles` [A], turned by `turns` [F] rad, frames weighted by
    `weight` [F]."""
    axis = torch.stack([angles.cos(), angles.sin(), torch.zeros_like(angles)], -1)[:, None, None]  # [A, 1, 1, 3]
    arm = (stick - stick.new_tensor([0.0, 0.0, depth]))[None, None]  # [1, 1, Q, 3]
    cosine, sine = turns.cos()[None, :, None, None], turns.sin()[None, :, None, None]
    along = (arm * axis).sum(-1, keepdim=True) * axis
    across = torch.linalg.cross(axis.expand(-1, 1, arm.shape[2], 3), arm.expand(len(angles), 1, -1, 3))
    turned = arm * cosine + across * sine + along * (1 - cosine)  # [A, F, Q, 3]
    turned[..., 2] += depth
    flat = turned.permute(1, 0, 2, 3).reshape(len(turns), -1, 3)  # [F, A * Q, 3]
    points = flat @ camera_from_shaft[:, :3, :3].transpose(1, 2) + camera_from_shaft[:, None, :3, 3]
    hits, inside = evidence.look_up_camera(points)
    weights = (inside * weight[:, None]).reshape(len(turns), len(angles), -1)
    total = (hits.reshape(weights.shape) * weights).sum((0, 2))
    return total / weights.sum((0, 2)).clamp_min(1e-6)
