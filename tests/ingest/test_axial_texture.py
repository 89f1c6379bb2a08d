"""Colours along an instrument's line tell how far in it is, whatever its outline says."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
from ingest.base_world import INTRINSICS, TRUE_CLOCK_S, WORLD_FROM_BASE, make_world, rigid

from neeco.geometry.projection import project
from neeco.ingest.foreground.silhouettes import silhouettes_of
from neeco.ingest.registration.axial_texture import with_marks
from neeco.ingest.registration.silhouette_model import (
    CLOCK_SHIFTS_S,
    SilhouetteFit,
    SilhouetteProblem,
    first_shape,
    marks_off,
    reach,
    surface_points,
)

FRAMES = 20
RING_MM = 40.0  # behind the tip, where the shaft turns from light to dark


@functools.cache
def _fitted() -> tuple[SilhouetteProblem, SilhouetteFit]:
    """The problem of a world, and a fit at its true base, along the axis of its shaft."""
    world = make_world(FRAMES)
    poses = np.stack([world.poses_at(float(shift)) for shift in CLOCK_SHIFTS_S])
    problem = SilhouetteProblem(
        silhouettes=silhouettes_of(world.masks, INTRINSICS), camera_from_world=world.camera_from_world, poses=poses,
        readings=np.zeros((FRAMES, 0)), blocks=np.zeros(FRAMES, int),
    )  # fmt: skip
    frame = np.linalg.inv(rigid((0.1, -0.15, 0.5), (2.0, -1.0, -8.0)))  # of the shaft, as `base_world` has it
    tip = frame[:3, 3] + 14 * frame[:3, 2]
    start = SilhouetteFit.of_line(WORLD_FROM_BASE, TRUE_CLOCK_S, tip, frame[:3, 2], 0)
    return problem, first_shape(problem, start)


def _painted(problem: SilhouetteProblem, fit: SilhouetteFit) -> np.ndarray:
    """uint8 [F, h, w, 3]: the instrument, dark from RING_MM behind its tip on, before black."""
    images = np.zeros((*problem.silhouettes.masks.shape, 3), np.uint8)
    near = surface_points(problem, fit, np.array([RING_MM, RING_MM + 5.0]))
    x, y = project(near, *INTRINSICS, nearest=5.0)
    v, u = np.mgrid[: images.shape[1], : images.shape[2]] + 0.5
    for row, mask in enumerate(problem.silhouettes.masks):
        away = (u - x[row, 0]) * (x[row, 1] - x[row, 0]) + (v - y[row, 0]) * (y[row, 1] - y[row, 0])
        images[row][mask] = (200, 170, 90)
        images[row][mask & (away > 0)] = (40, 42, 45)
    return images


def test_a_ring_about_a_shaft_is_found_where_it_is_in_every_frame():
    problem, fit = _fitted()
    marked, found = with_marks(replace(problem, images=_painted(problem, fit)), fit)
    assert marked.marks is not None
    off, _ = marks_off(marked, found, reach(marked, found)[1])
    assert abs(found.mark - RING_MM) < 1.0
    assert np.nanmedian(np.abs(off - np.nanmedian(off))) < 0.35  # px: colours step by whole ones


def test_an_instrument_of_one_colour_has_no_marks():
    problem, fit = _fitted()
    images = np.where(problem.silhouettes.masks[..., None], np.uint8(120), np.uint8(0)) * np.ones(3, np.uint8)
    marked, _ = with_marks(replace(problem, images=images), fit)
    assert marked.marks is None


def test_a_fit_behind_the_camera_has_no_marks():
    problem, fit = _fitted()
    images = np.full((*problem.silhouettes.masks.shape, 3), 90, np.uint8)
    behind = fit.world_from_base.copy()
    behind[2, 3] -= 400.0
    marked, unchanged = with_marks(replace(problem, images=images), replace(fit, world_from_base=behind))
    assert marked.marks is None
    assert np.array_equal(unchanged.world_from_base, behind)
