"""Gaussians are added and removed within each body's budget, and Adam follows."""

from __future__ import annotations

import math

import pytest
import torch

from neeco.raster.optimizer import Adam
from neeco.scene.canonical import CanonicalGaussians, join_bodies, seed_gaussians
from neeco.training.config import DensityConfig
from neeco.training.density import GradientStatistics, control_density, reset_opacity


def two_bodies(size: float) -> CanonicalGaussians:
    """Ten Gaussians at x = 0..9 and five at x = 100..104."""
    bodies = []
    for start, count in ((0, 10), (100, 5)):
        positions = torch.zeros(count, 3)
        positions[:, 0] = torch.arange(start, start + count)
        bodies.append(seed_gaussians(positions, torch.rand(count, 3), torch.full((count,), size)))
    return join_bodies(bodies)


def steep(canonical: CanonicalGaussians, *rows: int) -> GradientStatistics:
    """Only `rows` have a gradient, the first the strongest."""
    statistics = GradientStatistics(len(canonical), torch.device("cpu"))
    for rank, row in enumerate(rows):
        statistics.total[row], statistics.seen[row] = 10.0 - 0.1 * rank, 1
    return statistics


def change(canonical, statistics, most=(100, 100), threshold=1.0, adam=None, unsupported=None):
    generator = torch.Generator().manual_seed(0)
    return control_density(
        canonical,
        adam or Adam(),
        statistics,
        max_gaussians=most,
        dense_size=1.0,
        threshold=threshold,
        generator=generator,
        config=DensityConfig(),
        unsupported=unsupported,
    )


def test_a_small_gaussian_is_cloned_where_it_is() -> None:
    before = two_bodies(0.5)
    after = change(before, steep(before, 3))
    assert after.counts == (11, 5)
    assert int((after.means == before.means[3]).all(1).sum()) == 2
    assert torch.equal(after.log_scales.unique(), before.log_scales.unique())


def test_a_large_gaussian_is_split_into_two_smaller() -> None:
    before = two_bodies(2.0)
    after = change(before, steep(before, 3))
    assert after.counts == (11, 5)
    assert not (after.means == before.means[3]).all(1).any()
    halves = after.log_scales[:, 0] < before.log_scales[0, 0]
    assert int(halves.sum()) == 2
    assert torch.allclose(after.log_scales[halves].exp(), torch.full((2, 3), 2.0 / 1.6))


def test_a_transparent_gaussian_goes() -> None:
    before = two_bodies(0.5)
    before.opacity_logits[12] = math.log(0.004)
    after = change(before, steep(before), threshold=math.inf)
    assert after.counts == (10, 4)
    assert 102.0 not in after.means[:, 0]


def test_an_unsupported_gaussian_goes_however_opaque_and_steep() -> None:
    before = two_bodies(0.5)
    unsupported = torch.zeros(15, dtype=torch.bool)
    unsupported[[3, 11]] = True
    after = change(before, steep(before, 3, 5), unsupported=unsupported)
    assert after.counts == (10, 4)  # one removed, one cloned; one removed
    assert not (after.means == before.means[3]).all(1).any()


@pytest.mark.parametrize("size", [0.5, 2.0])
def test_budgets_hold_and_bodies_stay_apart(size: float) -> None:
    before = two_bodies(size)
    after = change(before, steep(before, *range(15)), most=(13, 5))
    assert after.counts == (13, 5)
    assert bool((after.means[:13, 0] < 50).all())
    assert bool((after.means[13:, 0] > 50).all())


def test_the_steepest_get_the_room_there_is() -> None:
    before = two_bodies(0.5)
    after = change(before, steep(before, 7, 2, 5), most=(12, 5))
    counted = [int((after.means[: 10 + 2, 0] == x).sum()) for x in (7, 2, 5)]
    assert counted == [2, 2, 1]


def test_adams_rows_follow_and_new_ones_start_at_zero() -> None:
    before, adam = two_bodies(0.5), Adam()
    means = before.means.requires_grad_()
    means.grad = torch.arange(1.0, 16.0)[:, None].repeat(1, 3)
    adam.step([("means", means, 0.0)])
    means.requires_grad_(False)
    expected = {float(x): float(m) for x, m in zip(means[:, 0], adam.first["means"][:, 0], strict=True)}
    before.opacity_logits[1] = -20.0
    after = change(before, steep(before, 3), adam=adam)
    moments = adam.first["means"][:, 0]
    assert len(moments) == len(after) == 15
    twins = (after.means[:, 0] == 3).nonzero()[:, 0]
    assert sorted(moments[twins].tolist()) == pytest.approx([0.0, expected[3.0]])
    others = [i for i in range(15) if i not in twins.tolist()]
    assert moments[others].tolist() == pytest.approx([expected[float(after.means[i, 0])] for i in others])


def test_an_opacity_reset_lowers_the_high_ones_keeps_the_low_ones_and_forgets_their_momentum() -> None:
    canonical = two_bodies(0.5)
    canonical.opacity_logits[:] = torch.linspace(-8, 8, 15)
    before, adam = canonical.opacity_logits.clone(), Adam()
    for name in ("opacity_logits", "means"):
        tensor = canonical.tensors()[name].requires_grad_(True)
        tensor.grad = torch.ones_like(tensor)
        adam.step([(name, tensor, 0.0)])
    reset_opacity(canonical, adam, 0.01)
    ceiling = math.log(0.01 / 0.99)
    assert torch.equal(canonical.opacity_logits.detach(), before.clamp(max=ceiling))
    assert bool((before > ceiling).any())
    assert bool((before < ceiling).any())
    assert float(adam.first["opacity_logits"].abs().max()) == float(adam.second["opacity_logits"].abs().max()) == 0
    assert float(adam.first["means"].abs().min()) > 0
