"""Devices: choice by `--device`, messages of failures, cached constants, and reduced precision."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache, lru_cache

import torch
from torch import Tensor

from neeco.base.errors import NeecoError, memory_failure
from neeco.raster.triton.ready import missing, require_triton


def device_of(word: str, drawing: bool = True) -> torch.device:
    """Return the device of `--device`: cpu, cuda, cuda:N, or auto: a CUDA device if there is one, else the CPU.

    drawing: it renders, which on CUDA needs triton; else PyTorch is sufficient. `auto` skips a card that
    PyTorch or Triton cannot use, with a warning.

    Raises NeecoError for another value, or a device that does not exist or cannot be used.
    """
    name, colon, number = word.partition(":")
    if name not in ("auto", "cpu", "cuda") or (colon and (name != "cuda" or not number.isdecimal())):
        raise NeecoError(f"--device: {word!r} is unknown; choose auto, cpu, cuda or cuda:N")
    count = torch.cuda.device_count() if name != "cpu" and torch.cuda.is_available() else 0
    if name == "cpu" or (name == "auto" and not count):
        return torch.device("cpu")
    if not count:
        raise NeecoError(f"--device: {word}: PyTorch finds no CUDA device here: {_no_cuda()}, or use --device cpu")
    if int(number or 0) >= count:
        raise NeecoError(f"--device: {word}: there are {count}, counted from 0; use cuda:{count - 1} or less")
    device = torch.device("cuda" if name == "auto" else word)
    refusal = _not_built_for(device) or (missing(device) if drawing else None)
    if refusal and name == "auto":
        warnings.warn(f"--device auto: working on the CPU: {refusal}", stacklevel=2)
        return torch.device("cpu")
    if refusal:
        raise NeecoError(f"--device: {word}: {refusal}")
    if drawing:
        require_triton(device)
    return device


def device_failure(error: BaseException) -> str | None:
    """Return a one-line message of a failed CUDA device or of exhausted memory, with the remedy; None: another
    error."""
    message = _first_line(error)
    if isinstance(error, torch.cuda.OutOfMemoryError) or re.match("CUDA error: (out of memory|CUBLAS.*ALLOC)", message):
        asked = re.search(r"Tried to allocate ([\d.]+ \w+)", message)
        memory = re.search(r"total capacity of ([\d.]+ \w+) of which ([\d.]+ \w+) is free", message)
        numbers = [f"{asked[1]} more were asked for"] if asked else []
        numbers += [f"{memory[2]} of {memory[1]} are free"] if memory else []
        details = f" ({', '.join(numbers)})" if numbers else ""
        return (
            f"--device: the GPU's memory is full{details}: close what else uses it, take smaller budgets of Gaussians "
            "(--max-tissue-gaussians, --max-instrument-gaussians), smaller images or fewer frames, or --device cpu"
        )
    # since PyTorch 2.8; before, a RuntimeError with the same message
    accelerator_error = getattr(torch, "AcceleratorError", ())
    gpu_messages = ("CUDA error:", "cuDNN error:", "Triton Error [CUDA]:")
    if isinstance(error, accelerator_error) or message.startswith(gpu_messages):
        return f"--device: the GPU gave up ({message}): look at `nvidia-smi` and the system's log, then start again"
    return memory_failure(error)


@contextmanager
def readable_failures() -> Iterator[None]:
    """Raise NeecoError, one line, where a CUDA device fails or memory is exhausted in the block (`device_failure`)."""
    try:
        yield
    except Exception as error:
        if (failure := device_failure(error)) is None:
            raise
        raise NeecoError(failure) from error


def _no_cuda() -> str:
    """Return the reason why PyTorch has no CUDA device, and the remedy."""
    if torch.version.cuda is None and torch.version.hip is None:
        return (
            f"{torch.__version__} is a build without CUDA; on Linux pip install --force-reinstall torch takes PyPI's, "
            "which has it"
        )
    try:
        torch.cuda.init()
        message = "no further message"
    except (RuntimeError, AssertionError) as error:  # missing or outdated driver, or no GPU
        message = _first_line(error).rstrip(".")
    return f"{message}; check `nvidia-smi` and CUDA_VISIBLE_DEVICES, install or update NVIDIA's driver"


def _first_line(error: BaseException) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0]


def _not_built_for(device: torch.device) -> str | None:
    """Return the reason why this PyTorch has no kernels for the GPU; None if it has. Binaries (sm_XY) run on GPUs with
    the same major and at least this minor version, intermediate code (compute_XY) on all newer GPUs."""
    card = torch.cuda.get_device_capability(device)
    names = torch.cuda.get_arch_list()
    parsed = [match for name in names if (match := re.fullmatch(r"(sm|compute)_(\d+)(\d)[a-z]?", name))]
    built = [(kind, (int(major), int(minor))) for kind, major, minor in (match.groups() for match in parsed)]
    if not built or any(v <= card and (kind == "compute" or v[0] == card[0]) for kind, v in built):
        return None
    return (
        f"{torch.cuda.get_device_name(device)} has compute capability {card[0]}.{card[1]}, and PyTorch "
        f"{torch.__version__} is built for {', '.join(names)}; install one that is built for it (pytorch.org), or use "
        "--device cpu"
    )


@lru_cache(maxsize=256)
def constant(values: tuple[float, ...], device: torch.device) -> Tensor:
    """Return `values` [n] float32 on `device`, cached, since a copy to a CUDA device waits for its queue. Do not
    modify."""
    return torch.tensor(values, dtype=torch.float32, device=device)


class CachedPredicate:
    """A boolean predicate of a tensor, read from its device once per in-place version of the tensor.

    It is false of a tensor on the device "meta", which has no values.
    """

    def __init__(self, question: Callable[[Tensor], Tensor]) -> None:
        self.question = question
        self._about: tuple[Tensor, int] | None = None
        self._answer = False

    def __call__(self, tensor: Tensor) -> bool:
        cached = self._about
        if cached is None or cached[0] is not tensor or cached[1] != tensor._version:
            self._answer = not tensor.is_meta and bool(self.question(tensor.detach()))
            self._about = tensor, tensor._version
        return self._answer


@contextmanager
def tf32_products(device: torch.device) -> Iterator[None]:
    """Let a CUDA device multiply float32 matrices in TF32 within the block: ten bits of every factor, sums in float32.
    For networks alone: poses and positions in mm need more. Not tested on a GPU."""
    before = torch.get_float32_matmul_precision()
    if device.type == "cuda":
        torch.set_float32_matmul_precision("high")
    try:
        yield
    finally:
        if device.type == "cuda":
            torch.set_float32_matmul_precision(before)


@cache
def processor_has(*features: str) -> bool:
    """Return whether the CPU has one of these instruction sets, by PyTorch's names; False for an old PyTorch."""
    capabilities: Mapping[str, object] = getattr(torch.cpu, "get_capabilities", dict)()
    return any(bool(capabilities.get(feature)) for feature in features)


def fast_bfloat16() -> bool:
    """Return whether the CPU multiplies several times faster in bfloat16 than in float32. Measured: 3 times with AMX on
    an Intel Xeon, 4 times with AVX-512 BF16 alone on an AMD EPYC, but a third slower with it on the Xeon."""
    capabilities: Mapping[str, object] = getattr(torch.cpu, "get_capabilities", dict)()
    by_amd = str(capabilities.get("cpu_name", "")).startswith("AMD")
    return processor_has("amx_bf16") or (by_amd and processor_has("avx512_bf16"))


@contextmanager
def bfloat16_products(device: torch.device, wanted: bool) -> Iterator[None]:
    """Let a CPU multiply in bfloat16 within the block where `wanted`: eight bits of every factor and result, sums in
    float32. For networks alone. Results may be bfloat16; parameters and their gradients stay float32. A processor
    without such instructions would be 4 to 20 times slower: it stays with float32, with a warning."""
    wanted = wanted and device.type == "cpu"
    if wanted and not processor_has("amx_bf16", "avx512_bf16", "bf16"):
        warnings.warn("deformation.half: this processor has no bfloat16; it multiplies in float32", stacklevel=3)
        wanted = False
    with torch.autocast("cpu", dtype=torch.bfloat16, enabled=wanted):
        yield
