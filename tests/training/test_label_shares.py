"""Gaussians that model an instrument's shadow count less in its labels than those that model the instrument."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from neeco.geometry.camera import Camera
from neeco.methods.kinematic import label_shares as module
from neeco.methods.kinematic.articulation import LABEL_SHARE
from neeco.methods.kinematic.label_shares import store_label_shares
from neeco.raster.types import Gaussians
from neeco.scene.canonical import CanonicalGaussians, join_bodies, seed_gaussians

TISSUE, METAL = (0.6, 0.25, 0.2), (0.55, 0.57, 0.6)
SHADE = 0.35  # of the tissue's light, in the shadow
SIDE = 64
CAMERA = Camera(np.eye(4), 60.0, 60.0, 32.0, 32.0, SIDE, SIDE)


def flat(
    x: tuple[float, float], depth: float, color: tuple[float, float, float], step: float = 1.0
) -> CanonicalGaussians:
    """Opaque Gaussians over the columns x [mm] of a plane before the camera."""
    across, down = torch.meshgrid(torch.arange(*x, step), torch.arange(-36.0, 36.0, step), indexing="ij")
    points = torch.stack([across, down, torch.full_like(across, depth)], -1).reshape(-1, 3)
    count = len(points)
    return seed_gaussians(points, torch.tensor(color).expand(count, 3), torch.full((count,), 0.7 * step), opacity=0.99)


@dataclass
class StillScene:
    """Tissue behind an instrument of two stripes: metal, and at its side what models its shadow, or its dark side."""

    metal: tuple[float, float, float] = METAL
    side: tuple[float, ...] = tuple(SHADE * value for value in TISSUE)
    wrist: tuple[float, float, float] | None = None  # a third stripe, the instrument's second part
    diagnostics: dict[str, Any] = field(default_factory=dict)
    label_names = (("tool", "shaft"), ("tool", "wrist"))
    label_threshold: float | None = None

    def __post_init__(self) -> None:
        stripes = [flat((-14.0, 4.0), 58.0, self.metal), flat((4.0, 6.0), 58.0, self.side)]  # type: ignore[arg-type]
        self.metal_count = len(stripes[0])
        self.shaft_count = sum(map(len, stripes))
        if self.wrist is not None:
            stripes.append(flat((-34.0, -16.0), 58.0, self.wrist))
        self.canonical = join_bodies([flat((-36.0, 36.0), 60.0, TISSUE), self.joined(stripes)])

    def label_channels(self) -> Tensor:
        channels = torch.zeros(len(self.canonical), 2)
        instrument = channels[self.canonical.body(1)]
        instrument[: self.shaft_count, 0] = 1
        instrument[self.shaft_count :, 1] = 1
        return channels

    @staticmethod
    def joined(stripes: list[CanonicalGaussians]) -> CanonicalGaussians:
        both = join_bodies(stripes)
        return replace(both, counts=(len(both),))

    def at(self, state: object) -> Gaussians:
        canonical = self.canonical
        return Gaussians(
            canonical.means,
            canonical.quats,
            canonical.log_scales.exp(),
            torch.sigmoid(canonical.opacity_logits),
            canonical.sh_dc,
        )


def session_of(scene: StillScene) -> Any:
    """A session of one frame, recorded as the scene is drawn."""
    with torch.no_grad():
        image: Tensor = module.rasterize(scene.at(None), CAMERA).color
    views = SimpleNamespace(target=lambda index: image, mask=lambda index: None)
    return SimpleNamespace(
        scene=scene,
        views=views,
        corrected=lambda index: (None, CAMERA),
        frames_along_poses=lambda count: [0],
    )


def test_what_looks_like_tissue_in_another_shade_is_no_instrument() -> None:
    scene = StillScene()
    store_label_shares(session_of(scene))
    tissue, instrument = scene.canonical.body(0), scene.canonical.body(1)
    share = scene.canonical.extras[LABEL_SHARE]
    metal, shadow = share[instrument][: scene.metal_count], share[instrument][scene.metal_count :]
    points = scene.canonical.means[instrument][scene.metal_count :]
    in_view = (points[:, 0] > 4.5) & (points[:, 1].abs() < 25)
    assert float(metal.min()) > 0.9
    assert float(shadow[in_view].max()) < 0.1
    assert bool((share[tissue] == 1).all())
    assert scene.label_threshold == 0.5


def test_the_dark_side_of_a_dark_shaft_is_instrument() -> None:
    scene = StillScene((0.22, 0.22, 0.24), (0.04, 0.03, 0.03))
    store_label_shares(session_of(scene))
    instrument = scene.canonical.body(1)
    in_view = scene.canonical.means[instrument][:, 1].abs() < 25
    assert scene.label_threshold == 0.5
    assert float(scene.canonical.extras[LABEL_SHARE][instrument][in_view].min()) > 0.9


@pytest.mark.parametrize("metal", [tuple(0.5 * value for value in TISSUE)])
def test_where_colours_do_not_tell_everything_stays_as_it_was(metal: tuple[float, float, float]) -> None:
    scene = StillScene(metal)
    before = scene.canonical
    store_label_shares(session_of(scene))
    assert scene.canonical is before
    assert scene.label_threshold is None
    assert scene.diagnostics["label_shares"]["inside"] < module.MIN_INSIDE


def test_a_wrist_that_mirrors_the_tissue_does_not_make_the_shafts_shadow_instrument() -> None:
    scene = StillScene(wrist=(0.5 * TISSUE[0], 0.5 * TISSUE[1], 0.5 * TISSUE[2]))
    store_label_shares(session_of(scene))
    assert scene.diagnostics["label_shares"]["inside"] < module.MIN_INSIDE
    instrument = scene.canonical.body(1)
    share, points = scene.canonical.extras[LABEL_SHARE][instrument], scene.canonical.means[instrument]
    metal, shadow, wrist = share.tensor_split([scene.metal_count, scene.shaft_count])
    place = points[scene.metal_count : scene.shaft_count]
    assert float(metal.min()) > 0.9
    assert float(shadow[(place[:, 0] > 4.5) & (place[:, 1].abs() < 25)].max()) < 0.1
    assert bool((wrist == 1).all())
    assert scene.label_threshold == 0.5


class FringedScene(StillScene):
    """The side stripe is a translucent fringe of tissue's colour, which a state shifts to the right, in mm."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.canonical.opacity_logits[self.canonical.body(1)][self.metal_count :] = 0.0

    def at(self, state: object) -> Gaussians:
        posed = super().at(state)
        means = posed.means.clone()
        fringe = means[self.canonical.body(1)][self.metal_count :]
        fringe += torch.tensor([float(state or 0), 0.0, -1.0])  # type: ignore[arg-type]
        return replace(posed, means=means)


def test_a_fringe_is_no_instrument_though_some_frames_show_it_in_front_of_the_instrument() -> None:
    scene = FringedScene(side=tuple(0.8 * value for value in TISSUE))
    places = (-10, 8, 12)  # in front of the metal, on the tissue, on the tissue
    bare = StillScene.at(scene, None).select(slice(0, len(scene.canonical) - 144))
    session = session_of(scene)
    image = module.rasterize(bare, CAMERA).color
    session.views.target = lambda index: image
    session.corrected = lambda index: (places[index], CAMERA)
    session.frames_along_poses = lambda count: range(len(places))
    store_label_shares(session)
    instrument = scene.canonical.body(1)
    share, points = scene.canonical.extras[LABEL_SHARE][instrument], scene.canonical.means[instrument]
    fringe = (torch.arange(len(share)) >= scene.metal_count) & (points[:, 1].abs() < 25)
    assert float(share[: scene.metal_count].min()) > 0.9
    assert float(share[fringe].max()) < 0.1
