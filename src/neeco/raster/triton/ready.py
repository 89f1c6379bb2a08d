"""Availability of Triton on a device, with messages for users. Importing this needs no `triton`."""

from __future__ import annotations

import importlib.util
import os
from contextlib import AbstractContextManager, nullcontext
from functools import cache

import torch
from torch import Tensor

from neeco.base.errors import NeecoError, install_hint

OLDEST = (7, 0)  # compute capability that Triton compiles for


def installed() -> bool:
    """Return whether the package `triton` is installed, as with every CUDA build of PyTorch for Linux."""
    return importlib.util.find_spec("triton") is not None


def interpreted() -> bool:
    """Return whether Triton's interpreter replaces its compiler; kernels then run slowly, on CPU tensors."""
    return os.environ.get("TRITON_INTERPRET", "0").lower() in ("1", "true", "on", "yes", "y")


def missing(device: torch.device) -> str | None:
    """Return the missing requirement of Triton on `device`, without a trial run, and the remedy; None: none."""
    if not installed():
        return f"package triton is missing; on Linux {install_hint('triton')}, or render on the CPU"
    if interpreted():
        return None
    if device.type != "cuda":
        return f"tensors are on {device}; move them to a CUDA device or use backend='cpu' (tests: TRITON_INTERPRET=1)"
    capability = torch.cuda.get_device_capability(device)
    if capability < OLDEST:
        has, needs = (".".join(map(str, version)) for version in (capability, OLDEST))
        return f"{device} has compute capability {has}, Triton needs {needs}; use --device cpu"
    return None


@cache
def require_triton(device: torch.device) -> None:
    """Raise NeecoError unless Triton's kernels run on `device`."""
    if refusal := missing(device):
        raise NeecoError(f"backend: triton: {refusal}")
    if interpreted():
        return
    from neeco.raster.triton.probe import launch

    try:
        launch(device)
    except Exception as error:  # of driver, compiler or assembler
        message = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise NeecoError(
            f"backend: triton: cannot start a kernel on {device}: {message}; check `nvidia-smi` and that a C compiler "
            "and Python's headers are installed, or use --device cpu"
        ) from error


@cache
def starts_on(device: torch.device) -> bool:
    """Return whether `require_triton` accepts `device`."""
    try:
        require_triton(device)
    except NeecoError:
        return False
    return True


def runs_triton(tensor: Tensor) -> bool:
    """Return whether Triton's kernels process `tensor`: float32 on a CUDA device on which they run."""
    return tensor.is_cuda and tensor.dtype == torch.float32 and starts_on(tensor.device)


def working_on(device: torch.device) -> AbstractContextManager[None]:
    """Make `device` the current CUDA device, on which Triton launches kernels, within the block."""
    return torch.cuda.device(device) if device.type == "cuda" else nullcontext()
