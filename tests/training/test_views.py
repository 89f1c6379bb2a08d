"""Pixels are given where the scene is, whether they live there or are copied frame by frame."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from neeco.capture import read_capture
from neeco.methods.nerfies.session import RayTable
from neeco.scene import training_views as module
from neeco.scene.training_views import PixelPrefetcher, TrainingViews
from neeco.training.config import training_config
from neeco.training.initial import begin_session

CPU, CUDA = torch.device("cpu"), torch.device("cuda")


@pytest.fixture
def views(capture: Path, monkeypatch: pytest.MonkeyPatch) -> TrainingViews:
    """The second frame has a mask. Without CUDA no memory can be page-locked."""
    monkeypatch.setattr(Tensor, "pin_memory", lambda tensor: tensor)
    read = TrainingViews.read(read_capture(capture).split("train"))
    mask = torch.arange(read.images[1].shape[0])[:, None].expand(read.images[1].shape[:2]) % 2 == 0
    return TrainingViews(read.frames, read.images, (None, mask, *read.masks[2:]))


def test_copied_frames_are_the_frames_prefetched_or_not(views: TrainingViews) -> None:
    copied = views.prefetched_to(CPU)
    assert copied.device == CPU
    for index in (0, 1, 1, 3, 0):
        assert torch.equal(copied.target(index), views.target(index))
        assert (copied.mask(index) is None) == (views.mask(index) is None)
        copied.prefetch(index + 1)
    assert torch.equal(copied.mask(1), views.masks[1])


def test_what_is_prefetched_is_copied_once_and_ahead(views: TrainingViews, monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[int] = []
    real = PixelPrefetcher.start

    def begin(self: PixelPrefetcher, index: int, image: Tensor, mask: Tensor | None) -> None:
        if index != self._index:
            begun.append(index)
        real(self, index, image, mask)

    monkeypatch.setattr(PixelPrefetcher, "start", begin)
    copied = views.prefetched_to(torch.device("meta"))
    copied.prefetch(1)
    assert begun == [1]
    target, mask = copied.target(1), copied.mask(1)
    assert target.is_meta
    assert mask is not None
    assert mask.is_meta
    assert not copied.images[1].is_meta
    copied.prefetch(2)
    copied.target(2)
    assert begun == [1, 2]


@pytest.mark.parametrize("stays", [True, False])
def test_pixels_stay_in_the_hosts_memory_where_the_device_is_too_small(stays, views, monkeypatch):
    size = sum(image.numel() for image in views.images) + views.masks[1].numel()
    free = int(size / module.MAX_MEMORY_SHARE) - 2 if stays else int(size / module.MAX_MEMORY_SHARE) + 2
    moved: list[torch.device] = []
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (free, 10 * size))
    monkeypatch.setattr(TrainingViews, "prefetched_to", lambda self, device: "copied")
    monkeypatch.setattr(Tensor, "to", lambda tensor, device: moved.append(device) or tensor)
    there = views.to(CUDA)
    assert (there == "copied") == stays
    assert moved == ([] if stays else [CUDA] * (len(views) + 1))


def test_a_fields_rays_are_all_on_the_device(views: TrainingViews) -> None:
    table = RayTable(views.prefetched_to(torch.device("meta")))
    assert table.pixels.is_meta
    assert table.valid is not None
    assert table.valid.is_meta
    assert len(table.pixels) == len(table.valid) == sum(image[..., 0].numel() for image in views.images)


def test_a_run_learns_the_same_from_frames_that_are_copied(capture: Path, views: TrainingViews) -> None:
    config = training_config("3dgs", {"iterations": 30, "batch_size": 2}, ["density_start=10"])
    learned = []
    for given in (views, views.prefetched_to(CPU)):
        torch.manual_seed(0)
        session = begin_session(read_capture(capture), given, config, print)
        while session.progress < 1:
            session.step()
        learned.append(session.scene.canonical.means.detach())
    assert torch.equal(*learned)
