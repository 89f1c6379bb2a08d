"""Which device a word means, and what is said where there is none or where it fails."""

from __future__ import annotations

import pytest
import torch

from neeco.base.errors import NeecoError
from neeco.raster import devices
from neeco.raster.devices import device_failure, device_of, readable_failures

FULL = (
    "CUDA out of memory. Tried to allocate 2.50 GiB. GPU 0 has a total capacity of 7.78 GiB of which 1.02 GiB is free. "
    "Process 1 has 6.70 GiB memory in use."
)


class Cards:
    """Stands in for PyTorch's view of the machine: two cards, or none and `told` of it, and what the build has kernels
    for."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.capability, self.built = (8, 9), ["sm_75", "sm_80", "sm_90a", "compute_120"]
        self.told, self.triton_lacks = "", ""
        self.started: list[str] = []  # devices on which Triton was started
        of_pytorch = {
            "is_available": lambda: not self.told,
            "init": self.init,
            "device_count": lambda: 2,
            "get_device_name": lambda device: "Some Card",
            "get_device_capability": lambda device: self.capability,
            "get_arch_list": lambda: self.built,
        }
        for name, stands_in in of_pytorch.items():
            monkeypatch.setattr(torch.cuda, name, stands_in)
        monkeypatch.setattr(torch.version, "cuda", "13.0")
        monkeypatch.setattr(devices, "missing", lambda device: self.triton_lacks or None)
        monkeypatch.setattr(devices, "require_triton", lambda device: self.started.append(str(device)))

    def init(self) -> None:
        raise RuntimeError(self.told)


@pytest.fixture
def cards(monkeypatch: pytest.MonkeyPatch) -> Cards:
    return Cards(monkeypatch)


def refused(word: str, drawing: bool = True) -> str:
    with pytest.raises(NeecoError) as error:
        device_of(word, drawing)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_words_mean_the_devices_that_are_there(cards: Cards) -> None:
    assert [str(device_of(word)) for word in ("auto", "cpu", "cuda", "cuda:1")] == ["cuda", "cpu", "cuda", "cuda:1"]
    assert refused("cuda:2") == "--device: cuda:2: there are 2, counted from 0; use cuda:1 or less"
    for word in ("gpu", "cuda:", "cuda:x", "auto:0", "cpu:0", ""):
        assert "is unknown; choose auto, cpu, cuda or cuda:N" in refused(word)


@pytest.mark.skipif(torch.version.cuda is not None, reason="a build with CUDA")
def test_a_pytorch_without_cuda_is_named_with_the_remedy() -> None:
    told = refused("cuda")
    assert "PyTorch finds no CUDA device" in told
    assert "is a build without CUDA" in told
    assert "pip install --force-reinstall torch" in told
    assert device_of("auto").type == "cpu"


@pytest.mark.parametrize("said", ["Found no NVIDIA driver on your system. Please check.", "No CUDA GPUs are available"])
def test_a_machine_without_a_driver_or_a_card_says_what_pytorch_says(said: str, cards: Cards) -> None:
    cards.told = said + "\nand more"
    assert f"{said.rstrip('.')}; check `nvidia-smi`" in refused("cuda:0")


@pytest.mark.parametrize(
    ("capability", "usable"),
    [
        ((6, 1), False),
        ((7, 0), False),
        ((7, 5), True),
        ((8, 6), True),
        ((9, 0), True),
        ((10, 0), False),
        ((12, 1), True),
    ],
)
def test_a_card_that_pytorch_has_no_kernels_for_is_refused(capability, usable, cards):
    cards.capability = capability
    if usable:
        assert device_of("cuda").type == "cuda"
        return
    for drawing in (True, False):
        told = refused("cuda", drawing)
        assert f"Some Card has compute capability {capability[0]}.{capability[1]}, and PyTorch" in told
        assert "built for sm_75, sm_80, sm_90a, compute_120" in told
    with pytest.warns(UserWarning, match="--device auto: working on the CPU: Some Card has compute"):
        assert device_of("auto").type == "cpu"


def test_triton_must_start_there_before_any_work(cards: Cards) -> None:
    cards.triton_lacks = "package triton is missing"
    assert "package triton is missing" in refused("cuda")
    assert device_of("cuda", drawing=False).type == "cuda"
    assert cards.started == []
    cards.triton_lacks = ""
    assert device_of("cuda:1") == torch.device("cuda:1")
    assert cards.started == ["cuda:1"]


def test_full_memory_says_how_much_was_asked_for_and_what_to_do() -> None:
    told = device_failure(torch.cuda.OutOfMemoryError(FULL))
    assert told is not None
    assert "memory is full (2.50 GiB more were asked for, 1.02 GiB of 7.78 GiB are free): " in told
    assert "--max-tissue-gaussians" in told
    assert "--device cpu" in told
    for said in ("CUDA error: out of memory\nCUDA kernel", "CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling"):
        assert "memory is full: " in (device_failure(RuntimeError(said)) or "")


@pytest.mark.parametrize(
    "said",
    ["CUDA error: unspecified launch failure\nCUDA kernel errors", "Triton Error [CUDA]: an illegal memory access"],
)
def test_a_device_that_gives_up_is_told_in_a_line(said: str) -> None:
    told = device_failure(RuntimeError(said))
    assert told is not None
    assert said.splitlines()[0] in told
    assert "\n" not in told
    kind = getattr(torch, "AcceleratorError", None)
    assert kind is None or kind.__mro__[1] is RuntimeError  # the words alone would do


def test_other_errors_are_left_as_they_are() -> None:
    with pytest.raises(RuntimeError, match="shapes"), readable_failures():
        raise RuntimeError("shapes differ")
    with pytest.raises(NeecoError, match="more were asked") as error, readable_failures():
        raise torch.cuda.OutOfMemoryError(FULL)
    assert isinstance(error.value.__cause__, torch.cuda.OutOfMemoryError)
