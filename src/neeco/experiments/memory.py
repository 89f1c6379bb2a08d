"""How much memory a piece of work takes at most."""

from __future__ import annotations

import ctypes
import gc
from pathlib import Path

STATUS = Path("/proc/self/status")
CLEAR = Path("/proc/self/clear_refs")
RESET_PEAK = "5"  # proc(5): resets the high-water mark of the resident memory


def reset_peak_memory() -> bool:
    """Begin a new high-water mark of this process's resident memory; False where the system has none.

    What earlier work freed goes back to the system first, as far as the C library can (glibc): it would count here too.
    """
    gc.collect()
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):
        pass
    else:
        trim(ctypes.c_size_t(0))
    try:
        CLEAR.write_text(RESET_PEAK)
    except OSError:
        return False
    return peak_memory_mb() is not None


def peak_memory_mb() -> float | None:
    """Most resident memory of this process since the last reset, in MiB; None where the system does not tell."""
    try:
        lines = STATUS.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return None
    for line in lines:
        if line.startswith("VmHWM:"):
            return round(int(line.split()[1]) / 1024, 1)
    return None
