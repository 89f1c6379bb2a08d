"""The machine that numbers were taken on, in words, and how much of its memory a piece of work takes at most."""

from __future__ import annotations

import ctypes
import gc
import os
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from neeco.raster.devices import cuda_backend
from neeco.raster.native import simd, threads

STATUS = Path("/proc/self/status")
CLEAR = Path("/proc/self/clear_refs")
RESET_PEAK = "5"  # proc(5): resets the high-water mark of the resident memory


def machine(device: torch.device) -> dict[str, Any]:
    """Processor, cores this process may use, threads, versions, and the GPU where `device` is one."""
    on_gpu = device.type == "cuda"
    return {
        "cpu": processor_name(),
        "cores": usable_cores(),
        "threads": threads(),
        "torch_threads": torch.get_num_threads(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "torch": torch.__version__,
        "backend": f"{cuda_backend()} (CUDA {torch.version.cuda})" if on_gpu else f"cpu ({simd()})",
        "gpu": torch.cuda.get_device_name(device) if on_gpu else None,
    }


def hardware_words(machine: Mapping[str, Any]) -> str:
    """What computed, of what `machine` told: the GPU, if it was one, and the processor."""
    gpu = f"{machine['gpu']}, " if machine.get("gpu") else ""
    return f"{gpu}{machine['cpu']}, {machine['cores']} cores"


def processor_name() -> str:
    """The processor's name as the system knows it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith(("model name", "Model"))]
    return names[0] if names else platform.processor() or platform.machine()


def usable_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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
