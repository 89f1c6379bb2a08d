"""How many threads the CPU kernels and torch use, which instruction set, and what becomes of freed memory."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from neeco.errors import NeecoError
from neeco.raster.native import native


def set_threads(count: int) -> None:
    """Use `count` threads in every CPU kernel; 0: the cores this process may use, at most OMP_NUM_THREADS."""
    if count < 0:
        raise NeecoError(f"threads: {count}: must be 0 (automatic) or more")
    native().set_thread_count(count)


def threads() -> int:
    """Threads that the CPU kernels use."""
    return native().thread_count()


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch's own operations use `count` threads until the end of the block; the kernels keep theirs.

    Threads that share a small operation wait for each other, at full load, longer than they work: one is best for the
    operations between two drawings.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def synchronise(device: torch.device) -> None:
    """Wait until `device` has done all that it was asked: before a clock is read."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def simd() -> str:
    """Instruction set in use: "sse2", "avx2", "avx512" or "neon". The environment variable NEECO_SIMD forces one."""
    try:
        return native().simd()
    except RuntimeError as error:
        raise NeecoError(str(error)) from error


def keep_freed_memory() -> bool:
    """Let this process keep what it frees, up to 1 GiB; whether the system can (glibc).

    A training step frees megabytes of tensors that the next one wants again; by default the system takes them back
    and clears every page anew. A setting of the whole process: for programs to call, not for libraries.
    """
    return native().keep_freed_memory()
