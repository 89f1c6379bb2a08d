"""Tissue inside the instruments' shafts: impossible, since a shaft is solid and tissue stays where it is.

Where a dark shaft stands over the same pixels in most frames, dark tissue explains it as well, takes its place in the
images, and leaves holes in its labels.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neeco.methods.kinematic.articulation import ArticulatedInstruments, Articulation
from neeco.methods.kinematic.wrist import MIN_SOLID_GAUSSIANS, SOLID_OPACITY, solid_gaussians
from neeco.scene.canonical import CanonicalGaussians
from neeco.training.session import GaussianSession

RADIUS_SHARE = 0.9  # quantile of the solid Gaussians' distances from the axis: the shaft's surface
INTERIOR = 0.9  # of the radius: errors of states and the surface's own thickness stay outside
MIN_FRAMES = 0.1  # share of the training frames: a wrong state puts the shaft anywhere
REMOVED_OPACITY = 1e-4  # of tissue that is to be pruned


@torch.no_grad()
def fade_interior_tissue(session: GaussianSession, articulated: ArticulatedInstruments) -> None:
    """Make tissue inside a shaft transparent, so that it is pruned and the instrument takes its place, where enough of
    it is solid to be taken for the shaft."""
    canonical = session.scene.canonical
    inside = interior_tissue(session, articulated)
    logits = canonical.opacity_logits[canonical.body(0)]
    if int((inside & (torch.sigmoid(logits) > SOLID_OPACITY)).sum()) < MIN_SOLID_GAUSSIANS:
        return
    logits[inside] = math.log(REMOVED_OPACITY)


@torch.no_grad()
def interior_tissue(session: GaussianSession, articulated: ArticulatedInstruments) -> Tensor:
    """Return which tissue Gaussians [T] are inside a shaft in at least MIN_FRAMES of the training frames, bool."""
    scene = session.scene
    canonical = scene.canonical
    points = canonical.means[canonical.body(0)]
    states = [scene.registered(session.corrected(index)[0]) for index in range(len(session.given))]
    inside = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for index, articulation in enumerate(articulated.articulations):
        cylinder = _cylinder(canonical, index, articulation)
        if cylinder is None:
            continue
        rear, front, radius = cylinder
        origin, direction = articulation.shaft()
        frames = torch.zeros_like(points[:, 0])
        for state in states:
            if (given := state.instruments.get(scene.instruments[index].name)) is None:
                continue
            pose = given.pose.to(points)
            arm = (points - pose[:3, 3]) @ pose[:3, :3] - origin
            along = arm @ direction
            across = (arm - along[:, None] * direction).norm(dim=1)
            frames += (across < radius) & (along > rear) & (along < front)
        inside |= frames >= max(2.0, MIN_FRAMES * len(states))
    return inside


def _cylinder(
    canonical: CanonicalGaussians, index: int, articulation: Articulation
) -> tuple[Tensor, Tensor, Tensor] | None:
    """Return (rear end, front end, radius) in mm of the interior of an instrument's shaft, from its solid Gaussians;
    None where they are too few, or nothing tells where the shaft ends."""
    if not articulation.jointed:
        return None
    points = canonical.means[canonical.body(index + 1)][solid_gaussians(canonical, index)]
    along = articulation.along_shaft(points)
    shaft = along < articulation.first_joint()
    if int(shaft.sum()) < MIN_SOLID_GAUSSIANS:
        return None
    origin, direction = articulation.shaft()
    across = (points - origin - along[:, None] * direction)[shaft].norm(dim=1)
    radius = INTERIOR * across.quantile(RADIUS_SHARE)
    return along[shaft].min(), articulation.first_joint() - radius, radius
