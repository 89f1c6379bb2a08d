"""Conditions (what a model is trained on, in words), and which recorded frames are labelled."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from neeco.errors import NeecoError
from neeco.studies.downstream.batches import DEFAULT_SCHEDULE, SCHEDULES, Schedule
from neeco.studies.downstream.samples import Edges

REAL, STRONG, PASTE, MATCH, PERMUTED = "real", "strong", "paste", "match", "permuted"
EDGES: tuple[Edges, ...] = ("hard", "soft", "ignore")
DEFAULT_EDGES: Edges = "hard"
RESERVED = (REAL, STRONG, PASTE, MATCH, PERMUTED, *SCHEDULES, *EDGES)
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
    match: bool = False  # half of the labelled frames' images in the colours of another recording
    permuted: bool = False  # the sets' labels belong to other images
    edges: Edges = DEFAULT_EDGES  # how the edges of synthetic labels are learned
    schedule: Schedule = DEFAULT_SCHEDULE  # when recorded and when synthetic images are learned


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
    edges = [edge for edge in EDGES if edge in words]
    schedules = [schedule for schedule in SCHEDULES if schedule in words]
    chosen = tuple(word for word in words if word in sets)
    if len(edges) > 1 or (edges and not chosen):
        raise refuse(f"one of {', '.join(EDGES)} at most, and only together with a set")
    if PERMUTED in words and not chosen:
        raise refuse(f"{PERMUTED} only together with a set, whose labels it permutes")
    if PASTE in words and REAL not in words:
        raise refuse(f"{PASTE} only together with {REAL}, whose instruments it pastes")
    if MATCH in words and REAL not in words:
        raise refuse(f"{MATCH} only together with {REAL}; synthesize the set with --match-colors")
    if len(schedules) > 1 or (schedules and not (REAL in words and (chosen or PASTE in words))):
        raise refuse(f"one of {', '.join(SCHEDULES)} at most, and only together with {REAL} and a set or {PASTE}")
    if not chosen and REAL not in words:
        raise refuse("nothing to learn from; add real or a set")
    return Condition(
        name=name,
        sets=chosen,
        real=REAL in words,
        strong=STRONG in words,
        paste=PASTE in words,
        match=MATCH in words,
        permuted=PERMUTED in words,
        edges=edges[0] if edges else DEFAULT_EDGES,
        schedule=schedules[0] if schedules else DEFAULT_SCHEDULE,
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
