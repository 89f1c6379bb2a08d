"""Registration of an instrument with stated links: a constant correction of its poses, fitted to the evidence before
any Gaussian exists.

Gradients through rendering hardly move an instrument that is off by a shaft's radius or more along its shaft: Gaussians
form where the evidence is, whatever link they belong to. The silhouette of capsules along the links, driven by the
readings, bends where the joints are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d

from neeco.capture.model import BaseUncertainty, evenly_spaced
from neeco.evidence.carving import CarvedShape, Evidence, camera_from_instrument
from neeco.geometry.least_squares import Linearisation, levenberg_marquardt
from neeco.geometry.projection import project
from neeco.geometry.rotations import rigid_from_vector, rotation_from_vector, skew
from neeco.methods.kinematic.articulation import SETTINGS, Articulation
from neeco.states.outline_fit import OUTLINES


@dataclass(frozen=True, kw_only=True)
class LinkRegistrationSettings:
    """Priors and settings of the registration."""

    max_frames: int = 30  # frames compared, at most
    widths: tuple[int, int] = (20, 40)  # width of the compared images in cells, coarse to fine
    max_steps: tuple[int, int] = (8, 4)  # Levenberg-Marquardt steps at each width
    cells_per_observation: float = 10.0  # cells of the fine images per independent observation (errors are correlated)
    evidence_sd: float = 0.3  # of a cell; the cost is linear beyond (Huber)
    # of a residual; less where most frames have evidence, since the tissue's fit absorbed the instrument
    min_weight: float = 0.1
    edge_cells: float = 0.6  # width of a silhouette's soft edge
    shaft_length_mm: float = 150.0  # length of shaft that is compared, from its distal end
    nearest_mm: float = 5.0  # minimum depth of compared geometry
    # rad, mm: standard deviations of the frame's error about and along the shaft
    frame_sd: tuple[float, float] = (0.035, 2.0)
    # of the shape: tilts (rad) and shifts (mm) of the carved shaft, log radii, heading (rad) and log length of end
    # links
    shaft_sd: tuple[float, float, float, float] = (0.1, 0.1, 2.0, 2.0)
    log_radius_sd: float = 0.4
    end_sd: tuple[float, float] = (0.15, 0.4)
    link_radius: float = 0.8  # radius of links between joints, in carved radii
    end_radius: float = 0.4  # radius of end links, in carved radii
    end_length: float = 3.0  # length of end links, in carved radii
    step: float = 0.05  # finite-difference step, in standard deviations
    model_error: float = 2.0  # factor on standard deviations: model errors are common to all frames
    min_gain: float = 10.0  # minimum gain in -log likelihood for a correction
    # minimum shift of the links along the shaft; training finds smaller errors by itself
    min_along_mm: float = 3.0


CAPSULES = LinkRegistrationSettings()

# nested models, each with the parameters of the one before: shape alone (links as stated); links; all
MODELS = (("shaft", "radii", "ends"), ("turns", "shifts", "offsets"), ("base", "frame"))


@dataclass(frozen=True, eq=False, kw_only=True)
class LinkRegistration:
    """A correction of an instrument's poses, and of its links in the tracked frame."""

    base: Tensor  # [6] rotation vector (rad) about `center`, translation (mm), world frame; zero: links suffice
    center: Tensor  # [3] mm, world frame
    pivots: Tensor  # [J, 3] mm, of the joints at rest, tracked frame
    axes: Tensor  # [J, 3] unit
    offsets: Tensor  # [R] rad or mm, of the readings
    needed: bool  # whether the evidence is explained significantly better and the correction is not negligible
    cost: float  # -log likelihood plus prior, of the most general model
    along_mm: float  # shift of the first pivot along the shaft, mean over the frames
    along_sd_mm: float


@torch.no_grad()
def register_links(
    links: Articulation,
    evidence: Evidence,
    name: str,
    shape: CarvedShape,
    readings: list[dict[str, float]],
    *,
    stated: BaseUncertainty | None = None,
) -> LinkRegistration | None:
    """Return the correction of instrument `name` for which its links explain the evidence best; None without two
    consecutive joints. `readings`: of every frame of the evidence; `stated`: the uncertainty of the base.
    """
    line = links.rest_line()
    if line is None:
        return None
    problem = SilhouetteProblem(links, evidence, name, shape, line, readings)
    if stated is not None:
        arm = problem.center.double().cpu() - torch.tensor(stated.center, dtype=torch.float64)
        to_center = torch.eye(6, dtype=torch.float64)  # a turn about another point shifts this one
        to_center[3:, :3] = -skew(arm)
        covariance = to_center @ torch.tensor(stated.covariance, dtype=torch.float64) @ to_center.T
        problem.base_root = torch.linalg.cholesky(covariance).to(problem.center)
        problem.layout["base"] = torch.ones_like(problem.layout["base"])
    fits: list[tuple[tuple[str, ...], np.ndarray, Linearisation[np.ndarray]]] = []
    names: list[str] = []
    for more in MODELS:
        names += more
        problem.fit_only(names)
        solved = problem.minimised()
        fits.append((tuple(names), solved, problem.linearise(solved)))
    costs = [fitted.value for _, _, fitted in fits]
    chosen = next(k for k in range(len(fits)) if costs[k] - min(costs[k:]) < CAPSULES.min_gain)
    fitted_names, solved, fitted = fits[chosen]
    problem.fit_only(fitted_names)
    parts, along = problem.parts(solved), problem.along_shaft(solved)
    slope = (
        np.array([problem.along_shaft(solved + step) - along for step in CAPSULES.step * np.eye(problem.size)])
        / CAPSULES.step
    )
    pivots, axes = problem.corrected_axes(parts)
    return LinkRegistration(
        base=parts["base"],
        center=problem.center,
        pivots=pivots,
        axes=axes,
        offsets=parts["offsets"],
        needed=chosen == len(MODELS) - 1 or (chosen > 0 and abs(along) > CAPSULES.min_along_mm),
        cost=costs[-1],
        along_mm=along,
        along_sd_mm=CAPSULES.model_error
        * float(np.sqrt(slope @ np.linalg.solve(np.asarray(fitted.information), slope))),
    )


class SilhouetteProblem:
    """Silhouettes of capsules along an instrument's links, against the evidence of F frames.

    `layout` has the standard deviations of all parameters, in which vectors of those that are fitted are counted."""

    layout: dict[str, Tensor]
    # [6, 6] root of the stated covariance of the turn (rad) about `center` and shift (mm), in which `base` is counted
    base_root: Tensor | None = None

    def __init__(
        self,
        links: Articulation,
        evidence: Evidence,
        name: str,
        shape: CarvedShape,
        line: tuple[Tensor, Tensor],
        readings: Sequence[Mapping[str, float]],
    ) -> None:
        chosen = evenly_spaced(len(evidence.frames), CAPSULES.max_frames)
        self.links, self.shape = links, shape
        self.evidence = evidence.subset(torch.tensor(chosen))
        self.pivot, self.axis = line[0], nn.functional.normalize(line[1], dim=0)
        self.readings = torch.tensor([[readings[i][r] for r in links.reading_names] for i in chosen]).to(self.axis)
        to_camera = self.evidence.camera_from_world
        self.poses = torch.linalg.solve(to_camera, camera_from_instrument(self.evidence, name))
        self.center = self.poses[:, :3, 3].mean(0)
        joints = range(len(links.points))
        # of every link except the shaft: the joint that carries it, and the joints that it carries
        self.own = [links.joint_of(link) for link in range(1, links.link_count)]
        carriers = [links.link_of(group[0].parent) for group in links.joint_groups]
        self.carried = [[j for j in joints if carriers[j] == k] for k in range(1, links.link_count)]
        spreads = {
            "base": [OUTLINES.base_sd_rad] * 3 + [OUTLINES.base_sd_mm] * 3,
            "frame": CAPSULES.frame_sd,
            "turns": [SETTINGS.axis_sd] * 3 * len(joints),
            "shifts": [SETTINGS.pivot_sd] * 3 * len(joints),
            "offsets": [sd * float(seen) for sd, seen in zip(links.offset_sds, links.observable, strict=True)],
            "shaft": CAPSULES.shaft_sd,
            "radii": [CAPSULES.log_radius_sd] * links.link_count,
            "ends": [*CAPSULES.end_sd] * sum(not carried for carried in self.carried),
        }
        self.layout = {key: torch.tensor(spread).to(self.axis) for key, spread in spreads.items()}

    def fit_only(self, names: Sequence[str]) -> None:
        """Fit only the parameters of these names; others, and those without a standard deviation, stay 0."""
        spread = torch.cat([spread * float(key in names) for key, spread in self.layout.items()])
        self.columns = torch.nonzero(spread)[:, 0]
        self.spread, self.size = spread, len(self.columns)

    def parts(self, at: np.ndarray) -> dict[str, Tensor]:
        """Return the parameters by name, in their own units."""
        full = torch.zeros_like(self.spread)
        full[self.columns] = torch.from_numpy(at).to(full) * self.spread[self.columns]
        parts = dict(zip(self.layout, full.split([len(spread) for spread in self.layout.values()]), strict=True))
        return parts if self.base_root is None else parts | {"base": self.base_root @ parts["base"]}

    def compare_at(self, width: int) -> None:
        """Compare images about `width` cells wide from now on."""
        evidence = self.evidence
        hits = evidence.hits if evidence.unshaded is None else evidence.unshaded
        self.cell_px = max(1, round(hits.shape[2] / width))
        self.target = avg_pool2d(hits[:, None], self.cell_px)[:, 0]
        rows, columns = (torch.arange(size, device=hits.device) + 0.5 for size in self.target.shape[1:])
        y, x = torch.meshgrid(rows, columns, indexing="ij")
        self.cells = torch.stack([x, y], -1).view(-1, 2) * self.cell_px  # [C, 2] px
        correlated = CAPSULES.cells_per_observation * (width / CAPSULES.widths[-1]) ** 2
        usual = (1 - self.target.mean(0)).clamp_min(CAPSULES.min_weight)
        self.weight = usual / (CAPSULES.evidence_sd * correlated**0.5)

    def minimised(self, *, coarse: bool = False) -> np.ndarray:
        """Return the minimiser of the cost, in standard deviations of the fitted parameters. Images of the last width
        are compared from then on; coarse: of the first width only."""
        solved = np.zeros(self.size)
        for width, steps in list(zip(CAPSULES.widths, CAPSULES.max_steps, strict=True))[: 1 if coarse else None]:
            self.compare_at(width)
            solved = levenberg_marquardt(solved, self.linearise, np.add, max_steps=steps, damping=1e-3, tolerance=1e-3)
        return solved

    def linearise(self, at: np.ndarray) -> Linearisation[np.ndarray]:
        residual = self._residual(at)
        steps = CAPSULES.step * np.eye(self.size)
        slopes = torch.stack([(self._residual(at + step) - residual) / CAPSULES.step for step in steps], 1)
        robust = self._limit / residual.abs().clamp_min(1e-9)
        weighed = slopes * robust.clamp_max(1.0)[:, None]
        return Linearisation(
            (weighed.T @ slopes).double().cpu().numpy() + np.eye(self.size),
            (weighed.T @ residual).double().cpu().numpy() + at,
            self.cost(at, residual),
            self.cost,
        )

    def cost(self, at: np.ndarray, residual: Tensor | None = None) -> float:
        """Return -log likelihood plus prior; `residual`: that of `at`, if already computed."""
        size = (self._residual(at) if residual is None else residual).abs()
        huber = torch.where(size < self._limit, 0.5 * size.square(), self._limit * (size - 0.5 * self._limit))
        return float(huber.sum(dtype=torch.float64)) + 0.5 * float(at @ at)

    @property
    def _limit(self) -> Tensor:
        """Return the residuals [F * C] beyond which the cost is linear."""
        return (CAPSULES.evidence_sd * self.weight).flatten().repeat(len(self.target))

    def _residual(self, at: np.ndarray) -> Tensor:
        """Return weighted differences [F * C] of silhouette and evidence."""
        inside = self._inside_px(*self._capsules(self.parts(at)))
        silhouette = torch.sigmoid(inside / (CAPSULES.edge_cells * self.cell_px))
        return ((silhouette - self.target.flatten(1)) * self.weight.flatten()).flatten()

    def corrected_axes(self, parts: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return (pivots [J, 3] mm, axes [J, 3]) of the joints at rest, with both corrections."""
        turn, shift = rotation_from_vector(self.axis * parts["frame"][0]), self.axis * parts["frame"][1]
        pivots, axes = self.links.axes()
        pivots = pivots + parts["shifts"].view(-1, 3)
        axes = nn.functional.normalize(axes + torch.linalg.cross(parts["turns"].view(-1, 3), axes), dim=1)
        return (pivots - self.pivot) @ turn.T + self.pivot + shift, axes @ turn.T

    def _corrected(self, parts: dict[str, Tensor]) -> Tensor:
        """Return the poses [F, 4, 4] with the base's correction."""
        correction, poses = rigid_from_vector(parts["base"]), self.poses.clone()
        poses[:, :3, :3] = correction[:3, :3] @ self.poses[:, :3, :3]
        poses[:, :3, 3] = (self.poses[:, :3, 3] - self.center) @ correction[:3, :3].T + self.center + correction[:3, 3]
        return poses

    def along_shaft(self, at: np.ndarray) -> float:
        """Return the shift, mm, of the first pivot along the shaft by the correction, mean over the frames."""
        parts, zero = self.parts(at), self.parts(np.zeros(self.size))
        moved, still = self._corrected(parts), self._corrected(zero)
        shift = moved[:, :3, :3] @ self.corrected_axes(parts)[0][-1] + moved[:, :3, 3] - still[:, :3, 3]
        shift = shift - still[:, :3, :3] @ self.corrected_axes(zero)[0][-1]
        return float((shift * (still[:, :3, :3] @ self.axis)).sum(1).mean())

    def _capsules(self, parts: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return the ends [F, S, 2, 3] mm of the links' capsules in the cameras' frames, and their radii [S] mm."""
        links, shape, ends = self.links, self.shape, parts["ends"].view(-1, 2)
        pivots, axes = self.corrected_axes(parts)
        tilts, shifts = parts["shaft"].split(2)
        base = shape.instrument_from_shaft.to(axes)
        shaft = nn.functional.normalize(base[:3, :3] @ torch.cat([tilts, tilts.new_ones(1)]), dim=0)
        origin = base[:3, :3] @ torch.cat([shifts, shifts.new_zeros(1)]) + base[:3, 3]
        front = origin + ((pivots[-1] - origin) @ shaft) * shaft
        segments = [(0, torch.stack([front - CAPSULES.shaft_length_mm * shaft, front]), 1.0)]
        for link, (hinge, carried) in enumerate(zip(self.own, self.carried, strict=True), 1):
            segments += [(link, pivots[[hinge, joint]], CAPSULES.link_radius) for joint in carried]
            if carried:
                continue
            (heading, length), ends = ends[0], ends[1:]
            ahead = self.axis - (self.axis @ axes[hinge]) * axes[hinge]
            ahead = nn.functional.normalize(ahead, dim=0)
            ahead = heading.cos() * ahead + heading.sin() * torch.linalg.cross(axes[hinge], ahead)
            tip = pivots[hinge] + CAPSULES.end_length * shape.radius * length.exp() * ahead
            segments.append((link, torch.stack([pivots[hinge], tip]), CAPSULES.end_radius))
        to_camera = self.evidence.camera_from_world @ self._corrected(parts)
        values = links.constants + torch.einsum("jlr,fr->fjl", links.gains, self.readings - parts["offsets"])
        placed = []
        for link, points, _ in segments:
            moved = points.expand(len(values), -1, -1)
            for joint in range(len(pivots)) if link else ():
                amount = values[:, joint, link - 1]
                if links.slides[joint]:
                    moved = moved + amount[:, None, None] * axes[joint]
                else:
                    turns = rotation_from_vector(amount[:, None] * axes[joint])
                    moved = (moved - pivots[joint]) @ turns.transpose(1, 2) + pivots[joint]
            placed.append(moved @ to_camera[:, :3, :3].transpose(1, 2) + to_camera[:, None, :3, 3])
        radii = [shape.radius * size * parts["radii"][link].exp() for link, _, size in segments]
        return torch.stack(placed, 1), torch.stack(radii)

    def _inside_px(self, ends: Tensor, radii: Tensor) -> Tensor:
        """Return the distance [F, C] px of every cell's centre inside the nearest capsule's outline."""
        far, near = ends.unbind(2)  # [F, S, 3]
        depth = near[..., 2] - far[..., 2]
        share = (CAPSULES.nearest_mm - far[..., 2]) / torch.where(depth.abs() > 1e-6, depth, 1e-6)
        share = torch.where(far[..., 2] < CAPSULES.nearest_mm, share.clamp(0, 1), 0.0)
        far = far + share[..., None] * (near - far)
        fx, fy, cx, cy = (column[:, None] for column in self.evidence.intrinsics.unbind(1))
        (far_px, far_radius), (near_px, near_radius) = (
            (torch.stack(project(end, fx, fy, cx, cy, 1.0), -1), fx * radii / end[..., 2].clamp_min(1))
            for end in (far, near)
        )
        x, y = self.cells.unbind(1)  # [C]: coordinates apart, twice as fast as vectors
        best = x.new_full((len(ends), len(x)), -torch.inf)
        for k in range(len(radii)):
            (step_x, step_y), (far_x, far_y) = ((part[:, k, None].unbind(-1)) for part in (near_px - far_px, far_px))
            arm_x, arm_y = x - far_x, y - far_y  # [F, C]
            place = (arm_x * step_x + arm_y * step_y) / (step_x.square() + step_y.square()).clamp_min(1e-6)
            place = place.clamp(0, 1)
            distance = torch.hypot(arm_x - place * step_x, arm_y - place * step_y)
            radius = far_radius[:, k, None] + place * (near_radius - far_radius)[:, k, None]
            best = torch.maximum(best, radius - distance)
        return best
