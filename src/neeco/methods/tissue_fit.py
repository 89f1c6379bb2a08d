"""A short fit of the tissue alone, whose residual is the evidence of instruments, and the shapes carved from it."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.capture.model import HOW_TO_REGISTER
from neeco.evidence.carving import (
    CARVING,
    CarvedShape,
    Evidence,
    carve,
    distinct_frames,
    gather_evidence,
    posed_views,
    score_points,
)
from neeco.methods.breathing import Breathing
from neeco.methods.static import Static
from neeco.scene.drawable import Recorded
from neeco.scene.gaussian_scene import GaussianScene
from neeco.scene.training_views import TrainingViews
from neeco.states.refinement import RefineConfig
from neeco.training.config import OptimizerConfig, TrainConfig, method_defaults
from neeco.training.session import GaussianSession

DENSITY_START = 200  # steps of a longer fit of the tissue before it adds Gaussians


def tissue_evidence(
    scene: GaussianScene, views: TrainingViews, config: TrainConfig, tissue: GaussianScene | None = None
) -> Evidence:
    """Return the silhouette evidence: residuals of a fit of the tissue, static or breathing. `tissue`: that fit, if
    made.

    A few hundred steps suffice on textured tissue with enough sparse points. Where the residual is large, a longer fit
    may add Gaussians.
    """
    settings = config.deformation.carving
    tissue = tissue or fit_tissue(scene, views, config)
    linked = any(instrument.kinematics is not None for instrument in scene.instruments)  # registered without shadows
    evidence = gather_evidence(tissue, views, settings, unshaded=linked)
    if float(evidence.hits.mean()) <= settings.max_evidence:
        return evidence
    breathing = tissue.deformation.breathing if isinstance(tissue.deformation, Static) else None
    longer = fit_tissue(scene, views, config, settings.long_tissue_steps, DENSITY_START, breathing)
    return gather_evidence(longer, views, settings, unshaded=linked)


def fit_tissue(
    scene: GaussianScene,
    views: TrainingViews,
    config: TrainConfig,
    steps: int | None = None,
    density_start: int = 10**9,
    breathing: Breathing | None = None,
) -> GaussianScene:
    """Return a copy of the tissue of `scene`, which has no instruments yet, after `steps` steps (None: `tissue_steps`),
    with density control from `density_start` on; static, or breathing from a start at `breathing`."""
    steps = config.deformation.carving.tissue_steps if steps is None else steps
    canonical = scene.canonical.map(lambda tensor: tensor.clone())
    deformation = Static()
    if breathing is not None:
        deformation.start_breathing(breathing)
    tissue = GaussianScene(Static.method, canonical, deformation, (), Recorded(), scene.center)
    tissue.background = scene.background  # or the background of transparent images would be evidence
    short = replace(
        config,
        iterations=steps,
        minutes=None,
        schedule=method_defaults(Static.method).schedule,
        refine=RefineConfig(),
        density_start=density_start,
        density_stop=0.8,
        optimizer=OptimizerConfig(),  # what counts as evidence was measured at these rates, whatever training has
    )
    distinct = distinct_frames([(frame.state, frame.camera) for frame in views.frames])
    session = GaussianSession(tissue, views.subset(distinct), short)
    session.start()
    while session.iteration < steps:
        session.step()
    tissue.requires_grad_(False)
    return tissue


def carved_shape(session: GaussianSession, evidence: Evidence, name: str, generator: torch.Generator) -> CarvedShape:
    """Return the carved shape, or seeds around the tracked frame where the evidence does not move with the instrument,
    which is reported and noted in the scene's diagnostics. Raises NeecoError without evidence."""
    search = session.config.deformation.carving
    shape = carve(evidence, name, generator, search)
    if shape is None:
        raise NeecoError(
            f"instrument {name!r}: nothing in the images moves with its recorded pose; check that its poses are in mm "
            f"and in the cameras' world frame (`neeco check`): {HOW_TO_REGISTER}; or train with --method nps"
        )
    # with exchanged poses the evidence must be weaker: where it is not (an instrument that hardly moves), carving
    # cannot separate the instrument from static parts of the scene
    views = posed_views(evidence, name, search)
    recorded_scores, _ = score_points(evidence, views.own, shape.seeds)
    other = views.exchanged_scores(shape.seeds)
    moves = float(recorded_scores.mean()) > search.motion_ratio * float(other.mean())
    session.scene.diagnostics.setdefault("instruments", {})[name] = {
        "evidence": round(float(recorded_scores.mean()), 4),
        "evidence_of_other_poses": round(float(other.mean()), 4),
        "moves_with_its_pose": moves,
    }
    if moves:
        return shape
    session.report(
        f"warning: {name}: the images hardly depend on its recorded pose; its shape is searched around the "
        f"tracked frame, and its labels may be wrong: record more motion, or register its poses ({HOW_TO_REGISTER})"
    )
    spread = CARVING.seed_spread * evidence.distance
    seeds = (torch.randn(search.seeds, 3, generator=generator, device=generator.device) * spread).to(shape.seeds)
    frame = torch.eye(4, device=seeds.device)  # the tracked frame is on the body
    return replace(shape, instrument_from_shaft=frame, near=-spread, tip=spread, radius=0.1 * spread, seeds=seeds)


def carve_seeds(session: GaussianSession) -> list[tuple[Tensor, float]]:
    """Return points [P, 3] mm on every instrument in its own frame, and its shaft's radius, mm. Raises NeecoError for
    an instrument without evidence."""
    session.report("searching for the instruments, on which Gaussians start")
    evidence = tissue_evidence(session.scene, session.views, session.config)
    generator = torch.Generator().manual_seed(session.config.seed)
    names = [instrument.name for instrument in session.scene.instruments]
    shapes = [carved_shape(session, evidence, name, generator) for name in names]
    return [(shape.seeds, shape.radius) for shape in shapes]
