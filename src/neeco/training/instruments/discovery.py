"""Find each instrument and its joints from training frames alone, and seed its Gaussians (of a method with hinges)."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from neeco.errors import NeecoError
from neeco.scene.canonical import join_bodies, seed_gaussians
from neeco.scene.deformations.static import Static
from neeco.scene.drawable import Recorded
from neeco.scene.instruments import PART_LOGITS, HingedInstruments, Hinges
from neeco.scene.scene import Scene
from neeco.scene.training_session import Report
from neeco.scene.training_views import TrainingViews
from neeco.training.config import RefineConfig, TrainConfig, method_defaults
from neeco.training.instruments.carving import MOVES, CarvedShape, carve, posed_views, score_points
from neeco.training.instruments.evidence import Evidence, gather_evidence
from neeco.training.instruments.hinge_search import balanced_depth, dominant_angle, search_hinge
from neeco.training.session import GaussianSession, new_session

TISSUE_STEPS = 500  # of the short tissue-only fit that makes the evidence
LONGER_STEPS = 1500  # of the one with density control, where the sparse points alone explain too little
UNEXPLAINED = 0.25  # mean evidence that is too much for instruments alone
SEEDS = 3000  # Gaussians per instrument at the start
AROUND_FRAME = 0.05  # of the distance to the tissue: how far about an untrusted frame seeds are strewn
BODY_LEAN = 2.0  # part logit given to the side of the hinge a seed lies on


def find_instruments(session: GaussianSession, hinged: HingedInstruments) -> None:
    """Add every instrument's body to the session's scene, whose canonical set holds the tissue alone, and start its
    hinges.

    `hinged` is the scene's deformation, known to have hinges. Raises NeecoError when an instrument leaves no evidence
    in its own frame: its poses do not match the images.
    """
    scene, config, report = session.scene, session.config, session.report
    if not scene.instruments:
        return
    report("looking for the instruments: fitting the tissue alone")
    evidence = tissue_evidence(scene, session.views, config)
    generator = torch.Generator().manual_seed(config.seed)
    bodies = [scene.canonical]
    for index, instrument in enumerate(scene.instruments):
        shape = carve(evidence, instrument.name, generator, SEEDS)
        if shape is None:
            raise NeecoError(
                f"instrument {instrument.name!r}: nothing in the images moves with its recorded pose; check that its "
                "poses are in the cameras' world frame and in mm (`neeco check`), or train with --method neeco"
            )
        if not judge_evidence(scene, evidence, instrument.name, shape, report):
            shape = shape_around_frame(shape, evidence.distance, generator)
        hinges = hinged.hinges_of(index)
        start_hinges(hinges, evidence, instrument.name, shape, report)
        seeds = shape.seeds.to(scene.center.device)
        logits = seed_logits(hinges, seeds, hinged.logit_count, generator)
        seeds = at_middle(hinges, seeds, logits)
        body = seed_gaussians(seeds, seeds.new_full((SEEDS, 3), 0.4), seeds.new_full((SEEDS,), 0.4 * shape.radius))
        bodies.append(body.with_extras(**{PART_LOGITS: logits}))
    scene.canonical = join_bodies(bodies)


def judge_evidence(scene: Scene, evidence: Evidence, name: str, shape: CarvedShape, report: Report) -> bool:
    """Does the evidence move with the instrument? Exchange the poses among frames: it must get worse.

    Where it does not (an instrument that hardly moves, say), carving cannot tell the instrument from what stands still.
    """
    views = posed_views(evidence, name)
    own, _ = score_points(evidence, views.own, shape.seeds)
    other = views.exchanged_scores(shape.seeds)
    moves = float(own.mean()) > MOVES * float(other.mean())
    scene.diagnostics.setdefault("instruments", {})[name] = {
        "evidence": round(float(own.mean()), 4),
        "evidence_of_other_poses": round(float(other.mean()), 4),
        "moves_with_its_pose": moves,
    }
    if not moves:
        report(
            f"warning: {name}: what the images show hardly depends on its recorded pose; its shape is sought about the "
            "tracked frame, and its labels may be wrong (record more motion, or check that poses are registered)"
        )
    return moves


def shape_around_frame(shape: CarvedShape, distance: float, generator: torch.Generator) -> CarvedShape:
    """What to start from when carving cannot be trusted: seeds about the tracked frame, which is on the body."""
    spread = AROUND_FRAME * distance
    seeds = (torch.randn(SEEDS, 3, generator=generator, device=generator.device) * spread).to(shape.seeds)
    frame = torch.eye(4, device=seeds.device)
    return replace(shape, instrument_from_shaft=frame, near=-spread, tip=spread, radius=0.1 * spread, seeds=seeds)


def tissue_evidence(scene: Scene, views: TrainingViews, config: TrainConfig) -> Evidence:
    """Fit a copy of the tissue with nothing moving; what is left over is the evidence.

    A few hundred steps of the sparse points do on tissue full of texture. Where much is left over, the points are too
    few, and a longer fit may add Gaussians.
    """
    evidence = _evidence_after(TISSUE_STEPS, 10**9, scene, views, config)
    if float(evidence.hits.mean()) <= UNEXPLAINED:
        return evidence
    return _evidence_after(LONGER_STEPS, 200, scene, views, config)


def _evidence_after(
    steps: int, density_start: int, scene: Scene, views: TrainingViews, config: TrainConfig
) -> Evidence:
    """Evidence left by a static fit of `steps` steps, with density control from `density_start` on."""
    tissue = scene.canonical.map(lambda tensor: tensor.clone())
    alone = Scene(Static.method, tissue, Static(), (), Recorded(), scene.center)
    alone.background = scene.background  # or what lies behind transparent images would be evidence
    short = replace(
        config,
        iterations=steps,
        minutes=None,
        schedule=method_defaults(Static.method).schedule,
        refine=RefineConfig(),
        density_start=density_start,
        density_stop=0.8,
    )
    session = new_session(alone, views, short)
    session.start()
    while session.iteration < steps:
        session.step()
    alone.requires_grad_(False)
    return gather_evidence(alone, views)


def start_hinges(hinges: Hinges, evidence: Evidence, name: str, shape: CarvedShape, report: Report) -> None:
    """Put the shaft where it was carved and each joint at the best hypothesis of the search."""
    hinges.base.copy_(shape.instrument_from_shaft)
    hinges.extent.copy_(torch.tensor([shape.near, shape.tip]))
    for index, joint in enumerate(hinges.joint_names):
        guesses = search_hinge(evidence, name, joint, shape)
        if not guesses:
            report(f"{name}: joint {joint} hardly moves in the training frames; its hinge cannot be found")
            continue
        with torch.no_grad():
            hinges.hinge_angle[index] = dominant_angle(guesses)
            hinges.hinge_depth[index] = balanced_depth(guesses)
            hinges.share[index] = 1.0 if guesses[0].gains[1] == 0 else 0.5
            readings = [frame.state.instruments[name].joints[joint] for frame in evidence.frames]
            hinges.middle[index] = sum(readings) / len(readings)
            hinges.closed[index] = min(readings)
            hinges.offsets[index] = (hinges.middle[index] - min(readings)) * hinges.gains[index]
    hinges.radius.fill_(shape.radius)
    if hinges.joint_names:
        hinges.wrist_start.fill_(float(hinges.hinge_depth[0].detach()) - 5 * shape.radius)


@torch.no_grad()
def at_middle(hinges: Hinges, seeds: Tensor, logits: Tensor) -> Tensor:
    """Seeds [M, 3] mm, carved with the joints at their offsets, as they are where every part's offset is zero, which
    they are set to: there a change of hinge or gains moves nothing."""
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
        logits[:, 0] += torch.where(beyond, 0.0, BODY_LEAN)
        side = torch.randint(1, hinges.part_count, (len(seeds),), generator=generator).to(seeds.device)
        lean = nn.functional.one_hot(side, columns) * (BODY_LEAN / 2)
        return logits + torch.where(beyond[:, None], lean, lean.new_zeros(()))
