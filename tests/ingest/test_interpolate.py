"""Between a log's samples lie the poses the instrument had: exactly when clean, smoothed when noisy, none in gaps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neeco.ingest.readers.interpolate import poses_at, readings_at, smoothing
from neeco.ingest.readers.logs import PoseLog, ReadingLog

QUERIES = np.linspace(0.3, 4.6, 87)


def pose_log(world, times, noise_mm=0.0, noise_rad=0.0, gaps=(), seed=0):
    generator = np.random.default_rng(seed)
    positions = world.positions(times) + generator.normal(0, noise_mm, (len(times), 3))
    noisy = world.rotations(times) * Rotation.from_rotvec(generator.normal(0, noise_rad, (len(times), 3)))
    quats = noisy.as_quat()[:, [3, 0, 1, 2]]
    signs = np.cumprod(np.sign(np.concatenate([[1], (quats[1:] * quats[:-1]).sum(axis=1)])))
    return PoseLog(Path("log.csv"), "em", times, positions, quats * signs[:, None], gaps=gaps)


def errors(world, log, smooth_s=None, queries=QUERIES):
    poses, valid = poses_at(log, queries, smooth_s)
    assert valid.all()
    truth = world.poses(queries)
    distances = np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1)
    turns = (Rotation.from_matrix(poses[:, :3, :3]).inv() * Rotation.from_matrix(truth[:, :3, :3])).magnitude()
    return np.sqrt((distances**2).mean()), np.sqrt((turns**2).mean())


@pytest.mark.parametrize("smooth_s", [None, 0.0, 0.1])
def test_clean_logs_are_followed_closely(world, smooth_s):
    distance, turn = errors(world, pose_log(world, world.times), smooth_s)
    assert distance < 0.01
    assert turn < 1e-4


def test_noise_is_smoothed_by_more_than_half_and_rotations_too(world):
    log = pose_log(world, world.times, noise_mm=0.3, noise_rad=0.004)
    rough, smooth = errors(world, log, 0.0), errors(world, log)
    assert smooth[0] < 0.5 * rough[0]
    assert smooth[1] < 0.5 * rough[1]


def test_the_width_grows_with_the_noise(world):
    widths = [smoothing(pose_log(world, world.times, noise), "positions") for noise in (0.001, 0.1, 1.0)]
    assert widths[0] < widths[1] < widths[2]


def test_the_chosen_width_is_nearly_the_best_one(world):
    log = pose_log(world, world.times, 0.3, 0.004)
    best = np.min([errors(world, log, width) for width in (0, 0.075, 0.1, 0.15, 0.2, 0.3, 0.4, 0.6, 0.8)], axis=0)
    assert (errors(world, log) < 1.25 * best).all()


def test_wild_samples_do_not_pull(world):
    log = pose_log(world, world.times, 0.2, 0.003)
    before = errors(world, log)
    log.positions[[60, 61, 120]] += 300
    log.quats[[62, 121]] = [1.0, 0, 0, 0]
    after = errors(world, log)
    assert after[0] < 1.5 * before[0] + 0.05
    assert after[1] < 1.5 * before[1] + 0.001


def test_nothing_is_made_up_in_gaps_or_outside(world):
    times = np.delete(world.times, slice(100, 120))
    log = pose_log(world, times, 0.1, gaps=((times[99], times[100]),))
    inside_gap = np.array([(times[99] + times[100]) / 2, times[99] + 0.001])
    queries = np.concatenate([[-0.01, times[-1] + 0.01], inside_gap, [times[99], times[100], times[0], times[-1], 1.0]])
    poses, valid = poses_at(log, queries)
    assert valid.tolist() == [False] * 4 + [True] * 5
    assert np.isnan(poses[:4]).all()
    assert np.isfinite(poses[4:]).all()
    # the samples beyond the gap have no say before it
    log.positions[100:] += 1000
    again, _ = poses_at(log, queries[[4, 8]])
    np.testing.assert_allclose(again[:, :3, 3], world.positions(queries[[4, 8]]), atol=0.5)


def test_few_samples_are_interpolated_linearly():
    times = np.array([0.0, 1.0, 2.0, 3.0])
    log = ReadingLog(Path("log.csv"), "jaw", times, np.array([0.0, 1.0, 0.0, 1.0]))
    values, valid = readings_at(log, np.array([0.5, 1.25, 3.0]), 0.4)
    assert valid.all()
    np.testing.assert_allclose(values, [0.5, 0.75, 1.0])


def test_isolated_samples_hold_only_at_their_time():
    times = np.array([0.0, 0.1, 0.2, 0.3, 5.0, 9.0, 9.1, 9.2])
    log = ReadingLog(Path("log.csv"), "jaw", times, np.arange(8.0), gaps=((0.3, 5.0), (5.0, 9.0)))
    values, valid = readings_at(log, np.array([4.9, 5.0, 5.1]), 0.3)
    assert valid.tolist() == [False, True, False]
    assert values[1] == 4.0


def test_a_log_too_coarse_for_its_motion_is_taken_as_it_is():
    times = np.arange(60) / 5.0
    truth = lambda seconds: 0.6 + 0.5 * np.sin(5 * seconds)  # noqa: E731 a jaw that opens within three samples
    noise = np.random.default_rng(0).normal(0, 0.003, len(times))
    log = ReadingLog(Path("jaw.csv"), "jaw", times, truth(times) + noise)
    assert smoothing(log, "values") == 0
    np.testing.assert_allclose(readings_at(log, times)[0], log.values, atol=1e-12)
    queries = np.linspace(0.5, 11.2, 200)
    off = np.abs(readings_at(log, queries)[0] - truth(queries))
    assert off.mean() < 0.3 * np.abs(np.interp(queries, times, log.values) - truth(queries)).mean()


def test_turns_of_a_coarse_log_are_followed_through_its_samples():
    times = np.arange(50) / 5.0

    def turns(seconds):
        return Rotation.from_euler("XYZ", np.stack([np.sin(3 * seconds), 0.6 * np.cos(2 * seconds), seconds], 1))

    log = PoseLog(Path("log.csv"), "em", times, np.zeros((50, 3)), turns(times).as_quat()[:, [3, 0, 1, 2]])
    assert smoothing(log, "quats") == 0
    queries = np.linspace(0.5, 9.0, 100)
    off = (Rotation.from_matrix(poses_at(log, queries)[0][:, :3, :3]).inv() * turns(queries)).magnitude()
    assert off.max() < 0.02
