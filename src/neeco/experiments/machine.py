"""The machine that numbers were taken on, in words."""

from __future__ import annotations

import platform
from pathlib import Path
from typing import Any

import torch

from neeco.experiments.cluster import usable_cores
from neeco.raster.threads import simd, threads


def machine() -> dict[str, Any]:
    """Processor, cores this process may use, threads, and versions."""
    return {
        "cpu": processor_name(),
        "cores": usable_cores(),
        "threads": threads(),
        "torch_threads": torch.get_num_threads(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "torch": torch.__version__,
        "backend": f"cpu ({simd()})",
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }


def processor_name() -> str:
    """The processor's name as the system knows it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith(("model name", "Model"))]
    return names[0] if names else platform.processor() or platform.machine()
