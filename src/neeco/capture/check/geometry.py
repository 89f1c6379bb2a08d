"""Check that cameras, points and instruments fit together: distances, units, axes, and who sees what.

A mistake of units or axes leaves things out of view. Where that happens the usual mistakes are tried, and one that
brings things back into view is named.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from neeco.capture.check.frames import states_of
from neeco.capture.parsed import Parsed, Place
from neeco.capture.poses import swap_camera_axes
from neeco.capture.problems import ProblemReport, errors_only, shown
from neeco.raster.geometry import project

FEW_POINTS = 100
FAR = 10.0  # in sizes of the scene
SEEN_RARELY = 0.1  # a share of the points, or of the frames, that makes one look for a mistake
SEEN_SURELY = 0.7  # a share that settles it
SEEN_AGAIN = 0.3  # a share that makes a mistake the likely one
METRES = 1.0  # mm; an endoscope is never this close, nor an instrument's travel this short
BEHIND = 1e-9  # mm; what is less deep is not in front of a camera
SENSOR_REACH_MM = 500.0  # how far from the visible part of an instrument its sensor may sit


@dataclass(frozen=True)
class _Cameras:
    """All frames' cameras as arrays."""

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

    def sees(self, points: np.ndarray, poses: np.ndarray | None = None) -> np.ndarray:
        """Which camera has which point in its image, bool [F, P]; points [P, 3], or [F, P, 3] one set per camera."""
        poses = self.poses if poses is None else poses
        local = np.einsum("fpi,fij->fpj", points - poses[:, None, :3, 3], poses[:, :3, :3])
        fx, fy, cx, cy = self.intrinsics.T[..., None]  # each [F, 1]
        width, height = self.sizes.T[..., None]
        with np.errstate(all="ignore"):
            u, v = project(local, fx, fy, cx, cy, nearest=BEHIND)
            return (local[..., 2] > BEHIND) & (u > 0) & (u < width) & (v > 0) & (v < height)


def check_geometry(parsed: Parsed, report: ProblemReport) -> None:
    """Check points, cameras against points, then instruments against both (not against cameras that are wrong)."""
    before = len(errors_only(report.problems))
    points = usable_points(parsed, report)
    placed = parsed.with_cameras()
    if points is not None and placed.frames:
        check_cameras(placed, points, report)
    if placed.frames and len(errors_only(report.problems)) == before:
        check_instruments(placed, report)


def usable_points(parsed: Parsed, report: ProblemReport) -> np.ndarray | None:
    """The measured points [P, 3] float64. Reports that there are none, few, or all in one spot; None when unusable."""
    place = parsed.points_place
    if parsed.points is None or not parsed.points.measured:
        already = any(problem.file == place.file and problem.field == place.field for problem in report.problems)
        if not already:
            report.warning(
                place.file, place.field, "no sparse points", "training starts from random ones, and gets less"
            )
        return None
    points = parsed.points.positions.astype(np.float64)
    if len(points) == 0:
        report.error(place.file, place.field, "holds no points", "add SfM points or drop ply_file_path")
        return None
    if len(points) < FEW_POINTS:
        message = f"few sparse points: {len(points)}, fewer than {FEW_POINTS}"
        report.warning(place.file, place.field, message, "give SfM's whole cloud if you can")
    if _spread(points) < 1e-9:
        report.error(place.file, place.field, "all points are in one spot", "repair the point cloud")
        return None
    return points


def _spread(points: np.ndarray) -> float:
    """mm, 90% of the points [P, 3] are within this of their centre."""
    return float(np.quantile(np.linalg.norm(points - np.median(points, axis=0), axis=1), 0.9))


def check_cameras(parsed: Parsed, points: np.ndarray, report: ProblemReport) -> None:
    """Report cameras far from the points, and mistakes in camera poses."""
    scene = _Scene.of(parsed, points)
    if parsed.instruments and scene.distance < METRES:
        message = f"cameras are {scene.distance:.3g} mm from the points: metres?"
        report.error(parsed.places[0].file, "frames", message, "give cameras, points and poses in mm")
        return
    _check_camera_views(parsed, scene, report)


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
        distance = float(np.median(np.linalg.norm(cameras.poses[:, :3, 3] - center, axis=1)))
        return cls(cameras, points[:: max(1, len(points) // 500)], center, _spread(points), distance)

    @property
    def size(self) -> float:
        return max(self.spread, self.distance)


def _check_camera_views(parsed: Parsed, scene: _Scene, report: ProblemReport) -> None:
    cameras, points = scene.cameras, scene.points
    seen = cameras.sees(points[None]).mean(axis=1)  # [F] share of the points in each image
    file = parsed.places[0].file
    mistake = _camera_mistake(scene, float(seen.mean())) if seen.mean() < SEEN_RARELY else None
    if mistake is not None:
        report.error(file, "frames[*].transform_matrix", f"points are outside the images: {mistake[0]}", mistake[1])
        return
    if not seen.any():
        message = "no camera has any point in its image"
        remedy = "camera-to-world with OpenGL axes, in the points' frame and unit (mm), is expected"
        report.error(file, "frames[*].transform_matrix", message, remedy)
        return
    if scene.distance > 10 * FAR * scene.spread:
        message = f"cameras are far from the points: {scene.distance:.4g} mm, the points span {2 * scene.spread:.4g} mm"
        report.error(file, "frames[*].transform_matrix", message, "metres for mm?")
        return
    distances = np.linalg.norm(cameras.poses[:, :3, 3] - scene.center, axis=1)
    for index, place in enumerate(parsed.places):
        field = f"{place.field}.transform_matrix"
        if distances[index] > FAR * scene.size:
            message = f"camera is far from the points: {distances[index]:.4g} mm, others {scene.distance:.4g} mm"
            report.error(place.file, field, message, "repair the pose or drop the frame")
        elif seen[index] == 0:
            message = "the camera has no point in its image"
            report.warning(place.file, field, message, "a wrong pose, or a part of the scene that SfM missed")


def _camera_mistake(scene: _Scene, given: float) -> tuple[str, str] | None:
    """The mistake (what, remedy) that best explains points out of view, or None."""
    cameras, points = scene.cameras, scene.points[None]
    opengl = swap_camera_axes(cameras.poses)  # as written in the file
    metres = "give all lengths in mm"
    if np.linalg.norm(opengl[:, :3, 3], axis=1).max() < METRES < 0.1 * scene.spread:
        return "camera positions are in metres", metres
    inverted = np.linalg.inv(opengl)
    farther = cameras.poses.copy()
    farther[:, :3, 3] *= 1000.0
    guesses = {
        ("camera axes are OpenCV's", "flip y and z: transform_matrix has OpenGL axes"): (opengl, points),
        ("matrices are world-to-camera", "invert them: camera-to-world is expected"): (
            swap_camera_axes(inverted),
            points,
        ),
        ("matrices are world-to-camera with OpenCV axes", "invert them, then flip y and z"): (inverted, points),
        ("camera positions are in metres", metres): (farther, points),
        ("points are in metres", metres): (cameras.poses, points * 1000.0),
    }
    return _likeliest(
        {name: float(cameras.sees(moved, poses).mean()) for name, (poses, moved) in guesses.items()}, given
    )


def _likeliest(shares: dict[tuple[str, str], float], given: float) -> tuple[str, str] | None:
    """The mistake that brings the greatest share back into view, if it explains much more than none does."""
    best = max(shares, key=lambda name: shares[name])
    return best if shares[best] > max(SEEN_AGAIN, 3 * given) else None


def check_instruments(parsed: Parsed, report: ProblemReport) -> None:
    """Report instruments far from the scene or outside every image, and the mistakes behind it."""
    if not parsed.registered and parsed.instruments:
        message = "instrument poses are 'unregistered': in a tracker's or robot's own frame, not the cameras' world"
        remedy = (
            "where an instrument is in the images must be learned, and cannot be checked here; register it if you can"
        )
        report.warning(parsed.places[0].file, "instrument_frame", message, remedy)
    for instrument in parsed.instruments:
        found = list(states_of(parsed, instrument.name))
        if not found:
            continue
        poses = np.stack([state.pose.numpy() for _, state in found])
        if not _report_metres(instrument.name, poses, found[0][0], report) and parsed.registered:
            has = [instrument.name in frame.state.instruments for frame in parsed.frames]
            _check_placement(parsed, instrument.name, np.array(has), poses, [place for place, _ in found], report)


def _report_metres(name: str, poses: np.ndarray, place: Place, report: ProblemReport) -> bool:
    """Report an instrument that moves, but never a millimetre from its frame's origin; True if so."""
    origins = poses[:, :3, 3]
    farthest = float(np.linalg.norm(origins, axis=1).max())
    if np.ptp(origins, axis=0).max() == 0 or farthest >= METRES:
        return False
    message = f"positions of {shown(name)} stay within {farthest:.2g} mm of the frame's origin: metres?"
    report.error(place.file, "frames[*].instruments[*].pose", message, "give them in mm")
    return True


def _check_placement(
    parsed: Parsed, name: str, has: np.ndarray, poses: np.ndarray, places: list[Place], report: ProblemReport
) -> None:
    """Check one registered instrument; poses [I, 4, 4] of the frames that have it."""
    everyone = _Cameras.of(parsed)
    cameras = _Cameras(everyone.poses[has], everyone.intrinsics[has], everyone.sizes[has])
    seen = cameras.sees(poses[:, None, :3, 3])[:, 0]  # [I]
    if seen.mean() < SEEN_RARELY and (mistake := _instrument_mistake(cameras, poses, float(seen.mean()))) is not None:
        message = f"instrument {shown(name)} is outside {_how_many(seen)}: {mistake[0]}"
        report.error(places[0].file, "frames[*].instruments[*].pose", message, mistake[1])
        return
    if parsed.points is not None and parsed.points.measured and len(parsed.points.positions):
        scene = _Scene.of(parsed, parsed.points.positions.astype(np.float64))
        if _report_far(name, poses, scene, places, report):
            return
    elif parsed.instruments and np.median(np.linalg.norm(poses[:, :3, 3] - cameras.poses[:, :3, 3], axis=1)) < METRES:
        message = f"instrument {shown(name)} is within {METRES:g} mm of the cameras: metres?"
        report.error(places[0].file, "frames[*].instruments[*].pose", message, "give all lengths in mm")
        return
    if not seen.any():
        _report_never_seen(name, cameras, poses, places, report)
    elif seen.mean() < SEEN_RARELY:
        message = f"the origin of {shown(name)} is outside {_how_many(seen)}"
        report.warning(places[0].file, "frames[*].instruments[*].pose", message, "right if its sensor sits far behind")
    else:
        _report_jumps(name, poses, seen, places, report)


def _how_many(seen: np.ndarray) -> str:
    return "every image" if not seen.any() else f"{len(seen) - int(seen.sum())} of {len(seen)} images"


def _report_far(name: str, poses: np.ndarray, scene: _Scene, places: list[Place], report: ProblemReport) -> bool:
    """Report poses far from the points; True when there were any."""
    distances = np.linalg.norm(poses[:, :3, 3] - scene.center, axis=1)
    limit = FAR * scene.size + SENSOR_REACH_MM * (scene.distance > METRES)
    for index in np.flatnonzero(distances > limit):
        message = f"instrument {shown(name)} is far from the points: {distances[index]:.4g} mm"
        remedy = "pose and points must share frame and unit (mm)"
        report.error(places[index].file, f"{places[index].field}.pose", message, remedy)
    return bool((distances > limit).any())


def _report_never_seen(
    name: str, cameras: _Cameras, poses: np.ndarray, places: list[Place], report: ProblemReport
) -> None:
    """An origin outside every image: a sensor away from the instrument's visible part, or a wrong frame."""
    field = "frames[*].instruments[*].pose"
    message = f"the origin of {shown(name)} is outside every image"
    (x, y, z), share = _visible_body_point(cameras, poses)
    if share > 0.5:
        remedy = f"right only if the sensor sits away from the tip: the point ({x:.0f}, {y:.0f}, {z:.0f}) mm is in view"
        report.warning(places[0].file, field, message, remedy)
    else:
        remedy = (
            "world_from_instrument in mm, in the cameras' world, is expected (quaternion order, axes, registration?)"
        )
        report.error(places[0].file, field, message, remedy)


def _visible_body_point(cameras: _Cameras, poses: np.ndarray) -> tuple[np.ndarray, float]:
    """The point [3] fixed to the instrument, within a sensor's reach, that most images show, and the share that do.

    Least squares: the body point nearest to all optical axes.
    """
    axes, centers = cameras.poses[:, :3, 2], cameras.poses[:, :3, 3]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    rows = (across @ poses[:, :3, :3]).reshape(-1, 3)
    target = (across @ (centers - poses[:, :3, 3])[:, :, None]).reshape(-1)
    point = np.linalg.lstsq(rows, target, rcond=1e-6)[0]
    if np.linalg.norm(point) > SENSOR_REACH_MM:
        return point, 0.0
    world = np.einsum("fij,j->fi", poses[:, :3, :3], point) + poses[:, :3, 3]
    return point, float(cameras.sees(world[:, None])[:, 0].mean())


def _instrument_mistake(cameras: _Cameras, poses: np.ndarray, given: float) -> tuple[str, str] | None:
    """The mistake (what, remedy) that best explains an instrument out of view, or None."""
    origins = poses[:, :3, 3]
    in_camera = np.einsum("fij,fj->fi", cameras.poses[:, :3, :3], origins) + cameras.poses[:, :3, 3]
    flipped = np.einsum("fij,fj->fi", cameras.poses[:, :3, :3], origins * [1, -1, -1]) + cameras.poses[:, :3, 3]
    inverted = np.linalg.inv(poses)[:, :3, 3]
    in_world = "turn the poses into the cameras' world frame"
    guesses = {
        ("poses are instrument-from-world", "invert them: world_from_instrument is expected"): inverted,
        ("its world has y and z flipped (OpenGL axes)", in_world): origins * [1, -1, -1],
        ("its world has y and z swapped (y up)", in_world): origins[:, [0, 2, 1]] * [1, -1, 1],
        ("its world has z and y swapped (z up)", in_world): origins[:, [0, 2, 1]] * [1, 1, -1],
        ("poses are in the camera's frame", "multiply by world_from_camera"): in_camera,
        ("poses are in the camera's frame with OpenGL axes", "multiply by transform_matrix"): flipped,
    }
    # shrinking puts everything at the world's origin, in view or not: a unit slip must also be far out to begin with
    if np.median(np.linalg.norm(origins, axis=1)) > 30 * np.linalg.norm(cameras.poses[:, :3, 3], axis=1).max():
        guesses["cameras and points are in metres, its positions in mm", "give all lengths in mm"] = origins / 1000.0
    # a sensor behind the visible part needs no mistake to be out of view: where that explains things, nothing is wrong
    if _visible_body_point(cameras, poses)[1] > SEEN_SURELY:
        return None
    return _likeliest({name: float(cameras.sees(moved[:, None]).mean()) for name, moved in guesses.items()}, given)


def _report_jumps(name: str, poses: np.ndarray, seen: np.ndarray, places: list[Place], report: ProblemReport) -> None:
    """Single poses far away from all others, and out of view: tracker drop-outs."""
    origins = poses[:, :3, 3]
    distances = np.linalg.norm(origins - np.median(origins, axis=0), axis=1)
    usual = max(float(np.median(distances)), METRES)
    for index in np.flatnonzero((distances > FAR * usual) & ~seen):
        message = f"instrument {shown(name)} is {distances[index]:.4g} mm from where it usually is, and out of view"
        remedy = "a tracker drop-out or unit slip? repair the pose or drop the frame"
        report.warning(places[index].file, f"{places[index].field}.pose", message, remedy)
