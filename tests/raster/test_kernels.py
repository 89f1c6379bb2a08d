"""Plain torch takes the native kernels' place by one switch; what it then learns: `training/test_generic_path.py`."""

from __future__ import annotations

import sys
from pathlib import Path
from threading import Thread

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))

from neeco.base.errors import NeecoError
from neeco.raster import kernels
from neeco.raster.native import runs_native


def test_the_switch_holds_for_its_block_and_its_thread() -> None:
    tensor, seen = torch.zeros(1), []
    with kernels("torch"):
        assert not runs_native(tensor)
        with kernels("native"):
            assert runs_native(tensor)
        thread = Thread(target=lambda: seen.append(runs_native(tensor)))
        thread.start()
        thread.join()
    assert runs_native(tensor)
    assert seen == [True]
    assert not runs_native(tensor.to("meta"))


def test_an_unknown_family_is_named() -> None:
    with pytest.raises(NeecoError, match="'fast': unknown"), kernels("fast"):  # type: ignore[arg-type]
        pass
