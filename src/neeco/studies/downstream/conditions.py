"""Conditions (what a model is trained on, in words), and which recorded frames are labelled."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from neeco.errors import NeecoError

RESERVED = REAL, STRONG, PASTE, PERMUTED = "real", "strong", "paste", "permuted"
BASELINES = (REAL, f"{REAL}+{STRONG}")  # without synthetic images: the better of them is the reference
GOLDEN_RATIO = (5**0.5 - 1) / 2

FrameSelection = Literal["spread", "first"]


@dataclass(frozen=True, kw_only=True)
class Condition:
    """The training data of a model: a sum of words, `SET+real+strong`."""

    name: str
    sets: tuple[str, ...] = ()  # names of data sets
    real: bool = False  # with labelled recorded frames
    strong: bool = False  # with strong augmentation of every image
    paste: bool = False  # with the labelled instruments pasted over backgrounds
    permuted: bool = False  # the sets' labels belong to other images


def parse_condition(name: str, sets: Collection[str]) -> Condition:
    """`kinematic+real+strong`. Raises NeecoError for a word that is none of `sets` nor known, or a lack of images."""

    def refuse(problem: str) -> NeecoError:
        return NeecoError(f"--conditions {name}: {problem}")

    words = name.split("+")
    for word in words:
        if word not in RESERVED and word not in sets:
            raise refuse(f"{word!r} is neither {', '.join(RESERVED)} nor a set; name it in --sets")
    if len(set(words)) < len(words):
        raise refuse("a word stands in it twice")
    chosen = tuple(word for word in words if word in sets)
    if PERMUTED in words and not chosen:
        raise refuse(f"{PERMUTED} only together with a set, whose labels it permutes")
    if PASTE in words and REAL not in words:
        raise refuse(f"{PASTE} only together with {REAL}, whose instruments it pastes")
    if not chosen and REAL not in words:
        raise refuse("nothing to learn from; add real or a set")
    return Condition(
        name=name,
        sets=chosen,
        real=REAL in words,
        strong=STRONG in words,
        paste=PASTE in words,
        permuted=PERMUTED in words,
    )


def default_conditions(sets: Sequence[str]) -> list[str]:
    """The baselines and cut-and-paste; then each set alone, alone and strongly augmented (the recipe for another
    recording), with labelled frames (the one for the same), and with labels of other images."""
    used = ("", f"+{STRONG}", f"+{REAL}", f"+{REAL}+{PERMUTED}")
    return [*BASELINES, f"{REAL}+{PASTE}", *(name + words for name in sets for words in used)]


def labelled_count(word: str, frames: int) -> int:
    """Return the number of labelled frames, of so many, that a word of `--num-real` means. Raises NeecoError."""
    if word == "all":
        return frames
    if not word.isdecimal():
        raise NeecoError(f"--num-real: {word!r} is neither a number of labelled frames nor all")
    if int(word) > frames:
        raise NeecoError(f"--num-real: {word} labelled frames are asked for, the capture has {frames}; use all")
    return int(word)


def labelled_frames(frames: int, count: int, fold: int, selection: FrameSelection) -> list[int]:
    """Choose the `count` of so many recorded frames that are labelled in a fold, in their order.

    Those of a smaller count are among those of a larger one. spread: the additive recurrence of the golden ratio from a
    start of the fold's own, whose first points are spread evenly whatever their number (Steinhaus' three-gap theorem);
    of a frame taken already the next one. first: the recording's first, the same in every fold. The same for every
    condition and model of a fold.
    """
    if selection == "first":
        return list(range(count))
    start = np.random.default_rng(np.random.SeedSequence([fold, 0])).random()
    free = np.ones(frames, bool)
    for k in range(count):
        place = int((start + k * GOLDEN_RATIO) % 1 * frames)
        after = np.flatnonzero(np.roll(free, -place))
        free[(place + after[0]) % frames] = False
    return np.flatnonzero(~free).tolist()
