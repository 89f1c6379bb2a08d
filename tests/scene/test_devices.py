"""Everything that posing and learning compute stays on the scene's device.

The device "meta" holds no numbers: an operation that mixes it with a tensor left on the CPU raises, and so does asking
a tensor for its value. So this is shown without a GPU.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import numpy as np
import pytest
import torch
from scene_worlds import CAMERA, make_nerf, make_scene
from torch import Tensor

from neeco.methods import hexplane, nps, time_mlp
from neeco.methods.nerfies import field
from neeco.methods.nerfies.field import Rays
from neeco.methods.nerfies.session import elastic_loss, geman_mcclure
from neeco.raster import rasterize
from neeco.raster.losses import photometric_loss
from neeco.scene.deformation import UNPERTURBED, Perturbation
from neeco.scene.gaussian_scene import GaussianScene
from neeco.scene.method_registry import methods

META = torch.device("meta")
OF_GAUSSIANS = [name for name, kind in methods().items() if kind.has_gaussians]


def all_meta(*tensors: Tensor | None) -> bool:
    return all(tensor is None or tensor.is_meta for tensor in tensors)


@pytest.fixture(params=OF_GAUSSIANS)
def scene(request: pytest.FixtureRequest) -> GaussianScene:
    scene = make_scene(request.param).to(META)
    scene.background = 0.5
    return scene


def test_a_scene_moves_with_all_it_has(scene: GaussianScene) -> None:
    assert all_meta(*scene.state_dict().values(), *scene.canonical.tensors().values(), scene.canonical.bodies)


def test_a_moved_scene_is_the_same_scene() -> None:
    scene = make_scene("kinematic")
    there = make_scene("kinematic").to(torch.device("cpu"))
    for name, tensor in scene.canonical.tensors().items():
        assert torch.equal(there.canonical.tensors()[name], tensor), name


def test_posing_labels_and_deltas_stay_on_the_device(scene: GaussianScene) -> None:
    state = scene.recorded.states[3]
    disturbed = [
        scene.deformation.perturb(Perturbation(0.3), 5_000, 0.1, np.random.default_rng(seed)) for seed in range(8)
    ]
    for perturbation in (UNPERTURBED, *disturbed):
        posed = scene.at(state, perturbation)
        light = posed.headlight
        assert light is not None
        assert all_meta(posed.means, posed.quats, posed.scales, posed.opacities, posed.sh, posed.sh_frames)
        assert all_meta(light.falloff, light.vignette, posed.background)
    assert all_meta(scene.label_channels(), *vars(scene.deltas(state)).values())
    assert all_meta(*(point for points in scene.keypoints(state).values() for point in points.values()))


def test_losses_and_regularisers_stay_on_the_device_with_their_gradients(scene: GaussianScene) -> None:
    scene.requires_grad_(True)
    for tensor in scene.canonical.tensors().values():
        tensor.requires_grad_(True)
    deformation, canonical = scene.deformation, scene.canonical
    channels = deformation.training_channels(canonical, 5_000)
    rendering = rasterize(scene.at(scene.recorded.states[3]), CAMERA, channels=channels)
    target = torch.zeros(CAMERA.height, CAMERA.width, 3, device=META)
    mask = torch.ones(CAMERA.height, CAMERA.width, dtype=torch.bool, device=META)
    loss = photometric_loss(rendering.color, target, mask, ssim_weight=0.2)
    own = deformation.regularisation(canonical, rendering, 5_000)
    (loss if own is None else loss + own).backward()
    assert all_meta(loss, own, canonical.means.grad, *(parameter.grad for parameter in scene.parameters()))


def test_a_field_and_its_losses_stay_on_the_device() -> None:
    scene = make_nerf(fine_samples=5, appearance=2).requires_grad_(True).to(META)
    directions = torch.ones(7, 3, device=META)
    rays = Rays(torch.zeros(7, 3, device=META), directions, torch.zeros(7, dtype=torch.float64, device=META))
    drawn = scene.render_rays(rays)
    assert drawn.fine is not None
    moved = scene.warp(drawn.positions[:, 0], drawn.codes, scene.opened)
    elastic = elastic_loss(scene.warp.jacobian(drawn.positions[:, 0], drawn.codes, scene.opened)).mean()
    loss = drawn.fine.color.mean() + drawn.coarse.color.mean() + elastic + geman_mcclure(moved.square().sum(-1)).mean()
    loss.backward()
    assert all_meta(loss, *(parameter.grad for parameter in scene.parameters()))
    rendering = scene.render(scene.recorded.states[0], scene.recorded.cameras[0])
    assert all_meta(rendering.color, rendering.alpha, rendering.depth)


class TestProducts:
    """Networks alone are multiplied with fewer bits; by what, their device decides."""

    @pytest.fixture
    def asked(self, monkeypatch: pytest.MonkeyPatch) -> list[torch.device]:
        asked: list[torch.device] = []

        def note(device: torch.device) -> AbstractContextManager[None]:
            asked.append(device)
            return nullcontext()

        for module in (nps, time_mlp, hexplane, field):
            monkeypatch.setattr(module, "tf32_products", note)
        return asked

    def test_a_network_that_moves_gaussians(self, scene: GaussianScene, asked: list[torch.device]) -> None:
        scene.at(scene.recorded.states[3])
        assert asked == ([META] if scene.deformation.large_operations else [])

    def test_the_networks_of_a_field(self, asked: list[torch.device]) -> None:
        scene = make_nerf(fine_samples=5).to(META)
        scene.render_rays(Rays(*torch.ones(2, 7, 3, device=META), torch.zeros(7, dtype=torch.float64, device=META)))
        assert asked == [META] * 4  # coarse and fine, each through the warp
