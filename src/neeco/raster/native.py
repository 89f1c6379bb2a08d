"""The compiled kernels: loading them, their threads, and the choice between them and plain torch."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from neeco.base.errors import NeecoError

Family = Literal["native", "torch"]
_family: ContextVar[Family] = ContextVar("family of kernels", default="native")


def native() -> Any:
    """Return the module `neeco._native`. Raises NeecoError if it was not built."""
    try:
        return importlib.import_module("neeco._native")
    except ImportError as error:
        raise NeecoError("neeco._native: the compiled kernels are missing; install with `pip install .`") from error


@contextmanager
def kernels(family: Family) -> Iterator[None]:
    """Select the `family` of kernels that this thread uses for CPU tensors within the block.

    "native": neeco's own, the default; "torch": plain torch, which works on every device and is slow. Applies to
    `rasterize(backend="auto")`, `photometric_loss` and `adam_steps`. Raises NeecoError for another family.
    """
    if family not in get_args(Family):
        raise NeecoError(f"kernels: {family!r}: unknown; use one of {', '.join(get_args(Family))}")
    token = _family.set(family)
    try:
        yield
    finally:
        _family.reset(token)


def runs_native(tensor: Tensor) -> bool:
    """Return whether the native kernels process `tensor`: on the CPU, outside `kernels("torch")`."""
    return tensor.device.type == "cpu" and _family.get() == "native"


def all_run_native(*tensors: Tensor) -> bool:
    """Return whether the native kernels, which support only float32, process `tensors`."""
    return all(runs_native(tensor) and tensor.dtype == torch.float32 for tensor in tensors)


def set_threads(count: int) -> None:
    """Use `count` threads in every CPU kernel; 0: the cores this process may use, at most OMP_NUM_THREADS."""
    if count < 0:
        raise NeecoError(f"threads: must be at least 0 (0: automatic) (got {count})")
    native().set_thread_count(count)


def threads() -> int:
    """Return the number of threads of the CPU kernels."""
    return native().thread_count()


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch's own operations use `count` threads within the block; the kernels keep theirs.

    Threads that share a small operation wait for each other longer than they work: one is best for the operations
    between two renderings.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def synchronise(device: torch.device) -> None:
    """Wait until `device` has finished its queue, for time measurements."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def simd() -> str:
    """Return the instruction set in use: "sse2", "avx2", "avx512" or "neon". The environment variable NEECO_SIMD forces
    one."""
    try:
        return native().simd()
    except RuntimeError as error:
        raise NeecoError(str(error)) from error


def keep_freed_memory() -> bool:
    """Let this process keep up to 1 GiB of freed memory; return whether the system supports it (glibc).

    A training step frees megabytes of tensors that the next one allocates again; by default the system takes them back
    and clears every page. A setting of the whole process, for programs, not libraries.
    """
    return native().keep_freed_memory()
