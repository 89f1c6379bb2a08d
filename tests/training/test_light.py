"""The lamps beside the lens are found by their shadows, learned on, and left alone where there are none."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from rod_world import CAMERA, make_scene

from neeco.capture.model import Frame
from neeco.methods.kinematic.lamp_search import find_shadow
from neeco.raster import rasterize
from neeco.scene import GaussianScene
from neeco.scene.training_views import TrainingViews
from neeco.training.config import training_config
from neeco.training.session import GaussianSession

OFFSET, STRENGTH = (9.0, -6.0, 0.0), 0.5  # mm, of the lamp of the recorded images
OTHER = (-7.0, -7.0, 0.0)


def lit(scene: GaussianScene, offsets: Sequence[tuple[float, float, float]], strength: float) -> GaussianScene:
    with torch.no_grad():
        for lamp, offset in enumerate(offsets):
            scene.shadow_offsets[lamp] = torch.tensor(offset)
            scene.shadow_strengths[lamp] = strength
        scene.shadow_width.fill_(0.02)
    return scene


def session(
    strength: float,
    blank: slice | None = None,
    offsets: Sequence[tuple[float, float, float]] = (OFFSET,),
    blank_every: int = 1,
) -> GaussianSession:
    """About a scene without a shadow, learning from recorded images taken under lamps of `strength` each; `blank`:
    columns that are masked, in all frames but every `blank_every`th."""
    world = lit(make_scene(), offsets, strength)
    states = world.recorded.states
    with torch.no_grad():
        images = tuple((rasterize(world.at(s), CAMERA).color.clamp(0, 1) * 255).round().to(torch.uint8) for s in states)
    frames = tuple(Frame(Path(f"{k:06d}.png"), CAMERA, state, "train") for k, state in enumerate(states))
    mask = None
    if blank is not None:
        mask = torch.ones(CAMERA.height, CAMERA.width, dtype=torch.bool)
        mask[:, blank] = False
    masks = tuple(None if blank_every > 1 and k % blank_every == 0 else mask for k in range(len(frames)))
    views = TrainingViews(frames, images, masks)
    config = training_config("3dgs", {"iterations": 400})
    return GaussianSession(lit(make_scene(), (), 0.0), views, config)


def lamps(scene: GaussianScene) -> list[torch.Tensor]:
    """Offsets [3] mm of those found."""
    found = scene.shadow_strengths.detach() > 0
    return list(scene.shadow_offsets.detach()[found])


def alike(a: torch.Tensor, b: tuple[float, float, float]) -> float:
    """Cosine between the directions."""
    return float(torch.nn.functional.cosine_similarity(a, torch.tensor(b), dim=0))


def test_the_lamp_is_found_on_its_side() -> None:
    training = session(STRENGTH)
    find_shadow(training)
    scene, look = training.scene, training.scene.diagnostics["shadow"][-1]
    assert look["agree"] == 1.0
    assert look["explains"] > 0.4
    found = lamps(scene)
    assert len(found) == len(look["found_at_mm"]) >= 1
    assert max(alike(lamp, OFFSET) for lamp in found) > 0.7  # one of eight directions
    assert 0.2 < float(scene.shadow_strengths.detach().sum()) < 0.9


def test_two_lamps_are_found_each_on_its_side() -> None:
    training = session(0.35, offsets=(OFFSET, OTHER))
    find_shadow(training)
    found = lamps(training.scene)
    for there in (OFFSET, OTHER):
        assert max(alike(lamp, there) for lamp in found) > 0.7


def test_another_look_finds_what_the_first_left() -> None:
    training = session(0.35, offsets=(OFFSET, OTHER))
    lit(training.scene, (OFFSET,), 0.35)
    find_shadow(training)
    found = lamps(training.scene)
    assert torch.equal(found[0], torch.tensor(OFFSET))
    assert max(alike(lamp, OTHER) for lamp in found[1:]) > 0.7


def test_what_was_faint_is_learned_anew_once_a_lamp_is_found() -> None:
    for strength, faded in ((STRENGTH, True), (0.0, False)):
        training = session(strength)
        canonical = training.scene.canonical
        rows = canonical.body(1)
        with torch.no_grad():
            canonical.opacity_logits[rows][:3] = -1.0  # .27
        before = canonical.opacity_logits.clone()
        find_shadow(training)
        changed = canonical.opacity_logits != before
        assert bool(changed.any()) is faded
        assert not bool(changed[canonical.body(0)].any())
        assert not bool(changed[before > 0].any())


@pytest.mark.parametrize("blank", [None, slice(0, 40)])
def test_without_a_shadow_there_is_no_lamp(blank: slice | None) -> None:
    training = session(0.0, blank)
    find_shadow(training)
    assert training.scene.diagnostics["shadow"][-1]["found_at_mm"] == []
    assert not training.scene.casts_shadow
    assert not bool(training.scene.shadow_offsets.any())


def test_pixels_that_do_not_count_do_not_tell_of_a_shadow() -> None:
    training = session(STRENGTH, slice(0, CAMERA.width))
    find_shadow(training)
    assert not training.scene.casts_shadow


def test_frames_that_show_no_shadow_do_not_outvote_those_that_do() -> None:
    """Where an instrument rests on the tissue, most frames tell nothing of the lamps."""
    training = session(STRENGTH, slice(0, CAMERA.width), blank_every=3)
    find_shadow(training)
    assert max(alike(lamp, OFFSET) for lamp in lamps(training.scene)) > 0.7


def test_what_was_found_is_learned_on() -> None:
    training = session(STRENGTH)
    lit(training.scene, ((6.0, -6.0, 0.0),), 0.3)
    scene = training.scene
    before = float((scene.shadow_offsets[0].detach() - torch.tensor(OFFSET)).norm())
    training.start()
    for tensor in scene.canonical.tensors().values():
        tensor.requires_grad_(False)  # the light alone
    for _ in range(300):
        training.step()
    assert float((scene.shadow_offsets[0].detach() - torch.tensor(OFFSET)).norm()) < 0.8 * before
    assert float(scene.shadow_strengths[0].detach()) == pytest.approx(STRENGTH, abs=0.15)


def test_shadows_are_looked_for_in_images_no_larger_than_those_learned_from() -> None:
    learning = session(STRENGTH)
    learning._use_views(learning.full_views.scaled(0.5), 0.5)
    with learning.searching(as_learned=True):
        assert learning.scale == 0.5
    with learning.searching():
        assert learning.scale == 1.0
    assert learning.scale == 0.5
