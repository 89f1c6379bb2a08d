"""Where the triton backend's time goes: its five stages, what they must move and compute, and what the device can."""

from __future__ import annotations

import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from raster import FLOPS_BACKWARD, FLOPS_FORWARD, STAGES
from torch import Tensor

from neeco.raster.native import synchronise

MODEL = (  # by which shares of the peaks are told
    "Bytes: every number of every array that a stage takes or makes, once; what caches serve twice, and what a sort "
    "moves between its passes, is not counted. Arithmetic: in compositing alone, "
    f"{FLOPS_FORWARD} operations forward and {FLOPS_BACKWARD} backward for every pixel of a tile and every Gaussian of "
    "its list until all its pixels are full."
)
FLOAT = 4  # bytes
COPIED = 2**26  # floats: larger than any cache
SIDE = {"cuda": 4096, "cpu": 512}  # of the matrices
TRIES = 20
FUNCTIONS = {  # of neeco.raster.triton_backend
    "project": "project",
    "list_per_tile": "bin",
    "composite": "composite",
    "composite_backward": "composite_backward",
    "project_backward": "project_backward",
}


class Marks:
    """Moments in a device's own order of work: CUDA events, or the clock's time on a CPU."""

    def __init__(self, device: torch.device) -> None:
        self.device = device

    def mark(self) -> Any:
        if self.device.type != "cuda":
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record(torch.cuda.current_stream(self.device))
        return event

    def between(self, start: Any, end: Any) -> float:
        """Milliseconds. On CUDA both must have come to pass: synchronise first."""
        return (end - start) * 1e3 if self.device.type != "cuda" else start.elapsed_time(end)


def peaks(device: torch.device, floats: int = COPIED) -> dict[str, float]:
    """Bytes and float32 operations a second that the device reaches: a copy of 4 x `floats` bytes, read and written,
    and a product of matrices (TF32 off). The best of 20 after as many to warm up."""
    marks, side = Marks(device), SIDE[device.type]
    source, target = torch.rand(floats, device=device), torch.empty(floats, device=device)
    a, b, c = torch.rand(3, side, side, device=device)
    tf32, torch.backends.cuda.matmul.allow_tf32 = torch.backends.cuda.matmul.allow_tf32, False

    def best(work: Callable[[], object]) -> float:
        stretches = []
        for _ in range(2 * TRIES):
            start = marks.mark()
            work()
            stretches.append((start, marks.mark()))
        synchronise(device)
        return min(marks.between(*stretch) for stretch in stretches[TRIES:]) / 1e3

    try:
        moved = 2 * FLOAT * floats / best(lambda: target.copy_(source))
        return {"bytes": moved, "flops": 2 * side**3 / best(lambda: torch.mm(a, b, out=c))}
    finally:
        torch.backends.cuda.matmul.allow_tf32 = tf32


class Stages:
    """Stretches of time by stage, and what the last drawing had to do."""

    def __init__(self, device: torch.device) -> None:
        self.marks = Marks(device)
        self.stretches: dict[str, list[tuple[Any, Any]]] = defaultdict(list)
        self.seen: dict[str, tuple[tuple[Any, ...], Any]] = {}  # by stage, arguments and result of the last call

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Notes every stage of the triton backend that runs in the block."""
        from neeco.raster import triton_backend as backend

        plain = {name: getattr(backend, name) for name in FUNCTIONS}
        for name, stage in FUNCTIONS.items():
            setattr(backend, name, self._timed(stage, plain[name]))
        try:
            yield
        finally:
            for name, function in plain.items():
                setattr(backend, name, function)

    def _timed(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*arguments: Any) -> Any:
            start = self.marks.mark()
            result = function(*arguments)
            self.stretches[stage].append((start, self.marks.mark()))
            self.seen[stage] = (arguments, result)
            return result

        return timed

    def rows(self, peak: dict[str, float]) -> list[dict[str, Any]]:
        """By stage: median ms, bytes and operations by the model, and the shares of the peaks that they come to."""
        synchronise(self.marks.device)
        work = self._work()
        rows = []
        for stage in STAGES:
            taken = statistics.median(self.marks.between(*stretch) for stretch in self.stretches[stage])
            moved, computed = work[stage]
            share = {"bandwidth": moved / (taken / 1e3) / peak["bytes"]}
            if computed:
                share["arithmetic"] = computed / (taken / 1e3) / peak["flops"]
            rows.append({"stage": stage, "ms": taken, "bytes": moved, "flops": computed, "share": share})
        return rows

    def _work(self) -> dict[str, tuple[int, int]]:
        """Bytes and operations of each stage in the last drawing."""
        (inputs, _, tiles), projected = self.seen["project"]
        _, lists = self.seen["bin"]
        _, images = self.seen["composite"]
        arguments, sums = self.seen["composite_backward"]
        _, gradients = self.seen["project_backward"]
        touched = projected.counts > 0
        drawn = int(touched.sum())
        own = [inputs.means, inputs.quats, inputs.scales, inputs.opacities, inputs.frames, inputs.falloff]
        given = size_of(*own, inputs.channels)
        colors = drawn * inputs.sh[0].nbytes if len(inputs) else 0
        records = drawn * (projected.records[0].nbytes + projected.ellipses[0].nbytes) if len(inputs) else 0
        listed = size_of(lists.gaussians, lists.starts)
        pixels = size_of(images.color, images.alpha, images.depth, images.channels, images.left, images.full_at)
        evaluated = tiles.size**2 * int(walked(images.full_at, lists.starts, tiles.size).sum())
        made = size_of(projected.counts, projected.depths)
        wanted = size_of(images.alpha, images.depth, images.left, images.full_at, *arguments[-1])
        return {
            "project": (given + colors + records + made + size_of(projected.radii), 0),
            "bin": (made + drawn * projected.ellipses[0].nbytes + listed + size_of(lists.slots, lists.order), 0),
            "composite": (drawn * projected.records[0].nbytes + listed + pixels, FLOPS_FORWARD * evaluated),
            "composite_backward": (
                drawn * projected.records[0].nbytes + listed + wanted + size_of(sums),
                FLOPS_BACKWARD * evaluated,
            ),
            "project_backward": (
                given + colors + size_of(sums, *(t for t in vars(gradients).values() if isinstance(t, Tensor))),
                0,
            ),
        }


def size_of(*tensors: Tensor | None) -> int:
    """Bytes of them all."""
    return sum(tensor.nbytes for tensor in tensors if tensor is not None)


def walked(full_at: Tensor, starts: Tensor, tile: int) -> Tensor:
    """[tiles] how far each tile's list is walked: until the last of its pixels [H, W] is full, or to the end."""
    height, width = full_at.shape
    padded = torch.nn.functional.pad(full_at.long() + 1, (0, -width % tile, 0, -height % tile))
    rows, columns = (size // tile for size in padded.shape)
    last = padded.reshape(rows, tile, columns, tile).amax(dim=(1, 3)).flatten()
    return torch.minimum(last, starts.diff().long())
