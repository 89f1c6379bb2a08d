"""Pairs of worlds: one instrument in two operations, and what `adapt` reaches there."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

from adapted import ARMS, tip_of
from pairs import OF_INSTRUMENT, next_world
from rendered.draws import draw_world

from neeco.capture import read_capture

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
SMALL_WORLD = "9026"  # its seed


def test_the_next_world_has_one_instrument_before_what_another_draws() -> None:
    world = next_world(5, 6)
    assert all(getattr(world, name) == getattr(draw_world(5), name) for name in OF_INSTRUMENT)
    assert world.background == draw_world(6).background
    assert world.states == "exact"


def test_the_tip_is_where_an_instrument_ends_inside_the_image() -> None:
    shaft = cv2.line(np.zeros((60, 80), np.uint8), (0, 10), (50, 40), 1, 5)
    tip = tip_of(shaft > 0)
    assert tip is not None
    assert np.linalg.norm(tip - [50, 40]) < 4  # px
    assert tip_of(cv2.line(shaft.copy(), (50, 40), (79, 59), 1, 5) > 0) is None  # leaves the image
    assert tip_of(shaft == 2) is None


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_what_a_pair_shows_is_measured_to_the_end(tmp_path: Path) -> None:
    def said(*words: str) -> str:
        return subprocess.run([sys.executable, *words], capture_output=True, text=True, check=True).stdout

    world, run, following, adapted = (str(tmp_path / name) for name in ("world", "run", "next", "adapted"))
    said(str(BENCHMARKS / "worlds.py"), "draw", SMALL_WORLD, world)
    said("-m", "neeco", "train", world, "--output", run, "--iterations", "150")
    said(str(BENCHMARKS / "pairs.py"), SMALL_WORLD, "9027", following)
    assert len(read_capture(following).frames) == 46
    assert len(list(Path(following, "plates").iterdir())) == 24
    options = ("--force", "--count", "6", "--steps", "6", "--frames", "6", "--rounds", "1", "--min-overlap", "0")
    plates = ("--backgrounds", str(Path(following, "plates")))
    said("-m", "neeco", "adapt", run, following, *plates, "--output", adapted, *options)
    arms = [arm for arm in ARMS if arm != "filtered"]  # whose networks confirm nothing after six steps
    words = said(str(BENCHMARKS / "adapted.py"), adapted, following, "--seeds", "1", "--arms", *arms)
    assert "round 1: network 0." in words
    assert all(f"{arm} 0: " in words for arm in arms)
