"""Batches of examples: every source an equal share of each, at last the first alone; the seed decides the order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from neeco.experiments.downstream.samples import Example, Sample

CACHE_BYTES = 1 << 30  # of decoded images that a feed keeps; others are read again

Augment = Callable[[Example, np.random.Generator], Example]


class Feed:
    """Draws examples from sources without end. A source's order is shuffled anew when all of it has been seen.

    sources: recorded frames, each data set. Each batch takes as many from each, whatever their sizes: a few labelled
    frames are not drowned by a thousand drawn ones. mixed: how many examples are drawn so; those after them are the
    first source's. Augmentation changes nothing of the order.
    """

    def __init__(
        self,
        sources: Sequence[Sequence[Sample]],
        seed: int,
        augment: Augment | None = None,
        mixed: int | None = None,
    ) -> None:
        self.sources = [source for source in sources if source]
        self.mixed = mixed
        self.rng, self.augment_rng = (np.random.default_rng(np.random.SeedSequence([seed, k])) for k in (1, 2))
        self.augment = augment
        self._orders = [self._shuffled(len(source)) for source in self.sources]
        self._turn = 0
        self._cache: dict[tuple[int, int], Example] = {}
        self._cached = 0

    def batch(self, count: int) -> list[Example]:
        """The next `count` examples, augmented where that was asked for."""
        return [self._next() for _ in range(count)]

    def _next(self) -> Example:
        alone = self.mixed is not None and self._turn >= self.mixed
        source = 0 if alone else self._turn % len(self.sources)
        self._turn += 1
        example = self._load(source, next(self._orders[source]))
        return example if self.augment is None else self.augment(example, self.augment_rng)

    def _shuffled(self, count: int) -> Iterator[int]:
        while True:
            yield from self.rng.permutation(count).tolist()

    def _load(self, source: int, index: int) -> Example:
        key = source, index
        if key not in self._cache:
            example = self.sources[source][index].load()
            arrays = (example.image, example.classes, example.instruments, example.counted, example.share)
            size = sum(array.nbytes for array in arrays if array is not None)
            if self._cached + size > CACHE_BYTES:
                return example
            self._cache[key] = example
            self._cached += size
        return self._cache[key]
