"""Departures of the network from the paper: learned membership, seeds on the instrument, annealed octaves."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))
from scene_worlds import GRASPER, grasper_state, pose_of, random_canonical

from neeco.base.errors import NeecoError
from neeco.capture.model import Instrument, State
from neeco.methods.nps import INITIAL_LOGIT, MEMBER_LOGITS, NPS, NPSSettings, members
from neeco.scene.deformation import Posed


def state(k: int) -> State:
    return grasper_state(pose_of(0.3 * k - 1, 0.2 * k, 0.1, k, 2 * k, 60 - k))


def network(**settings: object) -> NPS:
    torch.manual_seed(0)
    return NPS((GRASPER,), NPSSettings(depth=2, width=16, **settings))


def test_members_are_carried_with_the_instrument_and_tissue_stays() -> None:
    net = network(membership=True)
    canonical = random_canonical(torch.Generator().manual_seed(5), (40,))
    rest, other = state(0), state(3)
    net.fit_ranges([rest, rest], canonical.means)
    logits = canonical.means.new_full((40, 1), -40.0)
    logits[:10] = 40.0
    canonical = canonical.with_extras(**{MEMBER_LOGITS: logits})
    posed = net.pose(canonical, other)
    name = GRASPER.name
    moved = other.instruments[name].pose.float() @ rest.instruments[name].pose.float().inverse()
    expected = canonical.means[:10] @ moved[:3, :3].T + moved[:3, 3]
    assert torch.allclose(posed.means[:10], expected, atol=1e-3)
    assert torch.allclose(posed.means[10:], canonical.means[10:], atol=1e-4)
    assert not torch.allclose(posed.means[:10], canonical.means[:10], atol=0.1)
    assert torch.equal(net.label_channels(canonical)[:, 0] > 0.5, torch.arange(40) < 10)


def test_seeds_stand_where_the_state_of_rest_puts_them_and_belong_to_the_instrument() -> None:
    net = network(membership=True, seeds=True)
    canonical = random_canonical(torch.Generator().manual_seed(5), (40,))
    rest = state(2)
    net.fit_ranges([rest, rest], canonical.means)
    canonical = canonical.with_extras(**net.initial_extras(canonical))
    points = torch.randn(100, 3)
    joined = net._with_seeds(canonical, [(points, 2.0)])
    assert joined.counts == (len(joined),)
    assert 40 < len(joined) <= 60
    pose = rest.instruments[GRASPER.name].pose.float()
    assert torch.allclose(joined.means[40], points[0] @ pose[:3, :3].T + pose[:3, 3], atol=1e-4)
    assert (members(joined)[40:, 1] > 0.99).all()
    assert (members(joined)[:40, 1] < 0.01).all()
    assert INITIAL_LOGIT > 0


def posed_members(net: NPS, *states: State) -> list[Posed]:
    """What the untrained network makes of an instrument's Gaussians, its head's weights drawn at random."""
    torch.nn.init.normal_(net.head.weight)
    canonical = random_canonical(torch.Generator().manual_seed(5), (40,))
    net.fit_ranges([state(0), state(4)], canonical.means)
    canonical = canonical.with_extras(**{MEMBER_LOGITS: canonical.means.new_full((40, len(net.instruments)), 40.0)})
    return [net.pose(canonical, given) for given in states]


def test_a_network_of_joints_deforms_alike_wherever_the_instrument_is() -> None:
    given = [
        grasper_state(pose_of(0.3 * k - 1, 0.2 * k, 0.1, k, 2 * k, 60 - k), jaw) for k, jaw in ((0, 0.4), (3, 0.4))
    ]
    here, there = posed_members(network(membership=True, state="joints"), *given)
    poses = [s.instruments[GRASPER.name].pose.float() for s in given]
    moved = poses[1] @ poses[0].inverse()
    assert torch.allclose(here.means @ moved[:3, :3].T + moved[:3, 3], there.means, atol=1e-3)
    assert torch.equal(here.scales, there.scales)
    opened = grasper_state(given[0].instruments[GRASPER.name].pose, 0.6)
    other = posed_members(network(membership=True, state="joints"), given[0], opened)
    assert not torch.allclose(other[0].means, other[1].means, atol=1e-2)


def test_a_network_of_joints_without_joints_still_deforms() -> None:
    torch.manual_seed(0)
    rigid = Instrument(GRASPER.name, {})
    net = NPS((rigid,), NPSSettings(depth=2, width=16, membership=True, state="joints"))
    first, second = posed_members(net, state(0), state(0))
    assert net.state_size() == 1
    assert torch.isfinite(first.means).all()
    assert torch.equal(first.means, second.means)


def test_joints_alone_are_refused_where_nothing_carries_the_instrument() -> None:
    with pytest.raises(NeecoError, match="membership=true"):
        NPSSettings(state="joints")


@pytest.mark.parametrize("warming_up", [True, False])
def test_instruments_are_carried_while_the_network_is_still_off(warming_up: bool) -> None:
    net = network(membership=True)
    net.warming_up = warming_up
    torch.manual_seed(0)
    here, there = posed_members(net, state(0), state(3))
    assert (here.means - there.means).norm(dim=1).min() > 1


def test_octaves_open_from_the_lowest() -> None:
    net = network(anneal=0.5)
    values = torch.tensor([0.3, -0.7])
    assert not net._encode(values, 10).any()
    net.opened.fill_(0.3)
    encoded = net._encode(values, 10).view(2, 2, 10)
    assert encoded[..., :3].all()
    assert not encoded[..., 3:].any()
    net.opened.fill_(1.0)
    assert torch.allclose(net._encode(values, 10), network()._encode(values, 10))
