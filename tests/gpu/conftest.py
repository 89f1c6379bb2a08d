"""Every test here takes a device: on the CPU it runs with the others, and with a GPU under `-m gpu`."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch
from device_params import DEVICES

sys.path.insert(0, str(Path(__file__).parents[1] / "training"))  # for its captures


@pytest.fixture(scope="session", params=DEVICES)
def word(request: pytest.FixtureRequest) -> str:
    """What `--device` is given."""
    return request.param


@pytest.fixture(scope="session")
def device(word: str) -> torch.device:
    return torch.device(word)
