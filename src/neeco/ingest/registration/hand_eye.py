"""Hand-eye calibration: register SfM's cameras to the tracker's frame, and its log's clock to the video's.

SfM gives the cameras up to a similarity; the tracker a sensor on the laparoscope, up to a constant hand-eye transform
and its clock (t_log = offset + rate * t_video). All of it is solved at once, robustly:

    world_from_sensor(offset + rate * t_i)  =  similarity(world_from_camera_sfm_i) @ camera_from_sensor
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
from scipy.optimize import least_squares, nnls
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.capture.model import BaseUncertainty
from neeco.geometry.rotations import rigid
from neeco.ingest.readers.interpolate import poses_at
from neeco.ingest.readers.logs import PoseLog
from neeco.ingest.recording.model import IngestSettings
from neeco.ingest.timing.clock_search import CLOCK, SCOPE_MOTION, ClockOffset, clock_from_turning


@dataclass(frozen=True, kw_only=True)
class HandEyeSettings:
    """Settings of the calibration."""

    min_frames: int = 12  # minimum number of frames that fall on the log
    # rad, spread of the scope's directions below which the hand-eye rotation is not determined
    min_turn_rad: float = 0.05
    min_travel_mm: float = 3.0  # mm, spread of the scope's positions below which the scale is not determined
    min_deviation: float = 1e-6  # rad, mm: no covariance is smaller
    knot_spacing_s: float = 2.5  # s between the knots of the tracker's drift
    # over which a tracker's errors may be correlated; slower drift is told by its knots
    correlated_s: tuple[float, float, float] = (0.1, 0.3, 1.0)
    # bins of the autocovariance: a frame with itself, with later ones
    lags_s: tuple[float, ...] = (0.0, 1e-6, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
    placed_mm: float = 1.0  # standard deviation of the cameras' place in the tracker's frame: usual, or less
    placed_deg: float = 0.7  # the same, of their turn


HAND_EYE = HandEyeSettings()

LAG, STRETCH = 13, 14  # the unknowns of the clock
N_UNKNOWNS = 15  # in addition to the drift: scale, rotation, origin, hand-eye rotation, lever, clock


@dataclass(frozen=True, eq=False, kw_only=True)
class Registration:
    """Registration of the reconstruction to the tracker. Lengths mm, angles rad, times s."""

    scale: float  # mm per SfM unit
    rotation: np.ndarray  # [3, 3] world_from_sfm
    translation: np.ndarray  # [3] mm
    camera_from_sensor: np.ndarray  # [4, 4] hand-eye, mm
    clock: ClockOffset
    scale_sd: float  # relative, one standard deviation
    origin: np.ndarray  # [3] mm, world: about which the scale and the rotation may be off
    covariances: np.ndarray  # [2, 7, 7], as `_covariances`, of SfM's world: ln scale, turn (rad), shift (mm)
    position_residual: np.ndarray  # [N] mm, per frame used
    rotation_residual: np.ndarray  # [N] rad
    used: np.ndarray  # [N] indices of the frames used

    def cameras(self, world_from_camera_sfm: np.ndarray) -> np.ndarray:
        """Transform cameras [N, 4, 4] from the SfM gauge to world_from_camera, mm."""
        placed = np.array(world_from_camera_sfm, dtype=np.float64)
        placed[:, :3, :3] = self.rotation @ placed[:, :3, :3]
        placed[:, :3, 3] = self.points(placed[:, :3, 3])
        return placed

    def placement_sd(self, places: np.ndarray) -> tuple[float, float]:
        """Standard deviations, mm and degrees, by which cameras and tissue together may be off the tracker's frame at
        places [N, 3] mm of it, in the worst direction: by as much instruments are rendered beside their place."""
        moves = self._moves(places)
        shifts = np.einsum("nij,kjl,nml->kim", moves, self.covariances, moves) / max(len(places), 1)
        sds = [np.sqrt(np.linalg.eigvalsh(part)[:, -1].max()) for part in (shifts, self.covariances[:, 1:4, 1:4])]
        return float(sds[0]), float(np.degrees(sds[1]))

    def uncertainty(self, places: np.ndarray) -> BaseUncertainty:
        """Return the covariance of the error that all poses share with which instruments at places [N, 3] mm are placed
        among cameras and tissue, for a capture: the larger of `covariances`."""
        center = places.mean(0)
        moves = np.concatenate([np.eye(7)[1:4], self._moves(center[None])[0]])
        shared = max(moves @ self.covariances @ moves.T, key=lambda covariance: float(np.trace(covariance[3:, 3:])))
        # the reader asks for a positive definite one
        covariance = (shared + shared.T) / 2 + HAND_EYE.min_deviation**2 * np.eye(6)
        return BaseUncertainty(tuple(center.tolist()), tuple(map(tuple, covariance.tolist())))

    def _moves(self, places: np.ndarray) -> np.ndarray:
        """Derivatives [N, 3, 7] of the shift of places [N, 3] mm by ln scale, turn (rad) and shift (mm)."""
        arms = places - self.origin
        moves = np.zeros((len(places), 3, 7))
        moves[:, :, 0], moves[:, :, 4:] = arms, np.eye(3)
        moves[:, :, 1:4] = np.cross(np.eye(3), arms[:, None]).transpose(0, 2, 1)
        return moves

    def points(self, points: np.ndarray) -> np.ndarray:
        """Transform points [P, 3] from the SfM gauge to the world, mm."""
        return self.scale * points @ self.rotation.T + self.translation


def register_with_laparoscope(
    world_from_camera: np.ndarray,
    times: np.ndarray,
    log: PoseLog,
    stated: ClockOffset | None,
    settings: IngestSettings | None = None,
) -> Registration:
    """Estimate similarity, hand-eye and clock from SfM cameras [N, 4, 4] at video `times` [N] s and the scope's log.

    From a closed form all unknowns are refined under a soft-L1 loss, the tracker's slow drift among them: left out, it
    (a few tenths of a mm over seconds) is taken for scope motion and bends the scale by percents. A known clock is
    kept; else it is estimated, with a rate where that differs from 1 by CLOCK.rate_significance. Raises
    NeecoError when the scope moved too little.
    """
    clock = clock_from_turning(world_from_camera, times, log) if stated is None else stated
    problem = _HandEye(world_from_camera, times, log, clock, settings or IngestSettings())
    if stated is not None:
        solution, covariances = problem.solve(problem.start, (LAG, STRETCH))
    else:
        solution, covariances = problem.solve(problem.start, ())
        sd = _clock_deviations(covariances)
        rate = clock.rate * (1 + solution[STRETCH])
        if abs(rate - 1) < CLOCK.rate_significance * clock.rate * sd[1]:
            solution[STRETCH], rate = 1 / clock.rate - 1, 1.0
            solution, covariances = problem.solve(solution, (STRETCH,))
            sd = _clock_deviations(covariances)
        seconds = clock.seconds + clock.rate * solution[LAG] + (clock.rate - rate) * problem.now
        off = float(np.hypot(sd[0], sd[1] * times.std()))
        clock = ClockOffset(float(seconds), off, SCOPE_MOTION, float(rate), float(sd[1]))
    scale, rotation, origin, hand, lever, _, _ = problem.unpack(solution)
    position, turn, keep = problem.errors(solution)
    used = np.flatnonzero(keep)
    return Registration(
        scale=scale,
        rotation=rotation.as_matrix(),
        translation=origin - scale * rotation.apply(problem.centre),
        camera_from_sensor=rigid(hand.as_matrix(), lever),
        clock=clock,
        scale_sd=float(np.sqrt(covariances[:, 0, 0].max())),
        origin=origin,
        covariances=covariances[:, :7, :7],
        position_residual=np.linalg.norm(position[used], axis=1),
        rotation_residual=np.linalg.norm(turn[used], axis=1),
        used=used,
    )


class _HandEye:
    """The least-squares problem: unknowns [U] about a closed form, the last of them the drift at its knots. Raises
    NeecoError where the scope moved too little."""

    def __init__(
        self,
        world_from_camera: np.ndarray,
        times: np.ndarray,
        log: PoseLog,
        clock: ClockOffset,
        settings: IngestSettings,
    ) -> None:
        self.times, self.settings = times, settings
        poses, self.valid = poses_at(log, clock.at(times))
        if self.valid.sum() < HAND_EYE.min_frames:
            raise NeecoError(
                f"{log.path}: only {int(self.valid.sum())} video frames fall on its samples (at least "
                f"{HAND_EYE.min_frames} are needed); check the clock offset in `sync` and that log and video "
                "are of the same recording"
            )
        # in closed form: the hand-eye rotation from relative turns (rotation vectors differ by it alone), the rest
        # linearly
        cameras, sensors = world_from_camera[self.valid], poses[self.valid]
        camera_turns, sensor_turns = (Rotation.from_matrix(part[:, :3, :3]) for part in (cameras, sensors))
        middle = len(cameras) // 2
        steps = [(0, slice(None)), (middle, slice(None)), (len(cameras) - 1, slice(None))]
        # relative turns [3N, 3] in the camera's and in the sensor's frame
        a, b = (
            np.concatenate([(turns[i].inv() * turns[j]).as_rotvec() for i, j in steps])
            for turns in (camera_turns, sensor_turns)
        )
        spread = np.linalg.svd(b, compute_uv=False) / np.sqrt(len(b))
        if spread[1] < HAND_EYE.min_turn_rad:
            raise NeecoError(
                f"{log.path}: the laparoscope turned about hardly more than one axis ({np.degrees(spread[1]):.1f} deg "
                "across the others), so its hand-eye calibration cannot be found; record the scope turning about two "
                "axes by 10 deg or more"
            )
        hand, _ = Rotation.align_vectors(a, b)
        world_from_sfm = (sensor_turns * hand.inv() * camera_turns.inv()).mean()
        turned = world_from_sfm.as_matrix() @ cameras[:, :3, :3]  # [N, 3, 3] world_from_camera rotations
        travel = cameras[:, :3, 3] @ world_from_sfm.as_matrix().T  # [N, 3]
        system = [travel[:, :, None], np.tile(np.eye(3), (len(cameras), 1, 1)), turned]
        solution = np.linalg.lstsq(np.concatenate(system, -1).reshape(-1, 7), sensors[:, :3, 3].ravel(), rcond=None)[0]
        if solution[0] <= 0 or np.linalg.norm(travel.std(0)) * solution[0] < HAND_EYE.min_travel_mm:
            raise NeecoError(
                f"{log.path}: the laparoscope travelled too little to tell the scale; move it by 20 mm or more"
            )
        # scale, world_from_sfm, camera_from_sensor, and the sensor's origin in the camera's frame [3] mm
        self.first = float(solution[0]), world_from_sfm, hand, solution[4:]
        # centred, so that scale and translation decouple, as lag and stretch do
        self.centre, self.now = world_from_camera[:, :3, 3].mean(0), float(times.mean())
        self.arms = world_from_camera[:, :3, 3] - self.centre
        self.turns = Rotation.from_matrix(world_from_camera[:, :3, :3])
        self.middle = float(solution[0]) * world_from_sfm.apply(self.centre) + solution[1:4]
        # on the video's clock: seconds since 1970 leave too few digits for derivatives
        gaps = tuple((float(start), float(end)) for start, end in clock.video_times(np.reshape(log.gaps, (-1, 2))))
        near = replace(log, times=clock.video_times(log.times), gaps=gaps)
        # most columns of the Jacobian leave the clock alone
        self.sensor_poses = lru_cache(maxsize=4)(
            lambda lag, stretch: poses_at(near, times + lag + stretch * (times - self.now))
        )
        knots = np.arange(
            times[0] - HAND_EYE.knot_spacing_s / 2, times[-1] + 1.5 * HAND_EYE.knot_spacing_s, HAND_EYE.knot_spacing_s
        )
        # [N, K] weights of piecewise linear interpolation between knots
        self.hats = np.maximum(0.0, 1 - np.abs(times[:, None] - knots) / HAND_EYE.knot_spacing_s)
        self.start = np.zeros(N_UNKNOWNS + 3 * len(knots))

    def unpack(self, x: np.ndarray) -> tuple[float, Rotation, np.ndarray, Rotation, np.ndarray, float, float]:
        """Scale, rotation, translation of the centre, camera_from_sensor's rotation and lever mm, lag s and stretch."""
        first_scale, first_rotation, first_hand, first_lever = self.first
        rotation = Rotation.from_rotvec(x[1:4]) * first_rotation
        hand = first_hand * Rotation.from_rotvec(x[7:10])
        origin, lever = self.middle + x[4:7], first_lever + x[10:13]
        return first_scale * np.exp(x[0]), rotation, origin, hand, lever, float(x[LAG]), float(x[STRETCH])

    def errors(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position error [N, 3] mm (drift not yet taken off), rotation error [N, 3] rad, on the log [N]."""
        scale, rotation, origin, hand, lever, lag, stretch = self.unpack(x)
        poses, still = self.sensor_poses(lag, stretch)
        placed = rotation * self.turns
        position = scale * rotation.apply(self.arms) + origin + placed.apply(lever) - poses[:, :3, 3]
        sensors = Rotation.from_matrix(np.where(still[:, None, None], poses[:, :3, :3], np.eye(3)))
        return position, ((placed * hand).inv() * sensors).as_rotvec(), still & self.valid

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Weighted residuals [Q]: positions and rotations of the frames, then the drift's priors."""
        position, turn, keep = self.errors(x)
        drift = x[N_UNKNOWNS:].reshape(-1, 3)
        # a frame that slid off the log counts as wrong by the noise, so that sliding off is never a gain
        rows = [
            np.where(keep[:, None], (position - self.hats @ drift) / self.settings.tracker_noise_mm, 1.0)[self.valid],
            np.where(keep[:, None], turn / self.settings.tracker_noise_rad, 1.0)[self.valid],
            drift / self.settings.tracker_drift_mm,
            np.diff(drift, axis=0) / (0.5 * self.settings.tracker_drift_mm),
        ]
        return np.concatenate(rows).ravel()

    def solve(self, x: np.ndarray, fixed: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Solve all unknowns [U] from `x` on, except `fixed`; return them and their `_covariances`."""
        free = np.setdiff1d(np.arange(len(x)), fixed)

        def of_free(values: np.ndarray) -> np.ndarray:
            changed = x.copy()
            changed[free] = values
            return self.residuals(changed)

        solved = least_squares(of_free, x[free], loss="soft_l1", max_nfev=self.settings.registration_steps)
        solution, covariance, jacobian = x.copy(), np.zeros((len(x), len(x))), np.zeros((len(solved.fun), len(x)))
        solution[free], jacobian[:, free] = solved.x, solved.jac
        covariance[np.ix_(free, free)] = np.linalg.pinv(solved.jac.T @ solved.jac)
        return solution, _covariances(solved.fun, jacobian, covariance, self.times[self.valid])


def _covariances(residuals: np.ndarray, jacobian: np.ndarray, covariance: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Covariances [2, U, U] of the unknowns, of which the larger holds: by the stated noise; and by the tracker's own
    errors, white and correlated over `correlated_s`, whose variances explain the residuals' autocovariance.

    The unknowns absorb much of slow errors: what is left in residuals looks smaller and less correlated than the errors
    are. So the variances (Rao 1972, "Estimation of variance and covariance components") are those whose residuals,
    after that absorption, have the autocovariances at `lags_s` that were found. residuals [Q] and jacobian [Q, U] as
    `least_squares` returns them: the first are not yet weighted by the soft-L1 loss. times [N] s of the frames, whose
    positions and rotations come first.
    """
    count, unknowns = len(times), len(covariance)
    weighted = (residuals * (1 + residuals**2) ** 0.25)[: 6 * count].reshape(2, count, 3).transpose(0, 2, 1)
    gain = (covariance @ jacobian.T)[:, : 6 * count].reshape(unknowns, 2, count, 3).transpose(1, 3, 0, 2)
    slopes = jacobian[: 6 * count].reshape(2, count, 3, unknowns).transpose(0, 2, 1, 3)
    apart = np.abs(times[:, None] - times)
    # [C][2, 3, U, N] gain times the errors' correlation: white ones, and correlated ones
    spread = [gain, *(gain @ _correlation(apart, seconds) for seconds in HAND_EYE.correlated_s)]
    absorbed = np.stack([np.einsum("kaun,kavn->kuv", some, gain, optimize=True) for some in spread], 1)  # [2, C, U, U]
    observed, expected = list[float](), list[np.ndarray]()
    for low, high in pairwise(HAND_EYE.lags_s):
        pairs = ((apart >= low) & (apart < high)).astype(np.float64)
        if not (total := pairs.sum()):
            continue
        sums = [np.trace(pairs), *(_correlation(apart[pairs > 0], seconds).sum() for seconds in HAND_EYE.correlated_s)]
        for kind in range(2):  # positions, rotations
            near = pairs @ slopes[kind] / total  # [3, N, U]
            row = np.einsum("kcuv,anu,anv->kc", absorbed, slopes[kind], near, optimize=True)
            for component, some in enumerate(spread):
                row[kind, component] += 3 * sums[component] / total - 2 * np.einsum("aun,anu->", some[kind], near)
            observed.append(float(np.sum(weighted[kind] * (weighted[kind] @ pairs))) / total)
            expected.append(row.ravel())
    variances, _ = nnls(np.stack(expected), np.array(observed))
    return np.stack([covariance, np.tensordot(variances, absorbed.reshape(-1, unknowns, unknowns), 1)])


def _correlation(apart: np.ndarray, seconds: float) -> np.ndarray:
    """Correlation of errors that are `apart` s, smooth as a tracker's filter leaves them."""
    return np.exp(-((apart / seconds) ** 2) / 2)


def _clock_deviations(covariances: np.ndarray) -> np.ndarray:
    """Standard deviations [2] of LAG, s, and STRETCH."""
    clock = [LAG, STRETCH]
    return np.asarray(np.sqrt(np.maximum(covariances[:, clock, clock].max(0), 0.0)))
