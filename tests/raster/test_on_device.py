"""What is asked of a device, copied to it and multiplied on it, as far as that shows without a GPU; by which kernel."""

from __future__ import annotations

from threading import Thread

import pytest
import torch

from neeco.base.errors import NeecoError
from neeco.raster import kernels
from neeco.raster.devices import CachedPredicate, constant, tf32_products
from neeco.raster.native import runs_native
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


def test_kernels_are_launched_for_float32_on_cuda_devices_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not ready.runs_triton(torch.zeros(3))
    assert not ready.runs_triton(torch.zeros(3, device=META))
    monkeypatch.setattr(ready, "installed", lambda: False)
    ready.require_triton.cache_clear()
    ready.starts_on.cache_clear()
    try:
        assert not ready.starts_on(CUDA)
    finally:
        ready.require_triton.cache_clear()
        ready.starts_on.cache_clear()


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
