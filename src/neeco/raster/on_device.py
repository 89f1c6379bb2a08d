"""What is copied to a device, asked of it and multiplied on it: as seldom, and as fast, as may be."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache

import torch
from torch import Tensor


@lru_cache(maxsize=256)
def constant(values: tuple[float, ...], device: torch.device) -> Tensor:
    """`values` [n] float32 on `device`, copied there once and kept: a copy to a CUDA device waits for all that it has
    yet to do. Not to be changed."""
    return torch.tensor(values, dtype=torch.float32, device=device)


class Answer:
    """A yes or no about a tensor that its device is asked for once, as long as nothing changes the tensor in place.

    Of a tensor on the device "meta", which holds no numbers, the answer is no.
    """

    def __init__(self, question: Callable[[Tensor], Tensor]) -> None:
        self.question = question
        self._about: tuple[Tensor, int] | None = None
        self._answer = False

    def __call__(self, tensor: Tensor) -> bool:
        known = self._about
        if known is None or known[0] is not tensor or known[1] != tensor._version:
            self._answer = not tensor.is_meta and bool(self.question(tensor.detach()))
            self._about = tensor, tensor._version
        return self._answer


@contextmanager
def quick_products(device: torch.device) -> Iterator[None]:
    """Until the end of the block, let a CUDA device multiply float32 matrices in TF32: ten bits of every factor, sums
    in float32. For networks alone: a pose, or a place in mm, needs more. Elsewhere nothing changes. Not run on a GPU.
    """
    before = torch.get_float32_matmul_precision()
    if device.type == "cuda":
        torch.set_float32_matmul_precision("high")
    try:
        yield
    finally:
        if device.type == "cuda":
            torch.set_float32_matmul_precision(before)
