"""How fast finished runs draw, measured one beside the other on the same machine in the same state."""

from __future__ import annotations

import dataclasses
import importlib.util
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch

from neeco.capture.model import Capture, Frame
from neeco.experiments.machine import machine
from neeco.raster import rasterize
from neeco.raster.threads import synchronise
from neeco.raster.types import Gaussians
from neeco.scene.scene import gaussian_scene
from neeco.training.run import Run

WARM_UP = 3  # draws before any is timed
ROUNDS = 3  # every run is drawn in turn, so often: a slow moment of the machine meets them all
DRAWS = 7  # timed per run and round
PATIENCE = 5.0  # s per run and round, half of it to warm up: slow methods are timed by fewer draws


def backends() -> tuple[str, ...]:
    """The rasteriser's backends that this machine can draw with at speed."""
    cuda = torch.cuda.is_available() and importlib.util.find_spec("gsplat") is not None
    return ("cpu", "cuda") if cuda else ("cpu",)


@torch.no_grad()
def measure_speed(
    runs: Sequence[tuple[str, int, Run]], capture: Capture, progress: Callable[[int, int], None] | None = None
) -> dict[str, Any]:
    """Frames per second of every (name, seed, run), posing included, in one go.

    Returns {"rows": [{name, seed, method, backend, fps, milliseconds, draws, num_gaussians}], "image": [width, height],
    "frames": how many states were drawn in turn, "machine", "how"}. fps is 1 / the median.
    """
    frames = [frame for frame in capture.frames if frame.split != "train"] or list(capture.frames)
    report = progress or (lambda done, total: None)
    cases = [
        (index, backend)
        for backend in backends()
        for index, (_, _, run) in enumerate(runs)
        if backend == "cpu" or run.scene.has_gaussians  # a field is drawn where it is
    ]
    times: dict[tuple[int, str], list[float]] = {case: [] for case in cases}
    for step in range(ROUNDS):
        for number, case in enumerate(cases):
            report(step * len(cases) + number, ROUNDS * len(cases))
            times[case] += _timed(runs[case[0]][2], frames, case[1])
    report(ROUNDS * len(cases), ROUNDS * len(cases))
    rows = [_row(runs[index], backend, values, frames[0]) for (index, backend), values in times.items()]
    camera = frames[0].camera
    return {
        "rows": rows,
        "image": [camera.width, camera.height],
        "frames": len(frames),
        "machine": machine(),
        "how": f"Posing and drawing held-out frames in turn, 1 / median, {ROUNDS} rounds of up to {DRAWS} draws per "
        f"run after up to {WARM_UP} to warm up" + ("; cuda: posed on the processor" if "cuda" in backends() else ""),
    }


def _timed(run: Run, frames: Sequence[Frame], backend: str) -> list[float]:
    """Seconds of each timed draw."""
    seconds: list[float] = []
    with run.scene.torch_threads():
        for count, patience in ((WARM_UP, PATIENCE / 2), (DRAWS, PATIENCE)):
            seconds.clear()
            began = time.perf_counter()
            while len(seconds) < count and time.perf_counter() - began < patience:
                start = time.perf_counter()
                _draw(run, frames[len(seconds) % len(frames)], backend)
                seconds.append(time.perf_counter() - start)
    return seconds


def _draw(run: Run, frame: Frame, backend: str) -> None:
    if backend == "cuda":
        scene = gaussian_scene(run.scene, "backend cuda")
        drawn = rasterize(_on_cuda(scene.at(frame.state)), scene.camera(frame.camera), backend=backend)
    else:
        drawn = run.scene.draw(frame.state, frame.camera)
    synchronise(drawn.color.device)


def _on_cuda(gaussians: Gaussians) -> Gaussians:
    def moved(value: Any) -> Any:
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            return dataclasses.replace(
                value, **{f.name: moved(getattr(value, f.name)) for f in dataclasses.fields(value)}
            )
        return value.cuda() if isinstance(value, torch.Tensor) else value

    return moved(gaussians)


def _row(entry: tuple[str, int, Run], backend: str, seconds: list[float], frame: Frame) -> dict[str, Any]:
    name, seed, run = entry
    median = statistics.median(seconds)
    return {
        "name": name,
        "seed": seed,
        "method": run.config["method"],
        "backend": backend,
        "fps": round(1 / median, 3),
        "milliseconds": round(1000 * median, 4),
        "draws": len(seconds),
        "num_gaussians": run.scene.num_gaussians,
    }
