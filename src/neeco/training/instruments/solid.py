"""What of an instrument is its substance, how far it reaches and how thick its shaft is; which frames to ask."""

from __future__ import annotations

import torch
from torch import Tensor

from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.instruments import Hinges
from neeco.training.session import GaussianSession

SOLID = 0.3  # opacity of a Gaussian that counts as the instrument's substance
WITHIN = 0.9  # share of the solid Gaussians that lie within the shaft's radius
MOSTLY = 0.5  # of a Gaussian, to be counted with a part
TIP = 0.97  # share of a part's solid Gaussians that lie nearer to the hinge than its tip
ENOUGH = 10  # solid Gaussians without which an instrument is as good as absent


def spread(session: GaussianSession, count: int) -> list[int]:
    """Indices of `count` training frames spread evenly along the walk through poses."""
    order = session.pose_order
    return [int(order[int(place)]) for place in torch.linspace(0, len(order) - 1, min(count, len(order)))]


def solid(canonical: CanonicalGaussians, index: int) -> Tensor:
    """[M] bool: which Gaussians of instrument `index` are its substance."""
    return torch.sigmoid(canonical.opacity_logits[canonical.body(index + 1)]) > SOLID


def measure_radius(canonical: CanonicalGaussians, index: int, hinges: Hinges) -> None:
    """Set the shaft's radius to what most solid Gaussians well behind the first hinge stay within; leave it where
    there are too few."""
    points = canonical.means[canonical.body(index + 1)][solid(canonical, index)]
    origin, direction = hinges.shaft()
    along = hinges.along_shaft(points)
    away = (points - origin - along[:, None] * direction)[along < hinges.hinge_depth.min() - 2 * hinges.radius]
    if len(away) >= ENOUGH:
        hinges.radius.copy_(away.norm(dim=1).quantile(WITHIN))


def solid_extent(canonical: CanonicalGaussians, index: int, hinges: Hinges) -> Tensor:
    """[2] mm along the shaft between which the solid Gaussians lie."""
    along = hinges.along_shaft(canonical.means[canonical.body(index + 1)][solid(canonical, index)])
    if len(along) < ENOUGH:
        return hinges.extent.clone()
    return torch.quantile(along, along.new_tensor([0.02, 0.985]))


def measure_tips(canonical: CanonicalGaussians, index: int, hinges: Hinges, weights: Tensor) -> None:
    """Set the tips of every joint's parts to where their solid Gaussians lie farthest from the hinge; leave them
    unknown where there are too few. weights [M, part_count]."""
    points, kept = canonical.means[canonical.body(index + 1)], solid(canonical, index)
    shares = hinges.parts(points, weights)
    for joint in range(len(hinges.joint_names)):
        pivot, _ = hinges.hinge(joint)
        found = torch.full_like(hinges.tips[joint], torch.nan)
        for side, part in enumerate(hinges.left_right_order(joint).tolist()):
            of_part = points[kept & (shares[:, 2 + 2 * joint + side] > MOSTLY)]
            if len(of_part) < ENOUGH:
                continue
            away = (of_part - pivot).norm(dim=1)
            found[part] = of_part[away >= away.quantile(TIP)].mean(0)
        hinges.tips[joint] = found
