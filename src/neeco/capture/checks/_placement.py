"""Check that cameras, points and instruments fit together: distances, units, axes, and who sees what.

A mistake of units or axes leaves things out of view. Where that happens the usual mistakes are tried, and one that
brings things back into view is named: where images and points can tell, only if they confirm it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from neeco.capture.checks.colors import agreements
from neeco.capture.checks.motion import POSES, MotionVerdict, judge_motion
from neeco.capture.checks.motion_evidence import Rays
from neeco.capture.documents import Node, errors_only, printable
from neeco.capture.model import Instrument
from neeco.capture.readers.parsed import Parsed
from neeco.geometry.conventions import swap_camera_axes
from neeco.geometry.lines import across_projectors
from neeco.geometry.projection import project

FEW_POINTS = 100
FAR = 10.0  # in sizes of the scene
SEEN_RARELY = 0.1  # a share of the points, or of the frames, that makes one look for a mistake
SEEN_SURELY = 0.7  # a share that settles it
COLORS_AGREE = 0.2  # correlation of the points' colours with the images' that confirms a mistake
SEEN_AGAIN = 0.3  # a share that makes a mistake the likely one
METRES = 1.0  # mm; an endoscope is never this close, nor an instrument's travel this short
BEHIND = 1e-9  # mm; what is less deep is not in front of a camera
SENSOR_REACH_MM = 500.0  # how far from the visible part of an instrument its sensor may sit
ALL_IN_MM = "give all lengths in mm"
Mistake = tuple[str, str]  # what is wrong, what to do


@dataclass(frozen=True)
class _Cameras:
    """Cameras of frames as arrays."""

    poses: np.ndarray  # [F, 4, 4] world_from_camera, OpenCV axes
    intrinsics: np.ndarray  # [F, 4] fx fy cx cy
    sizes: np.ndarray  # [F, 2] width, height

    @classmethod
    def of(cls, parsed: Parsed) -> _Cameras:
        cameras = [frame.camera for frame in parsed.frames]
        return cls(
            np.stack([camera.world_from_camera.double().numpy() for camera in cameras]),
            np.array([(camera.fx, camera.fy, camera.cx, camera.cy) for camera in cameras]),
            np.array([(camera.width, camera.height) for camera in cameras], dtype=np.float64),
        )

    @property
    def centers(self) -> np.ndarray:
        """[F, 3]"""
        return self.poses[:, :3, 3]

    def sees(self, points: np.ndarray, poses: np.ndarray | None = None) -> np.ndarray:
        """Which camera has which point in its image, bool [F, P]; points [P, 3], or [F, P, 3] one set per camera."""
        poses = self.poses if poses is None else poses
        local = np.einsum("fpi,fij->fpj", points - poses[:, None, :3, 3], poses[:, :3, :3])
        fx, fy, cx, cy = self.intrinsics.T[..., None]  # each [F, 1]
        width, height = self.sizes.T[..., None]
        with np.errstate(all="ignore"):
            u, v = project(local, fx, fy, cx, cy, nearest=BEHIND)
            return (local[..., 2] > BEHIND) & (u > 0) & (u < width) & (v > 0) & (v < height)


@dataclass(frozen=True)
class _Scene:
    """Where the points are and how far the cameras are from them, robust against strays."""

    cameras: _Cameras
    points: np.ndarray  # [P, 3], a sample
    center: np.ndarray  # [3]
    spread: float  # mm, 90% of the points are within this of the centre
    distance: float  # mm, of the median camera from the centre

    @classmethod
    def of(cls, parsed: Parsed, points: np.ndarray) -> _Scene:
        cameras = _Cameras.of(parsed)
        center = np.median(points, axis=0)
        distance = float(np.median(np.linalg.norm(cameras.centers - center, axis=1)))
        return cls(cameras, points[:: max(1, len(points) // 500)], center, _spread(points), distance)

    @property
    def size(self) -> float:
        return max(self.spread, self.distance)


def check_geometry(parsed: Parsed) -> dict[str, MotionVerdict]:
    """Check points, cameras against points, then instruments against both (not against cameras that are wrong). Returns
    what the images say of instruments that are out of view, by name."""
    report = parsed.places[0].report
    before = len(errors_only(report.problems))
    points = _usable_points(parsed)
    placed = parsed.with_cameras()
    scene = None if points is None or not placed.frames else _Scene.of(placed, points)
    if scene is not None:
        _check_cameras(placed, scene)
    if placed.frames and len(errors_only(report.problems)) == before:
        return _check_instruments(placed, scene)
    return {}


def _usable_points(parsed: Parsed) -> np.ndarray | None:
    """The measured points [P, 3] float64. Reports that there are none, few, or all in one spot; None when unusable."""
    place = parsed.points_place
    assert place is not None  # there are frames
    if parsed.points is None or not parsed.points.measured:
        if not place.reported:
            place.warning("no sparse points", "training starts from random ones, and gets less")
        return None
    points = parsed.points.positions.astype(np.float64)
    if len(points) == 0:
        place.error("holds no points", "add SfM points or drop ply_file_path")
        return None
    if len(points) < FEW_POINTS:
        message = f"few sparse points: {len(points)}, fewer than {FEW_POINTS}"
        place.warning(message, "give SfM's whole cloud if you can")
    if _spread(points) < 1e-9:
        place.error("all points are in one spot", "repair the point cloud")
        return None
    return points


def _spread(points: np.ndarray) -> float:
    """mm, 90% of the points [P, 3] are within this of their centre."""
    return float(np.quantile(np.linalg.norm(points - np.median(points, axis=0), axis=1), 0.9))


def _check_cameras(parsed: Parsed, scene: _Scene) -> None:
    """Report cameras far from the points, and mistakes in camera poses."""
    matrices = parsed.header("frames[*].transform_matrix")
    if parsed.instruments and scene.distance < METRES:
        message = f"cameras are {scene.distance:.3g} mm from the points: metres?"
        parsed.header("frames").error(message, "give cameras, points and poses in mm")
        return
    seen = scene.cameras.sees(scene.points[None]).mean(axis=1)  # [F] share of the points in each image
    mistake = _camera_mistake(parsed, scene, float(seen.mean())) if seen.mean() < SEEN_RARELY else None
    if mistake is not None:
        matrices.error(f"points are outside the images: {mistake[0]}", mistake[1])
        return
    if not seen.any():
        remedy = "camera-to-world with OpenGL axes, in the points' frame and unit (mm), is expected"
        matrices.error("no camera has any point in its image", remedy)
        return
    if scene.distance > 10 * FAR * scene.spread:
        message = f"cameras are far from the points: {scene.distance:.4g} mm, the points span {2 * scene.spread:.4g} mm"
        matrices.error(message, "metres for mm?")
        return
    distances = np.linalg.norm(scene.cameras.centers - scene.center, axis=1)
    for place, distance, share in zip(parsed.places, distances, seen, strict=True):
        if distance > FAR * scene.size:
            message = f"camera is far from the points: {distance:.4g} mm, others {scene.distance:.4g} mm"
            place.child("transform_matrix").error(message, "repair the pose or drop the frame")
        elif share == 0:
            remedy = "a wrong pose, or a part of the scene that SfM missed"
            place.child("transform_matrix").warning("the camera has no point in its image", remedy)


def _camera_mistake(parsed: Parsed, scene: _Scene, given: float) -> Mistake | None:
    """The mistake that best explains points out of view, or None. Where the points' colours can tell, they must."""
    cameras, points = scene.cameras, scene.points[None]
    opengl = swap_camera_axes(cameras.poses)  # as written in the file
    if np.linalg.norm(opengl[:, :3, 3], axis=1).max() < METRES < 0.1 * scene.spread:
        return "camera positions are in metres", ALL_IN_MM
    inverted = np.linalg.inv(opengl)
    farther = cameras.poses.copy()
    farther[:, :3, 3] *= 1000.0
    guesses = [
        (opengl, "camera axes are OpenCV's", "flip y and z: transform_matrix has OpenGL axes"),
        (swap_camera_axes(inverted), "matrices are world-to-camera", "invert them: camera-to-world is expected"),
        (inverted, "matrices are world-to-camera with OpenCV axes", "invert them, then flip y and z"),
        (farther, "camera positions are in metres", ALL_IN_MM),
    ]
    nearer = cameras.poses.copy()
    nearer[:, :3, 3] /= 1000.0
    guesses.append((nearer, "points are in metres", ALL_IN_MM))
    colors = None if errors_only(parsed.places[0].report.problems) else agreements(parsed, [one[0] for one in guesses])
    if colors is not None:
        best = int(np.argmax(colors))
        return guesses[best][1:] if colors[best] > COLORS_AGREE else None
    return _likeliest({(what, remedy): cameras.sees(points, poses) for poses, what, remedy in guesses}, given)


def _likeliest(seen: dict[Mistake, np.ndarray], given: float) -> Mistake | None:
    """The mistake that brings the greatest share back into view, if it explains much more than none does."""
    shares = {mistake: float(visible.mean()) for mistake, visible in seen.items()}
    best = max(shares, key=lambda mistake: shares[mistake])
    return best if shares[best] > max(SEEN_AGAIN, 3 * given) else None


def _check_instruments(parsed: Parsed, scene: _Scene | None) -> dict[str, MotionVerdict]:
    """Report instruments far from the scene or outside every image, and the mistakes behind it; returns what the images
    say of them."""
    verdicts: dict[str, MotionVerdict] = {}
    if not parsed.registered and parsed.instruments:
        message = "instrument poses are 'unregistered': in a tracker's or robot's own frame, not the cameras' world"
        remedy = (
            "where an instrument is in the images must be learned, and cannot be checked here; register it if you can"
        )
        parsed.header("instrument_frame").warning(message, remedy)
    everyone = _Cameras.of(parsed)
    for instrument in parsed.instruments:
        found = parsed.states_of(instrument.name)
        if not found:
            continue
        name = printable(instrument.name)
        poses = np.stack([state.pose.numpy() for _, state in found])  # [I, 4, 4]
        origins = poses[:, :3, 3]
        farthest = float(np.linalg.norm(origins, axis=1).max())
        if np.ptp(origins, axis=0).max() > 0 and farthest < METRES:
            message = f"positions of {name} stay within {farthest:.2g} mm of the frame's origin: metres?"
            parsed.header(POSES).error(message, "give them in mm")
        elif parsed.registered:
            has = np.array([instrument.name in frame.state.instruments for frame in parsed.frames])
            cameras = _Cameras(everyone.poses[has], everyone.intrinsics[has], everyone.sizes[has])
            verdict = _check_placement(parsed, instrument, cameras, scene, poses, [place for place, _ in found])
            if verdict is not None:
                verdicts[instrument.name] = verdict
    return verdicts


def _check_placement(
    parsed: Parsed,
    instrument: Instrument,
    cameras: _Cameras,
    scene: _Scene | None,
    poses: np.ndarray,
    places: list[Node],
) -> MotionVerdict | None:
    """Check one registered instrument: the cameras, poses [I, 4, 4] and places of the frames that have it. Returns what
    the images tell of it, where they were asked."""
    name, all_poses = printable(instrument.name), parsed.header(POSES)
    seen = cameras.sees(poses[:, None, :3, 3])[:, 0]  # [I]
    outside = "every image" if not seen.any() else f"{len(seen) - int(seen.sum())} of {len(seen)} images"
    mistake, verdict = None, None
    if seen.mean() < SEEN_RARELY:
        rays = _rays(parsed, instrument)
        if rays is None:
            mistake = _instrument_mistake(cameras, poses, float(seen.mean()))
        else:  # the images decide where they can
            verdict = judge_motion(parsed, instrument, rays)
            fault = verdict.fault
            if fault is not None and fault.named and fault.field == POSES:
                mistake = fault.message, fault.remedy
    if mistake is not None:
        all_poses.error(f"instrument {name} is outside {outside}: {mistake[0]}", mistake[1])
        return None
    if scene is not None:
        distances = np.linalg.norm(poses[:, :3, 3] - scene.center, axis=1)
        far = np.flatnonzero(distances > FAR * scene.size + SENSOR_REACH_MM * (scene.distance > METRES))
        for index in far:
            message = f"instrument {name} is far from the points: {distances[index]:.4g} mm"
            places[index].child("pose").error(message, "pose and points must share frame and unit (mm)")
        if len(far):
            return verdict
    elif np.median(np.linalg.norm(poses[:, :3, 3] - cameras.centers, axis=1)) < METRES:
        all_poses.error(f"instrument {name} is within {METRES:g} mm of the cameras: metres?", ALL_IN_MM)
        return verdict
    if verdict is not None and (verdict.supported or verdict.fault is not None):
        return verdict  # more than where an origin is
    if not seen.any():  # a sensor away from the instrument's visible part, or a wrong frame
        (x, y, z), share = _visible_body_point(cameras, poses)
        if share > 0.5:
            point = f"({x:.0f}, {y:.0f}, {z:.0f})"
            remedy = f"right only if the sensor sits away from the tip: the point {point} mm is in view"
        else:
            expected = "world_from_instrument in mm, in the cameras' world, is expected"
            remedy = f"{expected} (quaternion order, axes, registration?)"
        (all_poses.warning if share > 0.5 else all_poses.error)(f"the origin of {name} is outside every image", remedy)
    elif seen.mean() < SEEN_RARELY:
        message = f"the origin of {name} is outside {outside}"
        all_poses.warning(message, "right if its sensor sits far behind")
    else:  # single poses far away from all others, and out of view: tracker drop-outs
        origins = poses[:, :3, 3]
        distances = np.linalg.norm(origins - np.median(origins, axis=0), axis=1)
        usual = max(float(np.median(distances)), METRES)
        for index in np.flatnonzero((distances > FAR * usual) & ~seen):
            message = f"instrument {name} is {distances[index]:.4g} mm from where it usually is, and out of view"
            remedy = "a tracker drop-out or unit slip? repair the pose or drop the frame"
            places[index].child("pose").warning(message, remedy)
    return verdict


def _rays(parsed: Parsed, instrument: Instrument) -> Rays | None:
    """What moves in the images, where they can be read and show where the instrument is."""
    states = [instrument.name in frame.state.instruments for frame in parsed.frames]
    return None if errors_only(parsed.places[0].report.problems) or not all(states) else Rays.of(parsed)


def _visible_body_point(cameras: _Cameras, poses: np.ndarray) -> tuple[np.ndarray, float]:
    """The point [3] fixed to the instrument, within a sensor's reach, that most images show, and the share that do.

    Least squares: the body point nearest to all optical axes.
    """
    axes = cameras.poses[:, :3, 2]
    across = across_projectors(axes)
    rows = (across @ poses[:, :3, :3]).reshape(-1, 3)
    target = (across @ (cameras.centers - poses[:, :3, 3])[:, :, None]).reshape(-1)
    point = np.linalg.lstsq(rows, target, rcond=1e-6)[0]
    if np.linalg.norm(point) > SENSOR_REACH_MM:
        return point, 0.0
    world = np.einsum("fij,j->fi", poses[:, :3, :3], point) + poses[:, :3, 3]
    return point, float(cameras.sees(world[:, None])[:, 0].mean())


def _instrument_mistake(cameras: _Cameras, poses: np.ndarray, given: float) -> Mistake | None:
    """The mistake that best explains an instrument out of view, or None."""
    # a sensor behind the visible part needs no mistake to be out of view: where that explains things, nothing is wrong
    if _visible_body_point(cameras, poses)[1] > SEEN_SURELY:
        return None
    origins = poses[:, :3, 3]
    in_camera = np.einsum("fij,fj->fi", cameras.poses[:, :3, :3], origins) + cameras.centers
    flipped = np.einsum("fij,fj->fi", cameras.poses[:, :3, :3], origins * [1, -1, -1]) + cameras.centers
    in_world = "turn the poses into the cameras' world frame"
    inverted = np.linalg.inv(poses)[:, :3, 3]
    guesses = {
        ("poses are instrument-from-world", "invert them: world_from_instrument is expected"): inverted,
        ("its world has y and z flipped (OpenGL axes)", in_world): origins * [1, -1, -1],
        ("its world has y and z swapped (y up)", in_world): origins[:, [0, 2, 1]] * [1, -1, 1],
        ("its world has z and y swapped (z up)", in_world): origins[:, [0, 2, 1]] * [1, 1, -1],
        ("poses are in the camera's frame", "multiply by world_from_camera"): in_camera,
        ("poses are in the camera's frame with OpenGL axes", "multiply by transform_matrix"): flipped,
    }
    # shrinking puts everything at the world's origin, in view or not: a unit slip must also be far out to begin with
    if np.median(np.linalg.norm(origins, axis=1)) > 30 * np.linalg.norm(cameras.centers, axis=1).max():
        guesses["cameras and points are in metres, its positions in mm", ALL_IN_MM] = origins / 1000.0
    return _likeliest({mistake: cameras.sees(moved[:, None]) for mistake, moved in guesses.items()}, given)
