"""What is drawn of a scene that a still scope recorded stays near what it saw."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rod_world import make_scene

from neeco.base.errors import NeecoError
from neeco.scene import GaussianScene
from neeco.synthesis.samplers import make_sampler


@pytest.fixture
def still() -> GaussianScene:
    scene = make_scene()
    scene.recorded = replace(scene.recorded, still=True)
    return scene


def test_perturbed_views_stay_within_millimetres_of_a_still_scope(still: GaussianScene) -> None:
    sampler = make_sampler(still, "interpolate", 0.2, "perturbed", 1)
    rng = np.random.default_rng(0)
    places = np.stack([camera.world_from_camera[:3, 3].numpy() for camera in still.recorded.cameras])
    for state in still.recorded.states[:10]:
        place = sampler.views(state, rng).world_from_camera[:3, 3].numpy()
        assert np.linalg.norm(places - place, axis=1).min() < 5


def test_no_orbit_about_what_was_seen_from_one_place(still: GaussianScene) -> None:
    with pytest.raises(NeecoError, match="--views orbit: the scope stood still"):
        make_sampler(still, "interpolate", 0.2, "orbit", 1)
