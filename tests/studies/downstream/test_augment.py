"""Strong augmentation changes what is seen, never what it means."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from neeco.studies.downstream.samples import Example
from neeco.studies.downstream.training_data import collate, shrink
from neeco.synthesis.augmentation import augment, augment_batch, moved

SIZE = (60, 80)
COUNT = 24


def coloured(half_valid: bool = False) -> Example:
    """A red and a green rectangle, classes 1 and 2, before blue."""
    classes = np.zeros(SIZE, np.uint8)
    image = np.full((*SIZE, 3), (10, 10, 130), np.uint8)
    image[15:40, 12:36], classes[15:40, 12:36] = (230, 10, 10), 1
    image[20:48, 44:70], classes[20:48, 44:70] = (10, 230, 10), 2
    valid = np.ones(SIZE, bool)
    valid[:, :20] = False
    return Example(image, classes, valid if half_valid else None)


def planes(example: Example) -> Tensor:
    """[COUNT, 6, h, w]: the same image many times."""
    batch = collate([shrink(example, SIZE[::-1], 2)] * COUNT, torch.device("cpu"))
    return torch.cat([batch.images, batch.shares[:, 1:], batch.valid[:, None]], 1)


def made(example: Example | None = None, seed: int = 0) -> tuple[Tensor, Tensor]:
    return augment(planes(example or coloured()), torch.Generator().manual_seed(seed))


def test_labels_stay_under_what_they_label() -> None:
    images, _ = made()
    strongest, bright = images[:, :3].argmax(1), images[:, :3].max(1).values > 0.25
    for shares, colour in ((images[:, 3], 0), (images[:, 4], 1), (1 - images[:, 3:5].sum(1), 2)):
        there = (shares > 0.99) & (images[:, -1] > 0.99) & bright
        assert there.sum() > 1000
        assert (strongest[there] == colour).float().mean() > 0.95  # edges are blurred


def test_what_comes_from_outside_did_not_count_or_is_cut_out_does_not_count() -> None:
    given, half = made()[0], made(coloured(half_valid=True))[0]
    assert torch.equal(given[:, :3], half[:, :3])
    assert (half[:, -1] <= given[:, -1] + 1e-6).all()
    assert 0.3 < half[:, -1].mean() / given[:, -1].mean() < 0.9  # three quarters of it are right of column 20
    assert (given[:, -1] == 0).any()
    assert given[:, 3:5][(given[:, -1:] == 0).expand(-1, 2, -1, -1)].min() >= 0


def test_images_are_flipped_about_half_the_time_and_never_upside_down() -> None:
    images = made()[0][:, 3:5]
    across = (images.sum(2) * torch.arange(SIZE[1])).sum(2) / images.sum((2, 3))  # [COUNT, 2]
    flipped = (across[:, 0] > across[:, 1]).sum().item()
    assert COUNT / 4 < flipped < 3 * COUNT / 4
    down = (images.sum(3) * torch.arange(SIZE[0])).sum(2) / images.sum((2, 3))
    assert (down[:, 0] - down[:, 1]).abs().max() < 35


def test_outlines_move_with_the_image() -> None:
    images, placements = made()
    outlines = shrink(coloured(), SIZE[::-1], 2, outlines=True).outlines
    for image, placement in zip(images, placements.double().numpy(), strict=True):
        for number, points in moved(outlines, placement):
            rows, columns = np.nonzero(image[2 + number].numpy() > 0.5)
            ends = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]) / np.tile(SIZE[::-1], 2)
            assert np.abs(np.concatenate([points.min(0), points.max(0)]) - ends).max() < 1.6 / min(SIZE)


def test_the_same_seed_gives_the_same_pixels_and_another_does_not() -> None:
    before = planes(coloured())
    (first, _), (again, _), (other, _) = made(seed=5), made(seed=5), made(seed=6)
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert torch.equal(before, planes(coloured()))
    assert len({image.numpy().tobytes() for image in first}) == COUNT


def test_parts_of_a_batch_stay_under_what_they_label_and_what_is_lost_is_ignored() -> None:
    example = coloured(half_valid=True)
    image = torch.from_numpy(example.image).permute(2, 0, 1).float() / 255
    batch = {"image": image, "parts": torch.from_numpy(example.classes), "ignore": ~torch.from_numpy(example.valid)}
    batch = {key: torch.stack([value] * COUNT) for key, value in batch.items()} | {"boxes": []}
    found, again = (augment_batch(batch, torch.Generator().manual_seed(0)) for _ in range(2))
    assert set(found) == {"image", "parts", "ignore"}
    assert all(torch.equal(value, again[key]) for key, value in found.items())
    image, parts, kept = found["image"], found["parts"], ~found["ignore"]
    bright = kept & (image.max(1).values > 0.25)
    for part, colour in ((1, 0), (2, 1), (0, 2)):
        there = bright & (parts == part)
        assert there.sum() > 1000
        assert (image.argmax(1)[there] == colour).float().mean() > 0.9  # edges are blurred
    assert 0.3 < kept.float().mean() < 0.75  # three quarters of the image are right of column 20
