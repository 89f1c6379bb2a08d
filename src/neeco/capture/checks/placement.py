"""Consistency checks of cameras, points and instruments: distances, units, and visibility.

For points or instruments out of view, the images determine the mistake.
"""

from __future__ import annotations

import numpy as np

from neeco.capture.checks.evidence import CameraArrays
from neeco.capture.checks.settings import SETTINGS
from neeco.capture.checks.verdicts import POSES, ImageVerdicts
from neeco.capture.documents import errors_only, printable
from neeco.capture.model import HOW_TO_REGISTER, Instrument
from neeco.capture.points import sampled
from neeco.capture.readers.parsed import Parsed
from neeco.geometry.lines import across_projectors

ALL_IN_MM = "give all lengths in mm"


def check_placement(parsed: Parsed, verdicts: ImageVerdicts) -> None:
    """Check points, cameras against points, then instruments against both (unless the cameras are wrong)."""
    report = parsed.places[0].report
    before = len(errors_only(report.problems))
    points, placed = _usable_points(parsed), parsed.with_cameras()
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


def _usable_points(parsed: Parsed) -> np.ndarray | None:
    """Return the measured points [P, 3] float64; None, and reported, if there are none or all coincide. Reports few."""
    place = parsed.points_place
    assert place is not None  # there are frames
    if parsed.points is None or not parsed.points.measured:
        if not place.reported:
            place.warning("no sparse points", "training starts from random points, with a poorer result")
        return None
    points = parsed.points.positions.astype(np.float64)
    if len(points) == 0:
        place.error("contains no points", "add SfM points or remove ply_file_path")
        return None
    if len(points) < SETTINGS.few_points:
        message = f"few sparse points: {len(points)}, fewer than {SETTINGS.few_points}"
        place.warning(message, "use the complete SfM point cloud if possible")
    if _radius(points) < 1e-9:
        place.error("all points coincide", "repair the point cloud")
        return None
    return points


def _radius(points: np.ndarray) -> float:
    """Return the 90 % quantile of distances, mm, of points [P, 3] to their median."""
    return float(np.quantile(np.linalg.norm(points - np.median(points, axis=0), axis=1), 0.9))


def _check_cameras(parsed: Parsed, points: np.ndarray, verdicts: ImageVerdicts) -> None:
    """Report cameras far from the points, or with no point in their images."""
    matrices = parsed.header("frames[*].transform_matrix")
    cameras = CameraArrays.of([frame.camera for frame in parsed.frames])
    distances = np.linalg.norm(cameras.centers - np.median(points, axis=0), axis=1)
    distance, radius = float(np.median(distances)), _radius(points)
    visible = cameras.sees(sampled(points)[None]).mean(axis=1)  # [F] share of the points in each image
    too_near = bool(parsed.instruments) and distance < SETTINGS.min_distance_mm
    if too_near or distance > SETTINGS.far_distance * radius:
        message = f"cameras are {distance:.4g} mm from the points, which span {2 * radius:.4g} mm: probably metres"
        matrices.error(message, ALL_IN_MM)
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
    visible = cameras.sees(origins[:, None])[:, 0]  # [I]
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
        behind = visible.any() or _body_visible(cameras, poses) > SETTINGS.min_body_visible
        remedy = "correct only if its sensor is far behind the tip"
        remedy += "" if behind else "; world_from_instrument in mm, in the cameras' world, is expected"
        (all_poses.warning if behind else all_poses.error)(f"the origin of {name} is outside {outside}", remedy)


def _body_visible(cameras: CameraArrays, poses: np.ndarray) -> float:
    """Return the share of images that show the instrument-fixed point nearest to all optical axes; 0 if it is beyond a
    sensor's reach."""
    across = across_projectors(cameras.poses[:, :3, 2])
    rows = (across @ poses[:, :3, :3]).reshape(-1, 3)
    target = (across @ (cameras.centers - poses[:, :3, 3])[:, :, None]).reshape(-1)
    point = np.linalg.lstsq(rows, target, rcond=1e-6)[0]
    world = np.einsum("fij,j->fi", poses[:, :3, :3], point) + poses[:, :3, 3]
    reached = np.linalg.norm(point) < SETTINGS.sensor_reach_mm
    return float(cameras.sees(world[:, None])[:, 0].mean()) if reached else 0.0
