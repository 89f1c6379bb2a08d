"""A rendered still scope stands at the origin of the world, and its right camera where its calibration says."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from PIL import Image


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


def test_shadow_is_tissue_that_the_instrument_darkens(benchmarks: ModuleType, tmp_path: Path) -> None:
    """Against the brightest that a pixel shows in any frame of a still scope."""
    from rendered.frames import Settings
    from rendered.render import Lens
    from rendered.scenes import SCENES
    from rendered.writing import write_recording

    settings = Settings(Lens(64, 48, 54.0), resolution=240, every=50, still=True)
    write_recording(SCENES["cloth-wristed"].with_still_camera(), tmp_path, settings)
    images = np.stack([np.array(Image.open(path)) for path in sorted(tmp_path.glob("images/*"))]).mean(-1)
    masks, shadows = (
        np.stack([np.array(Image.open(path)) for path in sorted((tmp_path / "truth" / name).iterdir())])
        for name in ("masks", "shadow")
    )
    assert not (shadows[masks > 0]).any()
    lit = np.where((masks == 0) & (shadows == 0), images, np.nan)
    assert (shadows > 0).sum() > 0.02 * shadows.size
    share = images / np.nanmax(lit, 0)  # of sRGB
    assert np.nanmedian(share[shadows > 0]) < 0.85
    assert np.nanmedian(share[(masks == 0) & (shadows == 0)]) > 0.97
