"""How many threads the CPU kernels use, and which instruction set."""

from __future__ import annotations

from neeco.errors import NeecoError


def set_threads(count: int) -> None:
    """Use `count` threads in every CPU kernel; 0 = the default: the cores this process may use, at most OMP_NUM_THREADS."""
    from neeco import _native

    if count < 0:
        raise NeecoError(f"threads: {count}: must be 0 (automatic) or more")
    _native.set_thread_count(count)


def threads() -> int:
    """Threads that the CPU kernels use."""
    from neeco import _native

    return _native.thread_count()


def simd() -> str:
    """Instruction set in use: "sse2", "avx2", "avx512" or "neon". The environment variable NEECO_SIMD forces one."""
    from neeco import _native

    try:
        return _native.simd()
    except RuntimeError as error:
        raise NeecoError(str(error)) from error
