"""Removal of tissue Gaussians inside the instruments' shafts, or in front of a shaft whenever they are in view: a shaft
is solid, and tissue stays where it is.

Where a dark shaft stands over the same pixels in most frames, dark tissue explains it as well, takes its place in the
images, and leaves holes in its labels.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neeco.geometry.projection import in_image
from neeco.methods.kinematic.articulation import ArticulatedInstruments, Articulation
from neeco.methods.kinematic.wrist import MIN_SOLID_GAUSSIANS, SOLID_OPACITY, solid_gaussians
from neeco.scene.canonical import CanonicalGaussians
from neeco.training.session import GaussianSession

RADIUS_SHARE = 0.9  # quantile of the solid Gaussians' distances from the axis: the shaft's surface
INTERIOR = 0.9  # of the radius: errors of states and the surface's own thickness stay outside
MIN_FRAMES = 0.1  # share of the training frames: a wrong state puts the shaft anywhere
ALWAYS = 0.8  # share of the frames with a point in view in which it is in front of a shaft, above which it is no tissue
REMOVED_OPACITY = 1e-4  # of tissue that is to be pruned


@torch.no_grad()
def fade_interior_tissue(session: GaussianSession, articulated: ArticulatedInstruments) -> None:
    """Make tissue inside a shaft, or always in front of it, transparent, so that it is pruned and the instrument takes
    its place, where enough of it is solid to be taken for the shaft."""
    canonical = session.scene.canonical
    inside = interior_tissue(session, articulated)
    logits = canonical.opacity_logits[canonical.body(0)]
    if int((inside & (torch.sigmoid(logits) > SOLID_OPACITY)).sum()) < MIN_SOLID_GAUSSIANS:
        return
    logits[inside] = math.log(REMOVED_OPACITY)


@torch.no_grad()
def interior_tissue(session: GaussianSession, articulated: ArticulatedInstruments) -> Tensor:
    """Return which tissue Gaussians [T] are inside a shaft in at least MIN_FRAMES of the training frames, or in front
    of one in as many and in more than ALWAYS of those with the Gaussian in view, bool."""
    scene = session.scene
    canonical = scene.canonical
    points = canonical.means[canonical.body(0)]
    corrected = [session.corrected(index) for index in range(len(session.given))]
    states = [scene.registered(state) for state, _ in corrected]
    seen = torch.stack([in_image(points, camera) for _, camera in corrected])  # [F, T]
    inside = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for index, articulation in enumerate(articulated.articulations):
        cylinder = _cylinder(canonical, index, articulation)
        if cylinder is None:
            continue
        rear, front, radius = cylinder
        origin, direction = articulation.shaft()
        frames, before = torch.zeros_like(points[:, 0]), torch.zeros_like(points[:, 0])
        for number, state in enumerate(states):
            if (given := state.instruments.get(scene.instruments[index].name)) is None:
                continue
            pose = given.pose.to(points)
            arm = (points - pose[:3, 3]) @ pose[:3, :3] - origin
            along = arm @ direction
            across = (arm - along[:, None] * direction).norm(dim=1)
            frames += (across < radius) & (along > rear) & (along < front)
            camera = (corrected[number][1].world_from_camera[:3, 3].to(points) - pose[:3, 3]) @ pose[:3, :3] - origin
            before += seen[number] & _hides(camera, arm, direction, radius, front)
        least = max(2.0, MIN_FRAMES * len(states))
        inside |= (frames >= least) | ((before >= least) & (before > ALWAYS * seen.sum(0)))
    return inside


def _hides(camera: Tensor, points: Tensor, direction: Tensor, radius: Tensor, front: Tensor) -> Tensor:
    """Return whether each of `points` [T, 3] is in front of a cylinder, as observed from `camera` [3], bool [T]. The
    cylinder's axis goes through the origin along `direction` and ends at `front` mm; towards the rear it is unbounded,
    since a shaft enters from outside of the image."""
    sight = points - camera
    ahead = sight @ direction
    across, start = sight - ahead[:, None] * direction, camera - (camera @ direction) * direction
    reach = -(across @ start) / across.square().sum(1).clamp(min=1e-12)  # to where the line is nearest to the axis
    nearest = (start + reach[:, None] * across).norm(dim=1)
    return (reach > 1) & (nearest < radius) & (camera @ direction + reach * ahead < front)


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
