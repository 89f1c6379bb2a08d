"""Augmentation changes what is seen, never what it means."""

from __future__ import annotations

import numpy as np
import pytest

from neeco.studies.downstream.samples import Example

pytest.importorskip("monai")

from neeco.studies.downstream.samples import augment

SIZE = (60, 80)


def coloured(valid: bool = False, coverage: bool = False) -> Example:
    """A red and a green rectangle of two instruments before blue."""
    classes, instruments = np.zeros((2, *SIZE), np.uint8)
    image = np.full((*SIZE, 3), (10, 10, 130), np.uint8)
    image[15:40, 12:36], classes[15:40, 12:36], instruments[15:40, 12:36] = (230, 10, 10), 1, 1
    image[20:48, 44:70], classes[20:48, 44:70], instruments[20:48, 44:70] = (10, 230, 10), 3, 2
    everywhere = np.ones(SIZE, bool)
    everywhere[:, :20] = False
    return Example(
        image,
        classes,
        instruments,
        everywhere if valid else None,
        (classes > 0).astype(np.float32) * 0.8 if coverage else None,
    )


def turns(example: Example, count: int = 12) -> list[Example]:
    return [augment(example, np.random.default_rng(seed)) for seed in range(count)]


def test_labels_stay_under_what_they_label() -> None:
    for made in turns(coloured()):
        strongest = made.image.astype(int).argmax(axis=2)  # 0 red, 1 green, 2 blue
        bright = made.image.max(axis=2) > 60
        for classes, colour in ((1, 0), (3, 1), (0, 2)):
            there = (made.classes == classes) & made.valid & bright
            assert there.any()
            assert (strongest[there] == colour).mean() > 0.93  # edges are blurred
        assert np.array_equal(made.instruments == 1, made.classes == 1)
        assert np.array_equal(made.instruments == 2, made.classes == 3)


def test_kinds_and_sizes_are_kept_and_ids_never_mixed() -> None:
    for made in turns(coloured(valid=True, coverage=True), 6):
        assert made.image.shape == (*SIZE, 3)
        assert made.classes.shape == made.instruments.shape == made.valid.shape == made.coverage.shape == SIZE
        kinds = (made.image.dtype, made.classes.dtype, made.instruments.dtype, made.valid.dtype, made.coverage.dtype)
        assert kinds == (np.uint8, np.uint8, np.uint8, bool, np.float32)
        assert made.image.flags.c_contiguous
        assert set(np.unique(made.classes)) <= {0, 1, 3}
        assert set(np.unique(made.instruments)) <= {0, 1, 2}


def test_the_share_moves_along() -> None:
    for made in turns(coloured(coverage=True), 6):
        assert made.coverage is not None
        assert made.coverage.max() <= 0.8 + 1e-5
        inside, outside = made.coverage[made.classes > 0], made.coverage[made.classes == 0]
        assert inside.mean() > 0.7
        assert outside.mean() < 0.05
    assert augment(coloured(), np.random.default_rng(0)).coverage is None


def test_what_comes_from_outside_or_did_not_count_does_not_count() -> None:
    away = 0
    for plain, masked in zip(turns(coloured()), turns(coloured(valid=True)), strict=True):
        assert np.array_equal(plain.image, masked.image)
        assert not (masked.valid & ~plain.valid).any()
        red = (masked.classes == 1) & plain.valid
        assert 0.45 < (masked.valid & red).sum() / red.sum() < 0.9  # two thirds of it are right of column 20
        away += (~plain.valid).sum()
        assert (plain.classes[~plain.valid] == 0).all()
    assert away > 0


def test_the_same_numbers_give_the_same_pixels_and_others_do_not() -> None:
    first, again, other = (augment(coloured(), np.random.default_rng(seed)) for seed in (5, 5, 6))
    assert np.array_equal(first.image, again.image)
    assert np.array_equal(first.classes, again.classes)
    assert not np.array_equal(first.classes, other.classes)
    assert not np.array_equal(first.image, coloured().image)


def test_the_original_is_left_as_it_was() -> None:
    example, before = coloured(valid=True, coverage=True), coloured(valid=True, coverage=True)
    augment(example, np.random.default_rng(1))
    for name in ("image", "classes", "instruments", "valid", "coverage"):
        assert np.array_equal(getattr(example, name), getattr(before, name))


def test_images_are_flipped_about_half_the_time_and_never_upside_down() -> None:
    sides = []
    for made in turns(coloured(), 40):
        (rows, columns), (others, across) = (np.nonzero(made.classes == number) for number in (1, 3))
        sides.append(columns.mean() < across.mean())
        assert abs(rows.mean() - others.mean()) < 30
    assert 8 < sum(sides) < 32
