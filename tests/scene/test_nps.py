"""The paper's network: what goes in, what comes out untrained, and what counts as moving."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))
from scene_worlds import GRASPER, TISSUE, grasper_state, pose_of, random_canonical, rounding

from neeco.base.errors import NeecoError
from neeco.methods.networks import encode
from neeco.methods.nps import NPS, NPSSettings
from neeco.raster.devices import fast_bfloat16, processor_has
from neeco.scene import GaussianScene
from neeco.scene.deformation import mark_moving, otsu
from neeco.scene.method_registry import method_class, method_settings
from neeco.training.config import method_defaults


def test_the_head_starts_at_zero_and_still_learns(neeco: GaussianScene) -> None:
    neeco.at(neeco.recorded.states[0]).means.square().sum().backward()
    assert not neeco.deformation.head.weight.any()
    assert neeco.deformation.head.weight.grad[:3].abs().max() > 0


@pytest.mark.parametrize("share", [-0.1, 1.0])
def test_a_warm_up_is_a_share_of_the_training(share: float) -> None:
    with pytest.raises(NeecoError, match=r"deformation\.warm_up: .* is not a share"):
        method_settings("nps", {"warm_up": share})


def test_encoding_by_hand() -> None:
    encoded = encode(torch.tensor([0.25]), 3)
    root = 0.5**0.5
    # sin, then cos, of pi/4, pi/2, pi
    assert torch.allclose(encoded, torch.tensor([root, 1.0, 0.0, root, 0.0, -1.0]), atol=1e-6)
    kept = NPS((GRASPER,), NPSSettings(identity=True, depth=2, width=8))._encode(torch.tensor([0.25]), 3)
    assert torch.equal(kept, torch.cat([encoded, torch.tensor([0.25])]))


@pytest.mark.parametrize(("identity", "expected"), [(False, 60), (True, 63)])
def test_a_position_becomes_sixty_numbers(identity: bool, expected: int) -> None:
    network = NPS((GRASPER,), NPSSettings(identity=identity))
    assert network._encode(torch.zeros(5, 3), 10).shape == (5, expected)
    assert network.mean_in.in_features == expected


def test_the_network_has_the_papers_size() -> None:
    network = NPS((GRASPER,))
    layers = [network.mean_in, *network.hidden]
    assert len(layers) == 12
    assert {layer.out_features for layer in layers} == {256}
    assert network.head.out_features == 10
    assert network.state_in.in_features == 20 * (3 + 4 + 1)


def test_recorded_states_span_minus_one_to_one(neeco: GaussianScene) -> None:
    vectors = torch.stack([neeco.deformation.state_vector(state) for state in neeco.recorded.states])
    assert vectors.abs().max() <= 1 + 1e-5
    spans = (vectors.max(0).values - vectors.min(0).values)[[0, 1, 2, 7]]  # position and jaw, which surely vary
    assert torch.allclose(spans, torch.full((4,), 2.0), atol=1e-4)


def test_the_quaternion_does_not_jump_where_its_sign_is_a_convention() -> None:
    """w passes through 0 at half a turn; the state must pass on smoothly."""
    states = [grasper_state(pose_of(angle, 0, 0, 0, 0, 0)) for angle in torch.linspace(2.6, 3.6, 41).tolist()]
    network = NPS((GRASPER,), NPSSettings(depth=2, width=8))
    network.fit_ranges(states, torch.randn(50, 3, generator=torch.Generator().manual_seed(0)))
    quats = torch.stack([network._raw_state(state)[3:7] for state in states])
    assert (quats[1:] - quats[:-1]).norm(dim=1).max() < 0.02


def test_noise_perturbs_the_encoded_state_only_when_asked(neeco: GaussianScene) -> None:
    network, state = neeco.deformation, neeco.recorded.states[2]
    clean = network._encoded_state(state, 0.0)
    noisy = torch.stack([network._encoded_state(state, 0.3) for _ in range(200)])
    assert torch.equal(clean, network._encoded_state(state, 0.0))
    assert abs(float((noisy - clean).std()) - 0.3) < 0.01


def test_evaluation_in_chunks_changes_nothing(neeco: GaussianScene) -> None:
    torch.manual_seed(1)
    torch.nn.init.normal_(neeco.deformation.head.weight)
    with torch.no_grad():
        whole = neeco.at(neeco.recorded.states[1]).means
        neeco.deformation.settings = replace(neeco.deformation.settings, chunk=7)
        parts = neeco.at(neeco.recorded.states[1]).means
    products = neeco.deformation.settings.depth * neeco.deformation.settings.width
    assert torch.allclose(whole, parts, rtol=0, atol=rounding(float(whole.abs().max()), products))
    assert not torch.allclose(whole, neeco.canonical.means, atol=0.01)


def test_otsu_parts_two_clusters() -> None:
    generator = torch.Generator().manual_seed(5)
    low, high = torch.randn(400, generator=generator), 8 + torch.randn(100, generator=generator)
    assert low.max() < otsu(torch.cat([low, high])) < high.min()


class Moves(NPS):
    """A network that moves the Gaussians by a share of the instrument's position."""

    def deltas(self, canonical, state):
        deltas = super().deltas(canonical, state)
        deltas.means.copy_(self.shares * state.instruments["grasper"].pose[:3, 3].float())
        return deltas


@pytest.mark.parametrize(("still", "first"), [(0, TISSUE), (20, 40)])
def test_what_moves_is_told_from_what_does_not_and_from_traces_of_motion(still: int, first: int) -> None:
    """Otsu's threshold is found among the Gaussians that move; zeros would pull it below the slightly moving ones."""
    network = Moves((GRASPER,), NPSSettings(depth=2, width=8))
    canonical = random_canonical(torch.Generator().manual_seed(0))
    network.shares = torch.full((len(canonical), 1), 1e-3)
    network.shares[:still], network.shares[first:] = 0.0, 1.0
    network.shares *= 0.5 + torch.rand(len(canonical), 1, generator=torch.Generator().manual_seed(0))
    states = [grasper_state(pose_of(0, 0, 0, 5.0 * k, 0, 0)) for k in range(5)]
    network.fit_ranges(states, canonical.means)
    assert not network.label_channels(canonical).any()
    labels = network.label_channels(mark_moving(network, canonical, states))
    assert labels.shape == (len(canonical), 1)
    assert not labels[:first].any()
    assert bool((labels[first:] == 1).all())


def in_bfloat16(network: NPS, inputs: tuple[torch.Tensor, torch.Tensor], half: bool) -> list[torch.Tensor]:
    """What the network makes of `inputs`, and the gradients of its parameters."""
    network.settings = replace(network.settings, half=half)
    network.zero_grad()
    output = network.network(*inputs)
    output.backward(torch.ones_like(output))
    return [output.detach(), *(parameter.grad.clone() for parameter in network.parameters())]


@pytest.fixture
def processor(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """Sets what PyTorch says of the processor."""

    def say(*features: str, **words: str) -> None:
        monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: dict.fromkeys(features, True) | words, raising=False)
        processor_has.cache_clear()

    yield say
    processor_has.cache_clear()


@pytest.fixture
def any_processor(processor: Callable[..., None]) -> None:
    """Computes in bfloat16 even where the processor has no instructions for it, slowly."""
    processor("bf16")


@pytest.fixture
def small() -> tuple[NPS, tuple[torch.Tensor, torch.Tensor]]:
    """A network of eight layers, places [500, 3] and an encoded state of numbers that bfloat16 holds exactly."""
    torch.manual_seed(2)
    network = NPS((GRASPER,), NPSSettings(depth=8, width=32, L_mean=2, L_state=1))
    torch.nn.init.normal_(network.head.weight)
    return network, (torch.rand(500, 3) * 2 - 1, torch.randn(16).bfloat16().float())


@pytest.mark.usefixtures("any_processor")
def test_bfloat16_changes_outputs_and_gradients_by_its_rounding(small: tuple) -> None:
    """Each layer rounds to eight bits, errors of which add in squares; a unit that is as close to zero as the error
    changes sides, and its whole gradient with it."""
    exact, rough = (in_bfloat16(*small, half=half) for half in (False, True))
    of_layer, layers = 2**-8, small[0].settings.depth
    of_output = of_layer * layers**0.5
    errors = [float((b - a).norm() / a.norm()) for a, b in zip(exact, rough, strict=True)]
    assert 0 < errors[0] < 2 * of_output
    assert max(errors[1:]) < (layers * of_output) ** 0.5
    assert all(value.dtype == torch.float32 for value in rough)


@pytest.mark.usefixtures("any_processor")
def test_bfloat16_gives_the_same_bits_again(small: tuple) -> None:
    first, second = (in_bfloat16(*small, half=True) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


@pytest.mark.usefixtures("any_processor")
def test_states_that_bfloat16_cannot_tell_apart_stay_apart(small: tuple) -> None:
    network, (places, state) = small
    beside = state * (1 + 2**-11)
    assert torch.equal(beside.bfloat16().float(), state)
    near, exact = (in_bfloat16(network, (places, beside), half)[0] for half in (True, False))
    assert not torch.equal(near, in_bfloat16(network, (places, state), half=True)[0])
    assert torch.allclose(near, exact, rtol=0, atol=0.1 * float(exact.abs().max()))


def test_a_processor_without_bfloat16_stays_with_float32_and_says_so(small, processor):
    processor()
    with pytest.warns(UserWarning, match="no bfloat16"):
        half = in_bfloat16(*small, half=True)
    assert all(torch.equal(a, b) for a, b in zip(half, in_bfloat16(*small, half=False), strict=True))


@pytest.mark.parametrize(
    ("name", "features", "fast"),
    [
        ("Intel(R) Xeon(R)", ["amx_bf16", "avx512_bf16"], True),
        ("Intel(R) Xeon(R)", ["avx512_bf16"], False),
        ("AMD EPYC", ["avx512_bf16"], True),
        ("AMD EPYC", ["avx2"], False),
        (None, [], False),  # an older PyTorch, or another architecture
    ],
)
def test_bfloat16_is_fast_with_tiles_and_on_amd(processor, name, features, fast):
    processor(*features, **({} if name is None else {"cpu_name": name}))
    assert fast_bfloat16() is fast


@pytest.mark.parametrize("method", ["nps", "deformable-3dgs"])
def test_networks_start_in_bfloat16_where_that_is_fast(method: str) -> None:
    config = method_defaults(method)
    assert config.deformation.half is None  # until training starts
    assert method_class(method).resolved(config.deformation).half is fast_bfloat16()
    for half in (True, False):
        begun = replace(config.deformation, half=half)
        assert method_class(method).resolved(config.deformation, begun).half is half
        assert method_class(method).resolved(begun) is begun
    assert not method_settings(method, {}).half  # of a run that does not say: an older one
