"""A walk through the source visits each function once, in the order of the text, and counts the returns to a file."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tools"))
UPPER = """
from package.lower import Thing, leaf

def start():
    leaf()
    near()
    Thing(1).work(leaf())

def near():
    return leaf()
"""
LOWER = """
def leaf():
    return 1

class Thing:
    def __init__(self, value):
        self.value = value

    def work(self, value):
        return self.other()

    def other(self):
        return unknown()
"""


@pytest.fixture(scope="module")
def walks() -> ModuleType:
    return importlib.import_module("walks")


def test_a_walk_visits_each_function_once_and_counts_returns(walks: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "package").mkdir()
    for name, text in (("upper", UPPER), ("lower", LOWER)):
        (tmp_path / "package" / f"{name}.py").write_text(text)
    walked = walks.Source.read(tmp_path).walk(("package.upper", "start"))
    names = [name for _, name in walked]
    assert names == ["start", "leaf", "near", "Thing.__init__", "Thing.work", "Thing.other"]
    assert walks.count(walked) == (6, 2, 2)  # back to `upper` for near, back to `lower` for Thing


def test_the_commands_are_followed_into_the_method(walks: ModuleType) -> None:
    source = walks.Source.read(walks.SOURCE)
    for start in walks.STARTS:
        module, _, function = start.partition(":")
        assert len(source.walk((module, function))) > 50
    trained = source.walk(("neeco.cli.train", "run"))
    assert ("neeco.methods.kinematic.deformation", "Kinematic.begin") in trained
