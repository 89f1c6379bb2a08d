"""The shapes of instruments, carved from the evidence in training frames."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from neeco.errors import NeecoError
from neeco.methods.carving.evidence import CarvedShape, Evidence, carve, posed_views, score_points
from neeco.methods.carving.tissue_fit import tissue_evidence
from neeco.training.session import GaussianSession

SEED_SPREAD = (
    0.05  # of the distance to the tissue: standard deviation of seeds about the tracked frame, without a shape
)


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
    search = session.config.deformation.carving
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
    search = session.config.deformation.carving
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
