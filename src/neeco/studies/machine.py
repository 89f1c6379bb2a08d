"""The machine of a study: its description, peak memory of a piece of work, rendering speed of runs."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import platform
import re
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from neeco.capture.model import Capture, Frame
from neeco.errors import counted
from neeco.raster.native import simd, synchronise, threads
from neeco.training.run import TrainedRun

STATUS = Path("/proc/self/status")
CLEAR = Path("/proc/self/clear_refs")
RESET_PEAK = "5"  # proc(5): resets the high-water mark of the resident memory

WARM_UP_IMAGES = 3  # rendered before any is timed
N_ROUNDS = 3  # every run is rendered in turn: a slow moment of the machine affects them all
TIMED_IMAGES = 7  # per run and round
MAX_ROUND_S = 5.0  # per run and round, half of it to warm up: slow methods are timed by fewer images


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


def reset_peak_memory() -> bool:
    """Begin a new high-water mark of this process's resident memory; False where the system has none.

    What earlier work freed goes back to the system first, as far as the C library can (glibc): it would count here too.
    """
    gc.collect()
    with contextlib.suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(ctypes.c_size_t(0))
    try:
        CLEAR.write_text(RESET_PEAK)
    except OSError:
        return False
    return peak_memory_mb() is not None


def peak_memory_mb() -> float | None:
    """Most resident memory of this process since the last reset, in MiB; None where the system does not report it."""
    try:
        found = re.search(r"^VmHWM:\s+(\d+)", STATUS.read_text(encoding="ascii", errors="replace"), re.MULTILINE)
    except OSError:
        return None
    return round(int(found[1]) / 1024, 1) if found else None


@torch.no_grad()
def measure_speed(
    runs: Sequence[tuple[str, int, TrainedRun]],
    capture: Capture,
    device: torch.device,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Frames per second of every (name, seed, run) on the CPU and, if it is another, on `device`, posing included.

    All are measured side by side, in turn. Moves the scenes. Returns {"rows": [{name, seed, method, backend, fps,
    milliseconds, draws, num_gaussians}], "image": [width, height], "frames": how many states were rendered in turn,
    "machine", "how"}. fps is 1 / the median.
    """
    frames = [frame for frame in capture.frames if frame.split != "train"] or list(capture.frames)
    report = progress or (lambda done, total: None)
    devices = dict.fromkeys((torch.device("cpu"), device))
    cases = [(index, device) for device in devices for index in range(len(runs))]
    times: dict[tuple[int, torch.device], list[float]] = {case: [] for case in cases}
    for step in range(N_ROUNDS):
        for number, (index, where) in enumerate(cases, 1):
            times[index, where] += _timed(runs[index][2], frames, where)
            report(step * len(cases) + number, N_ROUNDS * len(cases))
    rows = []
    for (index, where), seconds in times.items():
        (name, seed, run), median = runs[index], statistics.median(seconds)
        row = {"name": name, "seed": seed, "method": run.config["method"], "backend": where.type}
        row |= {"fps": round(1 / median, 3), "milliseconds": round(1000 * median, 4), "draws": len(seconds)}
        rows.append(row | {"num_gaussians": run.scene.num_gaussians})
    camera = frames[0].camera
    return {
        "rows": rows,
        "image": [camera.width, camera.height],
        "frames": len(frames),
        "machine": machine(device),
        "how": f"Posing and rendering held-out frames in turn, 1 / median, {N_ROUNDS} rounds of up to {TIMED_IMAGES} "
        f"images per run after up to {WARM_UP_IMAGES} to warm up",
    }


def _timed(run: TrainedRun, frames: Sequence[Frame], device: torch.device) -> list[float]:
    """Seconds of each timed image."""
    seconds: list[float] = []
    scene = run.scene.to(device)
    with scene.torch_threads():  # each as it would be rendered by itself, though they take turns
        for count, limit_s in ((WARM_UP_IMAGES, MAX_ROUND_S / 2), (TIMED_IMAGES, MAX_ROUND_S)):
            seconds.clear()
            began = time.perf_counter()
            while len(seconds) < count and time.perf_counter() - began < limit_s:
                start = time.perf_counter()
                frame = frames[len(seconds) % len(frames)]
                synchronise(scene.render(frame.state, frame.camera).color.device)
                seconds.append(time.perf_counter() - start)
    return seconds
