"""Which device a word of the command line means, and waiting for it."""

from __future__ import annotations

import importlib.util

import torch

from neeco.errors import NeecoError


def device_of(word: str, drawing: bool = True) -> torch.device:
    """The device behind `--device`: cpu, cuda, cuda:N, or auto: a CUDA device where there is one, else the CPU.

    drawing: it is to draw, which on CUDA needs gsplat; without, PyTorch is enough.

    Raises NeecoError for another word, or a device that is not there.
    """
    draws = torch.cuda.is_available() and (not drawing or importlib.util.find_spec("gsplat") is not None)
    if word == "auto":
        return torch.device("cuda" if draws else "cpu")
    name, colon, number = word.partition(":")
    if name not in ("cpu", "cuda") or (colon and (name == "cpu" or not number.isdecimal())):
        raise NeecoError(f"--device: {word!r} is unknown; choose auto, cpu, cuda or cuda:N")
    if name == "cpu":
        return torch.device("cpu")
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if not count:
        raise NeecoError(
            f"--device: {word}: PyTorch finds no CUDA device here; check `nvidia-smi` and that PyTorch is a CUDA "
            "build, or use --device cpu"
        )
    if int(number or 0) >= count:
        raise NeecoError(f"--device: {word}: there are {count}, counted from 0; use cuda:{count - 1} or less")
    if not draws:
        raise NeecoError(f"--device: {word}: drawing there needs gsplat; pip install 'neeco[cuda]', or --device cpu")
    return torch.device(word)
