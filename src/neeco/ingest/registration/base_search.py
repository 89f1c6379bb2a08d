"""Where a robot's base stands, roughly: of many rotations, those under which one line ending in one tip, fixed to the
instrument, falls on the shafts in the masks.

Given the rotation of world_from_base, everything else follows in closed form: the shaft's direction in the instrument's
frame is what lies in every plane through a camera and its image's line (the smallest eigenvector), the base's place and
the tip in the instrument's frame are linear in the places where lines and tips are seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.ingest.foreground.silhouettes import ShaftLines

LINE_RAD = 0.03  # by which a shaft's direction in a mask is off: jaws open, masks fray
TIP_PX, LINE_PX = 5.0, 2.0  # of masks: the tip's place moves with the jaws
TIP_MM = 60.0  # how far from the tracked frame's origin the tip may be: what is not determined goes there
ACROSS = 5e-4  # of a line's weight: what no motion tells, shafts are seen from the side
ROUNDS = 3  # of robust reweighting
CHUNK = 500  # rotations tried at once
FAR = 1e9


@dataclass(frozen=True, eq=False)
class Seen:
    """What the search looks at: shafts [F] in the masks as rays of the world, and the poses they are of."""

    lines: ShaftLines
    intrinsics: tuple[float, float, float, float]
    camera_from_world: np.ndarray  # [F, 4, 4]
    base_from_instrument: np.ndarray  # [F, 4, 4]


@dataclass(frozen=True, eq=False)
class Candidates:
    """Solutions [B], best first."""

    costs: np.ndarray  # [B] mean robust residual in [0, 1]
    world_from_base: np.ndarray  # [B, 4, 4]
    tips: np.ndarray  # [B, 3] mm, instrument frame
    axes: np.ndarray  # [B, 3] unit, instrument frame, towards the tip

    def take(self, rows: np.ndarray) -> Candidates:
        return Candidates(self.costs[rows], self.world_from_base[rows], self.tips[rows], self.axes[rows])


def uniform_rotations(count: int, generator: np.random.Generator) -> np.ndarray:
    """[count, 3, 3] over all of SO(3)."""
    return Rotation.random(count, random_state=generator).as_matrix()


def rotations_about(center: np.ndarray, sd_rad: float, count: int, generator: np.random.Generator) -> np.ndarray:
    """[count, 3, 3] turned from `center` [3, 3] by normal rotation vectors; the first is itself."""
    vectors = generator.normal(0, sd_rad, (count, 3))
    vectors[0] = 0
    return Rotation.from_rotvec(vectors).as_matrix() @ center


def solve(
    seen: Seen, rotations: np.ndarray, center: np.ndarray | None, sd_mm: float | None, distance: float
) -> Candidates:
    """The best base and instrument for each rotation [B, 3, 3], the cheapest first.

    center: where the prior puts the middle of the recorded positions in the world (None: anywhere), within sd_mm.
    distance mm: to the instrument, about, to weigh pixels.
    """
    parts = [
        _solve(seen, rotations[first : first + CHUNK], center, sd_mm, distance)
        for first in range(0, len(rotations), CHUNK)
    ]
    found = Candidates(*(np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])))
    return found.take(np.argsort(found.costs, kind="stable"))


def search(
    seen: Seen,
    rotations: np.ndarray,
    center: np.ndarray | None,
    sd_mm: float | None,
    distance: float,
    generator: np.random.Generator,
    first_step: float,
    keep: int = 6,
) -> Candidates:
    """The best `keep` places, different from each other, after narrowing down around the best rotations."""
    best = distinct(solve(seen, rotations, center, sd_mm, distance), 40, first_step)
    step = first_step
    while step > 0.004:
        rotations = best.world_from_base[:, :3, :3]
        around = [rotations_about(rotation, step, 12, generator) for rotation in rotations]
        step /= 2
        best = distinct(solve(seen, np.concatenate(around), center, sd_mm, distance), 20, step)
    return distinct(best, keep, 0.05)


def distinct(found: Candidates, count: int, apart_rad: float) -> Candidates:
    """The first `count` of which none is turned less than apart_rad from a better one."""
    rows: list[int] = []
    flat = found.world_from_base[:, :3, :3].reshape(len(found.costs), 9)
    limit = 2 * np.sqrt(2) * np.sin(apart_rad / 2)  # the distance of rotation matrices so far apart
    for row in range(len(flat)):
        if all(np.linalg.norm(flat[row] - flat[other]) >= limit for other in rows):
            rows.append(row)
            if len(rows) == count:
                break
    return found.take(np.array(rows))


def _solve(
    seen: Seen, rotations: np.ndarray, center: np.ndarray | None, sd_mm: float | None, distance: float
) -> Candidates:
    fx, fy, cx, cy = seen.intrinsics
    focal = (fx + fy) / 2
    lines, cameras = seen.lines, np.linalg.inv(seen.camera_from_world)
    places = cameras[:, :3, 3]
    turned = np.einsum("bij,fjk->bfik", rotations, seen.base_from_instrument[:, :3, :3])  # world_from_instrument
    middle = seen.base_from_instrument[:, :3, 3].mean(0)
    moved = np.einsum("bij,fj->bfi", rotations, seen.base_from_instrument[:, :3, 3] - middle)

    def rays(pixels: np.ndarray) -> np.ndarray:
        slopes = np.stack([(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy, np.ones(len(pixels))], -1)
        return np.einsum("fij,fj->fi", cameras[:, :3, :3], slopes)

    has_line, has_tip = np.isfinite(lines.points[:, 0]), np.isfinite(lines.tips[:, 0])
    on_line = np.where(has_line[:, None], lines.points, (cx, cy))
    ahead = np.where(has_line[:, None], lines.directions, (1.0, 0.0))
    tips = np.where(has_tip[:, None], lines.tips, (cx, cy))
    normals = _unit(np.cross(rays(on_line), rays(on_line + 10 * ahead)))  # [F, 3] of planes through line and camera
    tip_rays = rays(tips)
    across = _unit(np.cross(tip_rays, cameras[:, :3, 0]))
    up = _unit(np.cross(tip_rays, across))
    # rows that are 0 where the tip falls on its place, and on its line
    rows = np.stack([across, up, normals], 1)  # [F, 3, 3]
    scale = focal / distance / np.array([TIP_PX, TIP_PX, LINE_PX])
    given = np.stack([has_tip, has_tip, has_line], -1)

    count = len(rotations)
    along = np.einsum("fi,bfij->bfj", normals, turned)  # [B, F, 3]
    views = np.einsum("fi,bfij->bfj", _unit(rays(on_line)), turned)
    sideways = ACROSS * np.einsum("bfi,bfj->bij", views, views)
    weight = np.broadcast_to(has_line, (count, len(has_line))).astype(float)
    weights = np.broadcast_to(given, (count, *given.shape)).astype(float)
    linear = np.concatenate(
        [np.broadcast_to(rows, (count, *rows.shape)), np.einsum("fri,bfij->bfrj", rows, turned)], -1
    )
    linear = linear * scale[:, None]  # [B, F, 3, 6]: of the shift of the middle, and the tip
    wanted = np.einsum("fri,bfi->bfr", rows, places - moved) * scale
    prior = np.diag([0.0] * 3 + [TIP_MM**-2.0] * 3)
    target = np.zeros(6)
    if center is not None and sd_mm is not None:
        prior[:3, :3] = np.eye(3) / sd_mm**2
        target[:3] = prior[:3, :3] @ center
    for _ in range(ROUNDS):
        moments = np.einsum("bf,bfi,bfj->bij", weight, along, along) + sideways
        axes = np.linalg.eigh(moments)[1][:, :, 0]
        line_off = np.einsum("bfj,bj->bf", along, axes) / LINE_RAD
        weight = has_line / (1 + line_off**2)
        matrix = np.einsum("bfr,bfri,bfrj->bij", weights, linear, linear) + prior
        solution = np.linalg.solve(matrix, (np.einsum("bfr,bfri,bfr->bi", weights, linear, wanted) + target)[..., None])
        solution = solution[..., 0]
        off = np.einsum("bfri,bi->bfr", linear, solution) - wanted
        shift, tip = solution[:, :3], solution[:, 3:]
        at = np.einsum("bfij,bj->bfi", turned, tip) + moved + shift[:, None]  # the tip in the world
        depth = np.einsum("bfi,fi->bf", at - places, cameras[:, :3, 2])
        off = off * (distance / np.maximum(depth, 0.1 * distance))[..., None]  # as pixels
        weights = given / (1 + off**2)
    costs = _mean(line_off**2 / (1 + line_off**2), has_line) + _mean(off**2 / (1 + off**2), given)
    if center is not None and sd_mm is not None:
        costs = costs + 0.02 * np.square((shift - center) / sd_mm).sum(-1)
    costs = np.where((depth > 0).mean(1) > 0.9, costs, FAR)
    axes = axes * _towards_tip(seen, at, turned, axes, ahead, has_line, distance)[:, None]
    transform = np.tile(np.eye(4), (count, 1, 1))
    transform[:, :3, :3] = rotations
    transform[:, :3, 3] = shift - rotations @ middle
    return Candidates(costs, transform, tip, axes)


def _towards_tip(
    seen: Seen,
    at: np.ndarray,
    turned: np.ndarray,
    axes: np.ndarray,
    ahead: np.ndarray,
    has_line: np.ndarray,
    distance: float,
) -> np.ndarray:
    """[B] 1 or -1: which way along the axes leads to the tip in most images."""
    cameras = seen.camera_from_world
    behind = at - 0.1 * distance * np.einsum("bfij,bj->bfi", turned, axes)
    pixels = []
    for points in (at, behind):
        local = np.einsum("fij,bfj->bfi", cameras[:, :3, :3], points) + cameras[:, :3, 3]
        pixels.append(local[..., :2] / np.maximum(local[..., 2:], 1e-3))
    agreement = np.einsum("bfi,fi->bf", pixels[0] - pixels[1], ahead) * has_line
    return np.where(np.sign(agreement).sum(1) >= 0, 1.0, -1.0)


def _mean(values: np.ndarray, given: np.ndarray) -> np.ndarray:
    """[B] means over all that is given."""
    values = (values * given).reshape(len(values), -1)
    return np.asarray(values.sum(1) / max(int(given.sum()), 1))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
