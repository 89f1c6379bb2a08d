"""What is asked of a device, copied to it and multiplied on it, as far as that shows without a GPU; by which kernel."""

from __future__ import annotations

import sys
from pathlib import Path
from threading import Thread

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))
from raster_scenes import adam_step, draw, leaves, make_scene

from neeco.base.errors import NeecoError
from neeco.raster import kernels, rasterize
from neeco.raster.devices import CachedPredicate, constant, tf32_products
from neeco.raster.losses import photometric_loss
from neeco.raster.native import Family, runs_native, torch_threads
from neeco.raster.triton import ready

CPU, CUDA, META = torch.device("cpu"), torch.device("cuda"), torch.device("meta")


def test_constants_are_made_once_per_device() -> None:
    here = constant((1.0, 2.5), CPU)
    assert here.tolist() == [1.0, 2.5]
    assert constant((1.0, 2.5), CPU) is here
    assert constant((1.0, 2.5), META).is_meta
    assert constant((1, 2), CPU).dtype == torch.float32


def test_an_answer_is_asked_for_again_when_the_tensor_has_changed() -> None:
    asked: list[int] = []

    def any_of(tensor: torch.Tensor) -> torch.Tensor:
        asked.append(1)
        return tensor.any()

    answer, tensor = CachedPredicate(any_of), torch.nn.Parameter(torch.zeros(3))
    assert not answer(tensor)
    assert not answer(tensor)
    assert len(asked) == 1
    with torch.no_grad():
        tensor[1] = 2.0
    assert answer(tensor)
    assert answer(tensor)
    assert not answer(torch.zeros(3))
    assert len(asked) == 3
    assert not answer(torch.ones(3, device=META))


def test_only_cuda_multiplies_networks_in_fewer_bits_and_only_in_the_block() -> None:
    assert torch.get_float32_matmul_precision() == "highest"
    with tf32_products(CPU):
        assert torch.get_float32_matmul_precision() == "highest"
    inside = ""

    def fail() -> None:
        nonlocal inside
        with tf32_products(CUDA):
            inside = torch.get_float32_matmul_precision()
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert inside == "high"
    assert torch.get_float32_matmul_precision() == "highest"


def test_kernels_are_launched_for_float32_on_cuda_devices_alone(uninstalled) -> None:
    assert not ready.runs_triton(torch.zeros(3))
    assert not ready.runs_triton(torch.zeros(3, device=META))
    uninstalled("triton")
    ready.require_triton.cache_clear()
    ready.starts_on.cache_clear()
    try:
        assert not ready.starts_on(CUDA)
    finally:
        ready.require_triton.cache_clear()
        ready.starts_on.cache_clear()


LEARNED = {"means": 0.02, "quats": 0.002, "scales": 0.01, "opacities": 0.002, "sh": 0.01, "falloff": 0.01}


def train(family: Family, steps: int) -> tuple[list[float], dict[str, torch.Tensor]]:
    """Losses and end of Gaussians that learn to look like others."""
    scene, other = (make_scene(30, 4, 0, seed=seed, width=24, height=20) for seed in (1, 2))
    target = draw(other, torch.float32, "cpu", torch.ones(20, 24))[0].color.detach().clamp(0, 1)
    mask = torch.ones(20, 24, dtype=torch.bool)
    mask[:5] = False
    t, gaussians, camera = leaves(scene, torch.float32)
    moments = {name: torch.zeros(2, *t[name].shape) for name in LEARNED}
    losses = []
    with kernels(family), torch_threads(1):
        for step in range(1, steps + 1):
            loss = photometric_loss(rasterize(gaussians, camera).color, target, mask, 0.2)
            loss.backward()
            losses.append(float(loss.detach()))
            for name, lr in LEARNED.items():
                adam_step(t[name].detach(), t[name].grad, *moments[name], lr=lr, step=step)
                t[name].grad = None
    return losses, t


def test_two_hundred_steps_learn_the_same() -> None:
    native, ended_native = train("native", 200)
    plain, ended_plain = train("torch", 200)
    assert native[-1] < 0.8 * native[0], "there is something to learn"
    assert plain[:20] == pytest.approx(native[:20], rel=1e-4)
    assert plain == pytest.approx(native, rel=0.02)  # rounding grows from step to step
    assert plain != native, "the switch switches"
    for name in LEARNED:
        assert (ended_plain[name] - ended_native[name]).norm() < 0.05 * ended_native[name].norm(), name


def test_the_switch_holds_for_its_block_and_its_thread() -> None:
    tensor, seen = torch.zeros(1), []
    with kernels("torch"):
        assert not runs_native(tensor)
        with kernels("native"):
            assert runs_native(tensor)
        thread = Thread(target=lambda: seen.append(runs_native(tensor)))
        thread.start()
        thread.join()
    assert runs_native(tensor)
    assert seen == [True]
    assert not runs_native(tensor.to("meta"))


def test_an_unknown_family_is_named() -> None:
    with pytest.raises(NeecoError, match="'fast': unknown"), kernels("fast"):  # type: ignore[arg-type]
        pass
