"""Triton's loss and Adam are what float64 says they are, gradients included.

Run by test_triton.py in a process of its own, under Triton's interpreter: CPU tensors.
"""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from raster_scenes import adam_step
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.raster import losses, optimizer
from neeco.raster.losses import photometric_loss, photometric_loss_reference
from neeco.raster.optimizer import Adam, Update, adam_steps
from neeco.raster.triton import photometric

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numpy's, of the interpreter


@pytest.fixture(autouse=True)
def by_triton(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a CUDA device."""
    for module in (losses, optimizer):
        monkeypatch.setattr(module, "all_run_native", lambda *tensors: False)
        monkeypatch.setattr(module, "runs_triton", lambda tensor: tensor.dtype == torch.float32)


def images(height: int, width: int, masked: bool, seed: int = 0) -> tuple[Tensor, Tensor, Tensor | None]:
    """Alike above, unlike below."""
    g = torch.Generator().manual_seed(seed)
    image, target = torch.rand(2, height, width, 3, generator=g)
    target[: height // 2] = image[: height // 2] * 0.9 + 0.02
    return image.requires_grad_(), target, torch.rand(height, width, generator=g) > 0.3 if masked else None


@settings(max_examples=5, deadline=None, derandomize=True)
@given(
    height=st.integers(1, 24),
    width=st.integers(1, 24),
    masked=st.booleans(),
    weight=st.sampled_from([0.0, 0.1, 1.0]),
    outer=st.sampled_from([1.0, -2.5]),
)
def test_value_and_gradient_match_the_reference(height, width, masked, weight, outer):
    """From images smaller than the window to such of several blocks of numbers, whose borders fall anywhere."""
    image, target, mask = images(height, width, masked)
    exact = image.detach().double().requires_grad_()
    expected = photometric_loss_reference(exact, target.double(), mask, weight)
    (outer * expected).backward()
    actual = photometric_loss(image, target, mask, weight)
    (outer * actual).backward()
    assert actual.item() == pytest.approx(expected.item(), rel=1e-5, abs=1e-6)
    assert (image.grad - exact.grad).norm() <= 1e-4 * exact.grad.norm() + 1e-9


def test_equal_images_cost_nothing_and_pull_nowhere() -> None:
    image, _, _ = images(14, 9, False)
    loss = photometric_loss(image, image.detach().clone())
    loss.backward()
    assert loss.item() == pytest.approx(0, abs=1e-6)
    assert float(image.grad.abs().max()) < 1e-7


def test_a_mask_without_pixels_costs_nothing() -> None:
    image, target, _ = images(9, 9, False)
    loss = photometric_loss(image, target, torch.zeros(9, 9, dtype=torch.bool))
    loss.backward()
    assert loss.item() == 0
    assert not image.grad.any()


def test_without_a_gradient_the_loss_is_the_same() -> None:
    image, target, mask = images(20, 13, True)
    assert torch.equal(photometric_loss(image.detach(), target, mask), photometric_loss(image, target, mask))


def test_any_layout_and_float_type_of_what_is_compared() -> None:
    image, target, mask = images(12, 10, True)
    expected = photometric_loss(image, target, mask)
    across = image.detach().transpose(0, 1).contiguous().transpose(0, 1).requires_grad_()
    assert not across.is_contiguous()
    loss = photometric_loss(across, target.double(), mask)
    loss.backward()
    expected.backward()
    assert torch.equal(loss, expected)
    assert torch.equal(across.grad, image.grad)


@settings(max_examples=5, deadline=None, derandomize=True)
@given(
    sizes=st.lists(st.sampled_from([0, 1, 7, 1023, 1024, 1025, 3000]), min_size=1, max_size=9),
    betas=st.sampled_from([(0.9, 0.999), (0.5, 0.9)]),
    eps=st.sampled_from([1e-15, 1e-8, 0.1]),
)
def test_a_step_of_many_tensors_is_each_ones_own(sizes: list[int], betas: tuple[float, float], eps: float) -> None:
    """Each with its own rate and step count, whatever lies beside it in the launch."""
    g = torch.Generator().manual_seed(1)
    tensors = [[torch.randn(size, generator=g), *torch.zeros(2, size)] for size in sizes]
    exact = [[tensor.double() for tensor in held] for held in tensors]
    for step in range(1, 4):
        gradients = [torch.randn(size, generator=g) * 10.0 ** (step - 2) for size in sizes]
        updates = []
        for k, (held, gradient) in enumerate(zip(tensors, gradients, strict=True)):
            lr, count = 0.01 * (k + 1), step + 5 * k
            updates.append(Update(held[0], gradient, held[1], held[2], lr, count))
            adam_step(exact[k][0], gradient.double(), *exact[k][1:], lr=lr, step=count, betas=betas, eps=eps)
        adam_steps(updates, betas, eps)
    for held, wanted in zip(tensors, exact, strict=True):
        for found, right in zip(held, wanted, strict=True):
            assert torch.allclose(found.double(), right, rtol=1e-5, atol=1e-6)


def test_one_launch_steps_all_tensors_that_have_a_gradient(monkeypatch: pytest.MonkeyPatch) -> None:
    launches: list[int] = []
    real = photometric.step_together
    monkeypatch.setattr(photometric, "step_together", lambda *args: launches.append(len(args[0])) or real(*args))
    learned = {name: torch.ones(5, 3, requires_grad=True) for name in "abc"}
    (learned["a"].sum() - 2 * learned["c"].sum()).backward()
    optimiser = Adam()
    optimiser.step((name, tensor, 0.1) for name, tensor in learned.items())
    assert launches == [2]
    assert [float(tensor.detach().mean()) for tensor in learned.values()] == pytest.approx([0.9, 1.0, 1.1])
    assert all(tensor.grad is None for tensor in learned.values())


def test_the_same_bits_wherever_a_tensor_lies() -> None:
    g = torch.Generator().manual_seed(2)
    start, gradient = torch.randn(2, 2500, generator=g)
    whole, parts = start.clone(), [part.clone() for part in start.split([1100, 1400])]
    adam_steps([Update(whole, gradient, *torch.zeros(2, 2500), 0.01, 1)])
    given = zip(parts, gradient.split([1100, 1400]), strict=True)
    adam_steps([Update(part, slope, *torch.zeros(2, len(part)), 0.01, 1) for part, slope in given])
    assert torch.equal(torch.cat(parts), whole)


def test_autograd_notices_the_change() -> None:
    param = torch.ones(3, requires_grad=True)
    loss = (param**2).sum()
    adam_step(param, torch.ones(3), torch.zeros(3), torch.zeros(3), lr=0.1, step=1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_tensors_that_do_not_fit_are_named() -> None:
    across = torch.zeros(4, 3).T
    with pytest.raises(NeecoError, match="parameter: must be contiguous"):
        adam_step(across, torch.zeros(3, 4), torch.zeros(3, 4), torch.zeros(3, 4), lr=0.1, step=1)
    there = [Update(*torch.zeros(4, 3, device=device), 0.1, 1) for device in ("cpu", "meta")]
    with pytest.raises(NeecoError, match="several devices"):
        adam_steps(there)
