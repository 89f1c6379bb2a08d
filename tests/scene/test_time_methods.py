"""Methods that know the state by its time: what they are at the start, what noise may touch, and what learns."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parent))
from scene_worlds import SMALL, grasper_state, make_scene, pose_of, random_canonical, rounding

from neeco.base.errors import NeecoError
from neeco.capture.model import State
from neeco.methods.hexplane import HexPlane, HexPlaneSettings
from neeco.methods.time_mlp import NoisyTime, TimeMLP, TimeMLPSettings, octaves
from neeco.scene import GaussianScene
from neeco.scene.deformation import UNPERTURBED, Deformation, Perturbation
from neeco.scene.method_registry import make_deformation, method_settings

METHODS = ("deformable-3dgs", "4dgs")


@pytest.fixture(params=METHODS)
def scene(request: pytest.FixtureRequest) -> GaussianScene:
    return make_scene(request.param)


@pytest.fixture(params=[*METHODS, "nps"])
def of_networks(request: pytest.FixtureRequest) -> GaussianScene:
    return make_scene(request.param)


def woken(deformation: Deformation) -> Deformation:
    """The same with random numbers added to all it learns, as after some training."""
    torch.manual_seed(1)
    with torch.no_grad():
        for parameter in deformation.parameters():
            parameter += 0.1 * torch.randn(parameter.shape)
    return deformation


def test_an_untrained_scene_is_its_canonical_one_at_every_time(of_networks: GaussianScene) -> None:
    scene = of_networks
    for state in scene.recorded.states:
        posed = scene.at(state)
        assert torch.equal(posed.means, scene.canonical.means)
        assert torch.equal(posed.scales, scene.canonical.log_scales.exp())
        directions = torch.nn.functional.normalize(posed.quats, dim=-1)
        assert torch.allclose(directions, torch.nn.functional.normalize(scene.canonical.quats, dim=-1))


def test_the_gradient_reaches_every_parameter(of_networks: GaussianScene) -> None:
    scene = of_networks
    woken(scene.deformation)
    posed = scene.at(scene.recorded.states[3])
    loss = posed.means.square().sum() + posed.quats[:, 0].sum() + posed.scales.sum()
    own = scene.deformation.regularisation(scene.canonical, None, 1)
    (loss if own is None else loss + own).backward()
    for name, parameter in scene.deformation.named_parameters():
        assert parameter.grad is not None, name
        assert bool(parameter.grad.abs().max() > 0), name
    assert set(scene.deformation.learning_rates(0.0)) == {name for name, _ in scene.deformation.named_parameters()}


def test_a_deformation_changes_nothing_in_its_warm_up(of_networks: GaussianScene) -> None:
    scene = of_networks
    woken(scene.deformation).warming_up = True
    assert torch.equal(scene.at(scene.recorded.states[1]).means, scene.canonical.means)


@torch.no_grad()
def test_the_state_of_the_instrument_plays_no_part_but_its_time_does(scene: GaussianScene) -> None:
    woken(scene.deformation)
    first, later = scene.recorded.states[1], scene.recorded.states[5]
    assert torch.equal(scene.at(State(time=first.time)).means, scene.at(first).means)
    assert not torch.allclose(scene.at(State(later.instruments, first.time)).means, scene.at(later).means)


def test_noise_on_the_state_comes_from_torchs_generator_and_only_when_asked_for(scene: GaussianScene) -> None:
    assert_noise_is_drawn(scene, Perturbation(state_noise=0.3))


def test_noise_on_the_time_comes_from_torchs_generator_and_only_when_asked_for() -> None:
    assert_noise_is_drawn(make_scene("deformable-3dgs"), NoisyTime(time_noise=0.1))


@torch.no_grad()
def assert_noise_is_drawn(scene: GaussianScene, noise: Perturbation) -> None:
    woken(scene.deformation)
    state = scene.recorded.states[2]
    untouched = torch.get_rng_state()
    clean = scene.at(state).means
    assert torch.equal(scene.at(state).means, clean)
    assert torch.equal(torch.get_rng_state(), untouched)
    torch.manual_seed(4)
    noisy = scene.at(state, noise).means
    assert not torch.equal(noisy, clean)
    assert not torch.equal(scene.at(state, noise).means, noisy)
    torch.manual_seed(4)
    assert torch.equal(scene.at(state, noise).means, noisy)


def test_the_noise_on_the_time_is_the_published_share_of_an_interval() -> None:
    network = make_scene("deformable-3dgs").deformation
    assert isinstance(network, TimeMLP)
    state, noise = grasper_state(pose_of(0, 0, 0, 0, 0, 0), time=0.14), NoisyTime(time_noise=0.1)
    drawn = torch.stack([network.time_of(state, noise) for _ in range(2000)])
    assert float(drawn.mean()) == pytest.approx(0.5, abs=2e-3)
    assert float(drawn.std()) == pytest.approx(0.1 / 8, rel=0.1)  # eight frames
    rng = np.random.default_rng(0)
    disturbed = [network.perturb(UNPERTURBED, 1, share, rng) for share in (0.0, 0.25, 0.5, 1.0)]
    assert [given.time_noise for given in disturbed[:2]] == pytest.approx([0.1, 0.05])
    assert disturbed[2:] == [UNPERTURBED] * 2
    assert TimeMLP((), TimeMLPSettings(synthetic=True)).perturb(UNPERTURBED, 1, 0.0, rng) is UNPERTURBED


def test_the_networks_have_their_published_sizes_and_rates() -> None:
    real, synthetic = TimeMLP(()), TimeMLP((), TimeMLPSettings(synthetic=True))
    assert [layer.in_features for layer in real.layers] == [84, *(256,) * 4, 340, 256, 256]
    assert next(layer.in_features for layer in synthetic.layers) == 63 + 30
    assert [layer.in_features for layer in synthetic.time_net if hasattr(layer, "in_features")] == [13, 256]
    assert real.learning_rates(0.0)["head.weight"] == pytest.approx(8e-4)
    assert real.learning_rates(1.0)["head.weight"] == pytest.approx(1.6e-6)
    planes = HexPlane((), HexPlaneSettings(rate_scale=1.0))
    assert [tuple(plane.shape) for plane in planes.space] == [(3, 16, 64, 64), (3, 16, 128, 128)]
    assert [tuple(plane.shape) for plane in planes.time] == [(3, 16, 25, 64), (3, 16, 25, 128)]
    assert planes.learning_rates(0.0)["time.1"] == pytest.approx(1.6e-3)
    assert planes.learning_rates(1.0)["trunk.weight"] == pytest.approx(1.6e-5)


def test_encoding_by_hand() -> None:
    encoded = octaves(torch.tensor([0.5]), 2)
    assert torch.allclose(encoded, torch.tensor([0.5, 0.479426, 0.841471, 0.877583, 0.540302]), atol=1e-6)


@torch.no_grad()
def test_a_layer_split_between_place_and_time_is_the_layer() -> None:
    network = TimeMLP((), TimeMLPSettings(width=12))
    torch.nn.init.normal_(network.head.weight)
    places, time = torch.rand(5, 3), torch.rand(21)
    given = torch.cat([octaves(places, 10), time.expand(5, -1)], 1)
    features = given
    for index, layer in enumerate(network.layers):
        if index == 5:  # after layer 4; the time last, as the network has its columns
            features = torch.cat([given[:, :63], features, given[:, 63:]], 1)
        features = torch.relu(layer(features))
    expected = network.head(features)
    products = given.shape[1] + 12 * len(network.layers)  # along the longest way through the network
    largest = float(expected.abs().max())
    assert torch.allclose(network.network(places, time), expected, rtol=0, atol=rounding(largest, products))


@settings(max_examples=25, deadline=None)
@given(
    method=st.sampled_from(METHODS),
    tissue=st.integers(0, 6),
    instrument=st.integers(0, 6),
    time=st.floats(-10, 10),
    state_noise=st.sampled_from([0.0, 0.3]),
)
@torch.no_grad()
def test_every_gaussian_has_a_place_a_turn_and_a_size(method, tissue, instrument, time, state_noise):
    """Whatever the time, also far outside of the recording, and however many Gaussians there are."""
    deformation = woken(make_deformation(method, (), method_settings(method, SMALL[method])))
    canonical = random_canonical(torch.Generator().manual_seed(0), (tissue, instrument))
    deformation.fit_ranges([State(time=0.1 * k) for k in range(5)], 10 * torch.randn(40, 3))
    posed = deformation.pose(canonical, State(time=time), Perturbation(state_noise=state_noise))
    count = tissue + instrument
    for tensor, size in ((posed.means, 3), (posed.quats, 4), (posed.scales, 3)):
        assert tensor.shape == (count, size)
        assert bool(torch.isfinite(tensor).all())
    assert bool((posed.scales >= 0).all())
    assert deformation.label_channels(canonical).shape == (count, 0)


@pytest.mark.parametrize(
    ("field", "value"), [("resolution", 2), ("time_resolution", 1), ("levels", 0), ("warm_up", 1.0)]
)
def test_a_field_that_makes_no_planes_is_refused_by_name(field: str, value: float) -> None:
    with pytest.raises(NeecoError, match=rf"deformation\.{field}: "):
        HexPlaneSettings(**{field: value})


# --- the planes against their definition ---


def sample_by_hand(plane: Tensor, across: Tensor, down: Tensor) -> Tensor:
    """plane [C, H, W] at one point, coordinates in [-1, 1] or beyond: the four neighbours' weighted mean [C]."""
    place = []
    for value, count in ((down, plane.shape[1]), (across, plane.shape[2])):
        position = ((value.clamp(-1, 1) + 1) / 2) * (count - 1)
        below = min(int(position), count - 2)
        place.append((below, position - below))
    (i, fi), (j, fj) = place
    upper = plane[:, i, j] * (1 - fj) + plane[:, i, j + 1] * fj
    lower = plane[:, i + 1, j] * (1 - fj) + plane[:, i + 1, j + 1] * fj
    return upper * (1 - fi) + lower * fi


def features_by_hand(planes: HexPlane, places: Tensor, time: Tensor) -> Tensor:
    rows = []
    for x, y, z in places:
        levels = []
        for space, moments in zip(planes.space, planes.time, strict=True):
            value = sample_by_hand(space[0], x, y) * sample_by_hand(space[1], x, z) * sample_by_hand(space[2], y, z)
            for axis, coordinate in enumerate((x, y, z)):
                value = value * sample_by_hand(moments[axis], coordinate, 2 * time - 1)
            levels.append(value)
        rows.append(torch.cat(levels))
    return torch.stack(rows)


@pytest.mark.parametrize("time", [-0.5, 0.0, 0.37, 0.5, 1.0, 1.5])
def test_planes_give_what_their_definition_says_with_the_same_gradients(time: float) -> None:
    generator = torch.Generator().manual_seed(2)
    planes = HexPlane((), HexPlaneSettings(**SMALL["4dgs"])).double()
    with torch.no_grad():
        for plane in planes.time:
            plane.copy_(torch.rand(plane.shape, generator=generator))
    places = (1.3 * torch.randn(9, 3, generator=generator, dtype=torch.float64)).requires_grad_()
    moment = torch.tensor(time, dtype=torch.float64)
    weight = torch.randn(9, 8, generator=generator, dtype=torch.float64)
    found = planes.features(places, planes.rows_at(moment))
    expected = features_by_hand(planes, places, moment)
    assert torch.allclose(found, expected, atol=1e-12)
    wanted = [places, *planes.space, *planes.time]
    gradients = torch.autograd.grad((found * weight).sum(), wanted)
    references = torch.autograd.grad((expected * weight).sum(), wanted)
    for gradient, reference in zip(gradients, references, strict=True):
        assert torch.allclose(gradient, reference, atol=1e-12)


def test_regularisation_by_hand() -> None:
    """A ramp bends nowhere; a kink of 1 in one row of the planes of space and of time counts by its weight."""
    planes = HexPlane((), HexPlaneSettings(channels=1, resolution=4, levels=1, time_resolution=5))
    canonical = random_canonical(torch.Generator().manual_seed(0))
    with torch.no_grad():
        planes.space[0].copy_(torch.arange(4.0)[:, None].expand(3, 1, 4, 4))
        planes.time[0].fill_(1.0)
        assert float(planes.regularisation(canonical, None, 1)) == pytest.approx(0.0, abs=1e-12)
        planes.space[0][0, 0, 3] += 1  # one second difference of 1 among the two of each column of one plane
        assert float(planes.regularisation(canonical, None, 1)) == pytest.approx(1e-4 / 2)
        planes.time[0][1, 0, 4] = 2  # one of three in every column, and one fifth of that plane's numbers 1 away from 1
        assert float(planes.regularisation(canonical, None, 1)) == pytest.approx(1e-4 / 2 + 1e-2 / 3 + 1e-4 / 5)
