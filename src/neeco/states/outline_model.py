"""The silhouette of an articulated instrument: round cones along stated links, projected to images.

The root link is a tube that ends at the pivot of the first joint, each inner link a cone from its pivot to the next,
each outermost link one from its pivot outwards. Joints move them as the recording states. Radii, lengths of outermost
links and the errors of what is stated (pivots, axes, offsets of readings) are parameters with priors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.capture.kinematics import FIXED, PRISMATIC, KinematicTree, Link
from neeco.geometry.lines import frame_about, unit
from neeco.geometry.projection import project
from neeco.geometry.trocar import line_through_trocar


@dataclass(frozen=True, kw_only=True)
class OutlineModelSettings:
    """Priors of an instrument's shape and of its stated links."""

    tube_mm: float = 150.0  # length of the root link that is modelled
    nearest_mm: float = 8.0  # depth at which cones are cut off
    pivot_sd_mm: float = 1.2  # standard deviation of stated pivots
    axis_sd_rad: float = 0.06  # standard deviation of stated axes
    offset_sd_rad: float = 0.05  # standard deviation of stated offsets of revolute joints, errors of shapes included
    # standard deviation of an outermost link's direction from the tube's at rest: a curved jaw looks like an offset
    heading_sd_rad: float = 0.15
    slide_sd_mm: float = 1.0  # standard deviation of the offset of a prismatic joint
    play_sd_rad: float = 0.012  # standard deviation of the play by which readings lag or lead with the sign of motion
    play_sd_mm: float = 0.3  # the same, of prismatic joints
    motion_steps: int = 2  # number of instants before and after, from which the sign of motion is computed
    tilt_sd_rad: float = 0.03  # standard deviation of the tube's axis about its initial estimate
    aside_sd_mm: float = 0.7  # standard deviation of the distance of the tube's axis from the first pivot
    log_radius_sd: float = 0.4  # standard deviation of the logarithm of the tube's radius
    ratio_sd: float = 0.3  # standard deviation of the log ratio of a link's radius to its parent's
    flat_sd: float = 0.2  # standard deviation of the relative change of a radius with the viewing direction
    ears_mm: float = 6.0  # distance from the tube's end to the first pivot
    ears_sd_mm: float = 3.0  # standard deviation of that distance
    length_mm: float = 13.0  # length of outermost links
    length_sd_mm: float = 5.0  # standard deviation of that length
    unequal_sd_mm: float = 1.5  # standard deviation of the difference between the lengths of outermost links
    tube_radius_mm: float = 3.8  # initial radius of the tube
    taper: float = 0.5  # initial ratio of the end radii of outermost links
    min_radius_mm: float = 0.2  # minimum radius of a cone
    min_length_mm: float = 2.0  # minimum length of an outermost link
    max_bend_mm: float = 1.5  # maximum RMS distance of logged poses' axes from the trocar
    min_pivot_mm: float = 5.0  # minimum distance of the first pivot from the root's origin, for a direction
    max_along: float = 0.9  # cosine between a joint's axis and the shaft, above which it is a roll joint
    min_motion: float = 0.02  # standard deviation of a joint's value, rad, above which it counts as moving
    min_slide_mm: float = 0.5  # the same, of a prismatic joint
    # of outline points, from the tube's end
    tube_stations_mm: tuple[int, ...] = (1, 3, 6, 9, 13, 18, 24, 31, 40, 50, 62, 75, 90)


MODEL = OutlineModelSettings()

STATIONS = np.array([0.04, 0.15, 0.3, 0.5, 0.7, 0.85, 0.96])  # along a cone, of outline points
TUBE_STATIONS = 1 - np.array(MODEL.tube_stations_mm) / MODEL.tube_mm
CAP_ANGLES = np.radians([-80, -50, -25, 0, 25, 50, 80])  # about a cone's outer end


@dataclass(frozen=True, eq=False)
class Cone:
    """A round cone fixed to a link, from `start` to a pivot of a child, or outwards (`child` None)."""

    link: int
    child: int | None
    radii: int  # its parameters: logarithms of both radii, then two of its flatness
    length: int | None  # the parameter of an outermost link's length
    heading: int | None = None  # that of its direction out of the plane in which it turns


@dataclass(frozen=True, eq=False)
class Outlines:
    """Images of cones [C] in F frames: centres of both ends [F, C, 2, 2] px, half widths there [F, C, 2] px, and
    whether they are in front of the camera [F, C]."""

    ends: np.ndarray
    widths: np.ndarray
    valid: np.ndarray

    def distances(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return signed distances [F, C, N] px of points [F, N, 2] to every cone's outline, positive inside; the
        nearest position along the cones [F, C, N]; and unit directions [F, C, N, 2] from there."""
        start, along = self.ends[:, :, None, 0], (self.ends[:, :, 1] - self.ends[:, :, 0])[:, :, None]
        square = np.maximum((along**2).sum(-1), 1e-6)
        off = points[:, None] - start
        place = np.clip((off * along).sum(-1) / square, 0, 1)
        off = off - place[..., None] * along
        radius = self.widths[..., :1] + place * (self.widths[..., 1:] - self.widths[..., :1])
        away = np.sqrt((off**2).sum(-1) + 1e-9)
        return np.where(self.valid[..., None], radius - away, -1e3), place, off / away[..., None]


class ArticulatedModel:
    """Cones, parameters [P] and their priors (`means`, `sds`) of an instrument with a stated kinematic tree.

    poses [F, 4, 4] base_from_root and values [F, L] of all links' joints serve to estimate the tube's axis and to
    detect which joints move.
    """

    def __init__(self, tree: KinematicTree, poses: np.ndarray) -> None:
        self.tree = tree
        names = [link.name for link in tree.links]
        self.parents = [-1 if link.parent is None else names.index(link.parent) for link in tree.links]
        self.names: list[str] = []
        self.means, self.sds = np.zeros(0), np.zeros(0)
        self.rest = list(tree.rest_poses.values())
        self._hinges()
        self.first, self.first_pivot = next((i, pivot) for i, pivot in enumerate(self.pivots) if pivot is not None)
        self.axis = _tube_axis(tree, self.rest[self.first][:3, 3], poses)
        self.tilt = self._add("shaft", [0] * 4, [MODEL.tilt_sd_rad] * 2 + [MODEL.aside_sd_mm] * 2)
        self.least_ears = 0.5  # mm
        self.ears = self._add("ears", [MODEL.ears_mm], [MODEL.ears_sd_mm])
        self.tube = self._add(
            "tube radius", [np.log(MODEL.tube_radius_mm), -0.15], [MODEL.log_radius_sd, MODEL.ratio_sd]
        )
        self._cones()
        self._outline()

    def shaft_axis(self, parameters: np.ndarray) -> np.ndarray:
        """Direction [3] of the tube in the root's frame."""
        return np.asarray(unit(self.axis + frame_about(self.axis)[:, :2] @ parameters[self.tilt : self.tilt + 2]))

    def _add(self, name: str, means: list[float], sds: list[float]) -> int:
        start = len(self.means)
        self.means, self.sds = np.append(self.means, means), np.append(self.sds, sds)
        self.names += [name] * len(means)
        return start

    def _hinges(self) -> None:
        """Return the parameters of pivots and axes, shared by links at the same place, and of offsets."""
        self.pivots: list[int | None] = []
        self.offsets: list[int | None] = []
        self.plays: list[int] = []
        places: dict[tuple, int] = {}
        for index, (link, parent) in enumerate(zip(self.tree.links, self.parents, strict=True)):
            if link.type == FIXED:
                self.pivots.append(None)
                self.offsets.append(None)
                self.plays.append(-1)
                continue
            key = (parent, *link.origin[:3, 3].round(6), *link.axis.round(6))
            if key not in places:
                sds = [MODEL.pivot_sd_mm] * 3 + [MODEL.axis_sd_rad] * 2
                places[key] = self._add(f"pivot of {link.name}", [0] * 5, sds)
            self.pivots.append(places[key])
            sd = MODEL.slide_sd_mm if link.type == PRISMATIC else MODEL.offset_sd_rad
            if link.type != PRISMATIC and index not in self.parents:
                sd = float(np.hypot(sd, MODEL.heading_sd_rad))
            self.offsets.append(self._add(f"offset of {link.name}", [0], [sd]))
            self.plays.append(
                self._add(
                    f"play of {link.name}", [0], [MODEL.play_sd_mm if link.type == PRISMATIC else MODEL.play_sd_rad]
                )
            )

    def _cones(self) -> None:
        self.cones: list[Cone] = []
        self.mean_length = self._add("length", [MODEL.length_mm], [MODEL.length_sd_mm])
        moves = [False]
        for index, link in enumerate(self.tree.links[1:], 1):
            moves.append(moves[self.parents[index]] or self.pivots[index] is not None)
            if not (link.body and moves[index]):
                continue
            below = [i for i, parent in enumerate(self.parents) if parent == index]
            pivots = {tuple(self.tree.links[i].origin[:3, 3].round(3)): i for i in below}
            for child in pivots.values():
                if np.linalg.norm(self.tree.links[child].origin[:3, 3]) > 1.0:
                    radii = self._add(
                        f"radii of {link.name}", [-0.2, 0, 0, 0], [MODEL.ratio_sd] * 2 + [MODEL.flat_sd] * 2
                    )
                    self.cones.append(Cone(index, child, radii, None))
            if not below:
                means, sds = (
                    [-0.45, np.log(MODEL.taper), 0, 0],
                    [MODEL.ratio_sd, 2 * MODEL.ratio_sd, MODEL.flat_sd, MODEL.flat_sd],
                )
                radii = self._add(f"radii of {link.name}", means, sds)
                length = self._add(f"length of {link.name}", [0], [MODEL.unequal_sd_mm])
                heading = self._add(f"heading of {link.name}", [0], [MODEL.heading_sd_rad])
                self.cones.append(Cone(index, None, radii, length, heading))

    def link_poses(self, parameters: np.ndarray, values: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return root_from_link rotations [F, 3, 3] and translations [F, 3] mm of all links; values [F, L] of joints,
        or [F, 2 L] with the signs of their motion (`with_motion`), to which backlash is proportional."""
        count, links = len(values), len(self.tree.links)
        turns, shifts = [np.tile(np.eye(3), (count, 1, 1))], [np.zeros((count, 3))]
        turns[0], shifts[0] = turns[0] @ self.tree.links[0].origin[:3, :3], shifts[0] + self.tree.links[0].origin[:3, 3]
        for index, link in enumerate(self.tree.links[1:], 1):
            origin, parent = link.origin, self.parents[index]
            turn, shift = turns[parent], shifts[parent]
            place, axis = origin[:3, 3], link.axis
            start, offset = self.pivots[index], self.offsets[index]
            if start is None or offset is None:
                turns.append(turn @ origin[:3, :3])
                shifts.append(shift + turn @ place)
                continue
            place = place + parameters[start : start + 3]
            axis = unit(axis + frame_about(axis)[:, :2] @ parameters[start + 3 : start + 5])
            value = values[:, index] + parameters[offset]
            if values.shape[1] > links:
                value = value + parameters[self.plays[index]] * values[:, index + links]
            if link.type == PRISMATIC:
                turns.append(turn @ origin[:3, :3])
                shifts.append(shift + turn @ place + value[:, None] * (turn @ axis))
            else:
                turns.append(turn @ Rotation.from_rotvec(value[:, None] * axis).as_matrix() @ origin[:3, :3])
                shifts.append(shift + turn @ place)
        return turns, shifts

    def cones_at(self, parameters: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return ends [F, C, 2, 3] mm of all cones in the root's frame, their radii [C, 2] mm and flatness [C, 2], and
        `across` [F, C, 3], the reference direction of flatness. The first two cones are the tube and its end."""
        turns, shifts = self.link_poses(parameters, values)
        basis = frame_about(self.axis)
        tilt = parameters[self.tilt : self.tilt + 4]
        axis = unit(self.axis + basis[:, :2] @ tilt[:2])
        pivot = shifts[self.first] + basis[:, :2] @ tilt[2:]
        end = pivot - np.clip(parameters[self.ears], self.least_ears, 20) * axis
        tube = np.exp(parameters[self.tube])
        ears = tube * np.exp(parameters[self.tube + 1])
        across = np.broadcast_to(basis[:, 0], pivot.shape)
        ends = [np.stack([pivot - MODEL.tube_mm * axis, end], 1), np.stack([end, pivot], 1)]
        radii, flat, sideways = [(tube, tube), (ears, ears)], [np.zeros(2)] * 2, [across, across]
        for cone in self.cones:
            turn, shift = turns[cone.link], shifts[cone.link]
            rest = self.rest[cone.link][:3, :3].T
            if cone.child is None:
                assert cone.length is not None
                assert cone.heading is not None
                link = self.tree.links[cone.link]
                out_of_plane = link.origin[:3, :3].T @ link.axis
                ahead = unit(rest @ self.axis + parameters[cone.heading] * out_of_plane)
                length = max(parameters[self.mean_length] + parameters[cone.length], MODEL.min_length_mm)
                far = shift + length * (turn @ ahead)
            else:
                far = shifts[cone.child]
            ends.append(np.stack([shift, far], 1))
            shape = parameters[cone.radii : cone.radii + 4]
            near = max(tube * np.exp(shape[0]), MODEL.min_radius_mm)
            radii.append((near, max(near * np.exp(shape[1]), MODEL.min_radius_mm)))
            flat.append(np.clip(shape[2:], -0.6, 0.6))
            sideways.append(turn @ (rest @ basis[:, 0]))
        return np.stack(ends, 1), np.array(radii), np.array(flat), np.stack(sideways, 1)

    def outlines(
        self,
        parameters: np.ndarray,
        values: np.ndarray,
        camera_from_root: np.ndarray,
        intrinsics: tuple[float, float, float, float],
    ) -> Outlines:
        """Return the projections of all cones; camera_from_root [F, 4, 4]."""
        ends, radii, flat, sideways = self.cones_at(parameters, values)
        turn = camera_from_root[:, None, :3, :3]
        a = (turn @ ends[:, :, 0, :, None])[..., 0] + camera_from_root[:, None, :3, 3]
        b = (turn @ ends[:, :, 1, :, None])[..., 0] + camera_from_root[:, None, :3, 3]
        sideways = (turn @ sideways[..., None])[..., 0]
        valid = b[..., 2] > MODEL.nearest_mm
        gap = np.where(np.abs(b[..., 2] - a[..., 2]) > 1e-6, b[..., 2] - a[..., 2], 1e-6)
        cut = np.where(valid & (a[..., 2] < MODEL.nearest_mm), (MODEL.nearest_mm - a[..., 2]) / gap, 0.0)
        a = a + np.clip(cut, 0, 0.999)[..., None] * (b - a)
        axis = unit(b - a)
        normal = unit(np.cross(a, b) + 1e-9)  # of the plane through the camera and the cone's axis
        facing = np.cross(normal, axis)
        facing = facing * -np.sign((facing * b).sum(-1, keepdims=True))
        # flatness: the radius depends on the angle about the axis at which the outline lies
        other = np.cross(axis, sideways)
        angle = np.arctan2((normal * other).sum(-1), (normal * sideways).sum(-1))
        factor = np.exp(flat[:, 0] * np.cos(2 * angle) + flat[:, 1] * np.sin(2 * angle))
        factor = np.where((flat != 0).any(-1), factor, 1.0)
        middles, chords = [], []
        for place, radius in ((a, radii[:, 0]), (b, radii[:, 1])):
            size = (radius * factor)[..., None]
            sine = np.clip(size / np.maximum(-(facing * place).sum(-1, keepdims=True), 1e-3), 0, 0.9)
            near, out = place + size * sine * facing, size * np.sqrt(1 - sine**2) * normal
            left, right = (
                np.stack(project(p, *intrinsics, nearest=MODEL.nearest_mm / 2), -1) for p in (near - out, near + out)
            )
            middles.append((left + right) / 2)
            chords.append((right - left) / 2)
        images, chord = np.stack(middles, 2), np.stack(chords, 2)
        ahead = images[:, :, 1] - images[:, :, 0]
        ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=-1, keepdims=True), 1e-6)
        # across the cone's image: far from the image's middle, chords are oblique to it
        across = chord[..., 1] * ahead[:, :, None, 0] - chord[..., 0] * ahead[:, :, None, 1]
        widths = np.where(
            np.linalg.norm(images[:, :, 1] - images[:, :, 0], axis=-1)[..., None] > 1.0,
            np.abs(across),
            np.linalg.norm(chord, axis=-1),
        )
        return Outlines(images, widths, valid)

    def outline_points(self, outlines: Outlines) -> np.ndarray:
        """Return points [F, N, 2] px of all cones' outlines, of the cone `owner` [N] each."""
        start, end = outlines.ends[:, self.owner, 0], outlines.ends[:, self.owner, 1]
        ahead = end - start
        unit_ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=-1, keepdims=True), 1e-6)
        out = np.stack([-unit_ahead[..., 1], unit_ahead[..., 0]], -1)
        near, far = outlines.widths[:, self.owner, 0], outlines.widths[:, self.owner, 1]
        width = (near + self.places * (far - near))[..., None]
        way = np.cos(self.angles)[:, None] * unit_ahead + np.sin(self.angles)[:, None] * out
        return np.asarray(start + self.places[:, None] * ahead + width * way)

    def _outline(self) -> None:
        """Return every outline point's cone, position along it, and angle from the cone's direction."""
        owners, places, angles = [], [], []
        for cone in range(2 + len(self.cones)):
            stations = STATIONS if cone else TUBE_STATIONS
            caps = CAP_ANGLES if cone >= 2 and self.cones[cone - 2].child is None else np.zeros(0)
            owners += [cone] * (2 * len(stations) + len(caps))
            places += [*stations, *stations, *np.ones(len(caps))]
            angles += [*np.full(len(stations), np.pi / 2), *np.full(len(stations), -np.pi / 2), *caps]
        self.owner, self.places, self.angles = np.array(owners), np.array(places), np.array(angles)


def joint_values(tree: KinematicTree, readings: dict[str, np.ndarray]) -> np.ndarray:
    """Return values [..., L] of all links' joints, rad or mm, at readings [...]; 0 for fixed ones."""
    shape = next(iter(readings.values())).shape
    columns = []
    for link in tree.links:
        value = np.full(shape, link.offset if link.type != FIXED else 0.0)
        for name, gain in link.value.items():
            value = value + gain * readings[name]
        columns.append(value)
    return np.stack(columns, -1)


def with_motion(values: np.ndarray) -> np.ndarray:
    """Return values [S, F, 2 L]: those [S, F, L] of all links' joints at evenly spaced instants S around those of the
    frames, and the signs of their motion, smoothed at reversals."""
    last = len(values) - 1
    near = np.arange(len(values))
    speed = values[np.minimum(near + MODEL.motion_steps, last)] - values[np.maximum(near - MODEL.motion_steps, 0)]
    usual = np.abs(speed).mean((0, 1))
    return np.concatenate([values, np.tanh(speed / np.maximum(usual, 1e-6))], -1)


def bends(tree: KinematicTree, values: np.ndarray) -> bool:
    """Return whether joints move the links in a recording, values [F, L]."""
    kinds = [link.type for link in tree.links]
    least = np.array(
        [np.inf if kind == FIXED else MODEL.min_slide_mm if kind == PRISMATIC else MODEL.min_motion for kind in kinds]
    )
    return bool((np.std(values, axis=0) > least).any())


def mirrored(
    tree: KinematicTree,
    axis: np.ndarray,
    camera_from_world: np.ndarray,
    pose: np.ndarray,
    readings: Mapping[str, float],
) -> tuple[np.ndarray, dict[str, float]]:
    """Return the state with nearly the same silhouette as (pose [4, 4] world_from_root, readings): mirrored in depth
    about the first joint across the shaft and, in its own frame, along that joint's axis; joints across it are negated.
    axis [3]: the shaft's, unit, in the root's frame."""
    pivot, direction, across = _first_joint_across(tree, axis)
    moved = camera_from_world @ pose
    center = moved[:3, :3] @ pivot + moved[:3, 3]
    moved[:3, :3] = np.diag([1.0, 1.0, -1.0]) @ moved[:3, :3] @ (np.eye(3) - 2 * np.outer(direction, direction))
    moved[:3, 3] = center - moved[:3, :3] @ pivot
    values = _bent_back(readings, [link for link, joint_axis in across if abs(joint_axis @ direction) < 0.5])
    return np.linalg.inv(camera_from_world) @ moved, values


def half_turned(
    tree: KinematicTree, axis: np.ndarray, pose: np.ndarray, readings: Mapping[str, float]
) -> tuple[np.ndarray, dict[str, float]]:
    """Return the state (pose [4, 4] world_from_root, readings) rotated by 180 degrees about the shaft, with nearly the
    same silhouette: joints across the shaft are negated, and jaws change places. axis [3]: the shaft's, unit, in the
    root's frame."""
    pivot, _, across = _first_joint_across(tree, axis)
    turn = np.eye(4)
    turn[:3, :3] = 2 * np.outer(axis, axis) - np.eye(3)
    turn[:3, 3] = pivot - turn[:3, :3] @ pivot
    return pose @ turn, _bent_back(readings, [link for link, _ in across])


def _first_joint_across(
    tree: KinematicTree, axis: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[tuple[Link, np.ndarray]]]:
    """Return a point [3] (mm) and the direction [3] of the first joint that does not rotate about the shaft's `axis`
    [3], and every such joint with its direction, innermost first; directions are across the shaft, in the root's frame,
    at rest. Without one: the root's origin and any direction across."""
    points, axes = (part[::-1] for part in tree.axes_at_rest)
    joints = zip(tree.joints[::-1], points, axes, strict=True)
    across = [(link, point, u - (u @ axis) * axis) for link, point, u in joints if abs(u @ axis) < MODEL.max_along]
    if not across:
        return np.zeros(3), np.linalg.svd(axis[None])[2][1], []
    return across[0][1], unit(across[0][2]), [(link, unit(direction)) for link, _, direction in across]


def _bent_back(readings: Mapping[str, float], links: Sequence[Link]) -> dict[str, float]:
    """Return `readings`, negated where they move the joints of `links`; those that open jaws are unchanged."""
    values = dict(readings)
    for reading in {name for link in links for name in link.value}:
        gains = [link.value[reading] for link in links if reading in link.value]
        if abs(sum(gains)) > 0.5 * len(gains):
            values[reading] = -values[reading]
    return values


def _tube_axis(tree: KinematicTree, pivot: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Return an initial direction [3] of the tube in the root's frame: through the trocar estimated from the log; else
    from the root's origin to the first pivot; else the root's z axis."""
    line = line_through_trocar(poses, MODEL.max_bend_mm)
    if line is not None:
        return line.axis
    if np.linalg.norm(pivot) > MODEL.min_pivot_mm:
        return np.asarray(unit(pivot))
    return np.array([0.0, 0.0, 1.0])
