"""Remarks and contradictions that the stages of an ingest collect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Contradiction:
    """Parts of a recording that disagree, in one sentence. severe: the capture is likely to be wrong."""

    sentence: str
    severe: bool


class Notes:
    """The one value of an ingest that grows: every stage adds to it. names: of the episodes."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = tuple(names)
        self._sentences: dict[tuple[str, int | None], None] = {}  # in order; one without an episode holds for all
        self._contradictions: dict[tuple[str, int | None], Contradiction] = {}

    def add(self, sentence: str, episode: int | None = None) -> None:
        """Add a sentence, once: about one episode, or about all."""
        self._sentences[sentence, 0 if len(self._names) == 1 else episode] = None

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on losses and assumptions; one about one of several episodes begins with its name."""
        found = []
        for episode, name in enumerate(self._names):
            for sentence in [sentence for sentence, of in self._sentences if of == episode]:
                everywhere = all((sentence, other) in self._sentences for other in range(len(self._names)))
                found.append(sentence if everywhere else f"{name}: {sentence}")
        return tuple(dict.fromkeys([*found, *(sentence for sentence, of in self._sentences if of is None)]))

    def contradict(self, subject: str, sentence: str, *, severe: bool, episode: int | None = None) -> None:
        """Set the contradiction about a subject, of one episode or all, in place of an earlier one; an empty sentence
        removes it."""
        if not sentence:
            self._contradictions.pop((subject, episode), None)
            return
        named = sentence if len(self._names) == 1 or episode is None else f"{self._names[episode]}: {sentence}"
        self._contradictions[subject, episode] = Contradiction(named, severe)

    def is_contradicted(self, subject: str) -> bool:
        return any(held == subject for held, _ in self._contradictions)

    @property
    def contradictions(self) -> tuple[Contradiction, ...]:
        return tuple(self._contradictions.values())
