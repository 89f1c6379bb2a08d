"""The gate: what lies far from the instruments' path is not evaluated and does not move."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))
from scene_worlds import GRASPER, grasper_state, make_scene, pose_of, random_canonical, rounding

from neeco.errors import NeecoError
from neeco.methods.nps import NPS, NPSSettings, SweptVolume
from neeco.scene import GaussianScene
from neeco.scene.deformation import mark_moving
from neeco.scene.io import load_scene, save_scene

MARGIN_MM = 4.0


def path_points() -> torch.Tensor:
    """[P, 3] mm along a bent path through the middle of the Gaussians."""
    t = torch.linspace(-1, 1, 200)
    return torch.stack([12 * t, 6 * t**2, 3 * t], 1)


def gated(scene: GaussianScene) -> GaussianScene:
    """The same scene, network included, with its gate about `path_points`."""
    network = NPS(scene.instruments, NPSSettings(gate_mm=MARGIN_MM))
    network.load_state_dict(scene.deformation.state_dict(), strict=False)
    network.gate.cover(path_points())
    return GaussianScene("nps", scene.canonical, network, scene.instruments, scene.recorded, scene.center)


@pytest.fixture
def neeco() -> GaussianScene:
    """A scene whose network moves every Gaussian."""
    scene = make_scene("nps")
    torch.manual_seed(1)
    torch.nn.init.normal_(scene.deformation.head.weight)
    return scene


def test_a_swept_volume_is_what_lies_within_the_margin_of_the_path() -> None:
    volume = SweptVolume(MARGIN_MM)
    probe = 15 * torch.randn(4000, 3, generator=torch.Generator().manual_seed(2))
    assert volume.contains(probe).all()
    volume.cover(path_points())
    distance = torch.cdist(probe, path_points()).min(1).values
    cell = float(volume.cell.norm())
    inside = volume.contains(probe)
    assert inside[distance < MARGIN_MM - cell].all()
    assert not inside[distance > MARGIN_MM + cell].any()
    assert 0.01 < inside.float().mean() < 0.5


def test_the_gate_changes_nothing_inside_and_moves_nothing_outside(neeco: GaussianScene) -> None:
    other = gated(neeco)
    inside = other.deformation.gate.contains(neeco.canonical.means)
    assert 5 < int(inside.sum()) < len(inside) - 5
    state = neeco.recorded.states[3]
    with torch.no_grad():
        free, bound = neeco.deltas(state), other.deltas(state)
    # the network multiplies fewer rows; sums add up over all its layers
    products = neeco.deformation.settings.depth * neeco.deformation.settings.width
    for name in ("means", "scales"):
        gated_change, change = getattr(bound, name)[inside], getattr(free, name)[inside]
        assert torch.allclose(gated_change, change, rtol=0, atol=rounding(float(change.abs().max()), products))
    assert free.means[~inside].norm(dim=1).min() > 0.01
    assert not bound.means[~inside].any()
    assert not bound.scales[~inside].any()


def test_gradients_pass_the_gate(neeco: GaussianScene) -> None:
    other = gated(neeco)
    other.at(neeco.recorded.states[0]).means.square().sum().backward()
    assert other.deformation.head.weight.grad[:3].abs().max() > 0


def test_a_gated_scene_comes_back_exactly(neeco: GaussianScene, tmp_path: Path) -> None:
    other = gated(neeco)
    save_scene(other, tmp_path / "scene.safetensors")
    loaded = load_scene(tmp_path / "scene.safetensors")
    state = neeco.recorded.states[2]
    with torch.no_grad():
        assert torch.equal(loaded.at(state).means, other.at(state).means)
    assert loaded.deformation.gate.bounded


def test_the_published_network_has_no_gate(neeco: GaussianScene) -> None:
    assert neeco.deformation.gate is None
    assert not any("gate" in name for name in neeco.state_dict())


def test_what_the_gate_holds_still_does_not_shift_the_labels() -> None:
    """Otsu's threshold is found among the evaluated Gaussians; zeros would pull it below the slightly moving ones."""

    class Moves(NPS):
        def deltas(self, canonical, state):
            deltas = super().deltas(canonical, state)
            share = torch.full((len(canonical), 1), 1e-3)
            share[:20], share[40:] = 0.0, 1.0
            deltas.means.copy_(share * state.instruments["grasper"].pose[:3, 3].float())
            return deltas

    network = Moves((GRASPER,), NPSSettings(depth=2, width=8))
    canonical = random_canonical(torch.Generator().manual_seed(0))
    states = [grasper_state(pose_of(0, 0, 0, 5.0 * k, 0, 0)) for k in range(5)]
    network.fit_ranges(states, canonical.means)
    labels = network.label_channels(mark_moving(network, canonical, states))[:, 0]
    assert not labels[:40].any()
    assert bool(labels[40:].all())


@pytest.mark.parametrize("margin", [0, -3.0])
def test_a_margin_that_is_none_is_refused(margin: float) -> None:
    with pytest.raises(NeecoError, match="gate_mm"):
        NPSSettings(gate_mm=margin)
