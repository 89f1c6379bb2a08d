from __future__ import annotations

from collections.abc import Iterator

import pytest

from neeco import _native
from neeco.raster.native import set_threads


@pytest.fixture(params=_native.runnable_simd())
def simd(request: pytest.FixtureRequest) -> Iterator[str]:
    """Every instruction set this machine can run, one after the other, on two threads."""
    before = _native.simd()
    _native.select_simd(request.param)
    set_threads(2)
    yield request.param
    set_threads(0)
    _native.select_simd(before)


@pytest.fixture
def two_threads() -> Iterator[None]:
    set_threads(2)
    yield
    set_threads(0)
