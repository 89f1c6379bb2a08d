"""Tasks for worker processes, which have to import them."""

from __future__ import annotations

import os


def seen_gpu(shared: object, task: object, threads: int) -> str:
    """What PyTorch would see."""
    return os.environ["CUDA_VISIBLE_DEVICES"]
