"""LeRobot data sets for tests, of pictures that say what they are; who imports this is skipped where pyarrow or av is
absent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pyarrow")
pytest.importorskip("av")

from lerobotwriter import Episode, LeRobotWriter

FPS = 25
SIZE = (64, 48)
CAMERA = "observation.images.endoscope.left"
BODY = ("x", "y", "z", "qx", "qy", "qz", "qw")
DVRK = tuple(
    f"{arm}_{name}"
    for arm in ("psm1", "psm2")
    for name in (*(f"pose.position.{axis}" for axis in "xyz"), *(f"pose.orientation.{axis}" for axis in "xyzw"), "jaw")
)


def picture(episode: int, number: int) -> np.ndarray:
    """uint8 [H, W, 3]: a bright square whose left edge is `number` px, on a grey that tells the episode."""
    pixels = np.full((SIZE[1], SIZE[0], 3), 20 + 15 * episode, dtype=np.uint8)
    pixels[10:26, number : number + 16] = 220
    return pixels


def left_edge(pixels: np.ndarray) -> int:
    """The number of a picture."""
    return int(np.argmax(pixels[14:22].mean(axis=(0, 2)) > 130))


def write_data_set(
    folder: Path,
    version: str,
    states: Sequence[Mapping[str, np.ndarray]],
    cameras: Sequence[str] = (CAMERA,),
    shown: Mapping[int, int] | None = None,
    **options: Any,
) -> Path:
    """A data set with these states of every episode; shown: how many images an episode has, where not as many."""

    def images(episode: int, count: int) -> Any:
        return lambda: (picture(episode, number) for number in range(count))

    episodes = []
    for number, held in enumerate(states):
        count = (shown or {}).get(number, len(next(iter(held.values()))))
        episodes.append(Episode(held, {key: images(number, count) for key in cameras}))
    return Path(LeRobotWriter(folder, version, episodes, Fraction(FPS), SIZE, **options).write())
