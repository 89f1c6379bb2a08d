"""Pixels are given where the scene is; several frames per step give the mean of their losses."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from neeco.capture import read_capture
from neeco.methods.nerfies.session import RayTable
from neeco.raster.optimizer import Adam
from neeco.scene import training_views as module
from neeco.scene.training_views import TrainingViews
from neeco.training.config import TrainConfig, training_config
from neeco.training.initial import begin_session
from neeco.training.schedule import due
from neeco.training.session import GaussianSession

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


NEECO = ["deformation.width=16", "deformation.depth=2", "deformation.warm_up=0", "refine.start=0"]


def config_of(views: int, method: str = "nps", assignments: tuple[str, ...] = ()) -> TrainConfig:
    small = [
        *(NEECO if method == "nps" else []),
        "density_start=10",
        "density_stop=0.9",
        "log_interval=5",
        "checkpoint_interval=20",
        *assignments,
    ]
    return training_config(method, {"iterations": 60, "batch_size": views}, small)


def begun(folder: Path, config: TrainConfig) -> GaussianSession:
    capture = read_capture(folder)
    torch.manual_seed(0)
    return begin_session(capture, TrainingViews.read(capture.split("train")), config, print)


class Noting(Adam):
    """Keeps the gradients of what is learned, and learns nothing."""

    def step(self, learned) -> None:
        given = [(name, tensor) for name, tensor, _ in learned if tensor.grad is not None]
        self.seen = {name: tensor.grad.clone() for name, tensor in given}
        for _, tensor in given:
            tensor.grad = None


def gradients(session: GaussianSession, steps: int) -> list[dict[str, Tensor]]:
    """Of every tensor that is learned, step by step; nothing is."""
    session.adam = noting = Noting()
    return [noting.seen for _ in range(steps) if session.step()]


def test_gradients_are_the_mean_of_single_ones_and_density_counts_every_frame(capture):
    still = ("schedule.compensation=off", "schedule.frame_order=off", "density_start=50", "refine.frame_poses=true")
    one, two = (begun(capture, config_of(views, assignments=still)) for views in (1, 2))
    torch.nn.init.normal_(one.scene.deformation.head.weight, std=0.1)
    two.scene.load_state_dict(one.scene.state_dict())
    single = gradients(one, 2)
    (both,) = gradients(two, 1)
    assert both.keys() == single[0].keys() > {"means", "sh_dc", "falloff", "deformation.head.weight"}
    for name, gradient in both.items():
        mean = (single[0][name] + single[1][name]) / 2
        assert (gradient - mean).norm() <= 1e-5 * mean.norm() + 1e-9, name
    assert not torch.equal(single[0]["means"], single[1]["means"])
    assert torch.allclose(two.statistics.total, one.statistics.total, rtol=1e-5, atol=1e-9)
    assert torch.equal(two.statistics.seen, one.statistics.seen)
    assert torch.allclose(two.refinement.poses, one.refinement.poses, rtol=0.05)  # its rate falls with the progress
    assert two.refinement.poses.any()
    assert torch.equal(two.refinement.frame_steps, one.refinement.frame_steps)
    assert (two.iteration, two.queue) == (one.iteration, one.queue)
    histories = (torch.tensor(list(session.schedule.history)) for session in (one, two))
    assert torch.allclose(*histories, rtol=1e-4)


def test_intervals_fall_due_once_whatever_the_step() -> None:
    for views in (1, 2, 3, 7):
        fell_due = [step for step in range(views, 100, views) if due(10, step - views, step)]
        assert len(fell_due) == (100 - 1) // views * views // 10
        assert all(step % 10 < views for step in fell_due)


def test_rates_grow_with_the_root_and_memory_shrinks_with_the_number_of_frames() -> None:
    """A first step is as long as its rate, whatever the gradient; so many steps later a moment is forgotten alike."""
    one, four = Adam(), Adam(4)
    moved = []
    for adam, steps in ((one, 4), (four, 1)):
        tensor = torch.zeros(3, requires_grad=True)
        tensor.grad = torch.tensor([0.1, -2.0, 30.0])
        adam.step([("tensor", tensor, 0.01)])
        moved.append(tensor.detach().clone())
        first = adam.first["tensor"] / (1 - adam.betas[0])  # the gradient itself
        for _ in range(steps):
            tensor.grad = torch.zeros(3)
            adam.step([("tensor", tensor, 0.01)])
        assert torch.allclose(adam.first["tensor"] / (1 - adam.betas[0]), first * 0.9**4)
    assert torch.allclose(moved[1], 2 * moved[0])
    assert torch.allclose(moved[0], 0.01 * torch.tensor([-1.0, 1.0, -1.0]))
