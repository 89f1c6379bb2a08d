"""Every method poses, draws and learns on a device what it does on the CPU, to float32's accuracy."""

from __future__ import annotations

import json
import os
import signal
from contextlib import nullcontext
from pathlib import Path

import pytest
import torch
from capture_files import write_grasper
from device_params import SLOW_ON_CPU
from scene_worlds import CAMERA, make_nerf, make_scene
from torch import Tensor
from viewer_world import grasper_scene, write_recorded_images

from neeco.capture import read_capture
from neeco.evaluation.evaluate import evaluate_run
from neeco.methods.nerfies.field import Rays
from neeco.raster import rasterize
from neeco.raster.losses import photometric_loss
from neeco.scene.gaussian_scene import GaussianScene
from neeco.scene.method_registry import methods
from neeco.training.config import TrainConfig, training_config
from neeco.training.run import load_run
from neeco.training.train import ProgressRow, train

OF_GAUSSIANS = [name for name, kind in methods().items() if kind.has_gaussians]
STEPS = 40
SMALL = {
    "nps": ["deformation.width=16"],
    "deformable-3dgs": ["deformation.width=16"],
    "4dgs": ["deformation.resolution=8", "deformation.width=8", "deformation.time_resolution=5"],
    "nerfies": [
        f"deformation.{size}"
        for size in ("rays=64", "coarse_samples=6", "width=16", "depth=2", "warp_width=8", "warp_depth=2")
    ],
    # all that a long run does happens within 40 iterations
    "kinematic": [
        "deformation.carving.tissue_steps=60",
        "density_start=10",
        "refine.start=8",
        "schedule.plain_density.interval=15",
        "deformation.hinge_start=12",
        "schedule.events=[{at: 0.25, action: find_shadow}, {at: 0.4, action: place_wrists}]",
        "deformation.label_sharpness_start=14",
    ],
}
slowly = pytest.mark.parametrize("word", SLOW_ON_CPU, indirect=True)
# what three seeds differ by on the CPU, twice: on another device the frames that are drawn and the noise are others
LIKE_DB = {"nerfies": 2.5}
USUALLY_DB = 1.0


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recorded_images(grasper_scene(), tmp_path_factory.mktemp("gpu") / "capture")


def close(there: Tensor, here: Tensor, tolerance: float = 1e-3) -> bool:
    """To so much of what there is."""
    return bool((there.detach().cpu().double() - here.double()).norm() <= tolerance * here.double().norm() + 1e-6)


def all_of(scene: GaussianScene) -> dict[str, Tensor]:
    """What the scene is posed, drawn and labelled as in one state, and the gradients of its loss."""
    scene.requires_grad_(True)
    canonical, device = scene.canonical, scene.center.device
    for tensor in canonical.tensors().values():
        tensor.requires_grad_(True)
    state = scene.recorded.states[3]
    posed = scene.at(state)
    drawn = rasterize(posed, CAMERA, channels=scene.deformation.training_channels(canonical, 5_000))
    target = torch.rand(CAMERA.height, CAMERA.width, 3, generator=torch.Generator().manual_seed(5)).to(device)
    loss = photometric_loss(drawn.color, target, ssim_weight=0.2)
    own = scene.deformation.regularisation(canonical, drawn, 5_000)
    (loss if own is None else loss + own).backward()
    found = {"means": posed.means, "quats": posed.quats, "scales": posed.scales, "opacities": posed.opacities}
    found |= {"color": drawn.color, "alpha": drawn.alpha, "depth": drawn.depth, "loss": loss}
    found |= {"labels": scene.label_channels(), "moved": scene.deltas(state).means}
    learned = canonical.tensors() | dict(scene.named_parameters())
    found |= {f"gradient of {name}": t.grad for name, t in learned.items() if t.grad is not None}
    return {name: tensor.detach() for name, tensor in found.items()}


@pytest.mark.parametrize("method", OF_GAUSSIANS)
def test_a_scene_and_its_gradients_are_the_same_there(method: str, device: torch.device) -> None:
    here, there = all_of(make_scene(method)), all_of(make_scene(method).to(device))
    assert here.keys() == there.keys()
    assert here["gradient of means"].any()
    for name, expected in here.items():
        assert there[name].device.type == device.type
        assert close(there[name], expected), name


def test_a_field_is_the_same_there(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("neeco.methods.nerfies.field.tf32_products", lambda device: nullcontext())

    def traced(where: torch.device) -> list[Tensor]:
        # few octaves: with ten of them the gradients of a random field change wholly where a ray is nudged by 3e-6 mm
        scene = make_nerf(fine_samples=0, frequencies=3, warp_frequencies=2).requires_grad_(True).to(where)
        directions = torch.nn.functional.normalize(torch.ones(7, 3), dim=-1).to(where)
        times = torch.zeros(7, dtype=torch.float64, device=where)
        drawn = scene.render_rays(Rays(torch.zeros(7, 3, device=where), directions, times))
        drawn.coarse.color.square().sum().backward()
        return [drawn.coarse.color, *(p.grad for p in scene.parameters() if p.grad is not None)]

    for there, here in zip(traced(device), traced(torch.device("cpu")), strict=True):
        assert close(there, here.detach())


def psnr_of(run: Path) -> float:
    """Of the frames that were held out."""
    opened = load_run(run)
    return evaluate_run(opened, opened.capture(), ("test",))["given"]["test"]["psnr"]


def config_of(method: str) -> TrainConfig:
    return training_config(method, {"iterations": STEPS, "max_tissue_gaussians": 1000}, SMALL.get(method, []))


@slowly
@pytest.mark.parametrize("method", methods())
def test_a_method_learns_there_as_well_as_here(method, device, capture, tmp_path):
    here = psnr_of(train(capture, tmp_path / "here", config_of(method)))
    there = psnr_of(train(capture, tmp_path / "there", config_of(method), device=device))
    untrained = training_config(method, {"iterations": 1, "max_tissue_gaussians": 1000}, SMALL.get(method, []))
    assert here > psnr_of(train(capture, tmp_path / "untrained", untrained))
    assert there == pytest.approx(here, abs=LIKE_DB.get(method, USUALLY_DB))


@slowly
def test_an_instrument_is_found_there_and_an_interrupted_run_goes_on(device: torch.device, tmp_path: Path) -> None:
    """Carving, the search for the hinge, its wrist and the shadow; on the CPU with the same bits."""
    capture = write_grasper(tmp_path / "capture", sizes=((80, 64), (64, 72)))
    settings = [*SMALL["kinematic"], "deformation.carving.tissue_steps=100", "log_interval=1"]
    config = training_config("kinematic", {"iterations": STEPS}, settings)

    def interrupt(row: ProgressRow) -> None:
        if row.iteration == 23 and not row.note:
            os.kill(os.getpid(), signal.SIGINT)

    whole = train(capture, tmp_path / "whole", config, device=device)
    with pytest.raises(KeyboardInterrupt, match="at iteration 23"):
        train(capture, tmp_path / "cut", config, device=device, progress=interrupt)
    cut = train(capture, tmp_path / "cut", config, device=device, resume=True)
    rows = [json.loads(line) for line in (cut / "metrics.jsonl").read_text().splitlines()]
    assert [row["iteration"] for row in rows] == list(range(1, STEPS + 1))
    for run in (whole, cut):
        scene = load_run(run, device).scene
        assert scene.diagnostics["instruments"]["grasper"]["moves_with_its_pose"]
        assert abs(float(scene.deformation.articulations[0].hinge(0)[0][2]) - 6.0) < 6
    opened = load_run(whole, device)
    aligned = evaluate_run(opened, read_capture(capture), ("test",), align=True)
    assert aligned["aligned"]["test"]["psnr"] >= aligned["given"]["test"]["psnr"] - 0.1
    assert psnr_of(cut) == pytest.approx(psnr_of(whole), abs=USUALLY_DB)
    if device.type == "cpu":
        assert (cut / "scene.safetensors").read_bytes() == (whole / "scene.safetensors").read_bytes()
