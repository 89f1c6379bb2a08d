"""The machine of a study, described for tables and pages."""

from __future__ import annotations

import os
import platform
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from neeco.base.errors import counted
from neeco.raster.native import simd, threads


def machine(device: torch.device, workers: int | None = None) -> dict[str, Any]:
    """Processor, cores this process may use, threads, versions, and the GPU where `device` is one; of a study also its
    `workers`, and the threads that each of several has."""
    on_gpu = device.type == "cuda"
    share = threads_per_worker(workers) if workers is not None and workers > 1 else None
    return {
        "cpu": processor_name(),
        "cores": usable_cores(),
        "threads": threads(),
        "torch_threads": torch.get_num_threads(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "torch": torch.__version__,
        "backend": f"triton (CUDA {torch.version.cuda})" if on_gpu else f"cpu ({simd()})",
        "gpu": torch.cuda.get_device_name(device) if on_gpu else None,
    } | ({} if workers is None else {"workers": workers, "threads_per_worker": share})


def hardware_words(machine: Mapping[str, Any]) -> str:
    """Return the GPU, if there was one, and the processor, from what `machine` returned."""
    gpu = f"{machine['gpu']}, " if machine.get("gpu") else ""
    return f"{gpu}{machine['cpu']}, {machine['cores']} cores"


def machine_words(machine: Mapping[str, Any], threads: str = "threads") -> str:
    """The machine that a study's numbers were taken on. threads: the field that counts them where it had one worker."""
    count = machine["threads_per_worker"] or machine[threads]
    workers = f", {machine['workers']} at once" if machine["workers"] > 1 else ""
    return f"{hardware_words(machine)}, {counted(count, 'thread')}{workers}, torch {machine['torch']}"


def threads_per_worker(workers: int, cores: int | None = None) -> int:
    """Each of `workers` gets its share of the cores, at least one thread."""
    return max(1, (cores or usable_cores()) // workers)


def processor_name() -> str:
    """The processor's name as the system knows it."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        text = ""
    found = re.search(r"^(?:model name|Model)[^:\n]*:(.*)$", text, re.MULTILINE)
    return found[1].strip() if found else platform.processor() or platform.machine()


def usable_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
