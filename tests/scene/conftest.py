from __future__ import annotations

import pytest
from scene_worlds import make_scene

from neeco.scene import GaussianScene


@pytest.fixture
def kinematic() -> GaussianScene:
    return make_scene("kinematic")


@pytest.fixture
def neeco() -> GaussianScene:
    return make_scene("nps")


@pytest.fixture(params=["kinematic", "nps", "3dgs", "deformable-3dgs", "4dgs"])
def any_scene(request: pytest.FixtureRequest) -> GaussianScene:
    return make_scene(request.param)
