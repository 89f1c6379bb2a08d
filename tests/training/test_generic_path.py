"""Training through plain torch (loss, Adam, the reference rasteriser), as on any device, learns what kernels learn."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest
import torch
from capture_files import write_capture, write_grasper

from neeco.capture import read_capture
from neeco.raster import kernels
from neeco.raster.native import Family
from neeco.scene.gaussian_scene import GaussianScene
from neeco.scene.method_registry import methods
from neeco.scene.training_session import Session
from neeco.scene.training_views import TrainingViews
from neeco.training.config import training_config
from neeco.training.initial import begin_session

STEPS = 60
SMALL = {
    "nps": ["deformation.depth=3", "deformation.width=16"],
    "deformable-3dgs": ["deformation.width=16"],
    "kinematic": ["deformation.carving.seeds=300"],
    "4dgs": [
        "deformation.resolution=8",
        "deformation.channels=4",
        "deformation.time_resolution=5",
        "deformation.width=16",
    ],
    "nerfies": ["deformation.rays=32", "deformation.coarse_samples=8", "deformation.width=16"],
}


def begun(method: str, folder: Path) -> Session:
    """A session before its first step, always begun by the kernels."""
    # few seeds: the reference rasteriser evaluates every Gaussian at every pixel
    small = ["density_start=40", "refine.start=20", *SMALL.get(method, [])]
    config = training_config(
        method, {"iterations": STEPS, "max_tissue_gaussians": 60, "max_instrument_gaussians": 60}, small
    )
    if not folder.exists():
        write_grasper(folder, frames=8, sizes=((40, 32),)) if method == "kinematic" else write_capture(folder)
    capture = read_capture(folder)
    views = TrainingViews.read(capture.split("train"))
    torch.manual_seed(config.seed)
    return begin_session(capture, views, config, print)


@pytest.mark.parametrize("method", list(methods()))
def test_sixty_steps_agree(method: str, tmp_path: Path) -> None:
    """Losses within float32's rounding. A field's first gradients are noise, whose sign Adam follows: there the end."""
    losses: dict[Family, torch.Tensor] = {}
    sizes: dict[Family, int | None] = {}
    for family in get_args(Family):
        session = begun(method, tmp_path / "capture")
        with kernels(family):
            losses[family] = torch.tensor([session.step().loss for _ in range(STEPS)])
        sizes[family] = session.scene.num_gaussians
    native, plain = losses["native"], losses["torch"]
    assert sizes["native"] == sizes["torch"]
    if methods()[method].has_gaussians:
        apart = (plain - native).abs()
        # a loss of order 1 is a sum and product of some hundred float32 numbers, each rounded to 2**-24
        assert float(apart[:40].max()) < 256 * 2**-24
        # steps amplify differences: 27 times, where the most was measured
        assert float(apart.max()) < 256 * 2**-24 * 100
    assert float(plain[-20:].mean()) == pytest.approx(float(native[-20:].mean()), rel=5e-3)
    assert float(native[-20:].mean()) < 0.97 * float(native[:20].mean())  # and they learn


def test_no_instrument_begins_with_more_gaussians_than_it_may_have(tmp_path: Path) -> None:
    """Carved are 300 seeds, for at most 60."""
    session = begun("kinematic", tmp_path / "capture")
    assert isinstance(session.scene, GaussianScene)
    assert session.scene.canonical.counts[1:] == (60,)
