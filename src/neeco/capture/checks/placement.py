"""Check that cameras, points and instruments fit together: distances, units, axes, and what is in view.

A mistake of units or axes moves things out of view. Where that happens the usual mistakes are tried, and one that
brings things back into view is named: where images and points can confirm it, only if they do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from neeco.capture.checks.cameras import CameraArrays
from neeco.capture.checks.colors import agreements
from neeco.capture.checks.mistakes import camera_axes_mistakes, frame_mistakes, unit_mistakes
from neeco.capture.checks.motion import POSES, MotionVerdict, judge_motion
from neeco.capture.checks.motion_evidence import MotionEvidence
from neeco.capture.checks.pictures import Pictures
from neeco.capture.documents import Node, errors_only, printable
from neeco.capture.model import HOW_TO_REGISTER, Instrument, InstrumentState
from neeco.capture.points import sampled
from neeco.capture.readers.parsed import Parsed
from neeco.geometry.lines import across_projectors
from neeco.plausible import Fault

FEW_POINTS = 100
MAX_DISTANCE = 10.0  # sizes of the scene
MIN_VISIBLE = 0.1  # share of the points, or of the frames, below which a mistake is looked for
MIN_EXPLAINED = 0.3  # share in view that a mistake must restore to be named
MIN_BODY_VISIBLE = 0.7  # share of the frames that show a point fixed to the instrument: no mistake is needed
MIN_COLOR_CORRELATION = 0.2  # of the points' colours with the images' that confirms a mistake
MIN_DISTANCE_MM = 1.0  # an endoscope is never this close, nor an instrument's travel this short: lengths are in metres
SENSOR_REACH_MM = 500.0  # how far from the visible part of an instrument its sensor may sit
ALL_IN_MM = "give all lengths in mm"


@dataclass(frozen=True)
class _Extent:
    """Position of the points and the cameras' distance from them, robust against outliers."""

    cameras: CameraArrays
    points: np.ndarray  # [P, 3], a sample
    center: np.ndarray  # [3]
    radius: float  # mm, 90% of the points are within this of the centre
    distance: float  # mm, of the median camera from the centre

    @classmethod
    def of(cls, parsed: Parsed, points: np.ndarray) -> _Extent:
        cameras = CameraArrays.of([frame.camera for frame in parsed.frames])
        center = np.median(points, axis=0)
        distance = float(np.median(np.linalg.norm(cameras.centers - center, axis=1)))
        return cls(cameras, sampled(points), center, _radius(points), distance)

    @property
    def size(self) -> float:
        return max(self.radius, self.distance)


def check_placement(parsed: Parsed, pictures: Pictures) -> dict[str, MotionVerdict]:
    """Check points, cameras against points, then instruments against both (not against cameras that are wrong).

    Returns what the images say of instruments that are out of view, by name.
    """
    report = parsed.places[0].report
    before = len(errors_only(report.problems))
    points = _usable_points(parsed)
    placed = parsed.with_cameras()
    extent = None if points is None or not placed.frames else _Extent.of(placed, points)
    if extent is not None:
        _check_cameras(placed, extent, pictures)
    if placed.frames and len(errors_only(report.problems)) == before:
        return _check_instruments(placed, extent, pictures)
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
    if _radius(points) < 1e-9:
        place.error("all points are in one spot", "repair the point cloud")
        return None
    return points


def _radius(points: np.ndarray) -> float:
    """Radius, mm, about their centre that 90% of the points [P, 3] are within."""
    return float(np.quantile(np.linalg.norm(points - np.median(points, axis=0), axis=1), 0.9))


def _check_cameras(parsed: Parsed, extent: _Extent, pictures: Pictures) -> None:
    """Report cameras far from the points, and mistakes in camera poses."""
    matrices = parsed.header("frames[*].transform_matrix")
    if parsed.instruments and extent.distance < MIN_DISTANCE_MM:
        message = f"cameras are {extent.distance:.3g} mm from the points: metres?"
        parsed.header("frames").error(message, "give cameras, points and poses in mm")
        return
    visible = extent.cameras.sees(extent.points[None]).mean(axis=1)  # [F] share of the points in each image
    fault = _camera_fault(parsed, extent, float(visible.mean()), pictures) if visible.mean() < MIN_VISIBLE else None
    if fault is not None:
        matrices.error(f"points are outside the images: {fault[0]}", fault[1])
        return
    if not visible.any():
        remedy = "camera-to-world with OpenGL axes, in the points' frame and unit (mm), is expected"
        matrices.error("no camera has any point in its image", remedy)
        return
    if extent.distance > 10 * MAX_DISTANCE * extent.radius:
        span = f"the points span {2 * extent.radius:.4g} mm"
        matrices.error(f"cameras are far from the points: {extent.distance:.4g} mm, {span}", "metres for mm?")
        return
    distances = np.linalg.norm(extent.cameras.centers - extent.center, axis=1)
    for place, distance, share in zip(parsed.places, distances, visible, strict=True):
        if distance > MAX_DISTANCE * extent.size:
            message = f"camera is far from the points: {distance:.4g} mm, others {extent.distance:.4g} mm"
            place.child("transform_matrix").error(message, "repair the pose or drop the frame")
        elif share == 0:
            remedy = "a wrong pose, or a part of the scene that SfM missed"
            place.child("transform_matrix").warning("the camera has no point in its image", remedy)


def _camera_fault(parsed: Parsed, extent: _Extent, given: float, pictures: Pictures) -> Fault | None:
    """Name the mistake that best explains points out of view. Where the points' colours can confirm it, they must."""
    cameras, points = extent.cameras, extent.points[None]
    if np.linalg.norm(cameras.centers, axis=1).max() < MIN_DISTANCE_MM < 0.1 * extent.radius:
        return "positions of the cameras are in metres", ALL_IN_MM
    mistakes = [*camera_axes_mistakes(cameras.poses), *unit_mistakes(cameras.poses, {"metres": 1000.0})]
    faults = [(mistake.what.format(of="of the cameras"), mistake.remedy) for mistake in mistakes]
    clean = not errors_only(parsed.places[0].report.problems)
    if clean and (colors := agreements(parsed, [mistake.poses for mistake in mistakes], pictures)) is not None:
        best = int(np.argmax(colors))
        return faults[best] if colors[best] > MIN_COLOR_CORRELATION else None
    views = [CameraArrays(mistake.poses, cameras.intrinsics, cameras.sizes).sees(points) for mistake in mistakes]
    return _most_visible(faults, views, given)


def _most_visible(faults: Sequence[Fault], visible: Sequence[np.ndarray], given: float) -> Fault | None:
    """The mistake without which the greatest share is in view, if that is much more than the share given."""
    shares = [float(seen.mean()) for seen in visible]
    best = int(np.argmax(shares))
    return faults[best] if shares[best] > max(MIN_EXPLAINED, 3 * given) else None


def _check_instruments(parsed: Parsed, extent: _Extent | None, pictures: Pictures) -> dict[str, MotionVerdict]:
    """Report instruments far from the scene or outside every image, and the mistakes behind it.

    Returns what the images say of them, where they were compared.
    """
    verdicts: dict[str, MotionVerdict] = {}
    if not parsed.registered and parsed.instruments:
        message = "instrument poses are 'unregistered': in a tracker's or robot's own frame, not the cameras' world"
        remedy = f"where an instrument is in the images cannot be checked; {HOW_TO_REGISTER}"
        parsed.header("instrument_frame").warning(message, remedy)
    cameras = CameraArrays.of([frame.camera for frame in parsed.frames])
    for instrument in parsed.instruments:
        found = parsed.states_of(instrument.name)
        if not found:
            continue
        name = printable(instrument.name)
        origins = np.stack([state.pose[:3, 3].numpy() for _, state in found])
        farthest = float(np.linalg.norm(origins, axis=1).max())
        if np.ptp(origins, axis=0).max() > 0 and farthest < MIN_DISTANCE_MM:
            message = f"positions of {name} stay within {farthest:.2g} mm of the frame's origin: metres?"
            parsed.header(POSES).error(message, "give them in mm")
        elif parsed.registered:
            has = np.array([instrument.name in frame.state.instruments for frame in parsed.frames])
            verdict = _check_instrument(parsed, instrument, found, cameras[has], extent, pictures)
            if verdict is not None:
                verdicts[instrument.name] = verdict
    return verdicts


def _check_instrument(
    parsed: Parsed,
    instrument: Instrument,
    found: list[tuple[Node, InstrumentState]],
    cameras: CameraArrays,
    extent: _Extent | None,
    pictures: Pictures,
) -> MotionVerdict | None:
    """Check one registered instrument, given its states, their places and the cameras of the frames that have it.

    Returns what the images say of it, where they were compared.
    """
    name, all_poses, places = printable(instrument.name), parsed.header(POSES), [place for place, _ in found]
    poses = np.stack([state.pose.numpy() for _, state in found])  # [I, 4, 4]
    origins = poses[:, :3, 3]
    visible = cameras.sees(origins[:, None])[:, 0]  # [I]
    outside = "every image" if not visible.any() else f"{len(visible) - int(visible.sum())} of {len(visible)} images"
    fault, verdict = None, None
    if visible.mean() < MIN_VISIBLE:
        everywhere = all(instrument.name in frame.state.instruments for frame in parsed.frames)
        clean = not errors_only(parsed.places[0].report.problems)
        evidence = MotionEvidence.of(parsed, pictures) if everywhere and clean else None
        if evidence is None:
            fault = _instrument_fault(cameras, poses, float(visible.mean()))
        else:  # the images decide where they can
            verdict = judge_motion(parsed, instrument, evidence)
            named = verdict.fault
            if named is not None and named.named and named.field == POSES:
                fault = named.message, named.remedy
    if fault is not None:
        all_poses.error(f"instrument {name} is outside {outside}: {fault[0]}", fault[1])
        return None
    if extent is not None:
        distances = np.linalg.norm(origins - extent.center, axis=1)
        reach = SENSOR_REACH_MM * (extent.distance > MIN_DISTANCE_MM)
        far = np.flatnonzero(distances > MAX_DISTANCE * extent.size + reach)
        for index in far:
            message = f"instrument {name} is far from the points: {distances[index]:.4g} mm"
            places[index].child("pose").error(message, "pose and points must share frame and unit (mm)")
        if len(far):
            return verdict
    elif np.median(np.linalg.norm(origins - cameras.centers, axis=1)) < MIN_DISTANCE_MM:
        all_poses.error(f"instrument {name} is within {MIN_DISTANCE_MM:g} mm of the cameras: metres?", ALL_IN_MM)
        return verdict
    if verdict is not None and (verdict.supported or verdict.fault is not None):
        return verdict  # more than where an origin is
    if not visible.any():  # a sensor away from the instrument's visible part, or a wrong frame
        (x, y, z), share = _visible_body_point(cameras, poses)
        if share > 0.5:
            point = f"({x:.0f}, {y:.0f}, {z:.0f})"
            remedy = f"right only if the sensor sits away from the tip: the point {point} mm is in view"
        else:
            expected = "world_from_instrument in mm, in the cameras' world, is expected"
            remedy = f"{expected} (quaternion order, axes, registration?)"
        (all_poses.warning if share > 0.5 else all_poses.error)(f"the origin of {name} is outside every image", remedy)
    elif visible.mean() < MIN_VISIBLE:
        message = f"the origin of {name} is outside {outside}"
        all_poses.warning(message, "right if its sensor sits far behind")
    else:  # single poses far away from all others, and out of view: tracker drop-outs
        distances = np.linalg.norm(origins - np.median(origins, axis=0), axis=1)
        usual = max(float(np.median(distances)), MIN_DISTANCE_MM)
        for index in np.flatnonzero((distances > MAX_DISTANCE * usual) & ~visible):
            message = f"instrument {name} is {distances[index]:.4g} mm from where it usually is, and out of view"
            remedy = "a tracker drop-out or unit slip? repair the pose or drop the frame"
            places[index].child("pose").warning(message, remedy)
    return verdict


def _visible_body_point(cameras: CameraArrays, poses: np.ndarray) -> tuple[np.ndarray, float]:
    """The point [3] fixed to the instrument, within a sensor's reach, that most images show, and the share that do.

    Least squares: the body point nearest to all optical axes.
    """
    across = across_projectors(cameras.poses[:, :3, 2])
    rows = (across @ poses[:, :3, :3]).reshape(-1, 3)
    target = (across @ (cameras.centers - poses[:, :3, 3])[:, :, None]).reshape(-1)
    point = np.linalg.lstsq(rows, target, rcond=1e-6)[0]
    if np.linalg.norm(point) > SENSOR_REACH_MM:
        return point, 0.0
    world = np.einsum("fij,j->fi", poses[:, :3, :3], point) + poses[:, :3, 3]
    return point, float(cameras.sees(world[:, None])[:, 0].mean())


def _instrument_fault(cameras: CameraArrays, poses: np.ndarray, given: float) -> Fault | None:
    """Name the mistake that best explains an instrument out of view, where the images cannot decide."""
    # a sensor behind the visible part needs no mistake to be out of view: where that explains things, nothing is wrong
    if _visible_body_point(cameras, poses)[1] > MIN_BODY_VISIBLE:
        return None
    origins = poses[:, :3, 3]
    in_world = "turn the poses into the cameras' world frame"
    inverted, *in_camera = (
        (mistake.what.replace(" {of}", ""), mistake.remedy, mistake.poses[:, :3, 3])
        for mistake in frame_mistakes(poses, cameras.poses)
    )
    tried = [
        inverted,
        ("its world has y and z flipped (OpenGL axes)", in_world, origins * [1, -1, -1]),
        ("its world has y and z swapped (y up)", in_world, origins[:, [0, 2, 1]] * [1, -1, 1]),
        ("its world has z and y swapped (z up)", in_world, origins[:, [0, 2, 1]] * [1, 1, -1]),
        *in_camera,
    ]
    # shrinking puts everything at the world's origin, in view or not: a unit slip must also be far out to begin with
    if np.median(np.linalg.norm(origins, axis=1)) > 30 * np.linalg.norm(cameras.centers, axis=1).max():
        tried.append(("cameras and points are in metres, its positions in mm", ALL_IN_MM, origins / 1000.0))
    faults = [(what, remedy) for what, remedy, _ in tried]
    return _most_visible(faults, [cameras.sees(moved[:, None]) for _, _, moved in tried], given)
