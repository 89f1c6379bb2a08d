"""What tests that compute on a device are parametrised by: one body for the CPU, where everyone runs it, and a GPU."""

from __future__ import annotations

import pytest
import torch

ON_A_GPU = (pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA"))
DEVICES = ("cpu", pytest.param("cuda", marks=ON_A_GPU))
SLOW_ON_CPU = (pytest.param("cpu", marks=pytest.mark.slow), pytest.param("cuda", marks=ON_A_GPU))
