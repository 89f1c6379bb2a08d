"""Times rendering: stages, forward, forward + backward, beside the arithmetic floor and a PyTorch tile loop.

    python benchmarks/raster.py [--threads N] [--repeats N] [--torch] [--compare LIB.so]

`--compare` times another library in turns with ours, call by call, on the same Gaussians: a shared library with the C
functions rs_new, rs_vw, rs_threads, rs_forward and rs_backward (colours instead of SH, depth as fourth channel). With
`--cpu-time` and one thread, other processes hardly disturb the comparison.
"""

from __future__ import annotations

import argparse
import ctypes
import math
import statistics
import time
from collections import defaultdict
from collections.abc import Callable

import torch
from torch import Tensor

from neeco.raster import Camera, Gaussians, rasterize
from neeco.raster.cpu_backend import last_statistics
from neeco.raster.losses import photometric_loss
from neeco.raster.native import keep_freed_memory, set_threads, simd
from neeco.raster.optimizer import adam_step
from neeco.raster.reference import Projection, blend_weights, camera_from_world, project

WORKLOADS = {
    "20k, 256x192": (20_000, 256, 192),
    "100k, 640x480": (100_000, 640, 480),
    "300k, 960x540": (300_000, 960, 540),
}
STAGES = ("project", "bin", "composite", "composite_backward", "project_backward")
FLOPS_FORWARD, FLOPS_BACKWARD = 35, 60  # per Gaussian and pixel, 4 composited values
Timings = dict[str, list[float]]
clock: Callable[[], float] = time.perf_counter


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


class Ours:
    """Forward and forward + backward of `rasterize`, with gradients of everything but the camera."""

    def __init__(self, gaussians: Gaussians, camera: Camera, image_gradients: tuple[Tensor, Tensor, Tensor]) -> None:
        self.leaves = [
            t.clone().requires_grad_()
            for t in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
        ]
        self.camera, self.image_gradients = camera, image_gradients

    def __call__(self, timings: Timings, name: str) -> None:
        start = clock()
        out = rasterize(Gaussians(*self.leaves), self.camera, backend="cpu")
        middle = clock()
        torch.autograd.backward([out.color, out.depth, out.alpha], list(self.image_gradients))
        end = clock()
        for leaf in self.leaves:
            leaf.grad = None
        timings[f"{name} forward"].append((middle - start) * 1e3)
        timings[f"{name} forward+backward"].append((end - start) * 1e3)
        for stage, value in last_statistics().items():
            timings[stage].append(value)


class Other:
    """The same through a library with the C interface above."""

    def __init__(
        self, path: str, threads: int, gaussians: Gaussians, camera: Camera, gradients: tuple[Tensor, ...]
    ) -> None:
        self.library = ctypes.CDLL(path)
        self.library.rs_new.restype = ctypes.c_void_p
        self.handle = ctypes.c_void_p(self.library.rs_new())
        self.library.rs_threads(threads)
        self.tile = (8, 64) if self.library.rs_vw() == 16 else (8, 16)
        n, h, w = len(gaussians), camera.height, camera.width
        rotation, translation = camera_from_world(camera.world_from_camera)
        self.view = torch.eye(4)
        self.view[:3, :3], self.view[:3, 3] = rotation, translation
        self.intrinsics = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        self.inputs = [gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities]
        self.colors = (gaussians.sh[:, 0] * 0.28209479177387814 + 0.5).contiguous()
        self.size, self.images = (w, h), (torch.empty(h, w, 4), torch.empty(h, w))
        color, depth, alpha = gradients
        self.gradients = (torch.cat([color, depth[..., None]], dim=-1).contiguous(), alpha)
        self.outputs = [torch.empty(n, k) for k in (3, 4, 3, 1, 3, 2)]

    def __call__(self, timings: Timings, name: str) -> None:
        def p(t: Tensor) -> ctypes.c_void_p:
            return ctypes.c_void_p(t.data_ptr())

        (w, h), (color, alpha) = self.size, self.images
        gaussians, n = [p(t) for t in self.inputs], self.inputs[0].shape[0]
        start = clock()
        self.library.rs_forward(
            self.handle, n, *gaussians, p(self.colors), 3, 1, p(self.view), p(self.intrinsics), w, h, None,
            *self.tile, 1, p(color), p(alpha),
        )  # fmt: skip
        middle = clock()
        self.library.rs_backward(
            self.handle, *gaussians, 3, 1, p(self.view), p(self.intrinsics), None, *[p(t) for t in self.gradients],
            *[p(t) for t in self.outputs], 0,
        )  # fmt: skip
        end = clock()
        timings[f"{name} forward"].append((middle - start) * 1e3)
        timings[f"{name} forward+backward"].append((end - start) * 1e3)


def torch_tile_loop(gaussians: Gaussians, camera: Camera, tile: int = 16) -> Tensor:
    """What one would write in PyTorch: project all, then blend tile by tile. Colour and summed depth [H, W, 4]."""
    rotation, translation = camera_from_world(camera.world_from_camera)
    camera_means = gaussians.means @ rotation.T + translation
    projection = project(gaussians, camera, camera_means, rotation, torch.zeros(len(gaussians), 2))
    values = torch.cat([gaussians.sh[:, 0] * 0.28209479177387814 + 0.5, camera_means[:, 2:]], dim=-1)
    with torch.no_grad():
        reach = 3 * projection.covariances.diagonal(dim1=1, dim2=2).sqrt()
        low, high = projection.centers - reach, projection.centers + reach
    rows = []
    for y in range(0, camera.height, tile):
        row = []
        for x in range(0, camera.width, tile):
            w, h = min(tile, camera.width - x), min(tile, camera.height - y)
            near = (high[:, 0] > x) & (low[:, 0] < x + w) & (high[:, 1] > y) & (low[:, 1] < y + h)
            index = near.nonzero()[:, 0]
            corner = torch.tensor([x, y], dtype=torch.float32)
            part = Projection(
                projection.centers[index] - corner, projection.covariances[index], projection.depths[index]
            )
            order = torch.argsort(part.depths.detach(), stable=True)
            view = Camera(camera.world_from_camera, camera.fx, camera.fy, camera.cx, camera.cy, w, h)
            weights = blend_weights(part, gaussians.opacities[index], order, view)
            row.append((weights @ values[index][order]).reshape(h, w, 4))
        rows.append(torch.cat(row, dim=1))
    return torch.cat(rows)


def peak_flops(threads: int) -> float:
    """Floating-point operations a second that this machine reaches, by a matrix product in cache."""
    torch.set_num_threads(threads)
    a = torch.rand(512, 512)
    times = []
    for _ in range(20):
        start = clock()
        a @ a
        times.append(clock() - start)
    return 2 * 512**3 / min(times)


def blended_pairs(gaussians: Gaussians, camera: Camera) -> float:
    """Gaussians with alpha >= 1/255 summed over pixels, from the areas of their ellipses (what is hidden included)."""
    rotation, translation = camera_from_world(camera.world_from_camera)
    camera_means = gaussians.means @ rotation.T + translation
    projection = project(gaussians, camera, camera_means, rotation, torch.zeros(len(gaussians), 2))
    x, y = projection.centers.unbind(-1)
    inside = (projection.depths > 0) & (x > 0) & (x < camera.width) & (y > 0) & (y < camera.height)
    squared_reach = 2 * torch.log(255 * gaussians.opacities).clamp(min=0)
    return float((math.pi * squared_reach * torch.linalg.det(projection.covariances).sqrt())[inside].sum())


def median_of(call: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = clock()
        call()
        times.append((clock() - start) * 1e3)
    return statistics.median(times)


def run_workload(name: str, arguments: argparse.Namespace, flops: float) -> None:
    count, width, height = WORKLOADS[name]
    gaussians, camera = make_surface(count, width, height, arguments.sh)
    g = torch.Generator().manual_seed(1)
    shapes = [(height, width, 3), (height, width), (height, width)]
    color, depth, alpha = (torch.randn(shape, generator=g) / 1000 for shape in shapes)
    gradients = (color, depth, alpha)
    runners: dict[str, Callable[[Timings, str], None]] = {"ours": Ours(gaussians, camera, gradients)}
    if arguments.compare:
        runners["other"] = Other(arguments.compare, arguments.threads, gaussians, camera, gradients)
    timings: Timings = defaultdict(list)
    for repeat in range(arguments.repeats + 2):
        if repeat == 2:
            timings.clear()
        for runner, call in runners.items():
            call(timings, runner)
    median = {k: statistics.median(v) for k, v in timings.items()}
    drawn = f"{int(median['visible'])} drawn, {int(median['pairs'])} pairs"
    print(f"\n{name}, SH {arguments.sh}: ms, median of {arguments.repeats} ({drawn})")
    print("  " + "  ".join(f"{stage} {median[stage]:.1f}" for stage in STAGES))
    for runner in runners:
        forward, both = median[f"{runner} forward"], median[f"{runner} forward+backward"]
        print(f"  {runner}: forward {forward:.1f}, forward+backward {both:.1f}")
    if arguments.compare:
        ratios = [
            statistics.median(a / b for a, b in zip(timings[f"ours {kind}"], timings[f"other {kind}"], strict=True))
            for kind in ("forward", "forward+backward")
        ]
        print(f"  ours / other, paired: forward {ratios[0]:.2f}, forward+backward {ratios[1]:.2f}")
    work = blended_pairs(gaussians, camera)
    floors = [work * each / flops * 1e3 for each in (FLOPS_FORWARD, FLOPS_BACKWARD)]
    print(
        f"  floor of compositing at {flops / 1e9:.0f} GF/s, hidden Gaussians counted: {floors[0]:.1f}, {floors[1]:.1f}"
    )
    if arguments.torch:
        start = clock()
        with torch.no_grad():
            torch_tile_loop(gaussians, camera)
        taken = (clock() - start) * 1e3
        print(f"  PyTorch tile loop, forward: {taken:.0f} ({taken / median['ours forward']:.0f} times ours)")


def run_training_kernels(repeats: int) -> None:
    image, target = torch.rand(2, 256, 320, 3)
    image.requires_grad_()
    plain = median_of(lambda: photometric_loss(image, target).backward(), repeats)
    tensors = torch.rand(4, 100_000, 48)
    adam = median_of(lambda: adam_step(*tensors, lr=1e-3, step=5), repeats)
    print(f"\nloss 320x256x3, forward+backward: {plain:.2f} ms")
    print(f"Adam, 4.8M numbers: {adam:.2f} ms")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--sh", type=int, default=16, choices=(1, 4, 9, 16), help="SH coefficients per colour")
    parser.add_argument("--workload", choices=list(WORKLOADS), action="append", help="default: all three")
    parser.add_argument(
        "--torch", action="store_true", help="time a PyTorch tile loop too (minutes for the larger ones)"
    )
    parser.add_argument(
        "--cpu-time", action="store_true", help="this thread's time instead of the clock's: --threads 1"
    )
    parser.add_argument("--compare", metavar="LIB.so", help="another library to time in turns")
    arguments = parser.parse_args()
    if arguments.cpu_time:
        global clock
        clock = time.thread_time
    set_threads(arguments.threads)
    keep_freed_memory()  # as training does
    flops = peak_flops(arguments.threads)
    print(f"{simd()}, {arguments.threads} threads")
    for name in arguments.workload or WORKLOADS:
        run_workload(name, arguments, flops)
    run_training_kernels(arguments.repeats)


if __name__ == "__main__":
    main()
