"""Training through plain torch (loss, Adam, the reference rasteriser), as on any device, learns what the kernels learn."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest
import torch
from capture_files import write_capture, write_grasper

from neeco.capture import read_capture
from neeco.raster import kernels
from neeco.raster.native import Family
from neeco.scene.learning import Session, Start
from neeco.scene.methods import METHODS
from neeco.training.initial import gaussian_session
from neeco.training.options import training_config
from neeco.training.views import TrainingViews

STEPS = 200
FIRST = 20  # steps over which differences of rounding have not grown
SMALL = {
    "neeco": ["deformation.depth=3", "deformation.width=16"],
    "deformable-3dgs": ["deformation.width=16"],
    "4dgs": ["deformation.resolution=8", "deformation.channels=4", "deformation.moments=5", "deformation.width=16"],
    "nerfies": ["deformation.rays=32", "deformation.coarse_samples=8", "deformation.width=16"],
}


def begun(method: str, folder: Path) -> Session:
    """A session before its first step, always begun by the kernels."""
    small = ["density_start=50", "refine.start=20", *SMALL.get(method, [])]
    config = training_config(method, {"iterations": STEPS, "tissue_budget": 60, "instrument_budget": 60}, small)
    if not folder.exists():
        write_grasper(folder, frames=8, sizes=((40, 32),)) if method == "kinematic" else write_capture(folder)
    capture = read_capture(folder)
    views = TrainingViews.read(capture.split("train"))
    torch.manual_seed(config.seed)
    begin = partial(gaussian_session, capture, views, config, print)
    return METHODS[method].session(Start(capture, views, config, print, begin), None)


@pytest.mark.parametrize("method", list(METHODS))
def test_two_hundred_steps_agree(method: str, tmp_path: Path) -> None:
    losses: dict[Family, torch.Tensor] = {}
    sizes: dict[Family, int | None] = {}
    for family in ("native", "torch"):
        session = begun(method, tmp_path / "capture")
        with kernels(family):
            losses[family] = torch.tensor([session.step().loss for _ in range(STEPS)])
        sizes[family] = session.scene.num_gaussians
    native, plain = losses["native"], losses["torch"]
    print(method, ((plain - native).abs() / native)[:FIRST].max(), (plain - native).abs().max(), native[-20:].mean(), plain[-20:].mean(), native[:20].mean(), sizes)
