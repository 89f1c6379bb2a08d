"""A scene of several tissues: one is drawn, the others are not there."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from scene_worlds import CAMERA, TISSUE, make_scene

from neeco.capture.model import State
from neeco.errors import NeecoError
from neeco.raster import rasterize
from neeco.raster.types import Gaussians, Rendering
from neeco.scene import GaussianScene
from neeco.scene.canonical import TISSUE as OF
from neeco.scene.gaussian_scene import one_tissue, over_one
from neeco.scene.io import load_scene, save_scene


def draw(gaussians: Gaussians) -> Rendering:
    return rasterize(gaussians, CAMERA, backend="reference")


def two_tissues(method: str = "kinematic") -> GaussianScene:
    """The scene's tissue, every other Gaussian of it of a second one."""
    scene = make_scene(method)
    index = torch.zeros(len(scene.canonical))
    index[1:TISSUE:2] = 1
    scene.canonical = scene.canonical.with_extras(**{OF: index})
    states = tuple(replace(state, tissue="ab"[k % 2]) for k, state in enumerate(scene.recorded.states))
    scene.recorded = replace(scene.recorded, states=states, tissues=("a", "b"))
    scene.center = scene.center.expand(2, 3).clone()
    scene.registration = torch.nn.Parameter(torch.zeros(2, 7))
    return scene


@pytest.mark.parametrize("number", [0, 1])
def test_a_state_draws_its_tissue_alone(number: int) -> None:
    scene = two_tissues()
    state = scene.recorded.states[number]
    canonical = scene.canonical
    shown = canonical.of_tissue(number) | canonical.of_instruments
    with torch.no_grad():
        posed = scene.at(state)
        drawn = draw(posed)
        left = draw(posed.select(shown))
        alone = draw(scene.over("ab"[number]).at(state))
        all_of_it = draw(make_scene("kinematic").at(replace(state, tissue=None)))
    torch.testing.assert_close(drawn.color, left.color, rtol=0, atol=1e-5)
    torch.testing.assert_close(drawn.color, alone.color, rtol=0, atol=1e-5)
    torch.testing.assert_close(drawn.depth, alone.depth, rtol=1e-4, atol=1e-3)
    assert float((drawn.color - all_of_it.color).abs().max()) > 0.01


def test_a_drawing_teaches_its_tissue_alone() -> None:
    scene = two_tissues().requires_grad_(False)
    for tensor in scene.canonical.tensors().values():
        tensor.requires_grad_()
    draw(scene.at(scene.recorded.states[1])).color.square().sum().backward()
    for name in ("means", "opacity_logits", "sh_dc"):
        gradient = scene.canonical.tensors()[name].grad
        assert not gradient[scene.canonical.of_tissue(0)].any()
        assert gradient[scene.canonical.of_tissue(1)].any()
        assert gradient[scene.canonical.of_instruments].any()


def test_it_is_stored_with_its_tissues_and_one_without_as_before(tmp_path: Path) -> None:
    scene = two_tissues()
    save_scene(scene, tmp_path / "two.safetensors")
    loaded = load_scene(tmp_path / "two.safetensors")
    assert loaded.recorded.tissues == ("a", "b")
    assert [state.tissue for state in loaded.recorded.states] == ["a", "b"] * 4
    assert torch.equal(loaded.canonical.extras[OF], scene.canonical.extras[OF])
    save_scene(loaded, tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == (tmp_path / "two.safetensors").read_bytes()
    save_scene(make_scene("kinematic"), tmp_path / "one.safetensors")
    with safe_open(tmp_path / "one.safetensors", "pt") as stream:
        assert not [name for name in stream.keys() if OF in name]  # noqa: SIM118
        assert "tissues" not in json.loads(stream.metadata()["neeco"])
        assert "tissue" not in json.loads(stream.metadata()["neeco"])["recorded"][0]


def test_a_damaged_one_is_refused_in_a_line(tmp_path: Path) -> None:
    scene = two_tissues()
    scene.canonical = scene.canonical.with_extras(**{OF: scene.canonical.extras[OF] + 1})
    save_scene(scene, tmp_path / "two.safetensors")
    with pytest.raises(NeecoError, match="its Gaussians are of tissues that it does not name"):
        load_scene(tmp_path / "two.safetensors")


def test_a_state_that_names_no_tissue_of_it_is_refused() -> None:
    scene = two_tissues()
    for tissue, known in (("c", "name one of a, b"), (None, "name one of a, b")):
        with pytest.raises(NeecoError, match=rf"state: tissue: {tissue!r} is not in the scene; {known}"):
            scene.at(replace(scene.recorded.states[0], tissue=tissue))
    one = make_scene("3dgs")
    with pytest.raises(NeecoError, match="state: tissue: 'a' is not in the scene; it has one, without a name"):
        one.at(State(tissue="a"))


def test_what_shows_one_tissue_takes_the_first_or_the_one_named() -> None:
    scene = two_tissues()
    assert over_one(scene, None).recorded.tissues == ("a",)
    assert over_one(scene, "b").recorded.tissues == ("b",)
    assert len(over_one(scene, "b").recorded.states) == 4
    assert over_one(make_scene("kinematic"), None).num_gaussians == scene.num_gaussians
    with pytest.raises(NeecoError, match="--tissue: 'c' is not in the scene; its tissues are a, b"):
        over_one(scene, "c")
    with pytest.raises(NeecoError, match=r"track: the scene has several tissues \(a, b\), and this takes one"):
        one_tissue(scene, "track")


def test_each_tissue_corrects_its_poses_by_its_own_registration() -> None:
    scene = two_tissues().requires_grad_(False)
    scene.registration[1, 3:6] = torch.tensor([1.0, 2.0, 3.0])
    first, second = scene.recorded.states[:2]
    place = second.instruments["grasper"].pose[:3, 3].float()
    assert torch.equal(scene.registered(first).instruments["grasper"].pose, first.instruments["grasper"].pose.float())
    moved = scene.registered(second).instruments["grasper"].pose[:3, 3]
    torch.testing.assert_close(moved, place + torch.tensor([1.0, 2.0, 3.0]))
    torch.testing.assert_close(scene.over("b").registered(second).instruments["grasper"].pose[:3, 3], moved)
