"""The light beside the lens is found by its shadow, learned on, and left alone where there is none."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from rod_world import CAMERA, make_scene

from neeco.capture.model import Frame
from neeco.raster import rasterize
from neeco.scene import Scene
from neeco.training.instruments.light import find_shadow
from neeco.training.options import training_config
from neeco.training.session import GaussianSession, new_session
from neeco.training.views import TrainingViews

OFFSET, STRENGTH = (9.0, -6.0, 0.0), 0.5  # mm, of the light of the photographs


def lit(scene: Scene, offset: tuple[float, float, float], strength: float) -> Scene:
    with torch.no_grad():
        scene.shadow_offset.copy_(torch.tensor(offset))
        scene.shadow_strength.fill_(strength)
        scene.shadow_width.fill_(0.02)
    return scene


def session(strength: float, blank: slice | None = None) -> GaussianSession:
    """About a scene without a shadow, learning from photographs taken under a light of `strength`."""
    world = lit(make_scene(), OFFSET, strength)
    states = world.recorded.states
    with torch.no_grad():
        images = tuple((rasterize(world.at(s), CAMERA).color.clamp(0, 1) * 255).round().to(torch.uint8) for s in states)
    frames = tuple(Frame(Path(f"{k:06d}.png"), CAMERA, state, "train") for k, state in enumerate(states))
    mask = None
    if blank is not None:
        mask = torch.ones(CAMERA.height, CAMERA.width, dtype=torch.bool)
        mask[:, blank] = False
    views = TrainingViews(frames, images, (mask,) * len(frames))
    config = training_config("3dgs", {"iterations": 400})
    return new_session(lit(make_scene(), (0.0, 0.0, 0.0), 0.0), views, config)


def test_the_light_is_found_on_its_side() -> None:
    training = session(STRENGTH)
    find_shadow(training)
    scene, found = training.scene, training.scene.diagnostics["shadow"]
    assert found["found"]
    assert found["agree"] == 1.0
    assert found["explains"] > 0.4
    towards = torch.nn.functional.normalize(scene.shadow_offset.detach(), dim=0)
    assert float(towards @ torch.nn.functional.normalize(torch.tensor(OFFSET), dim=0)) > 0.7  # one of eight directions
    assert 0.2 < float(scene.shadow_strength.detach()) < 0.9


@pytest.mark.parametrize("blank", [None, slice(0, 40)])
def test_without_a_shadow_there_is_no_light(blank: slice | None) -> None:
    training = session(0.0, blank)
    find_shadow(training)
    assert not training.scene.diagnostics["shadow"]["found"]
    assert not training.scene.casts_shadow
    assert not bool(training.scene.shadow_offset.any())


def test_pixels_that_do_not_count_do_not_tell_of_a_shadow() -> None:
    training = session(STRENGTH, slice(0, CAMERA.width))
    find_shadow(training)
    assert not training.scene.casts_shadow


def test_what_was_found_is_learned_on() -> None:
    training = session(STRENGTH)
    find_shadow(training)
    scene = training.scene
    before = float((scene.shadow_offset.detach() - torch.tensor(OFFSET)).norm())
    training.start()
    for tensor in scene.canonical.tensors().values():
        tensor.requires_grad_(False)  # the light alone
    for _ in range(300):
        training.step()
    assert float((scene.shadow_offset.detach() - torch.tensor(OFFSET)).norm()) < 0.8 * before
    assert float(scene.shadow_strength.detach()) == pytest.approx(STRENGTH, abs=0.15)
