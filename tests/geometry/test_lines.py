"""Points nearest to lines: exact where lines meet, near their points where they are parallel."""

from __future__ import annotations

import numpy as np
import pytest

from neeco.geometry.lines import (
    distances_to_lines,
    nearest_point,
    places_nearest_to_rays,
    robust_nearest_point,
    unit,
)

MEETING = np.array([12.0, -7.0, 90.0])


def _lines(count: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """Points and unit directions [N, 3] of lines through MEETING."""
    generator = np.random.default_rng(0)
    directions = unit(generator.normal(size=(count, 3)))
    return MEETING + generator.uniform(-50, 50, (count, 1)) * directions, directions


def test_lines_that_meet_meet_in_the_nearest_point():
    points, directions = _lines()
    found = nearest_point(points, directions)
    assert found == pytest.approx(MEETING, abs=1e-9)
    assert distances_to_lines(found, points, directions) == pytest.approx(np.zeros(20), abs=1e-9)


def test_parallel_lines_have_no_nearest_point_but_one_near_their_points_under_a_ridge():
    points = np.array([[1.0, 0.0, 5.0], [-1.0, 0.0, 7.0]])
    directions = np.tile([0.0, 0.0, 1.0], (2, 1))
    with pytest.raises(np.linalg.LinAlgError):
        nearest_point(points, directions)
    assert nearest_point(points, directions, ridge=1e-3) == pytest.approx([0.0, 0.0, 6.0])


def test_a_line_that_misses_the_others_does_not_pull_the_robust_point():
    points, directions = _lines()
    points[3] += 40 * unit(np.cross(directions[3], [1.0, 0.0, 0.0]))
    assert np.linalg.norm(nearest_point(points, directions) - MEETING) > 1
    assert robust_nearest_point(points, directions, 0.1) == pytest.approx(MEETING, abs=0.02)


def test_the_place_nearest_to_a_ray_is_where_it_passes():
    point, direction = np.array([3.0, 4.0, 50.0]), unit(np.array([0.3, -0.2, 0.9]))
    rays = unit(point + np.array([[-4.0], [0.0], [11.0]]) * direction)
    assert places_nearest_to_rays(point, direction, rays) == pytest.approx([-4.0, 0.0, 11.0])
