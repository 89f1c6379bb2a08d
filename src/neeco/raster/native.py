"""The compiled kernels: whether they are there, and whether they are what works on a tensor."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from neeco.errors import NeecoError

Family = Literal["native", "torch"]
_family: ContextVar[Family] = ContextVar("family of kernels", default="native")


def native() -> Any:
    """The module `neeco._native`. Raises NeecoError when it was never built."""
    try:
        return importlib.import_module("neeco._native")
    except ImportError as error:
        raise NeecoError("neeco._native: the compiled kernels are missing; install with `pip install .`") from error


@contextmanager
def kernels(family: Family) -> Iterator[None]:
    """Until the end of the block, let this thread draw, compare and step CPU tensors by `family` of kernels.

    "native": neeco's own, the default; "torch": the plain torch that works on every device, and is slow. Concerns
    `rasterize(backend="auto")`, `photometric_loss` and `adam_step`. Raises NeecoError for another family.
    """
    if family not in get_args(Family):
        raise NeecoError(f"kernels: {family!r}: unknown; use one of {', '.join(get_args(Family))}")
    token = _family.set(family)
    try:
        yield
    finally:
        _family.reset(token)


def goes_native(tensor: Tensor) -> bool:
    """Whether the native kernels work on `tensor`: it is on the CPU, and `kernels("torch")` is not in force."""
    return tensor.device.type == "cpu" and _family.get() == "native"


def all_native(*tensors: Tensor) -> bool:
    """Whether native kernels, which know float32 alone, work on `tensors` as they are."""
    return all(goes_native(tensor) and tensor.dtype == torch.float32 for tensor in tensors)
