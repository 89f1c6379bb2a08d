"""Gives tests the worlds that several rooms' tests share: modules of this folder, and tests/evaluation/worlds.py."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import signal
import sys
from collections.abc import Callable, Iterator, MutableMapping
from pathlib import Path
from types import ModuleType

import pytest

# A shell without job control starts what it puts in the background with SIGINT ignored, and children inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

sys.path.insert(0, str(Path(__file__).parent))

# Before anything imports torch: threads that share a small operation wait for each other longer than they work, and
# pytest-xdist's workers and the processes that tests start fill the cores already. Tests of threads ask for their own.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# What the machine is set up with decides no test: weights, a cluster, the terminal's width.
for name in ("NEECO_LPIPS_WEIGHTS", "RAY_ADDRESS", "COLUMNS"):
    os.environ.pop(name, None)

os.fsync = lambda descriptor: None  # no test's files need to outlast a power cut, and a sync takes milliseconds

WORLDS = Path(__file__).resolve().parent / "evaluation" / "worlds.py"


@pytest.fixture
def inside(tmp_path: Path) -> Iterator[Path]:
    """The test's folder, in which it works: relative paths begin there."""
    with contextlib.chdir(tmp_path):
        yield tmp_path


@pytest.fixture
def environment() -> Iterator[MutableMapping[str, str]]:
    """The environment's variables, which a test may change: they are restored."""
    before = dict(os.environ)
    yield os.environ
    os.environ.clear()
    os.environ.update(before)


@pytest.fixture
def registered() -> Iterator[Callable[[type], type]]:
    """Register a method that a test defines, as an installed package's would be, until the test ends."""
    from neeco.scene.method_registry import add_method, methods

    yield add_method
    methods.cache_clear()


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of installed packages of this process, empty; plug-ins are looked for anew."""
    from neeco.ingest.readers import recording_formats
    from neeco.scene.method_registry import methods
    from neeco.studies.downstream.model import find_models
    from neeco.synthesis.dataset import writers

    (tmp_path / "site").mkdir()
    monkeypatch.syspath_prepend(tmp_path / "site")
    before, cached = set(sys.modules), (recording_formats, methods, find_models, writers)
    for found in cached:
        found.cache_clear()
    yield tmp_path / "site"
    for found in cached:
        found.cache_clear()
    for name in {name for name in sys.modules if name.startswith("neeco_")} - before:
        del sys.modules[name]


@pytest.fixture
def uninstalled(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Make a package as if it were not installed."""
    return lambda name: monkeypatch.setitem(sys.modules, name, None)


@pytest.fixture(scope="session")
def world() -> ModuleType:
    """The module itself: tests are not a package, so it cannot be imported by name."""
    if "neeco_test_worlds" not in sys.modules:
        spec = importlib.util.spec_from_file_location("neeco_test_worlds", WORLDS)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
    return sys.modules["neeco_test_worlds"]
