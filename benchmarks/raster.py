"""Times rendering on a CPU: stages, forward, forward + backward.

python benchmarks/raster.py [--threads N] [--repeats N]
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections import defaultdict
from collections.abc import Callable

import torch
from torch import Tensor

from neeco.raster import Camera, Gaussians, rasterize
from neeco.raster.losses import photometric_loss
from neeco.raster.native import keep_freed_memory, native, set_threads, simd
from neeco.raster.optimizer import Update, adam_steps

WORKLOADS = {
    "20k, 256x192": (20_000, 256, 192),
    "100k, 640x480": (100_000, 640, 480),
    "300k, 960x540": (300_000, 960, 540),
}
STAGES = ("project", "bin", "composite", "composite_backward", "project_backward")
Timings = dict[str, list[float]]


def make_surface(count: int, width: int, height: int, sh_count: int) -> tuple[Gaussians, Camera]:
    """A blobby closed surface of random Gaussians that fills the image; about 50 of them blend at a pixel."""
    g = torch.Generator().manual_seed(0)
    u = torch.nn.functional.normalize(torch.randn(count, 3, generator=g), dim=-1)
    radius = torch.ones(count)
    for _ in range(6):
        frequency, phase = torch.randn(3, generator=g) * 2.2, torch.rand(1, generator=g) * 6.28
        radius = radius + 0.07 * torch.sin(u @ frequency + phase)
    means = u * radius[:, None] + 0.01 * torch.randn(count, 3, generator=g)
    means = means * torch.tensor([width / height * 0.95, 1.0, 1.0])
    scales = math.sqrt(4 * math.pi / count) * torch.exp(torch.randn(count, 3, generator=g) * 0.45 - 0.1)
    quats = torch.randn(count, 4, generator=g)
    opacities = torch.sigmoid(torch.randn(count, generator=g) * 1.2)
    sh = torch.zeros(count, sh_count, 3)
    sh[:, 0] = (torch.rand(count, 3, generator=g) - 0.5) / 0.28209479177387814
    sh[:, 1:] = torch.randn(count, sh_count - 1, 3, generator=g) * 0.02
    c, s = math.cos(0.3), math.sin(0.3)
    rotation = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])  # camera_from_world
    pose = torch.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ torch.tensor([0.0, 0.0, 2.6])
    focal = 1.15 * height
    return Gaussians(means, quats, scales, opacities, sh), Camera(
        pose, focal, focal, width / 2 + 1.3, height / 2 - 0.7, width, height
    )


class Runner:
    """Forward and forward + backward of `rasterize`, with gradients of everything but the camera."""

    def __init__(self, gaussians: Gaussians, camera: Camera, image_gradients: tuple[Tensor, Tensor, Tensor]) -> None:
        names = ("means", "quats", "scales", "opacities", "sh")
        self.leaves = [getattr(gaussians, name).clone().requires_grad_() for name in names]
        self.camera, self.image_gradients = camera, image_gradients

    def __call__(self, timings: Timings) -> None:
        start = time.perf_counter()
        out = rasterize(Gaussians(*self.leaves), self.camera, backend="cpu")
        middle = time.perf_counter()
        torch.autograd.backward([out.color, out.depth, out.alpha], list(self.image_gradients))
        end = time.perf_counter()
        for leaf in self.leaves:
            leaf.grad = None
        timings["forward"].append((middle - start) * 1e3)
        timings["forward+backward"].append((end - start) * 1e3)
        for stage, value in native().last_statistics().items():
            timings[stage].append(value)


def median_of(call: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append((time.perf_counter() - start) * 1e3)
    return statistics.median(times)


def run_workload(name: str, arguments: argparse.Namespace) -> None:
    count, width, height = WORKLOADS[name]
    gaussians, camera = make_surface(count, width, height, arguments.sh)
    g = torch.Generator().manual_seed(1)
    shapes = [(height, width, 3), (height, width), (height, width)]
    color, depth, alpha = (torch.randn(shape, generator=g) / 1000 for shape in shapes)
    run = Runner(gaussians, camera, (color, depth, alpha))
    timings: Timings = defaultdict(list)
    for repeat in range(arguments.repeats + 2):
        if repeat == 2:
            timings.clear()
        run(timings)
    median = {k: statistics.median(v) for k, v in timings.items()}
    drawn = f"{int(median['visible'])} drawn, {int(median['pairs'])} pairs"
    print(f"\n{name}, SH {arguments.sh}: ms, median of {arguments.repeats} ({drawn})")
    print("  " + "  ".join(f"{stage} {median[stage]:.1f}" for stage in STAGES))
    print(f"  forward {median['forward']:.1f}, forward+backward {median['forward+backward']:.1f}")


def run_training_kernels(repeats: int) -> None:
    image, target = torch.rand(2, 256, 320, 3)
    image.requires_grad_()
    plain = median_of(lambda: photometric_loss(image, target).backward(), repeats)
    tensors = torch.rand(4, 100_000, 48)
    adam = median_of(lambda: adam_steps([Update(*tensors, lr=1e-3, step=5)]), repeats)
    print(f"\nloss 320x256x3, forward+backward: {plain:.2f} ms")
    print(f"Adam, 4.8M numbers: {adam:.2f} ms")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--sh", type=int, default=16, choices=(1, 4, 9, 16), help="SH coefficients per colour")
    parser.add_argument("--workload", choices=list(WORKLOADS), action="append", help="default: all three")
    arguments = parser.parse_args()
    set_threads(arguments.threads)
    keep_freed_memory()  # as training does
    print(f"{simd()}, {arguments.threads} threads")
    for name in arguments.workload or WORKLOADS:
        run_workload(name, arguments)
    run_training_kernels(arguments.repeats)


if __name__ == "__main__":
    main()
