"""SfM cameras find their place in the tracker's frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.ingest.readers.logs import PoseLog
from neeco.ingest.registration.hand_eye import register_with_laparoscope
from neeco.ingest.timing.clock_search import (
    CLOCK,
    GIVEN,
    ClockOffset,
    best_rate,
    clock_from_instrument,
    correlate,
    significance,
)

HAND_EYE = np.eye(4)
HAND_EYE[:3, :3] = Rotation.from_euler("xyz", [20, -10, 35], degrees=True).as_matrix()
HAND_EYE[:3, 3] = [14.0, -9.0, -38.0]


def scope_path(times: np.ndarray, turn: float = 1.0) -> np.ndarray:
    """[N, 4, 4] world_from_camera of a scope that sweeps and turns about two axes; `turn` scales its rotation."""
    angles = np.stack(
        [0.15 * np.sin(1.3 * times), 0.12 * np.sin(0.9 * times + 1), 0.2 * np.sin(0.5 * times + 2) ** 3], -1
    )
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(turn * angles).as_matrix()
    poses[:, :3, 3] = np.stack([18 * np.sin(0.8 * times), 12 * np.cos(1.1 * times), 9 * np.sin(0.4 * times)], -1)
    return poses


def recorded(offset: float, noise: float = 1.0, turn: float = 1.0, drift: float = 0.0) -> tuple[np.ndarray, PoseLog]:
    """(video times, what the tracker of the scope logged, its clock `offset` s ahead of the video's)."""
    rng = np.random.default_rng(3)
    ticks = np.arange(-0.4, 12.4, 0.025) + rng.normal(0, 0.001, 512)
    sensors = scope_path(ticks, turn) @ HAND_EYE
    slow = drift * np.stack([np.sin(0.5 * ticks), np.sin(0.45 * ticks + 2), np.cos(0.4 * ticks)], -1)
    positions = sensors[:, :3, 3] + slow + rng.normal(0, 0.3 * noise, (len(ticks), 3))
    turns = Rotation.from_matrix(sensors[:, :3, :3]) * Rotation.from_rotvec(rng.normal(0, 0.002 * noise, (512, 3)))
    log = PoseLog(Path("scope.csv"), "em", ticks + offset, positions, turns.as_quat(scalar_first=True))
    return np.arange(0, 12, 0.04), log


def slowly_off(seed: int, seconds: float, rad: float, mm: float) -> tuple[np.ndarray, PoseLog]:
    """As `recorded`, by a tracker whose only errors are rad and mm about and along each axis, smooth over `seconds`."""
    times, log = recorded(0.0, noise=0.0)
    slow = gaussian_filter1d(np.random.default_rng(seed).normal(size=(len(log.times), 6)), 40 * seconds, axis=0)
    slow *= np.repeat([rad, mm], 3) / slow.std(0)
    turns = Rotation.from_quat(log.quats, scalar_first=True) * Rotation.from_rotvec(slow[:, :3])
    return times, replace(log, quats=turns.as_quat(scalar_first=True), positions=log.positions + slow[:, 3:])


def in_sfm(world_from_camera: np.ndarray) -> np.ndarray:
    """The same cameras in a frame and unit of SfM's own."""
    turn = Rotation.from_euler("xyz", [70, 20, -130], degrees=True).as_matrix()
    moved = world_from_camera.copy()
    moved[:, :3, :3] = turn @ moved[:, :3, :3]
    moved[:, :3, 3] = (moved[:, :3, 3] @ turn.T + [30.0, -20.0, 5.0]) / 17.0
    return moved


def test_exact_cameras_are_placed_exactly_and_the_clock_is_found() -> None:
    times, log = recorded(offset=0.037, noise=0.0)
    truth = scope_path(times)
    found = register_with_laparoscope(in_sfm(truth), times, log, None)
    assert found.scale == pytest.approx(17.0, rel=2e-3)
    assert found.clock.seconds == pytest.approx(0.037, abs=1e-3)
    assert np.abs(found.cameras(in_sfm(truth)) - truth).max() < 0.1
    assert np.allclose(found.camera_from_sensor, HAND_EYE, atol=0.2)


def test_a_noisy_drifting_tracker_bends_the_scale_by_less_than_its_stated_uncertainty() -> None:
    times, log = recorded(offset=-1.81, drift=0.3)
    times = times[::2]
    truth = scope_path(times)
    found = register_with_laparoscope(in_sfm(truth), times, log, None)
    assert abs(found.scale / 17.0 - 1) < max(3 * found.scale_sd, 0.005)
    assert found.clock.seconds == pytest.approx(-1.81, abs=0.005)
    error = found.cameras(in_sfm(truth))[:, :3, 3] - truth[:, :3, 3]
    assert np.sqrt((error**2).sum(1).mean()) < 1.0


def test_a_clock_that_counts_from_1970_is_found_too() -> None:
    times, log = recorded(offset=1.7e9)
    times = times[::4]
    found = register_with_laparoscope(in_sfm(scope_path(times)), times, log, None)
    assert found.clock.seconds == pytest.approx(1.7e9, abs=0.005)


def test_a_given_offset_is_kept() -> None:
    times, log = recorded(offset=0.05)
    times = times[::4]
    found = register_with_laparoscope(in_sfm(scope_path(times)), times, log, ClockOffset(0.048, 0.0, GIVEN))
    assert found.clock.seconds == 0.048
    assert found.clock.source == "given"


def test_a_video_at_another_frame_rate_is_a_clock_with_a_rate() -> None:
    fps = 24.75
    right, log = recorded(offset=0.037, noise=0.5)
    right = right[::3]
    found = register_with_laparoscope(in_sfm(scope_path(right)), right * 25 / fps, log, None)
    assert abs(found.clock.rate - fps / 25) < 3 * found.clock.rate_sd < 0.003
    error = found.clock.at(right * 25 / fps) - right - 0.037
    assert np.abs(error).max() < 0.006, "s"
    assert np.sqrt((error**2).mean()) < 3 * found.clock.sd


def test_a_clock_that_runs_right_gets_no_rate() -> None:
    times, log = recorded(offset=0.037)
    found = register_with_laparoscope(in_sfm(scope_path(times[::4])), times[::4], log, None)
    assert (found.clock.rate, found.clock.rate_sd) == (1.0, 0.0)
    assert abs(found.clock.seconds - 0.037) < 3 * found.clock.sd


def test_a_scope_that_does_not_turn_cannot_be_calibrated() -> None:
    times, log = recorded(offset=0.0, turn=0.02)
    with pytest.raises(NeecoError, match=r"scope\.csv: .*turned"):
        register_with_laparoscope(in_sfm(scope_path(times, turn=0.02)), times, log, ClockOffset(0.0, 0.0, GIVEN))


def test_a_log_of_another_recording_is_refused() -> None:
    times, log = recorded(offset=0.0)
    other = replace(log, quats=np.roll(log.quats[::-1], 101, axis=0))
    with pytest.raises(NeecoError, match="its clock cannot be determined"):
        register_with_laparoscope(in_sfm(scope_path(times)), times, other, None)


def test_correlation_peaks_where_a_signal_was_cut_out() -> None:
    rng = np.random.default_rng(0)
    long = np.convolve(rng.normal(size=700), np.ones(9) / 9, "same")
    lags, scores = correlate(long[200:450], long)
    assert lags[scores.argmax()] == 200
    assert scores.max() == pytest.approx(1.0)


def swing(times: np.ndarray) -> np.ndarray:
    """[N, 3] mm: strokes that grow faster and rest now and then, so that no two seconds are alike."""
    phase = 0.7 * times + 0.1 * times**2
    pace = phase + 0.9 * np.sin(1.7 * times) + 0.6 * np.sin(0.61 * times**1.3)
    return np.stack([25 * np.sin(pace), 12 * np.sin(0.53 * pace + 1), 7 * np.cos(0.31 * pace)], -1)


def instrument_log(offset: float, seed: int = 0) -> PoseLog:
    rng = np.random.default_rng(seed)
    ticks = np.arange(0.0, 12.5, 0.025)
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (len(ticks), 1))
    return PoseLog(Path("tool.csv"), "em", ticks + offset, swing(ticks) + rng.normal(0, 0.3, (len(ticks), 3)), quats)


def motion_seen(times: np.ndarray) -> np.ndarray:
    """[N-1] px between frames: the instrument's motion from a distance that varies, and flow that errs."""
    rng = np.random.default_rng(1)
    moved = np.linalg.norm(np.diff(swing(times), axis=0), axis=1)
    return 2.4 * moved * (1 + 0.3 * np.sin(times[1:])) + np.abs(rng.normal(0, 0.4, len(moved)))


def test_the_instruments_clock_is_told_by_how_fast_it_moves_in_the_images() -> None:
    times = np.arange(0.4, 12, 0.04)
    found = clock_from_instrument(motion_seen(times), times, instrument_log(0.237))
    assert found.seconds == pytest.approx(0.237, abs=0.015)
    assert 0 < found.sd < 0.1
    assert found.source == "instrument motion"


@pytest.mark.parametrize("rate", [0.8, 2.0])
def test_the_instruments_motion_tells_another_frame_rate(rate: float) -> None:
    times = np.arange(0.4, 12, 0.04)
    found = clock_from_instrument(motion_seen(times), times / rate, instrument_log(0.237))
    assert found.rate == pytest.approx(rate, abs=3 * found.rate_sd)
    assert np.abs(found.at(times / rate) - times - 0.237).max() < 0.06, "s"


def test_rates_are_found_in_long_recordings_too() -> None:
    length = 150.0
    known = np.random.default_rng(2).normal(size=int(length / 0.5))
    speed = np.abs(np.interp(np.arange(0, length, CLOCK.step_s), np.arange(len(known)) * 0.5, known))
    video = np.interp(np.arange(0, 120, CLOCK.step_s) * 1.01 + 20, np.arange(0, length, CLOCK.step_s), speed)
    rate, lags, scores = best_rate(video, speed)
    assert rate == pytest.approx(1.01, abs=0.001)
    assert lags[scores.argmax()] * CLOCK.step_s == pytest.approx(20, abs=0.1)


def test_a_correlation_counts_by_how_many_independent_samples_it_has() -> None:
    """Six seconds of smooth motion fit by chance at one of many offsets; a minute of the same correlation does not."""
    rng = np.random.default_rng(1)
    one, other = (np.interp(np.arange(0, 60, CLOCK.step_s), np.arange(181) / 3, rng.normal(size=181)) for _ in range(2))
    short = significance(one[:300], other[:300], 0, 0.64)
    assert 1 < short < CLOCK.min_significance < 2 * short < significance(one, other, 0, 0.64)


def test_a_trackers_slow_errors_count_in_where_the_cameras_stand() -> None:
    """They last for half a second each: taken for independent ones, the turn would seem to be known far better."""
    offs, stated = [], []
    for seed in range(3):
        times, log = slowly_off(seed, 0.25, 0.005, 0.2)
        keep = times < 6
        cameras = scope_path(times[keep])
        found = register_with_laparoscope(cameras, times[keep], log, ClockOffset(0.0, 0.0, GIVEN))
        off = Rotation.from_matrix(found.rotation).as_rotvec(degrees=True)
        offs.append(np.linalg.norm(off))
        stated.append(found.placement_sd(cameras[:, :3, 3])[1])
        assert found.scale_sd**2 == pytest.approx(found.covariances[:, 0, 0].max())
        shared = np.array(found.uncertainty(cameras[:, :3, 3]).covariance)  # what a capture states
        assert np.degrees(np.linalg.eigvalsh(shared[:3, :3])[-1] ** 0.5) == pytest.approx(stated[-1], rel=0.3)
    assert 0.4 < np.sqrt(np.mean(np.square(offs))) / np.mean(stated) < 1.6


def test_a_trackers_slow_errors_count_in_turn_place_and_scale() -> None:
    """The registration absorbs most of them: by its residuals alone, all would seem to be known far better."""
    offs = []
    for seed in range(2):
        times, log = slowly_off(seed, 0.8, 0.002, 0.25)
        times = times[::5]
        cameras = scope_path(times)
        found = register_with_laparoscope(cameras, times, log, ClockOffset(0.0, 0.0, GIVEN))
        place = cameras[:, :3, 3].mean(0, keepdims=True) + np.array([0.0, 0.0, 100.0])
        shared = np.array(found.uncertainty(place).covariance)  # what a capture states
        turn, shift = Rotation.from_matrix(found.rotation).as_rotvec(), found.points(place)[0] - place[0]
        offs += [turn @ turn / np.trace(shared[:3, :3]), shift @ shift / np.trace(shared[3:, 3:])]
        offs.append((np.log(found.scale) / found.scale_sd) ** 2)
        assert found.scale_sd**2 == pytest.approx(found.covariances[:, 0, 0].max())
        assert found.placement_sd(place)[0] ** 2 == pytest.approx(np.linalg.eigvalsh(shared[3:, 3:])[-1], rel=0.01)
    assert 0.4 < np.sqrt(np.mean(offs)) < 1.5


def test_motion_of_something_else_tells_no_clock() -> None:
    times = np.arange(0, 11, 0.04)
    other = np.random.default_rng(5).gamma(2.0, 1.0, len(times) - 1)
    with pytest.raises(NeecoError, match=r"tool\.csv: its clock cannot be determined"):
        clock_from_instrument(other, times, instrument_log(0.0))
