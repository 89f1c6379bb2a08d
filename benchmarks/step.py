"""Times training steps of a run where its checkpoint left it: ms of the whole step, and of its parts.

    neeco train CAPTURE --method kinematic --iterations 2500 --output RUN
    python benchmarks/step.py RUN [--steps N] [--threads N] [--cpu-time]

The run's folder is only read. A part's time is without that of the parts within it; `autograd` is what the backward
pass takes beside the gradients listed. `--cpu-time` counts the process's time instead of the clock's: with it, what
else the machine does hardly shows.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from neeco.capture.checks import read_checked
from neeco.raster import articulated, cpu_backend, losses, shadow
from neeco.raster.native import keep_freed_memory, set_threads
from neeco.raster.optimizer import Adam
from neeco.scene.gaussian_scene import GaussianScene
from neeco.scene.training_views import TrainingViews
from neeco.training import session as steps
from neeco.training.initial import begin_session
from neeco.training.run import read_checkpoint, read_config, restore_session, stored_config

PARTS: list[tuple[Any, str, str]] = [
    (GaussianScene, "at", "GaussianScene.at without posing"),
    (cpu_backend._Rasterize, "forward", "rasterizing, shadow maps too"),
    (cpu_backend._Rasterize, "backward", "rasterizing, backward"),
    (shadow, "blocked", "shadows"),
    (shadow._Blocked, "backward", "shadows, backward"),
    (articulated._Pose, "backward", "posing, backward"),
    (losses._Photometric, "forward", "loss with its gradient"),
    (torch.Tensor, "backward", "autograd"),
    (steps.GaussianSession, "_regularisation", "regularisation"),
    (Adam, "step", "Adam"),
    (steps.Refinement, "apply", "refinement"),
    (steps.Refinement, "step", "refinement"),
    (steps.GaussianSession, "step", "the rest of a step"),
]


class Parts:
    """Seconds spent in named functions, each without what others of them took within it."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self.clock = clock
        self.seconds: dict[str, float] = defaultdict(float)
        self.within: list[float] = []

    def watch(self, owner: Any, name: str, label: str) -> None:
        """Time every call of `owner.name` from now on."""
        function = getattr(owner, name)

        def timed(*args: Any, **kwargs: Any) -> Any:
            self.within.append(0.0)
            start = self.clock()
            try:
                return function(*args, **kwargs)
            finally:
                taken = self.clock() - start
                self.seconds[label] += taken - self.within.pop()
                if self.within:
                    self.within[-1] += taken

        static = isinstance(vars(owner).get(name), staticmethod)
        setattr(owner, name, staticmethod(timed) if static else timed)


def session_of(run: Path) -> Any:
    """The training session that the checkpoint of a run folder holds."""
    stored = read_config(run)
    config = stored_config(run, stored)
    capture = read_checked(Path(stored["capture"]), config.transforms)
    views = TrainingViews.read(capture.split("train"))
    scene, header, tensors = read_checkpoint(run)
    session = begin_session(capture, views, config, print, scene)
    restore_session(session, header, tensors)
    return session


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--threads", type=int, default=0, help="of the kernels; 0: all cores")
    parser.add_argument("--cpu-time", action="store_true", help="the process's time, all threads together")
    arguments = parser.parse_args()
    set_threads(arguments.threads)
    torch.set_num_threads(1)  # as training does
    keep_freed_memory()
    clock = time.process_time if arguments.cpu_time else time.perf_counter
    session = session_of(arguments.run)
    counts = " + ".join(str(count) for count in session.scene.canonical.counts)
    for _ in range(5):
        session.step()
    times = []
    for _ in range(arguments.steps):
        start = clock()
        session.step()
        times.append((clock() - start) * 1e3)
    low, middle, high = statistics.quantiles(times)
    print(f"{counts} Gaussians: {middle:.1f} ms a step (quartiles {low:.1f} and {high:.1f})")
    parts = Parts(clock)
    for owner, name, label in [*PARTS, (type(session.scene.deformation), "pose", "posing")]:
        parts.watch(owner, name, label)
    for _ in range(arguments.steps):
        session.step()
    for label, seconds in sorted(parts.seconds.items(), key=lambda item: -item[1]):
        print(f"  {label:28s} {seconds / arguments.steps * 1e3:6.2f}")


if __name__ == "__main__":
    main()
