"""Times the networks of `nps` and `deformable-3dgs`, forward and backward: float32 against bfloat16, in turns.

    python benchmarks/networks.py [--gaussians 2000 8000] [--threads 1 2] [--repeats 15]

Medians in ms, of the clock and of the process's time (all threads together), and the greatest relative errors of
outputs and of parameters' gradients in bfloat16, for random outputs' gradients and weights as they are initialised.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections import defaultdict
from dataclasses import replace

import torch
from torch import Tensor

from neeco.capture.model import Instrument
from neeco.methods.nps import NPS
from neeco.methods.time_mlp import TimeMLP
from neeco.raster.native import keep_freed_memory, torch_threads

INSTRUMENT = Instrument("scissors", {"jaw_angle": None})


class Case:
    """One network with its inputs."""

    def __init__(self, kind: type[NPS] | type[TimeMLP], gaussians: int) -> None:
        torch.manual_seed(0)
        self.network = kind((INSTRUMENT,))
        torch.nn.init.normal_(self.network.head.weight)
        self.places = torch.rand(gaussians, 3) * 2 - 1
        moment = torch.rand(8 if kind is NPS else 1) * 2 - 1
        self.moment = (torch.pi * moment[:, None] * 2.0 ** torch.arange(10)).flatten()
        self.moment = torch.cat([self.moment.sin(), self.moment.cos(), *([] if kind is NPS else [moment])])
        self.gradient = torch.randn(gaussians, 10)

    def step(self, half: bool) -> tuple[float, float, list[Tensor]]:
        """Seconds of the clock and of the process, and what came out."""
        network = self.network
        network.settings = replace(network.settings, half=half)
        network.zero_grad()
        start, used = time.perf_counter(), time.process_time()
        output = network.network(self.places, self.moment)
        output.backward(self.gradient)
        taken, used = time.perf_counter() - start, time.process_time() - used
        return taken, used, [output.detach(), *(p.grad.clone() for p in network.parameters() if p.grad is not None)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, nargs="+", default=[2000, 8000])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeats", type=int, default=15)
    arguments = parser.parse_args()
    keep_freed_memory()
    print("method, Gaussians, threads: float32 clock / process, bfloat16 clock / process; errors of outputs, gradients")
    for kind in (NPS, TimeMLP):
        for gaussians in arguments.gaussians:
            case = Case(kind, gaussians)
            for threads in arguments.threads:
                with torch_threads(threads):
                    print(f"{kind.method}, {gaussians}, {threads}: {_compared(case, arguments.repeats)}", flush=True)


def _compared(case: Case, repeats: int) -> str:
    exact, rough = (case.step(half)[2] for half in (False, True))
    errors = [float((b - a).norm() / a.norm()) for a, b in zip(exact, rough, strict=True)]
    times = defaultdict(list)
    for _ in range(repeats):
        for half in (False, True):
            times[half].append(case.step(half)[:2])
    middles = [1e3 * statistics.median(column) for half in (False, True) for column in zip(*times[half], strict=True)]
    return "{:.1f} / {:.1f}, {:.1f} / {:.1f} ms".format(*middles) + f"; {errors[0]:.4f}, {max(errors[1:]):.3f}"


if __name__ == "__main__":
    main()
