"""How fast finished runs draw, measured one beside the other on the same machine in the same state."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch

from neeco.capture.model import Capture, Frame
from neeco.experiments.machine import machine
from neeco.raster.native import synchronise
from neeco.training.run import Run

WARM_UP = 3  # draws before any is timed
ROUNDS = 3  # every run is drawn in turn, so often: a slow moment of the machine meets them all
DRAWS = 7  # timed per run and round
PATIENCE = 5.0  # s per run and round, half of it to warm up: slow methods are timed by fewer draws


@torch.no_grad()
def measure_speed(
    runs: Sequence[tuple[str, int, Run]],
    capture: Capture,
    device: torch.device,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Frames per second of every (name, seed, run) on the processor and, if it is another, on `device`, posing
    included, in one go. Moves the scenes.

    Returns {"rows": [{name, seed, method, backend, fps, milliseconds, draws, num_gaussians}], "image": [width, height],
    "frames": how many states were drawn in turn, "machine", "how"}. fps is 1 / the median.
    """
    frames = [frame for frame in capture.frames if frame.split != "train"] or list(capture.frames)
    report = progress or (lambda done, total: None)
    devices = dict.fromkeys((torch.device("cpu"), device))
    cases = [(index, device) for device in devices for index in range(len(runs))]
    times: dict[tuple[int, torch.device], list[float]] = {case: [] for case in cases}
    for step in range(ROUNDS):
        for number, case in enumerate(cases):
            report(step * len(cases) + number, ROUNDS * len(cases))
            times[case] += _timed(runs[case[0]][2], frames, case[1])
    report(ROUNDS * len(cases), ROUNDS * len(cases))
    rows = [_row(runs[index], device, values) for (index, device), values in times.items()]
    camera = frames[0].camera
    return {
        "rows": rows,
        "image": [camera.width, camera.height],
        "frames": len(frames),
        "machine": machine(device),
        "how": f"Posing and drawing held-out frames in turn, 1 / median, {ROUNDS} rounds of up to {DRAWS} draws per "
        f"run after up to {WARM_UP} to warm up",
    }


def _timed(run: Run, frames: Sequence[Frame], device: torch.device) -> list[float]:
    """Seconds of each timed draw."""
    seconds: list[float] = []
    scene = run.scene.to(device)
    with scene.torch_threads():  # each as it would be drawn by itself, though they are drawn in turn
        for count, patience in ((WARM_UP, PATIENCE / 2), (DRAWS, PATIENCE)):
            seconds.clear()
            began = time.perf_counter()
            while len(seconds) < count and time.perf_counter() - began < patience:
                start = time.perf_counter()
                frame = frames[len(seconds) % len(frames)]
                synchronise(scene.draw(frame.state, frame.camera).color.device)
                seconds.append(time.perf_counter() - start)
    return seconds


def _row(entry: tuple[str, int, Run], device: torch.device, seconds: list[float]) -> dict[str, Any]:
    name, seed, run = entry
    median = statistics.median(seconds)
    return {
        "name": name,
        "seed": seed,
        "method": run.config["method"],
        "backend": device.type,
        "fps": round(1 / median, 3),
        "milliseconds": round(1000 * median, 4),
        "draws": len(seconds),
        "num_gaussians": run.scene.num_gaussians,
    }
