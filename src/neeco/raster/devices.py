"""Which device a word of the command line means, whether it can be drawn on, and what it says when it fails."""

from __future__ import annotations

import importlib.util
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from neeco.errors import NeecoError
from neeco.raster.triton.ready import missing, require_triton


def cuda_backend() -> str:
    """The backend for CUDA devices where nobody chooses: "cuda" (gsplat) if it is installed, else "triton"."""
    return "cuda" if importlib.util.find_spec("gsplat") is not None else "triton"


def device_of(word: str, drawing: bool = True) -> torch.device:
    """The device behind `--device`: cpu, cuda, cuda:N, or auto: a CUDA device where there is one, else the CPU.

    drawing: it is to draw, which on CUDA needs triton or gsplat; without, PyTorch is enough. `auto` passes over a card
    that PyTorch or Triton cannot use at all, with a warning.

    Raises NeecoError for another word, or a device that is not there or cannot be used.
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
    by_triton = drawing and cuda_backend() == "triton"
    refusal = _not_built_for(device) or (missing(device) if by_triton else None)
    if refusal and name == "auto":
        warnings.warn(f"--device auto: working on the CPU: {refusal}", stacklevel=2)
        return torch.device("cpu")
    if refusal:
        raise NeecoError(f"--device: {word}: {refusal}")
    if by_triton:
        require_triton(device)
    return device


def device_failure(error: BaseException) -> str | None:
    """What a CUDA device ended the work with, and what to do, in one line; None: the error is of another kind."""
    said = _first_line(error)
    if isinstance(error, torch.cuda.OutOfMemoryError) or re.match("CUDA error: (out of memory|CUBLAS.*ALLOC)", said):
        asked = re.search(r"Tried to allocate ([\d.]+ \w+)", said)
        there = re.search(r"total capacity of ([\d.]+ \w+) of which ([\d.]+ \w+) is free", said)
        numbers = [f"{asked[1]} more were asked for"] if asked else []
        numbers += [f"{there[2]} of {there[1]} are free"] if there else []
        told = f" ({', '.join(numbers)})" if numbers else ""
        return (
            f"--device: the GPU's memory is full{told}: close what else uses it, take smaller budgets of Gaussians "
            "(--max-tissue-gaussians, --max-instrument-gaussians), smaller images or fewer frames, or --device cpu"
        )
    lost = getattr(torch, "AcceleratorError", ())  # since PyTorch 2.8; before, a RuntimeError of the same words
    if isinstance(error, lost) or said.startswith(("CUDA error:", "cuDNN error:", "Triton Error [CUDA]:")):
        return f"--device: the GPU gave up ({said}): look at `nvidia-smi` and the system's log, then start again"
    return None


@contextmanager
def failures_told() -> Iterator[None]:
    """Raises NeecoError, one line, where a CUDA device fails in the block (`device_failure`)."""
    try:
        yield
    except Exception as error:
        if (failure := device_failure(error)) is None:
            raise
        raise NeecoError(failure) from error


def _no_cuda() -> str:
    """Why PyTorch has no CUDA device, and the remedy."""
    if torch.version.cuda is None and torch.version.hip is None:
        return (
            f"{torch.__version__} is a build without CUDA; on Linux pip install --force-reinstall torch takes PyPI's, "
            "which has it"
        )
    try:
        torch.cuda.init()
        said = "it says no more"
    except (RuntimeError, AssertionError) as error:  # a driver that is missing, too old or without a card
        said = _first_line(error).rstrip(".")
    return f"{said}; check `nvidia-smi` and CUDA_VISIBLE_DEVICES, install or update NVIDIA's driver"


def _first_line(error: BaseException) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0]


def _not_built_for(device: torch.device) -> str | None:
    """Why this PyTorch has no kernels for the card; None: it has. Binaries (sm_XY) run on cards of the same major and
    no lower minor number, intermediate code (compute_XY) on all that are no older."""
    card = torch.cuda.get_device_capability(device)
    names = torch.cuda.get_arch_list()
    parsed = [found for name in names if (found := re.fullmatch(r"(sm|compute)_(\d+)(\d)[a-z]?", name))]
    built = [(kind, (int(major), int(minor))) for kind, major, minor in (found.groups() for found in parsed)]
    if not built or any(v <= card and (kind == "compute" or v[0] == card[0]) for kind, v in built):
        return None
    return (
        f"{torch.cuda.get_device_name(device)} has compute capability {card[0]}.{card[1]}, and PyTorch "
        f"{torch.__version__} is built for {', '.join(names)}; install one that is built for it (pytorch.org), or use "
        "--device cpu"
    )
