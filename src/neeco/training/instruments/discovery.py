"""Find each instrument from training frames alone, and seed its Gaussians on its links."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from neeco.errors import NeecoError
from neeco.scene.articulation import LINK_LOGITS, ArticulatedInstruments
from neeco.scene.articulation.hinges import Hinges
from neeco.scene.articulation.stated import StatedLinks
from neeco.scene.breathing import Breathing, BreathingTissue
from neeco.scene.canonical import join_bodies, seed_instrument
from neeco.scene.deformations.static import Static
from neeco.scene.drawable import Recorded
from neeco.scene.scene import Scene
from neeco.scene.swept_volume import SweptVolume
from neeco.scene.training_views import TrainingViews
from neeco.training.config import RefineConfig, TrainConfig, method_defaults
from neeco.training.instruments.breathing import find_breathing
from neeco.training.instruments.evidence import (
    CarvedShape,
    Evidence,
    carve,
    gather_evidence,
    posed_views,
    score_points,
)
from neeco.training.instruments.hinge_search import start_hinges
from neeco.training.instruments.link_seeds import along_links, readings_of, start_links
from neeco.training.instruments.reading_doubts import doubt_readings
from neeco.training.session import GaussianSession, new_session

DENSITY_START = 200  # steps of a longer fit of the tissue before it adds Gaussians
MIN_SHARE_INSIDE = 0.01  # of the Gaussians in a bounded volume: with fewer the network cannot form an instrument
SEED_SPREAD = (
    0.05  # of the distance to the tissue: standard deviation of seeds about the tracked frame, without a shape
)


def find_instruments(session: GaussianSession, articulated: ArticulatedInstruments) -> None:
    """Add every instrument's body to the session's scene, whose canonical set holds the tissue alone, and start its
    joints.

    `articulated` is the scene's deformation. Raises NeecoError when an instrument leaves no evidence in its own frame:
    its poses do not match the images.
    """
    scene, report = session.scene, session.report
    if not scene.instruments:
        return
    report("looking for the instruments: fitting the tissue alone")
    tissue = fit_tissue(scene, session.views, session.config)
    if isinstance(articulated, BreathingTissue) and articulated.may_breathe and session.timed:
        tissue = _learn_breathing(session, articulated, tissue)
    evidence = tissue_evidence(scene, session.views, session.config, tissue)
    generator = torch.Generator().manual_seed(session.config.seed)
    bodies = [scene.canonical]
    for index, instrument in enumerate(scene.instruments):
        shape = carved_shape(session, evidence, instrument.name, generator)
        articulation = articulated.articulations[index]
        if isinstance(articulation, StatedLinks):
            shape = along_links(session, articulation, evidence, instrument.name, shape, generator)
        articulation.base.copy_(shape.instrument_from_shaft)
        articulation.extent.copy_(torch.tensor([shape.near, shape.tip]))
        articulation.radius.fill_(shape.radius)
        columns = articulated.logit_count
        if isinstance(articulation, StatedLinks):
            seeds, logits = start_links(session, articulation, evidence, instrument.name, shape, columns, generator)
            doubt_readings(session, articulation, evidence, instrument, readings_of(session, evidence, instrument.name))
        else:
            assert isinstance(articulation, Hinges)
            seeds, logits = start_hinges(session, articulation, evidence, instrument.name, shape, columns, generator)
        bodies.append(seed_instrument(seeds, shape.radius).with_extras(**{LINK_LOGITS: logits}))
    scene.canonical = join_bodies(bodies)


def bound_volume(session: GaussianSession, volume: SweptVolume) -> None:
    """Bound `volume`, outside which the paper's network is not evaluated, by what the carved instruments sweep in the
    training frames.

    Where carving cannot be trusted the volume stays unbounded: slow, but never wrong. Raises NeecoError when hardly any
    Gaussian lies inside: the network moves tissue onto the instrument, so the volume has to reach the tissue.
    """
    scene, views, report = session.scene, session.views, session.report
    report("looking for the instruments, to bound where the network is evaluated")
    evidence = tissue_evidence(scene, views, session.config)
    generator = torch.Generator().manual_seed(session.config.seed)
    shapes = []
    for instrument in scene.instruments:
        shape = carve(evidence, instrument.name, generator, session.config.search)
        if shape is None or not moves_with_pose(session, evidence, instrument.name, shape):
            report(f"warning: {instrument.name}: its shape cannot be carved; the network is evaluated everywhere")
            return
        shapes.append(shape)
    swept = []
    for instrument, shape in zip(scene.instruments, shapes, strict=True):
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


def carve_seeds(session: GaussianSession) -> list[tuple[Tensor, float]]:
    """Points [P, 3] mm on every instrument in its own frame, and its shaft's radius, mm. Raises NeecoError as
    `find_instruments` does."""
    session.report("looking for the instruments, on which Gaussians begin")
    evidence = tissue_evidence(session.scene, session.views, session.config)
    generator = torch.Generator().manual_seed(session.config.seed)
    names = [instrument.name for instrument in session.scene.instruments]
    shapes = [carved_shape(session, evidence, name, generator) for name in names]
    return [(shape.seeds, shape.radius) for shape in shapes]


def carved_shape(session: GaussianSession, evidence: Evidence, name: str, generator: torch.Generator) -> CarvedShape:
    """The carved shape, or what of it is around the instrument's frame where the rest may be static parts of the scene.
    Raises NeecoError when there is nothing."""
    search = session.config.search
    shape = carve(evidence, name, generator, search)
    if shape is None:
        raise NeecoError(
            f"instrument {name!r}: nothing in the images moves with its recorded pose; check that its poses are in the "
            "cameras' world frame and in mm (`neeco check`), or train with --method neeco as published"
        )
    if moves_with_pose(session, evidence, name, shape):
        return shape
    return shape_around_frame(shape, evidence.distance, search.seeds, generator)


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


def _learn_breathing(session: GaussianSession, breathes: BreathingTissue, tissue: Scene) -> Scene:
    """`tissue`, a fit of still tissue, or where that breathes one that was fitted anew with its breathing, with which
    `breathes` begins then."""
    scene, views, config = session.scene, session.views, session.config
    if len(scene.recorded.tissues) > 1:
        session.report("several tissues: none of them is taken to breathe")
        return tissue
    begun = find_breathing(tissue, views)
    if begun is None:
        return tissue
    breathing, found = begun
    session.report(f"the tissue breathes with a period of {found.period:.2f} s: fitting it again")
    tissue = fit_tissue(scene, views, config, breathing=breathing)
    deformation = tissue.deformation
    assert isinstance(deformation, BreathingTissue)
    assert deformation.breathing is not None
    breathes.start_breathing(deformation.breathing)
    scene.diagnostics["breathing"] = deformation.breathing.describe(scene.recorded.cameras) | {
        "explained": round(found.explained, 3)
    }
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
    longer = fit_tissue(scene, views, config, config.search.long_tissue_steps, DENSITY_START, breathing)
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
    recorded = Recorded(tissues=scene.recorded.tissues)
    tissue = Scene(Static.method, canonical, deformation, (), recorded, scene.center)
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
