"""Where the triton backend's time goes: medians of its five stages."""

from __future__ import annotations

import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch

from neeco.raster.native import synchronise

FUNCTIONS = {  # of neeco.raster.triton_backend, by the stage that it is
    "project": "project",
    "bin": "list_per_tile",
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


class Stages:
    """Stretches of time by stage."""

    def __init__(self, device: torch.device) -> None:
        self.marks = Marks(device)
        self.stretches: dict[str, list[tuple[Any, Any]]] = defaultdict(list)

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Note every stage of the triton backend that runs in the block."""
        from neeco.raster import triton_backend  # needs triton

        plain = {name: getattr(triton_backend, name) for name in FUNCTIONS.values()}
        for stage, name in FUNCTIONS.items():
            setattr(triton_backend, name, self._timed(stage, plain[name]))
        try:
            yield
        finally:
            for name, function in plain.items():
                setattr(triton_backend, name, function)

    def _timed(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*arguments: Any) -> Any:
            start = self.marks.mark()
            result = function(*arguments)
            self.stretches[stage].append((start, self.marks.mark()))
            return result

        return timed

    def medians(self) -> dict[str, float]:
        """Milliseconds by stage."""
        synchronise(self.marks.device)
        return {
            stage: statistics.median(self.marks.between(*stretch) for stretch in self.stretches[stage])
            for stage in FUNCTIONS
        }
