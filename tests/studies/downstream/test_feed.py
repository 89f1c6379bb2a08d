"""Batches: every image in its turn, each source when its schedule says so, the same order for the same seed."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
import torch
from downstream_world import Held, batch_of, squares
from hypothesis import given, settings
from hypothesis import strategies as st

from neeco.studies.downstream import training_data
from neeco.studies.downstream.samples import Cache, Example
from neeco.studies.downstream.training_data import BatchSampler, training_image

REAL, SETS = squares(3, 0, 16), (squares(11, 10, 16), squares(1, 50, 16))
SOURCES = (REAL, *SETS)


def names(feed: BatchSampler, count: int, done: float = 0.0) -> list[str]:
    return [sample.name for sample in feed.draw(count, done)]


def source_of(name: str) -> int:
    return next(k for k, source in enumerate(SOURCES) if name in {sample.name for sample in source})


def shares(feed: BatchSampler, count: int, done: float) -> list[float]:
    """Of recorded frames and of each set."""
    found = Counter(source_of(name) for name in names(feed, count, done))
    return [found[k] / count for k in range(3)]


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 99), st.lists(st.integers(1, 9), min_size=1, max_size=8))
def test_synthetic_sources_take_turns_whatever_the_batches(seed: int, sizes: list[int]) -> None:
    feed, total = BatchSampler(REAL, SETS, seed=seed), Counter()
    for size in sizes:
        total += Counter(source_of(name) for name in names(feed, size))
    assert total[0] == 0
    assert abs(total[1] - total[2]) <= 1


def test_synthetic_images_come_first_then_recorded_ones_alone() -> None:
    feed = BatchSampler(REAL, SETS, seed=0)
    alone, none = [1.0, 0.0, 0.0], [0.0, 0.5, 0.5]
    assert [shares(feed, 60, done) for done in (0.0, 0.59, 0.61, 0.71, 0.99)] == [none, none, alone, alone, alone]


def test_where_there_is_one_kind_it_is_all_there_is() -> None:
    assert shares(BatchSampler(REAL, seed=0), 9, 0.0) == [1, 0, 0]
    assert shares(BatchSampler((), SETS, seed=0), 8, 0.9) == [0, 0.5, 0.5]
    assert BatchSampler((), [(), SETS[0]], seed=0).sources == [SETS[0]]


def test_every_image_is_seen_once_a_round() -> None:
    seen = names(BatchSampler((), SOURCES, seed=4), 3 * 22)
    for k, source in enumerate(SOURCES):
        own = [name for name in seen if source_of(name) == k]
        everything = sorted(sample.name for sample in source)
        rounds = [own[start : start + len(source)] for start in range(0, len(own), len(source))]
        assert all(sorted(some) == everything for some in rounds if len(some) == len(source))
    others = [name for name in seen if source_of(name) == 1]
    assert others[:11] != others[11:]


def test_the_seed_decides_the_order_whatever_the_batches() -> None:
    feed = BatchSampler(REAL, SETS, seed=1)
    assert names(BatchSampler(REAL, SETS, seed=1), 30) == [name for _ in range(10) for name in names(feed, 3)]
    assert names(BatchSampler(REAL, SETS, seed=1), 30) != names(BatchSampler(REAL, SETS, seed=2), 30)


def test_images_are_read_once_unless_they_do_not_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    def reads(limit: int) -> list[int]:
        monkeypatch.setattr(training_data, "IMAGES", Cache(limit))
        source = [Held(sample.example, sample.name, []) for sample in squares(4, 0, 16)]
        for _ in range(3):
            for sample in source:
                training_image(sample, (16, 16), 1)
        return [len(sample.loads) for sample in source]

    one = (3 + 1 + 1) * 16**2  # image, shares, valid
    assert reads(4 * one) == [1] * 4
    assert reads(2 * one) == [3] * 4  # the ones wanted next are gone


def test_targets_are_shares_of_area() -> None:
    classes = np.zeros((4, 8), np.uint8)
    classes[:2, :1], classes[:, 4:6] = 1, 2
    counted = np.ones((4, 8), bool)
    counted[2:, 6:] = False
    example = Example(np.full((4, 8, 3), 51, np.uint8), classes, counted)
    batch = batch_of([example], (4, 2), 2)
    assert batch.images.shape == (1, 3, 2, 4)
    assert batch.images.numpy() == pytest.approx(np.full((1, 3, 2, 4), 0.2), abs=1e-6)
    half = 128 / 255
    assert batch.shares[0, 1].numpy() == pytest.approx(np.array([[half, 0, 0, 0], [0, 0, 0, 0]]))
    assert batch.shares[0, 2].tolist() == [[0, 0, 1, 0], [0, 0, 1, 0]]
    assert batch.shares[0].sum(0).numpy() == pytest.approx(np.ones((2, 4)))
    assert batch.valid[0].tolist() == [[1, 1, 1, 1], [1, 1, 1, 0]]


def test_boxes_of_a_batch_are_those_of_its_examples() -> None:
    classes = np.zeros((40, 80), np.uint8)
    classes[10:20, 20:60], classes[25:26, 3:4] = 2, 1
    example = Example(np.zeros((40, 80, 3), np.uint8), classes)
    (boxes, numbers), (nothing, none) = batch_of([example, Example(example.image, classes * 0)], (20, 20)).boxes()
    expected = [[3.5 / 80, 25.5 / 40, 1 / 80, 1 / 40], [0.5, 15 / 40, 0.5, 0.25]]  # centre and size
    assert boxes == pytest.approx(np.array(expected), abs=1e-6)
    assert numbers.tolist() == [1, 2]
    assert nothing.shape == (0, 4)
    assert none.shape == (0,)
    assert torch.equal(batch_of([example], (20, 20)).images, torch.zeros(1, 3, 20, 20))
