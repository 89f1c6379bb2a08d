"""Search for an instrument's shaft: the half-infinite cylinder whose silhouettes explain the evidence of all frames.

Points on evidence in every frame fill the visual hull, which extends far from an instrument that hardly rotates, along
the lines of sight. Silhouettes of cylinders resolve this. The line through a pair of such points is a candidate: it
gains the evidence that its silhouettes cover, loses what they cover without evidence, and ends where the gain is
largest. Gains with poses exchanged among the frames do not move with the instrument, and are subtracted. The best
candidates are refined by random steps.

A shaft pivots at its trocar, so it moves less there than where it is visible. Such a line gains more, and its trocar is
behind the tip. Without a pivot, its direction follows from the rear end leaving the image.

If no cylinder explains much of the evidence (other instruments contribute to it), or if a wrist bends the shaft in the
tracked frame of its tip, the line is the principal axis of these points.
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

    n_points: int = 600  # points with most evidence, which define candidate lines
    least_evidence: float = 0.4  # minimum mean evidence of these points
    n_frames: int = 16  # compared frames, evenly spaced
    widths_px: tuple[int, int] = (32, 64)  # width of the evidence images: for all candidates, and for the best
    n_pairs: int = 2400  # number of point pairs (candidates)
    least_apart: float = 0.12  # minimum distance of the points of a pair
    threshold: float = 0.45  # evidence from which a covered pixel is a gain
    always: float = 0.95  # share of frames with evidence above which a pixel is unexplained background
    radii: tuple[float, float, int] = (0.012, 0.055, 7)  # minimum, maximum, number (geometric)
    half_length: float = 1.5  # length of the line on either side of its origin
    n_bins: int = 96  # number of positions along it
    n_likely: int = 96  # candidates also scored with exchanged poses
    n_best: int = 12  # candidates that are refined
    least_share: float = 0.14  # minimum share of the evidence gained; shafts gained at least 0.16, bent ones 0.12
    solid: float = 0.9  # share of the maximum evidence, above which a point counts in the principal axis
    n_rounds: int = 4  # rounds of random steps, halving their size
    n_steps: int = 24  # steps per round and candidate
    shift: float = 0.02  # standard deviation of the first steps
    turn: float = 0.08  # rad, the same for directions
    trocar_weight: float = 0.4  # relative bonus for a line that rests at a trocar
    least_rest: float = 0.2  # minimum reduction of motion at a trocar, for it to determine the rear end
    trocar: tuple[float, float, int] = (0.4, 2.6, 12)  # distance from the evidence's centre: minimum, maximum, number


SETTINGS = ShaftSettings()


@dataclass(frozen=True, eq=False)
class Shaft:
    """A line in an instrument's frame: a point [3] mm, a unit direction [3], and the radius, mm (None: unknown).
    `lead`: relative advantage of the tip in that direction over the opposite one. `rest`: relative reduction of motion
    at a trocar behind compared with the visible part; negative: ahead."""

    origin: Tensor
    direction: Tensor
    radius: float | None
    lead: float
    rest: float


def reduced_evidence(hits: Tensor, sizes: Tensor, intrinsics: Tensor, width: int) -> tuple[Tensor, Tensor]:
    """Reduce evidence [F, H, W] in [0, 1] of images of `sizes` [F, 2] px to about `width` pixels: rays and worth of
    `CylinderViews`."""
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
    return normalize(rays.reshape(count, -1, 3), dim=-1), worth.reshape(count, -1)


@dataclass(frozen=True, eq=False)
class CylinderViews:
    """Evidence of F frames for cylinders: unit rays [F, P, 3] of the cameras, the gain of each pixel [F, P],
    camera_from_instrument [F, 4, 4] as recorded and with exchanged poses, and world_from_instrument [F, 4, 4].
    `distance`: mm, the unit of settings that are shares."""

    rays: Tensor
    worth: Tensor
    own: Tensor
    exchanged: Tensor
    world: Tensor
    distance: float

    def gains(
        self, transforms: Tensor, origins: Tensor, directions: Tensor, chunk: int = 64
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the gains of lines through origins [C, 3] along unit directions [C, 3] under camera_from_instrument
        [F, 4, 4] with the best radius and tip [C], their relative advantage over the opposite direction [C], and the
        radius [C], mm."""
        parts = [
            self._gains(transforms, *lines) for lines in zip(origins.split(chunk), directions.split(chunk), strict=True)
        ]
        gains, leads, radii = (torch.cat(values) for values in zip(*parts, strict=True))
        return gains, leads, radii

    def rests(self, origins: Tensor, directions: Tensor, center: Tensor) -> Tensor:
        """Return the relative reduction of lines' motion somewhere behind compared with that at `center` [3], negative
        if ahead [C]. Motion of a point is the median distance over frames from its mean position in the world."""
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
        # distance from ray to line and position along the line, by the common perpendicular
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
        """Return the products [C, F, P] of vectors [C, F, 3] and the rays; without matrix multiplication, whose last
        bits may depend on memory alignment."""
        x, y, z = (
            ray * vector[..., None] for ray, vector in zip(self.rays.unbind(-1), vectors.unbind(-1), strict=True)
        )
        return x + y + z


def find_shaft(
    coarse: CylinderViews, fine: CylinderViews, points: Tensor, scores: Tensor, generator: torch.Generator
) -> Shaft | None:
    """Return the shaft of an instrument from points [Q, 3] mm on evidence, instrument frame, and their mean evidence
    [Q]; None if no two are apart. coarse, fine: the evidence for all candidates, and for the best of them."""
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
        noise[:: settings.n_steps] = 0  # the unchanged candidate
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
