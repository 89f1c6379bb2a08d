"""Batches: equal shares, every image in its turn, the same order for the same seed."""

from __future__ import annotations

from collections import Counter

import numpy as np
from downstream_world import Held, squares
from hypothesis import given, settings
from hypothesis import strategies as st

from neeco.studies.downstream.samples import BatchSampler

SOURCES = [squares(3, 0, 16), squares(11, 10, 16), squares(1, 50, 16)]
NAMES = {id(sample.example): sample.name for source in SOURCES for sample in source}


def names(feed: BatchSampler, count: int) -> list[str]:
    return [NAMES[id(example)] for example in feed.batch(count)]


def source_of(name: str) -> int:
    return next(k for k, source in enumerate(SOURCES) if name in {sample.name for sample in source})


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 99), st.lists(st.integers(1, 9), min_size=1, max_size=8))
def test_sources_have_equal_shares_of_all_batches_and_each(seed: int, sizes: list[int]) -> None:
    feed, total = BatchSampler(SOURCES, seed), Counter()
    for size in sizes:
        batch = Counter(source_of(name) for name in names(feed, size))
        total += batch
        assert all(size // 3 <= batch[k] <= -(-size // 3) for k in range(3))
    assert max(total[k] for k in range(3)) - min(total[k] for k in range(3)) <= 1


def test_every_image_is_seen_once_a_round() -> None:
    seen = names(BatchSampler(SOURCES, 4), 3 * 22)
    for k, source in enumerate(SOURCES):
        own = [name for name in seen if source_of(name) == k]
        everything = sorted(sample.name for sample in source)
        rounds = [own[start : start + len(source)] for start in range(0, len(own), len(source))]
        assert all(sorted(some) == everything for some in rounds if len(some) == len(source))
    others = [name for name in seen if source_of(name) == 1]
    assert others[:11] != others[11:]


def test_the_seed_decides_the_order_whatever_the_batches() -> None:
    feed = BatchSampler(SOURCES, 1)
    assert names(BatchSampler(SOURCES, 1), 30) == [name for _ in range(10) for name in names(feed, 3)]
    assert names(BatchSampler(SOURCES, 1), 30) != names(BatchSampler(SOURCES, 2), 30)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 40), st.lists(st.integers(1, 9), min_size=1, max_size=8))
def test_after_the_mixed_ones_only_the_first_source_is_seen(mixed: int, sizes: list[int]) -> None:
    feed = BatchSampler(SOURCES, 2, mixed=mixed)
    seen = [name for size in sizes for name in names(feed, size)]
    assert seen[:mixed] == names(BatchSampler(SOURCES, 2), len(seen))[:mixed]
    assert {source_of(name) for name in seen[mixed:]} <= {0}


def test_empty_sources_take_no_share() -> None:
    assert {source_of(name) for name in names(BatchSampler([(), SOURCES[0]], 0), 12)} == {0}


def test_augmentation_sees_every_example_and_repeats_with_the_seed() -> None:
    def noisy(example, random):
        drawn.append(random.random())
        return example

    drawn: list[float] = []
    BatchSampler(SOURCES, 3, noisy).batch(9)
    first, drawn = drawn, []
    BatchSampler(SOURCES, 3, noisy).batch(9)
    assert first == drawn
    assert len(set(first)) == 9


def test_images_are_read_once_unless_they_do_not_fit() -> None:
    def read_twice(**limit: int) -> list[int]:
        source = [Held(sample.example, sample.name, []) for sample in squares(4, 0, 16)]
        feed = BatchSampler([source], 0, **limit)
        again = [feed.batch(4) for _ in range(3)]
        assert all(any(np.array_equal(example.image, s.example.image) for s in source) for b in again for example in b)
        return sorted(len(sample.loads) for sample in source)

    assert read_twice() == [1, 1, 1, 1]
    two = 2 * (3 + 1 + 1) * 16**2  # image, classes and instruments of two
    assert read_twice(cache_bytes=two) == [1, 1, 3, 3]
