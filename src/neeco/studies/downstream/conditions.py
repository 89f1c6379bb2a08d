"""Conditions (what a model is trained on, in words), and which recorded frames are labelled."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from neeco.base.errors import NeecoError

RESERVED = REAL, STRONG, PASTE, PERMUTED = "real", "strong", "paste", "permuted"
BASELINES = (REAL, f"{REAL}+{STRONG}")  # without synthetic images: the better of them is the reference
GOLDEN_RATIO = (5**0.5 - 1) / 2


@dataclass(frozen=True)
class Condition:
    """The training data of a model: a sum of words, `SET+real+strong`. `word in condition` asks for one of them.

    sets: names of data sets. real: with labelled recorded frames; strong: strong augmentation of every image; paste:
    with the labelled instruments pasted over backgrounds; permuted: the sets' labels belong to other images.
    """

    name: str
    sets: tuple[str, ...] = ()

    def __contains__(self, word: str) -> bool:
        return word in self.name.split("+")


def parse_condition(name: str, sets: Collection[str]) -> Condition:
    """`kinematic+real+strong`. Raises NeecoError for a word that is none of `sets` nor known, or a lack of images."""
    words = name.split("+")
    for word in words:
        if word not in RESERVED and word not in sets:
            known = ", ".join(RESERVED)
            raise NeecoError(f"--conditions {name}: {word!r} is neither {known} nor a set; name it in --sets")
    condition = Condition(name, tuple(word for word in words if word in sets))
    lacks_real = REAL not in condition and (PASTE in condition or not condition.sets)
    if len(set(words)) < len(words) or lacks_real or (PERMUTED in condition and not condition.sets):
        rule = "real or a set is needed, paste needs real, permuted needs a set, and no word stands twice"
        raise NeecoError(f"--conditions {name}: {rule}; correct it")
    return condition


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


def labelled_frames(frames: int, count: int, fold: int) -> list[int]:
    """Choose the `count` of so many recorded frames that are labelled in a fold, in their order.

    Those of a smaller count are among those of a larger one, and the same for every condition and model of a fold: the
    additive recurrence of the golden ratio from a start of the fold's own, whose first points are spread evenly
    whatever their number (Steinhaus' three-gap theorem); of a frame taken already the next one.
    """
    start = np.random.default_rng(np.random.SeedSequence([fold, 0])).random()
    free = np.ones(frames, bool)
    for k in range(count):
        place = int((start + k * GOLDEN_RATIO) % 1 * frames)
        after = np.flatnonzero(np.roll(free, -place))
        free[(place + after[0]) % frames] = False
    return np.flatnonzero(~free).tolist()
