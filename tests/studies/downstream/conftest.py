from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from downstream_world import write_set

SPLITS = ("train",) * 6 + ("test",) * 2 + ("train",) * 4 + ("unseen",)


@pytest.fixture(scope="session")
def recorded(world, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny world of 48 x 40 px on disk, not to be changed: frames 000 to 012, ten of them to be taught."""
    from neeco.capture.writer import write_capture

    root = tmp_path_factory.mktemp("recorded") / "capture"
    write_capture(world.make_capture(root, world.TinyScene(), SPLITS), root)
    return root


@pytest.fixture
def capture(recorded: Path, tmp_path: Path) -> Path:
    """The tiny world, to be changed at will."""
    return Path(shutil.copytree(recorded, tmp_path / "capture"))


@pytest.fixture
def drawn(tmp_path: Path) -> Path:
    """A data set of six images as `neeco synthesize` lays it out."""
    return write_set(tmp_path / "drawn")
