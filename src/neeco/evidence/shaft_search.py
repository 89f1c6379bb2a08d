"""Search for an instrument's shaft: the half-infinite cylinder whose silhouettes explain the evidence of all frames.

Points that lie on evidence in every frame fill the visual hull, which is far from the instrument where it hardly turns:
they lie along lines of sight as well. A cylinder is told from these by its silhouettes. The line through a pair of such
points is a candidate; it gains the evidence that its silhouettes cover and loses what they cover without evidence, and
ends where it gains most. What it gains with poses exchanged among the frames is evidence that does not move with the
instrument, and counts against it. The best candidates are improved by random steps.

A shaft turns about its trocar, so that it moves less there than where it is seen. A line that does gains more, and the
trocar is behind the tip. Where nothing holds the shaft, its two directions differ as it leaves the image at its rear.

Where no cylinder explains much of the evidence, which other instruments leave, too, or where a wrist bends the shaft in
the tracked frame of its tip, the line is the principal axis of these points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, normalize


@dataclass(frozen=True, kw_only=True)
class ShaftSettings:
    """Settings of the search. Lengths are shares of the median distance to the tissue."""

    n_points: int = 600  # with most evidence, through which lines are tried
    least_evidence: float = 0.4  # mean of each of these points
    n_frames: int = 16  # evenly spaced, that are compared
    widths_px: tuple[int, int] = (32, 64)  # of their evidence: for all candidates, and for the best
    n_pairs: int = 2400  # of points: candidates
    least_apart: float = 0.12  # of the two points of a pair
    threshold: float = 0.45  # evidence from which a covered pixel is a gain
    always: float = 0.95  # share of the frames with evidence from which a pixel shows background that nothing explains
    radii: tuple[float, float, int] = (0.012, 0.055, 7)  # least, most, and how many between, geometrically
    half_length: float = 1.5  # of the line on either side of its origin
    n_bins: int = 96  # along it
    n_likely: int = 96  # candidates that are also tried with exchanged poses
    n_best: int = 12  # of them that are improved
    least_share: float = 0.14  # of the evidence, that a cylinder must gain; shafts gained 0.16 and more, bent ones 0.12
    solid: float = 0.9  # of the largest mean evidence of a point, from which it counts for the principal axis
    n_rounds: int = 4  # of random steps, each half as large as the one before
    n_steps: int = 24  # tried in a round for each candidate
    shift: float = 0.02  # standard deviation of the first steps
    turn: float = 0.08  # rad, the same of directions
    trocar_weight: float = 0.4  # what a line that rests at a trocar gains more, as a share
    least_rest: float = 0.2  # share by which a line moves less at a trocar, which then tells where its rear is
    trocar: tuple[float, float, int] = (0.4, 2.6, 12)  # from the evidence's middle: least, most, how many between


SETTINGS = ShaftSettings()


@dataclass(frozen=True, eq=False)
class Shaft:
    """A line in an instrument's frame: a point [3] mm, a unit direction [3], and the radius, mm; None: not known.
    `lead`: by how much more of the evidence is explained with the tip in that direction than in the other, as a share.
    `rest`: by how much less than where it is seen it moves at a trocar behind, as a share; negative: ahead."""

    origin: Tensor
    direction: Tensor
    radius: float | None
    lead: float
    rest: float


@dataclass(frozen=True, eq=False)
class CylinderViews:
    """Evidence of F frames for cylinders: unit rays [F, P, 3] of the cameras, what each pixel is worth [F, P],
    camera_from_instrument [F, 4, 4] as recorded, and with poses exchanged among the frames, and world_from_instrument
    [F, 4, 4]. `distance`: mm, that settings are shares of."""

    rays: Tensor
    worth: Tensor
    own: Tensor
    exchanged: Tensor
    world: Tensor
    distance: float

    @staticmethod
    def of(
        *, hits: Tensor, sizes: Tensor, intrinsics: Tensor, distance: float, width: int, **poses: Tensor
    ) -> CylinderViews:
        """Reduce evidence [F, H, W] in [0, 1] of images of `sizes` [F, 2] px to about `width` pixels."""
        pool = max(1, round(hits.shape[2] / width))
        small = avg_pool2d(hits[:, None], pool)[:, 0]
        rows, columns = ((torch.arange(side, device=hits.device) + 0.5) * pool for side in small.shape[1:])
        v, u = torch.meshgrid(rows, columns, indexing="ij")
        fx, fy, cx, cy = (column[:, None, None] for column in intrinsics.unbind(1))
        rays = torch.stack([(u - cx) / fx, (v - cy) / fy, torch.ones_like(u).expand_as(small)], -1)
        inside = (u < sizes[:, :1, None]) & (v < sizes[:, 1:, None])
        moves = (small > SETTINGS.threshold).float().mean(0) < SETTINGS.always
        worth = torch.where(inside & moves, small - SETTINGS.threshold, 0.0)
        count = len(hits)
        rays = normalize(rays.reshape(count, -1, 3), dim=-1)
        return CylinderViews(rays, worth.reshape(count, -1), distance=distance, **poses)

    def gains(
        self, transforms: Tensor, origins: Tensor, directions: Tensor, chunk: int = 64
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return what the lines through origins [C, 3] along unit directions [C, 3] gain under camera_from_instrument
        [F, 4, 4] with the best radius and tip [C], what they gain more than in the opposite direction, as a share [C],
        and the radius [C], mm."""
        parts = [
            self._gains(transforms, *lines) for lines in zip(origins.split(chunk), directions.split(chunk), strict=True)
        ]
        gains, leads, radii = (torch.cat(values) for values in zip(*parts, strict=True))
        return gains, leads, radii

    def rests(self, origins: Tensor, directions: Tensor, center: Tensor) -> Tensor:
        """Return by how much less lines move somewhere behind than where they pass a `center` [3], as a share, negative
        where ahead [C]. How far a point moves is its distance from its middle in the world, in the median frame."""
        least, most, count = SETTINGS.trocar
        far = torch.linspace(least, most, count, device=origins.device) * self.distance
        places = ((center - origins) * directions).sum(-1)[:, None] + torch.cat([-far, far.new_zeros(1), far])
        points = (origins[:, None] + places[..., None] * directions[:, None]).to(self.world)  # [C, L, 3]
        moved = (self.world[:, None, None, :3, :3] * points[..., None, :]).sum(-1) + self.world[:, None, None, :3, 3]
        away = (moved - moved.median(0).values).norm(dim=-1).median(0).values.to(origins)  # [C, L] mm
        shares = 1 - away / away[:, count, None].clamp_min(1e-6)
        behind, ahead = shares[:, :count].amax(1).clamp_min(0.0), shares[:, count + 1 :].amax(1).clamp_min(0.0)
        return torch.where(behind >= ahead, behind, -ahead)

    def _gains(self, transforms: Tensor, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        rotation, shift = transforms[:, :3, :3], transforms[:, :3, 3]
        point = (rotation * origins[:, None, None]).sum(-1) + shift  # [C, F, 3]
        along = (rotation * directions[:, None, None]).sum(-1)
        # distance of a ray to the line, and where on the line it is reached, by the common perpendicular
        cosine, ahead = self._on_rays(along), self._on_rays(point)
        sine_squared = (1 - cosine.square()).clamp_min(1e-6)
        moment = self._on_rays(torch.linalg.cross(along, point))
        distance = moment.abs() / sine_squared.sqrt()
        place = (cosine * ahead - (point * along).sum(-1)[..., None]) / sine_squared
        least, most, n_radii = SETTINGS.radii
        radii = torch.logspace(0, 1, n_radii, base=most / least, device=origins.device) * least * self.distance
        half, n_bins = SETTINGS.half_length * self.distance, SETTINGS.n_bins
        ring = torch.bucketize(distance.contiguous(), radii)
        cell = ((place + half) / (2 * half) * n_bins).long().clamp(0, n_bins - 1)
        counted = (ring < n_radii) & (ahead + place * cosine > 0)  # in front of the camera
        worth = torch.where(counted, self.worth, 0.0).flatten(1)
        index = (ring.clamp_max(n_radii - 1) * n_bins + cell).flatten(1)
        sums = worth.new_zeros(len(origins), n_radii * n_bins).scatter_add_(1, index, worth)
        by_radius = sums.view(-1, n_radii, n_bins).cumsum(1)
        forward, backward = by_radius.cumsum(2).amax(2), by_radius.flip(2).cumsum(2).amax(2)
        gains, best = torch.maximum(forward, backward).max(1)
        row = torch.arange(len(origins), device=origins.device)
        return gains, (forward - backward)[row, best] / gains.clamp_min(1e-6), radii[best]

    def _on_rays(self, vectors: Tensor) -> Tensor:
        """Return the products [C, F, P] of vectors [C, F, 3] and the rays. Without a matrix product, whose last bits
        may differ from run to run with the memory's alignment."""
        x, y, z = (
            ray * vector[..., None] for ray, vector in zip(self.rays.unbind(-1), vectors.unbind(-1), strict=True)
        )
        return x + y + z


def find_shaft(
    coarse: CylinderViews, fine: CylinderViews, points: Tensor, scores: Tensor, generator: torch.Generator
) -> Shaft | None:
    """Return the shaft of an instrument by points [Q, 3] mm on evidence, instrument frame, and their mean evidence [Q];
    None where these are no two apart. coarse, fine: the evidence for all candidates, and for the best of them."""
    center = (scores[:, None] * points).sum(0) / scores.sum()
    settings, distance, weight = SETTINGS, coarse.distance, SETTINGS.trocar_weight
    firsts, seconds = (
        torch.multinomial(scores.to(generator.device), settings.n_pairs, True, generator=generator).to(points.device)
        for _ in range(2)
    )
    arms = points[seconds] - points[firsts]
    apart = arms.norm(dim=1) > settings.least_apart * distance
    if not bool(apart.any()):
        return None
    origins, directions = points[firsts][apart], normalize(arms[apart], dim=1)
    gains, _, _ = coarse.gains(coarse.own, origins, directions)
    gains = gains * (1 + weight * coarse.rests(origins, directions, center).abs())
    best = gains.topk(min(settings.n_likely, len(gains))).indices
    origins, directions = origins[best], directions[best]
    contrast = gains[best] - coarse.gains(coarse.exchanged, origins, directions)[0]
    best = contrast.topk(min(settings.n_best, len(contrast))).indices
    origins, directions = origins[best], directions[best]
    for number in range(settings.n_rounds):
        size = (len(origins) * settings.n_steps, 6)
        noise = torch.randn(size, generator=generator, device=generator.device).to(points) * 0.5**number
        noise[:: settings.n_steps] = 0  # the candidate as it is
        tried = origins.repeat_interleave(settings.n_steps, 0) + settings.shift * distance * noise[:, :3]
        turned = directions.repeat_interleave(settings.n_steps, 0) + settings.turn * noise[:, 3:]
        turned = normalize(turned, dim=1)
        evident, leads, radii = fine.gains(fine.own, tried, turned)
        gains = evident * (1 + weight * fine.rests(tried, turned, center).abs())
        best = gains.view(-1, settings.n_steps).argmax(1)
        best += torch.arange(len(origins), device=best.device) * settings.n_steps
        best = best[gains[best].argsort(descending=True)][: max(3, len(best) // 2)]
        origins, directions, leads, radii = tried[best], turned[best], leads[best], radii[best]
        gained = float(evident[best[0]])
    if gained < settings.least_share * float(fine.worth.clamp_min(0).sum()):
        origin, direction, radius, lead = *_principal_axis(points, scores), None, 0.0
    else:
        origin, direction, radius, lead = origins[0], directions[0], float(radii[0]), float(leads[0])
    return Shaft(origin, direction, radius, lead, float(fine.rests(origin[None], direction[None], center)))


def _principal_axis(points: Tensor, scores: Tensor) -> tuple[Tensor, Tensor]:
    """Return a point [3] and the direction [3] of the principal axis of points [Q, 3] with nearly the most evidence."""
    solid = points[scores >= SETTINGS.solid * scores.max()]
    center = solid.mean(0)
    arm = (solid - center).double()
    covariance = (arm[:, :, None] * arm[:, None, :]).sum(0)
    direction = torch.from_numpy(np.linalg.eigh(covariance.cpu().numpy())[1][:, -1].copy()).to(solid)
    return center, direction
