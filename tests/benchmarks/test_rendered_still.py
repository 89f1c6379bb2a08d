"""A rendered still scope stands at the origin of the world, and its right camera where its calibration says."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from PIL import Image

from neeco.ingest.calibration.stereo import read_stereo


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
    write_recording(SCENES["cloth-wristed"].with_still_camera(), tmp_path, settings, lambda line: None)
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


def test_the_stereo_calibration_is_the_cameras_own(benchmarks: ModuleType, tmp_path: Path) -> None:
    from rendered.frames import RIGHT_FROM_LEFT
    from rendered.recording import _stereo_calibration
    from rendered.render import Lens

    path = tmp_path / "stereo.yaml"
    path.write_text(_stereo_calibration(Lens()))
    left, right, right_from_left = read_stereo(path)
    assert left.intrinsics == right.intrinsics == (290.0, 290.0, 160.0, 128.0)
    assert np.abs(right_from_left - RIGHT_FROM_LEFT).max() < 1e-7


def test_a_stated_base_is_off_by_what_was_asked_for(benchmarks: ModuleType) -> None:
    from rendered.base import BASE_FROM_CAMERA, base_errors, rough_base

    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, 3] = [[-5.0, 2.0, 80.0], [0.0, 0.0, 90.0], [5.0, -2.0, 100.0]]
    given = rough_base(poses, 8.0, 5.0, 3)
    truth, logged = np.linalg.inv(BASE_FROM_CAMERA), BASE_FROM_CAMERA @ poses
    found = base_errors(np.array(given["transform"]), truth, logged)
    assert found["turned_deg"] == pytest.approx(5.0, abs=1e-3)
    assert 7.9 < found["raw_mm"] < 8.3  # turned about the middle of the places: a mm at those 10 mm away
    shift = np.eye(4)
    shift[0, 3] = 2.0  # along x alone, of poses that never turn: the shape makes up for it
    assert base_errors(shift @ truth, truth, logged)["beside_mm"] == pytest.approx(0.0, abs=1e-9)
    assert base_errors(shift @ truth, truth, logged)["raw_mm"] == pytest.approx(2.0)


def test_a_base_error_brings_a_still_scope_and_a_recording(benchmarks: ModuleType, tmp_path: Path) -> None:
    from rendered_captures import parse

    _, _, settings = parse(["bowel", str(tmp_path), "--base-error", "8x5"])
    assert settings.still
    assert settings.video
    assert settings.base_error == (8.0, 5.0)
    assert settings.options == " --base-error 8x5"
    with pytest.raises(SystemExit):
        parse(["bowel", str(tmp_path), "--base-error", "8"])
