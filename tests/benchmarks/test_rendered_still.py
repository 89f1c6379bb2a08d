"""A rendered still scope stands at the origin of the world, and its right camera where its calibration says."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from neeco.ingest.stereofile import read_stereo


@pytest.mark.parametrize("name", ["bowel", "stomach"])
def test_a_still_scopes_camera_is_the_identity_at_all_times(benchmarks: ModuleType, name: str) -> None:
    from rendered.motion import plan
    from rendered.scenes import SCENES
    from rendered.truth import World

    spec = SCENES[name].with_still_camera()
    trajectory, world = plan(spec.path, spec.design.hinge, 230, 45, spec.seed), World(spec, [])
    for time in (0.0, 3.3, 9.0):
        assert np.abs(world.camera(trajectory.at(time)) - np.eye(4)).max() < 1e-9
    moving = plan(SCENES[name].path, spec.design.hinge, 230, 45, spec.seed)
    assert np.array_equal(moving.at(3.3).scene_from_mechanical, trajectory.at(3.3).scene_from_mechanical)


def test_the_stereo_calibration_is_the_cameras_own(benchmarks: ModuleType, tmp_path: Path) -> None:
    from rendered.frames import RIGHT_FROM_LEFT
    from rendered.recording import _stereo_calibration
    from rendered.render import Lens

    path = tmp_path / "stereo.yaml"
    path.write_text(_stereo_calibration(Lens()))
    left, right, right_from_left = read_stereo(path)
    assert left.intrinsics == right.intrinsics == (290.0, 290.0, 160.0, 128.0)
    assert np.abs(right_from_left - RIGHT_FROM_LEFT).max() < 1e-7
