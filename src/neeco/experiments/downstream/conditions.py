"""What a model is taught with, and which recorded frames of each fold are labelled.

A condition is a sum of words: `real`, names of data sets, and how they are used: `augment` (classical augmentation of
everything), `hard`, `soft` or `ignore` (how the edges of drawn labels are learned).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np

from neeco.errors import NeecoError
from neeco.experiments.downstream.samples import Edges

REAL, AUGMENT = "real", "augment"
EDGES: tuple[Edges, ...] = ("hard", "soft", "ignore")
DEFAULT_EDGES: Edges = "hard"
RESERVED = (REAL, AUGMENT, *EDGES)
HELD_BACK_EVERY = 5  # of the labelled frames and of a set's images, one in so many is kept for validation
HELD_BACK_FROM = 40  # images: of fewer all are learned, what is held back would be too little to choose weights by
ALL = "all"

Pick = Literal["spread", "first"]
T = TypeVar("T")


@dataclass(frozen=True)
class Condition:
    """What a model is taught with."""

    name: str
    sets: tuple[str, ...]  # names of data sets
    real: bool  # with labelled recorded frames
    augment: bool
    edges: Edges


def parse_condition(name: str, sets: Collection[str]) -> Condition:
    """`kinematic+real+augment`. Raises NeecoError for a word that is none of `sets` nor known, or a lack of images."""
    words = name.split("+")
    for word in words:
        if word not in RESERVED and word not in sets:
            raise NeecoError(
                f"--conditions {name}: {word!r} is neither {', '.join(RESERVED)} nor a set; name it in --sets"
            )
    if len(set(words)) < len(words):
        raise NeecoError(f"--conditions {name}: a word stands in it twice")
    edges = [edge for edge in EDGES if edge in words]
    drawn = tuple(word for word in words if word in sets)
    if len(edges) > 1 or (edges and not drawn):
        raise NeecoError(f"--conditions {name}: one of {', '.join(EDGES)} at most, and only beside a set")
    if not drawn and REAL not in words:
        raise NeecoError(f"--conditions {name}: nothing to learn from; add real or a set")
    return Condition(name, drawn, REAL in words, AUGMENT in words, edges[0] if edges else DEFAULT_EDGES)


def default_conditions(sets: Sequence[str]) -> list[str]:
    """The paper's conditions and ours: recorded frames without and with augmentation, each set alone and with them."""
    return [REAL, f"{REAL}+{AUGMENT}", *(word for name in sets for word in (name, f"{name}+{REAL}"))]


def labelled_count(word: str, frames: int) -> int:
    """How many labelled frames `--real`'s word means, of so many. Raises NeecoError."""
    if word == ALL:
        return frames
    if not word.isdecimal():
        raise NeecoError(f"--real: {word!r} is neither a number of labelled frames nor all")
    if int(word) > frames:
        raise NeecoError(f"--real: {word} labelled frames are asked for, the capture has {frames}; use all")
    return int(word)


def labelled_frames(frames: int, count: int, fold: int, pick: Pick) -> list[int]:
    """Which `count` of so many recorded frames are labelled in a fold, in their order.

    spread: the recording is cut into `count` stretches of one length and a frame is drawn from each. first: the
    recording's first, the same in every fold. The same for every condition and model of a fold.
    """
    if pick == "first" or count == frames:
        return list(range(count))
    edges = np.linspace(0, frames, count + 1)
    draws = np.random.default_rng(np.random.SeedSequence([fold, count])).random(count)
    places = edges[:-1] + draws * (edges[1:] - edges[:-1])
    chosen: list[int] = []
    for place in places:  # a frame on the border of two stretches is taken once, and the next one after it
        chosen.append(max(min(int(place), frames - 1), chosen[-1] + 1 if chosen else 0))
    return chosen


def held_back(samples: Sequence[T], fold: int) -> tuple[list[T], list[T]]:
    """(to learn from, held back for validation): one in HELD_BACK_EVERY, another in each fold; none of fewer than
    HELD_BACK_FROM."""
    if len(samples) < HELD_BACK_FROM:
        return list(samples), []
    last = (HELD_BACK_EVERY - 1 + fold) % HELD_BACK_EVERY
    learned = [sample for index, sample in enumerate(samples) if index % HELD_BACK_EVERY != last]
    return learned, [sample for index, sample in enumerate(samples) if index % HELD_BACK_EVERY == last]
