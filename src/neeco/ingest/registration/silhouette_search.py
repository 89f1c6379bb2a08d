"""Rough base registration: of many rotations, those under which one line that ends in one tip, fixed to the instrument,
projects onto the shafts in the masks.

Given the rotation of world_from_base, the rest follows in closed form. The shaft's direction in the instrument's frame
lies in every plane through a camera and its image's line (the smallest eigenvector). The base's position and the tip
are linear in the places of lines and tips.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.geometry.lines import unit
from neeco.ingest.foreground.silhouettes import ShaftLines
from neeco.ingest.registration.articulated_fit import ArticulatedProblem
from neeco.ingest.registration.base import MIDDLE


@dataclass(frozen=True, kw_only=True)
class SilhouetteSearchSettings:
    """Settings of the search."""

    n_rotations: int = 500  # number of rotations tried about a rough base
    n_uniform: int = 4000  # number of rotations tried without one
    max_start_cost: float = 2.0  # maximum cost of a start: robust losses below 1 each, and the prior's
    typical_radius_mm: float = 3.5  # typical radius of a shaft
    line_sd_rad: float = 0.03  # standard deviation of a shaft's direction in a mask: jaws open, masks fray
    tip_sd_px: float = 5.0  # standard deviation of the tip, px of masks: it moves with the jaws
    line_sd_px: float = 2.0  # standard deviation of the distance of the tip from the line, px of masks
    tip_sd_mm: float = 60.0  # prior distance of the tip from the tracked frame's origin
    stated_tip_sd_mm: float = 5.0  # prior distance of the tip from where links state it
    sideways_weight: float = 5e-4  # of a line's weight: where motion leaves it open, shafts are viewed from the side
    n_rounds: int = 3  # rounds of robust reweighting
    chunk: int = 500  # number of rotations tried at once
    min_step_rad: float = 0.004  # minimum step to which rotations are narrowed down
    n_first: int = 40  # number of candidates kept at first
    n_next: int = 20  # number of candidates kept in later rounds
    n_around: int = 12  # number of rotations tried about each candidate
    n_best: int = 6  # number of results
    distinct_rad: float = 0.05  # minimum turn between results
    prior_weight: float = 0.02  # cost of a base one standard deviation off, share of the mean residual
    far_cost: float = 1e9  # cost of a base behind the cameras


COARSE = SilhouetteSearchSettings()


@dataclass(frozen=True, eq=False, kw_only=True)
class ShaftViews:
    """Shafts [F] in masks, the poses they are of, and where the base may be: `center` [3] mm is the prior mean of the
    instrument's mean position in the world, sd_mm its standard deviation; distance mm: approximate depth of the
    instrument; axis [3], end [3] and tips [F, 3] mm: the shaft's direction, its end, and the tip's places in the
    instrument's frame, as stated links have them; None where they are to be found, and the tip is on the shaft's
    line."""

    lines: ShaftLines
    intrinsics: tuple[float, float, float, float]
    camera_from_world: np.ndarray  # [F, 4, 4]
    base_from_instrument: np.ndarray  # [F, 4, 4]
    center: np.ndarray
    sd_mm: float
    distance: float
    axis: np.ndarray | None = None
    end: np.ndarray | None = None
    tips: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Candidates:
    """Solutions [B], best first."""

    costs: np.ndarray  # [B] mean robust residual in [0, 1]
    world_from_base: np.ndarray  # [B, 4, 4]
    tips: np.ndarray  # [B, 3] mm, instrument frame; relative to those stated
    axes: np.ndarray  # [B, 3] unit, instrument frame, towards the tip

    def distinct(self, count: int, apart_rad: float) -> Candidates:
        """The first `count` of which none is turned less than apart_rad from a better one."""
        rows: list[int] = []
        flat = self.world_from_base[:, :3, :3].reshape(len(self.costs), 9)
        limit = 2 * np.sqrt(2) * np.sin(apart_rad / 2)  # the distance of rotation matrices so far apart
        for row in range(len(flat)):
            if all(np.linalg.norm(flat[row] - flat[other]) >= limit for other in rows):
                rows.append(row)
                if len(rows) == count:
                    break
        return self.take(np.array(rows, int))

    def take(self, rows: np.ndarray) -> Candidates:
        """Those of some rows."""
        return Candidates(*(values[rows] for values in vars(self).values()))


def rotations_about(center: np.ndarray, sd_rad: float, count: int, generator: np.random.Generator) -> np.ndarray:
    """Rotations [count, 3, 3] turned from `center` [3, 3] by normal rotation vectors; the first is itself."""
    vectors = generator.normal(0, sd_rad, (count, 3))
    vectors[0] = 0
    return Rotation.from_rotvec(vectors).as_matrix() @ center


def search_bases(
    problem: ArticulatedProblem,
    generator: np.random.Generator,
    lines: ShaftLines | None = None,
    **stated: np.ndarray,
) -> Candidates:
    """The best bases by lines (the masks' shafts where None) and tips of the masks; stated: what links say of the shaft
    (see `ShaftViews`)."""
    prior = problem.prior
    base = problem.prior.world_from_base
    cameras = np.linalg.inv(problem.camera_from_world)
    half = float(np.median([mask.max() for mask in problem.silhouettes.distances]))
    distance = guess = COARSE.typical_radius_mm * problem.silhouettes.intrinsics[0] / max(half, 0.5)
    if prior.sd_rad is None or prior.sd_mm is None:
        rotations = Rotation.random(COARSE.n_uniform, random_state=generator).as_matrix()
        # the instrument is where most of the cameras look
        center = (cameras[:, :3, 3] + guess * cameras[:, :3, 2]).mean(0)
        sd_mm = guess
        step = 0.2
    else:
        rotations = rotations_about(base[:3, :3], prior.sd_rad, COARSE.n_rotations, generator)
        center, sd_mm, step = problem.pivot(base), prior.sd_mm, 0.5 * prior.sd_rad
        depth = float(np.median(problem.camera_from_world[:, 2, :3] @ center + problem.camera_from_world[:, 2, 3]))
        distance = depth if depth > 0.2 * guess else guess
    views = ShaftViews(
        lines=problem.silhouettes.shafts if lines is None else lines,
        intrinsics=problem.silhouettes.intrinsics,
        camera_from_world=problem.camera_from_world,
        base_from_instrument=problem.poses[MIDDLE],
        center=center,
        sd_mm=sd_mm,
        distance=distance,
        **stated,
    )
    candidates = search(views, rotations, generator, step)
    return candidates.take(np.flatnonzero(candidates.costs < COARSE.max_start_cost))


def search(views: ShaftViews, rotations: np.ndarray, generator: np.random.Generator, first_step: float) -> Candidates:
    """The best bases, different from each other, after narrowing down around the best rotations [B, 3, 3]; first_step
    rad: between these."""
    best = _solve_all(views, rotations).distinct(COARSE.n_first, first_step)
    step = first_step
    while step > COARSE.min_step_rad:
        around = [rotations_about(base[:3, :3], step, COARSE.n_around, generator) for base in best.world_from_base]
        step /= 2
        best = _solve_all(views, np.concatenate(around)).distinct(COARSE.n_next, step)
    return best.distinct(COARSE.n_best, COARSE.distinct_rad)


def _solve_all(views: ShaftViews, rotations: np.ndarray) -> Candidates:
    """The best base and instrument for each rotation, the cheapest first."""
    parts = [_solve(views, rotations[first : first + COARSE.chunk]) for first in range(0, len(rotations), COARSE.chunk)]
    columns = [np.concatenate(values) for values in zip(*(vars(part).values() for part in parts), strict=True)]
    order = np.argsort(columns[0], kind="stable")
    return Candidates(*(values[order] for values in columns))


def _solve(views: ShaftViews, rotations: np.ndarray) -> Candidates:
    fx, fy, cx, cy = views.intrinsics
    lines, distance, cameras = views.lines, views.distance, np.linalg.inv(views.camera_from_world)
    places = cameras[:, :3, 3]
    turned = np.einsum("bij,fjk->bfik", rotations, views.base_from_instrument[:, :3, :3])  # world_from_instrument
    middle = views.base_from_instrument[:, :3, 3].mean(0)
    ends = moved = np.einsum("bij,fj->bfi", rotations, views.base_from_instrument[:, :3, 3] - middle)
    if views.tips is not None:
        moved = moved + np.einsum("bfij,fj->bfi", turned, views.tips)
    if views.end is not None:
        ends = ends + np.einsum("bfij,j->bfi", turned, views.end)

    def rays(pixels: np.ndarray) -> np.ndarray:
        slopes = np.stack([(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy, np.ones(len(pixels))], -1)
        return np.einsum("fij,fj->fi", cameras[:, :3, :3], slopes)

    has_line, has_tip = np.isfinite(lines.points[:, 0]), np.isfinite(lines.tips[:, 0])
    on_line = np.where(has_line[:, None], lines.points, (cx, cy))
    ahead = np.where(has_line[:, None], lines.directions, (1.0, 0.0))
    normals = unit(np.cross(rays(on_line), rays(on_line + 10 * ahead)))  # [F, 3] of planes through line and camera
    tip_rays = rays(np.where(has_tip[:, None], lines.tips, (cx, cy)))
    across = unit(np.cross(tip_rays, cameras[:, :3, 0]))
    # equations [F, 3, 3] that are 0 where the tip projects onto its place, and onto its line
    rows = np.stack([across, unit(np.cross(tip_rays, across)), normals], 1)
    scale = (fx + fy) / 2 / distance / np.array([COARSE.tip_sd_px, COARSE.tip_sd_px, COARSE.line_sd_px])
    observed = np.stack([has_tip, has_tip, has_line], -1)

    count = len(rotations)
    along = np.einsum("fi,bfij->bfj", normals, turned)  # [B, F, 3]
    towards = np.einsum("fi,bfij->bfj", unit(rays(on_line)), turned)
    sideways = COARSE.sideways_weight * np.einsum("bfi,bfj->bij", towards, towards)
    weight = np.broadcast_to(has_line, (count, len(has_line))).astype(float)
    weights = np.broadcast_to(observed, (count, *observed.shape)).astype(float)
    on_tip = np.einsum("fri,bfij->bfrj", rows, turned)
    if views.end is not None:
        on_tip[:, :, 2] = 0.0
    # [B, F, 3, 6]: derivatives by the shift of the middle, and the tip
    linear = np.concatenate([np.broadcast_to(rows, on_tip.shape), on_tip], -1) * scale[:, None]
    wanted = np.einsum("fri,bfi->bfr", rows, places - moved)
    if views.end is not None:
        wanted[:, :, 2] = np.einsum("fi,bfi->bf", normals, places - ends)
    wanted = wanted * scale
    tip_sd = COARSE.tip_sd_mm if views.tips is None else COARSE.stated_tip_sd_mm
    prior = np.diag([views.sd_mm**-2.0] * 3 + [tip_sd**-2.0] * 3)
    target = np.append(prior[:3, :3] @ views.center, np.zeros(3))
    for _ in range(COARSE.n_rounds):
        moments = np.einsum("bf,bfi,bfj->bij", weight, along, along) + sideways
        axes = np.linalg.eigh(moments)[1][:, :, 0] if views.axis is None else np.tile(views.axis, (count, 1))
        line_off = np.einsum("bfj,bj->bf", along, axes) / COARSE.line_sd_rad
        weight = has_line / (1 + line_off**2)
        matrix = np.einsum("bfr,bfri,bfrj->bij", weights, linear, linear) + prior
        right = np.einsum("bfr,bfri,bfr->bi", weights, linear, wanted) + target
        solution = np.linalg.solve(matrix, right[..., None])[..., 0]
        off = np.einsum("bfri,bi->bfr", linear, solution) - wanted
        shift, tip = solution[:, :3], solution[:, 3:]
        at = np.einsum("bfij,bj->bfi", turned, tip) + moved + shift[:, None]  # the tip in the world
        depth = np.einsum("bfi,fi->bf", at - places, cameras[:, :3, 2])
        off = off * (distance / np.maximum(depth, 0.1 * distance))[..., None]  # as pixels
        weights = observed / (1 + off**2)
    costs = _mean(line_off**2 / (1 + line_off**2), has_line) + _mean(off**2 / (1 + off**2), observed)
    costs = costs + COARSE.prior_weight * np.square((shift - views.center) / views.sd_mm).sum(-1)
    costs = np.where((depth > 0).mean(1) > 0.9, costs, COARSE.far_cost)
    # of the axis' two directions, the one that leads to the tip in most images
    behind = at - 0.1 * distance * np.einsum("bfij,bj->bfi", turned, axes)
    ends = [np.einsum("fij,bfj->bfi", cameras[:, :3, :3].transpose(0, 2, 1), end - places) for end in (at, behind)]
    pixels = [end[..., :2] / np.maximum(end[..., 2:], 1e-3) for end in ends]
    agreement = np.sign(np.einsum("bfi,fi->bf", pixels[0] - pixels[1], ahead) * has_line).sum(1)
    if views.axis is None:
        axes = axes * np.where(agreement >= 0, 1.0, -1.0)[:, None]
    else:
        costs = np.where(agreement >= 0, costs, COARSE.far_cost)
    bases = np.tile(np.eye(4), (count, 1, 1))
    bases[:, :3, :3] = rotations
    bases[:, :3, 3] = shift - rotations @ middle
    return Candidates(costs, bases, tip, axes)


def _mean(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Means [B] over all that is valid."""
    values = (values * valid).reshape(len(values), -1)
    return np.asarray(values.sum(1) / max(int(valid.sum()), 1))
