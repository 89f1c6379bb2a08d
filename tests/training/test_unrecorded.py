"""Joints that nobody recorded are found by drawing."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import torch
from wristed_world import make_driver

from neeco.raster import rasterize
from neeco.training.instruments.finish import with_reading
from neeco.training.instruments.unrecorded import VALUES, find_unrecorded, smooth_path


def test_a_joint_is_put_where_its_drawings_are_most_like_the_images() -> None:
    scene = make_driver(frames=6)
    recorded = scene.recorded
    limits = (0.0, 1.6)
    instrument = replace(
        scene.instruments[0], joints={**scene.instruments[0].joints, "jaw": limits}, unrecorded=("jaw",)
    )
    scene.instruments = (instrument,)
    images = [
        rasterize(scene.at(state), camera).color.detach()
        for state, camera in zip(recorded.states, recorded.cameras, strict=True)
    ]
    found: list[float] = []

    def corrected(frame: int) -> Any:
        return with_reading(recorded.states[frame], "driver", "jaw", 0.8), recorded.cameras[frame]

    session = SimpleNamespace(
        scene=scene,
        corrected=corrected,
        views=SimpleNamespace(target=images.__getitem__, mask=lambda frame: None),
        refinement=SimpleNamespace(
            instants=list(range(len(images))),
            set_unrecorded=lambda item, reading, values: found.extend(values),
        ),
    )
    find_unrecorded(cast(Any, session), cast(Any, scene.deformation))
    truth = [float(state.instruments["driver"].joints["jaw"]) for state in recorded.states]
    assert np.abs(np.array(found) - truth).max() < 0.6 * (limits[1] - limits[0]) / (VALUES - 1)


def test_a_path_is_smooth_where_costs_tell_little() -> None:
    values = np.linspace(0, 1, 11)
    truth = np.array([0.2, 0.3, 0.4, 0.5, 0.6])
    costs = 400 * (values[None] - truth[:, None]) ** 2
    costs[2] = (values - 1.0) ** 2  # one instant that hardly tells, and the wrong way
    path = smooth_path(costs, values, sigma=0.1)
    assert np.allclose(np.delete(path, 2), np.delete(truth, 2))
    assert abs(path[2] - 0.4) < 0.11


def test_two_instants_apart_stay_apart() -> None:
    costs = np.full((2, 3), 100.0)
    costs[0, 0] = costs[1, 2] = 0.0
    assert smooth_path(costs, np.array([0.0, 0.5, 1.0]), sigma=0.5) == [0.0, 1.0]
    assert torch.tensor(smooth_path(costs, np.array([0.0, 0.5, 1.0]), sigma=0.01)).unique().numel() == 1
