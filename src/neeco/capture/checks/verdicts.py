"""Verdicts of the images on cameras and instruments, and their placement: distances, units, and visibility.

A mistake is named only if the images agree clearly better without it. If they contradict the recorded data and no
candidate explains it, only the contradiction is reported. For points or instruments out of view, the images determine
the mistake.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from itertools import permutations, product
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.capture.checks.evidence import CameraArrays, Candidate, ColorEvidence, MotionEvidence, Picture, Pixels
from neeco.capture.checks.settings import SETTINGS
from neeco.capture.documents import errors_only, printable
from neeco.capture.model import HOW_TO_REGISTER, Instrument
from neeco.capture.points import sampled
from neeco.capture.readers.parsed import Parsed
from neeco.geometry.conventions import DVRK_ECM, OPENCV, OPENGL, swap_camera_axes
from neeco.geometry.lines import across_projectors

STATES, POSES = "frames[*].instruments[*]", "frames[*].instruments[*].pose"
UNITS_MM = {"centimetres": 10.0, "inches": 25.4, "metres": 1000.0}
PIXELS: dict[str, Pixels] = {
    "mirrored left to right": lambda u, v, width, height: (width - u, v),
    "upside down (flipped)": lambda u, v, width, height: (u, height - v),
    "rotated by 180 degrees relative to their cameras": lambda u, v, width, height: (width - u, height - v),
}


class Verdict(NamedTuple):
    """Verdict on cameras or an instrument's states, with the fault according to the images."""

    status: Literal["undecided", "supported", "contradicted"]
    field: str = ""
    message: str = ""
    remedy: str = ""
    wrong_poses: bool = False  # the fault is a named mistake in poses

    @classmethod
    def of(cls, mistake: Candidate, poses_field: str, field: str) -> Verdict:
        wrong_poses = mistake.kind in ("pose", "rotation", "unit")
        place = poses_field if wrong_poses else field
        return cls("contradicted", place, mistake.message, mistake.remedy, wrong_poses)


class ImageVerdicts:
    """Verdicts on a capture. None while it has errors, nor on instruments if the images contradict the cameras."""

    def __init__(self, parsed: Parsed, pictures: Sequence[Picture]) -> None:
        self.parsed, self.pictures = parsed, pictures

    def report(self) -> None:
        """Report all contradictions as warnings."""
        for verdict in (self.cameras, *self.instruments.values()):
            if verdict.status == "contradicted":
                self.parsed.header(verdict.field).warning(verdict.message, verdict.remedy, contradicted=True)

    @cached_property
    def cameras(self) -> Verdict:
        """Return the verdict whether images and cameras correspond, by the sparse points' colours."""
        has_errors = bool(errors_only(self.parsed.places[0].report.problems))
        colors = None if has_errors else ColorEvidence.of(self.parsed, self.pictures)
        if colors is None:
            return Verdict("contradicted" if has_errors else "undecided")
        fine = float(colors.recorded.mean())
        all_poses = colors.all_cameras.poses
        rows = colors.rows
        candidates = list[Candidate]()
        for steps in range(-SETTINGS.max_offset, SETTINGS.max_offset + 1):
            if steps:
                at = (rows + steps).clip(0, len(all_poses) - 1)
                words = f"{abs(steps)} frame{'s' * (abs(steps) > 1)} {'earlier' if steps < 0 else 'later'}"
                message, remedy = f"the images fit the cameras of {words}", f"list each with the frame that is {words}"
                offset = Candidate("order", message, remedy, SETTINGS.offset, poses=all_poses[at])
                candidates.append(replace(offset, available=at == rows + steps))
        candidates += camera_candidates(colors.cameras.poses) if fine < SETTINGS.good_colors else []
        if (mistake := likeliest(candidates, colors)) is not None:
            return Verdict.of(mistake, "frames[*].transform_matrix", "frames")
        uncorrelated = fine < SETTINGS.contradicted_colors and colors.contrast > SETTINGS.min_contrast
        if uncorrelated and colors.agreement(coarse=True).mean() < SETTINGS.contradicted_coarsely:
            message = (
                "the images contradict the cameras: sparse points do not have the colours of the pixels they project "
                f"to (correlation {fine:.2f})"
            )
            remedy = "images, cameras, intrinsics and points must be of one recording, in one order, without rotation"
            return Verdict("contradicted", "frames", message, remedy)
        direct, swapped = (colors.color_difference(order) for order in ((0, 1, 2), (2, 1, 0)))
        if swapped < SETTINGS.max_swapped * direct:
            message = f"(they differ by {direct:.0f} of 255, swapped by {swapped:.0f})"
            message = f"red and blue of the images are swapped relative to the sparse points {message}"
            return Verdict("contradicted", "frames", message, "write both as RGB (OpenCV reads and writes BGR)")
        return Verdict("supported")

    @cached_property
    def _motion(self) -> MotionEvidence | None:
        contradicted = self.cameras.status == "contradicted"
        return None if contradicted else MotionEvidence.of(self.parsed, self.pictures)

    @cached_property
    def instruments(self) -> dict[str, Verdict]:
        """Return the verdicts whether instruments are at their stated poses, by motion. Needs states in all frames."""
        poses: dict[str, tuple[np.ndarray, np.ndarray]] = {}  # [N, 4, 4] as recorded, and to the root: most visible
        for item in self.parsed.instruments:
            tree = item.kinematics
            states = [state for _, state in self.parsed.states_of(item.name)]
            if len(states) == len(self.parsed.frames):
                back = [np.eye(4) if tree is None else tree.world_from_root(np.eye(4), one.joints) for one in states]
                poses[item.name] = np.stack([state.pose.numpy() for state in states]), np.stack(back)
        return {item.name: self._verdict(item.name, poses) for item in self.parsed.instruments}

    def _verdict(self, instrument: str, poses: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Verdict:
        if instrument not in poses or self._motion is None:
            return Verdict("undecided")
        rows = self._motion.rows
        recorded, root_from_recorded = poses[instrument]
        roots = recorded @ root_from_recorded
        other_paths = [(other @ back)[rows] for name, (other, back) in poses.items() if name != instrument]
        motion = self._motion.of_instrument(roots[rows], other_paths)
        if motion is None:
            return Verdict("undecided")
        name = printable(instrument)
        if (mistake := self._mistake(name, recorded, root_from_recorded, motion)) is not None:
            return Verdict.of(mistake, POSES, STATES)
        evidence = motion.mean(roots[rows])
        if evidence > SETTINGS.contradicted_poses:
            return Verdict("supported")
        by_chance = motion.by_chance(roots[rows])
        factor = SETTINGS.by_chance_few if len(rows) < SETTINGS.few_frames else SETTINGS.by_chance
        mostly_others = len(motion.ray_views) < len(self._motion.ray_views) / 2  # others explain most of the motion
        if evidence > factor * by_chance or mostly_others or motion.travel(roots[rows]) < SETTINGS.min_travel:
            return Verdict("undecided")
        message = (
            f"the images contradict the poses of {name}: the observed motion is not at these poses (evidence "
            f"{evidence:.2f}, {by_chance:.2f} by chance)"
        )
        remedy = "shifts, other axes, frames and units were tried; states, cameras and images must be of one recording"
        return Verdict("contradicted", POSES, message, remedy)

    def _mistake(self, name: str, recorded: np.ndarray, back: np.ndarray, motion: MotionEvidence) -> Candidate | None:
        """Return the mistake in the poses [N, 4, 4] of an instrument that the images confirm."""
        rows, roots = motion.rows, recorded @ back
        turns = Rotation.from_matrix(roots[rows, :3, :3])
        turning = np.degrees(np.sqrt(((turns.mean().inv() * turns).magnitude() ** 2).mean()))
        candidates = [
            replace(candidate, poses=candidate.poses @ back[rows])
            for candidate in instrument_candidates(recorded[rows], motion.cameras.poses, name)
            if candidate.kind != "rotation" or turning >= SETTINGS.min_turning_deg
        ]
        times = np.array([frame.state.time for frame in self.parsed.frames])
        at = partial(resampled, roots, rows, times, name)
        longest = int(len(times) * SETTINGS.max_shift)
        every = max(1, 2 * longest // SETTINGS.max_shifts)
        candidates += [at(steps=steps) for steps in range(-longest, longest + 1, every) if steps]
        candidates += [at(rate=rate) for rate in np.geomspace(*SETTINGS.rates) if rate != 1]
        best = likeliest(candidates, motion)
        if best is None or not best.steps:
            return best
        near = range(best.steps - SETTINGS.shift_radius, best.steps + SETTINGS.shift_radius + 1)
        shifts = [at(steps=steps) for steps in near if steps]
        common = np.prod([shift.available for shift in shifts if shift.available is not None], axis=0, dtype=bool)
        agreement = [motion.mean(shift.poses, common) for shift in shifts if shift.poses is not None]
        best = shifts[int(np.argmax(agreement))] if max(agreement) > 0 else best
        # at the end of the search range, another shift may be correct
        return None if abs(best.steps) >= longest else best


def likeliest(candidates: Sequence[Candidate], evidence: ColorEvidence | MotionEvidence) -> Candidate | None:
    """Return the candidate that agrees clearly better with the images than the recorded data, and better than any of
    another kind; None without one, or if several are equally likely."""
    compared = []
    for kind in dict.fromkeys(candidate.kind for candidate in candidates):
        of_kind = [candidate for candidate in candidates if candidate.kind == kind]
        quick = np.array([evidence.quick(candidate) for candidate in of_kind])
        best_few = np.argsort(-quick, kind="stable")[: SETTINGS.max_candidates]
        compared += [(of_kind[index], *evidence.compare(of_kind[index])) for index in best_few]
    clear = [
        (agreement, candidate)
        for candidate, factor, certainty, agreement in compared
        if all(np.array([factor, certainty, agreement]) > candidate.margin[:3])
    ]
    if not clear:
        return None
    most, best = max(clear, key=lambda item: item[0])
    rivals = [
        candidate
        for candidate, factor, _, agreement in compared
        if factor > SETTINGS.pose.factor and agreement > SETTINGS.rival * most
    ]

    def equals_best(one: Candidate) -> bool:  # in a still camera's world several descriptions are the same poses
        same_kind = one.kind == best.kind
        return same_kind and (one.kind != "pose" or np.allclose(np.asarray(one.poses), np.asarray(best.poses)))

    return best if best not in rivals or all(map(equals_best, rivals)) else None


def _pose_candidates(poses: np.ndarray, name: str, factors: Sequence[float] = ()) -> Iterator[Candidate]:
    """Return candidates of rotation formats, world axes, units and scale `factors` of poses [F, 4, 4]."""
    rotations = poses[:, :3, :3]
    quaternions = Rotation.from_matrix(rotations).as_quat()  # x y z w
    turned = {f"rotations of {name} are transposed": rotations.transpose(0, 2, 1)}
    for step, words in ((-1, "written w x y z and read as x y z w"), (1, "written x y z w and read as w x y z")):
        rolled = Rotation.from_quat(np.roll(quaternions, step, axis=1))
        turned[f"quaternions of {name} were {words}"] = rolled.as_matrix()
    for message, matrices in turned.items():
        changed = poses.copy()
        changed[:, :3, :3] = matrices
        yield Candidate("rotation", message, "convert them again", SETTINGS.rotation, poses=changed)
    for order, signs in product(permutations(range(3)), product((1, -1), repeat=3)):
        turn = np.eye(4)
        turn[:3, :3] = np.diag(signs) @ np.eye(3)[list(order)]
        axes = ", ".join(("-" if sign < 0 else "") + "xyz"[axis] for axis, sign in zip(order, signs, strict=True))
        if axes != "x, y, z":
            message = f"world axes of {name} differ from the scene's: (x, y, z) should be ({axes})"
            remedy = "replace them, in positions and rotations"
            yield Candidate("pose", message, remedy, SETTINGS.pose, poses=turn @ poses)
    scales = {f"in {unit}": length for unit, length in UNITS_MM.items()}
    scales |= {f"in mm, all others in {unit}": 1 / length for unit, length in UNITS_MM.items()}
    scales |= {f"about {1 / factor:.2g} times as large as the scene": factor for factor in factors}
    for words, factor in scales.items():
        scaled = poses * np.array([[1, 1, 1, factor]] * 3 + [[1, 1, 1, 1]])
        message = f"positions of {name} are {words}"
        yield Candidate("unit", message, "give all lengths in mm", SETTINGS.pose, poses=scaled)


def instrument_candidates(poses: np.ndarray, world_from_camera: np.ndarray, name: str) -> Iterator[Candidate]:
    """Return candidate mistakes in instrument poses [F, 4, 4]; cameras [F, 4, 4] have OpenCV axes."""
    yield from _pose_candidates(poses, name, SETTINGS.scales)
    message, remedy = f"poses of {name} are instrument-from-world", "invert them: world_from_instrument is expected"
    yield Candidate("pose", message, remedy, SETTINGS.pose, poses=np.linalg.inv(poses))
    in_camera = np.linalg.inv(world_from_camera) @ poses
    for axes in (OPENCV, OPENGL, DVRK_ECM):
        remedy = f"convert them to the world frame (`frame: {axes.name}` in recording.yaml)"
        for words, original in (("are in the camera's frame", poses), ("were converted to the world", in_camera)):
            moved = world_from_camera @ axes.poses_to_opencv(original)
            message = f"poses of {name} {words} with the axes of {axes.producer} ({axes.words})"
            if axes is not OPENCV or original is poses:
                yield Candidate("pose", message, remedy, SETTINGS.pose, poses=moved)


def resampled(
    poses: np.ndarray, rows: np.ndarray, times: np.ndarray, name: str, *, steps: int = 0, rate: float = 1.0
) -> Candidate:
    """Return the states of frames `rows` [F], of poses [N, 4, 4], shifted by a number of frames, or of a clock with
    another rate. A new recording starts where time decreases."""
    recording = np.concatenate([[0], np.cumsum(np.diff(times) < 0)])
    shifted = np.rint(rate * rows).astype(int) + steps
    source = shifted.clip(0, len(poses) - 1)
    words = f"on a clock that runs {rate:.3g} times as fast"
    if rate == 1:
        words = f"{abs(steps)} frame{'s' * (abs(steps) > 1)} {'earlier' if steps > 0 else 'later'}"
    return Candidate(
        "shift" if rate == 1 else "rate",
        f"states of {name} fit the images better {words}",
        "correct their times (clock offset or rate, dropped frames, or another first frame)",
        SETTINGS.shift if abs(steps) <= min(SETTINGS.small_shift, len(poses) // 5) else SETTINGS.pose,
        poses=poses[source],
        available=(source == shifted) & (recording[source] == recording[rows]),
        steps=steps,
    )


def camera_candidates(poses: np.ndarray) -> Iterator[Candidate]:
    """Return candidate mistakes in camera poses [F, 4, 4] (OpenCV axes) and images."""
    for condition, pixels in PIXELS.items():
        remedy = "transform their pixels, not only an EXIF tag"
        yield Candidate("image", f"the images are {condition}", remedy, SETTINGS.camera, pixels=pixels)
    written = swap_camera_axes(poses)  # as in transform_matrix
    message, inverse = "camera matrices are world-to-camera", np.linalg.inv(written)
    for words, moved in (
        ("camera axes are OpenCV's", written),
        (message, swap_camera_axes(inverse)),
        (f"{message} with OpenCV axes", inverse),
    ):
        yield Candidate("pose", words, "camera-to-world with OpenGL axes is expected", SETTINGS.camera, poses=moved)
    for candidate in _pose_candidates(written, "the cameras"):
        assert candidate.poses is not None
        yield replace(candidate, poses=swap_camera_axes(candidate.poses), margin=SETTINGS.camera)


def check_placement(parsed: Parsed, verdicts: ImageVerdicts) -> None:
    """Check points, cameras against points, then instruments against both (unless the cameras are wrong)."""
    report = parsed.places[0].report
    placed = parsed.with_cameras()
    before = len(errors_only(report.problems))
    place = parsed.points_place
    assert place is not None  # there are frames
    points = None  # the measured ones [P, 3] float64; None where there are none, or all coincide
    if parsed.points is None or not parsed.points.measured:
        if not place.reported:
            place.warning("no sparse points", "training starts from random points, with a poorer result")
    elif not len(points := parsed.points.positions.astype(np.float64)):
        place.error("contains no points", "add SfM points or remove ply_file_path")
        points = None
    else:
        if len(points) < SETTINGS.few_points:
            message = f"few sparse points: {len(points)}, fewer than {SETTINGS.few_points}"
            place.warning(message, "use the complete SfM point cloud if possible")
        if _radius(points) < 1e-9:
            place.error("all points coincide", "repair the point cloud")
            points = None
    if not placed.frames:
        return
    if not parsed.registered and parsed.instruments:
        message = "instrument poses are 'unregistered': in a tracker's or robot's frame, not the cameras' world"
        remedy = f"positions of instruments in the images cannot be checked; {HOW_TO_REGISTER}"
        parsed.header("instrument_frame").warning(message, remedy)
    if points is not None:
        _check_cameras(placed, points, verdicts)
    if len(errors_only(report.problems)) == before:
        for instrument in parsed.instruments:
            _check_instrument(placed, instrument, points, verdicts)


def _radius(points: np.ndarray) -> float:
    """Return the 90 % quantile of distances, mm, of points [P, 3] to their median."""
    return float(np.quantile(np.linalg.norm(points - np.median(points, axis=0), axis=1), 0.9))


def _check_cameras(parsed: Parsed, points: np.ndarray, verdicts: ImageVerdicts) -> None:
    """Report cameras far from the points, or with no point in their images."""
    matrices = parsed.header("frames[*].transform_matrix")
    cameras = CameraArrays.of([frame.camera for frame in parsed.frames])
    distances = np.linalg.norm(cameras.centers - np.median(points, axis=0), axis=1)
    distance, radius = float(np.median(distances)), _radius(points)
    visible = cameras.project(sampled(points)[None])[2].mean(axis=1)  # [F] share of the points in each image
    too_near = bool(parsed.instruments) and distance < SETTINGS.min_distance_mm
    if too_near or distance > SETTINGS.far_distance * radius:
        message = f"cameras are {distance:.4g} mm from the points, which span {2 * radius:.4g} mm: probably metres"
        matrices.error(message, "give all lengths in mm")
    elif visible.mean() < SETTINGS.min_visible and (verdict := verdicts.cameras).wrong_poses:
        matrices.error(f"points are outside the images: {verdict.message}", verdict.remedy)
    elif not visible.any():
        remedy = "camera-to-world with OpenGL axes, in the points' frame and unit (mm), is expected"
        matrices.error("no camera observes any point", remedy)
    else:
        for place, away, share in zip(parsed.places, distances, visible, strict=True):
            if away > SETTINGS.max_distance * max(radius, distance):
                message = f"camera is far from the points: {away:.4g} mm, others {distance:.4g} mm"
                place.child("transform_matrix").error(message, "repair the pose or drop the frame")
            elif share == 0:
                remedy = "check its pose, unless SfM missed this part of the scene"
                place.child("transform_matrix").warning("the camera observes no point", remedy)


def _check_instrument(
    parsed: Parsed, instrument: Instrument, points: np.ndarray | None, verdicts: ImageVerdicts
) -> None:
    """Report an instrument far from the scene or out of view."""
    name, all_poses = printable(instrument.name), parsed.header(POSES)
    states = parsed.states_of(instrument.name)
    if not states:
        return
    places, poses = [place for place, _ in states], np.stack([state.pose.numpy() for _, state in states])
    origins = poses[:, :3, 3]
    farthest = float(np.linalg.norm(origins, axis=1).max())
    if np.ptp(origins, axis=0).max() > 0 and farthest < SETTINGS.min_distance_mm:
        message = f"positions of {name} stay within {farthest:.2g} mm of the frame's origin: probably metres"
        all_poses.error(message, "give them in mm")
    if not parsed.registered or farthest < SETTINGS.min_distance_mm:
        return
    cameras = CameraArrays.of([frame.camera for frame in parsed.frames if instrument.name in frame.state.instruments])
    visible = cameras.project(origins[:, None])[2][:, 0]  # [I]
    outside = "every image" if not visible.any() else f"{len(visible) - int(visible.sum())} of {len(visible)} images"
    out_of_view = visible.mean() < SETTINGS.min_visible
    verdict = verdicts.instruments[instrument.name] if out_of_view else None
    if verdict is not None and verdict.wrong_poses:
        all_poses.error(f"instrument {name} is outside {outside}: {verdict.message}", verdict.remedy)
        return
    if points is not None:
        center = np.median(points, axis=0)
        size = max(_radius(points), float(np.median(np.linalg.norm(cameras.centers - center, axis=1))))
        distances = np.linalg.norm(origins - center, axis=1)
        far = np.flatnonzero(distances > SETTINGS.max_distance * size + SETTINGS.sensor_reach_mm)
        for index in far:
            message = f"instrument {name} is far from the points: {distances[index]:.4g} mm"
            places[index].child("pose").error(message, "pose and points must share frame and unit (mm)")
        if len(far):
            return
    if not out_of_view:  # single poses out of view and far away from all others: tracker drop-outs
        distances = np.linalg.norm(origins - np.median(origins, axis=0), axis=1)
        usual = max(float(np.median(distances)), SETTINGS.min_distance_mm)
        for index in np.flatnonzero((distances > SETTINGS.max_distance * usual) & ~visible):
            message = f"instrument {name} is {distances[index]:.4g} mm from its median position, and out of view"
            remedy = "probably a tracker drop-out or a wrong unit: repair the pose or drop the frame"
            places[index].child("pose").warning(message, remedy)
    elif verdict is not None and verdict.status == "undecided":
        behind = bool(visible.any())
        if not behind:  # whether most images show the instrument-fixed point nearest to all optical axes
            across = across_projectors(cameras.poses[:, :3, 2])
            rows = (across @ poses[:, :3, :3]).reshape(-1, 3)
            target = (across @ (cameras.centers - poses[:, :3, 3])[:, :, None]).reshape(-1)
            point = np.linalg.lstsq(rows, target, rcond=1e-6)[0]
            world = np.einsum("fij,j->fi", poses[:, :3, :3], point) + poses[:, :3, 3]
            shown = cameras.project(world[:, None])[2].mean() > SETTINGS.min_body_visible
            behind = bool(shown and np.linalg.norm(point) < SETTINGS.sensor_reach_mm)
        remedy = "correct only if its sensor is far behind the tip"
        remedy += "" if behind else "; world_from_instrument in mm, in the cameras' world, is expected"
        (all_poses.warning if behind else all_poses.error)(f"the origin of {name} is outside {outside}", remedy)
