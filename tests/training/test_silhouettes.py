"""What the learned tissue does not explain is an instrument, whatever the scene takes for one; shadows are tissue."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from neeco.capture import read_capture
from neeco.geometry.camera import Camera
from neeco.geometry.projection import project_world
from neeco.methods.kinematic.deformation import observe_silhouettes
from neeco.methods.kinematic.finish import drop_refuted, judge_frames
from neeco.raster import rasterize
from neeco.raster.types import Gaussians
from neeco.scene.canonical import CanonicalGaussians, join_bodies, seed_gaussians
from neeco.scene.training_views import TrainingViews
from neeco.training.config import training_config
from neeco.training.initial import begin_session
from neeco.training.session import GaussianSession
from neeco.training.silhouettes import INSTRUMENT, UNKNOWN, Silhouettes

TISSUE, METAL = (0.6, 0.25, 0.2), (0.55, 0.57, 0.6)
SIDE = 96
CAMERA = Camera(np.eye(4), 90.0, 90.0, 48.0, 48.0, SIDE, SIDE)


def plane(x: tuple[float, float], depth: float, color: tuple[float, float, float]) -> CanonicalGaussians:
    """Opaque Gaussians over the columns x [mm] of a plane before the camera."""
    across, down = torch.meshgrid(torch.arange(*x, 1.0), torch.arange(-36.0, 36.0, 1.0), indexing="ij")
    points = torch.stack([across, down, torch.full_like(across, depth)], -1).reshape(-1, 3)
    count = len(points)
    return seed_gaussians(points, torch.tensor(color).expand(count, 3), torch.full((count,), 0.7), opacity=0.99)


class Scene:
    """A scene that takes columns -10 .. 10 mm for the instrument."""

    instruments = ("tool",)

    def __init__(self, metal: tuple[float, float, float] = METAL) -> None:
        self.canonical = join_bodies([plane((-36.0, 36.0), 60.0, TISSUE), plane((-10.0, 10.0), 58.0, metal)])

    def at(self, state: object) -> Gaussians:
        canonical = self.canonical
        opacities = torch.sigmoid(canonical.opacity_logits)
        return Gaussians(canonical.means, canonical.quats, canonical.log_scales.exp(), opacities, canonical.sh_dc)


def session_of(scene: Scene, noise: float = 0.0, metal: tuple[float, float, float] = METAL) -> Any:
    """A session whose image shows metal in columns 36 .. 61 px, which are fewer, and a shadow in 61 .. 68 px."""
    posed = scene.at(None)
    with torch.no_grad():
        image: Tensor = rasterize(posed.select(~scene.canonical.of_instruments), CAMERA).color.clamp(0, 1).clone()
    image[:, 61:68] *= 0.7
    image[:, 36:61] = torch.tensor(metal)
    image += noise * torch.randn(image.shape, generator=torch.Generator().manual_seed(0))
    frames = (SimpleNamespace(name="a"),)
    views = SimpleNamespace(frames=frames, target=lambda index: image, mask=lambda index: None)
    session = SimpleNamespace(scene=scene, views=views, corrected=lambda index: (None, CAMERA), silhouettes=None)
    session.compared = partial(GaussianSession.compared, session)
    return session


def test_images_tell_instrument_from_shadow_and_tissue_where_the_scene_is_wrong() -> None:
    session = session_of(Scene())
    observe_silhouettes(session)
    (values,) = session.silhouettes.values
    middle = values[20:76]
    assert bool((middle[:, 38:59] == INSTRUMENT).all())
    assert int(middle[:, 63:66].max()) < 20  # its shadow, which the scene takes for the instrument
    assert int(middle[:, :33].max()) < 64


def test_a_shadow_that_the_scene_takes_for_the_instrument_is_tissue_from_penumbra_to_umbra() -> None:
    session = session_of(Scene(), noise=0.01)
    image = session.views.target(0)
    unshaded = image[:, 70:].mean((0, 1))
    image[:, 44:70] = unshaded * torch.linspace(0.25, 1, 26)[:, None]  # the label reaches to column 62
    image[:, 44:70] += 0.01 * torch.randn(SIDE, 26, 3, generator=torch.Generator().manual_seed(1))
    observe_silhouettes(session)
    (values,) = session.silhouettes.values
    assert float((values[20:76, 46:68] < UNKNOWN // 2).float().mean()) > 0.9
    assert bool((values[20:76, 38:42] == INSTRUMENT).all())


def test_what_the_lens_mixes_at_an_outline_is_no_instrument_where_less_than_half_is() -> None:
    session = session_of(Scene())
    sharp = session.views.target(0).numpy()
    blurred = torch.from_numpy(gaussian_filter(sharp, (1.0, 1.0, 0.0)))  # of an instrument in columns 36 .. 61
    session.views.target = lambda index: blurred
    observe_silhouettes(session)
    claimed = session.silhouettes.instrument(0)[20:76] > 0
    assert not bool(claimed[:, :36].any())
    assert bool(claimed[:, 38:59].all())


@pytest.mark.parametrize(("noise", "least"), [(0.02, 0.98), (0.08, 0.8), (0.15, 0.6)])
def test_the_noisier_the_images_the_less_is_certain_and_nothing_is_wrong(noise: float, least: float) -> None:
    session = session_of(Scene(), noise=noise)
    observe_silhouettes(session)
    middle = session.silhouettes.values[0][20:76]
    instrument, tissue = middle[:, 38:59], middle[:, :33]
    assert min(float((instrument > 160).float().mean()), float((tissue < 96).float().mean())) > least
    assert not bool((instrument < 96).any())
    assert not bool((tissue > 160).any())


def test_a_dark_shaft_before_dark_tissue_is_not_taken_for_tissue() -> None:
    dark = (0.06, 0.05, 0.05)
    scene = Scene(dark)
    tissue = scene.canonical.body(0)
    below = scene.canonical.means[tissue][:, 1] > 0
    scene.canonical.sh_dc[tissue][below] = plane((0.0, 1.0), 60.0, dark).sh_dc[0]
    session = session_of(scene, metal=dark)
    observe_silhouettes(session)
    (values,) = session.silhouettes.values
    assert bool((values[20:44, 39:52] == INSTRUMENT).all())  # from 3 px inside: at its outline it is all but a shade
    assert int(values[54:76, 38:52].min()) >= UNKNOWN - 30
    assert int(values[20:44, :30].max()) <= UNKNOWN + 5


def test_later_observations_replace_earlier_ones_only_where_the_tissue_is_better() -> None:
    session = session_of(Scene())
    observe_silhouettes(session)
    first = session.silhouettes
    observe_silhouettes(session)
    assert session.silhouettes is first
    first.noise = 1.0
    observe_silhouettes(session)
    assert session.silhouettes is not first


def test_the_loss_asks_for_labels_where_instruments_are_and_for_none_where_tissue_is() -> None:
    values = torch.full((8, 8), UNKNOWN, dtype=torch.uint8)
    values[:4, :4], values[4:, 4:] = INSTRUMENT, 0
    label = torch.full((8, 8), 0.5, requires_grad=True)
    Silhouettes((values,), 0.0).loss(0, label).backward()
    gradient = label.grad
    assert gradient is not None
    assert bool((gradient[:4, :4] < 0).all())
    assert bool((gradient[4:, 4:] > 0).all())
    assert bool((gradient[:4, 4:] == 0).all())


def test_many_frames_count_less_each() -> None:
    values = torch.full((4, 4), INSTRUMENT, dtype=torch.uint8)
    label = torch.full((4, 4), 0.5)
    few, many = (float(Silhouettes((values,) * count, 0.0).loss(0, label)) for count in (30, 60))
    assert few == pytest.approx(2 * many, rel=1e-6)


@pytest.mark.parametrize("size", [(4, 6), (8, 12), (16, 24)])
def test_the_loss_takes_labels_of_any_size(size: tuple[int, int]) -> None:
    values = torch.zeros(8, 12, dtype=torch.uint8)
    values[:, :6] = INSTRUMENT
    right = torch.zeros(size)
    right[:, : size[1] // 2] = 1
    silhouettes = Silhouettes((values,), 0.0)
    assert float(silhouettes.loss(0, right)) < 1e-4 < float(silhouettes.loss(0, 1 - right))


@pytest.mark.parametrize(("deviation_mm", "dropped"), [(0.0, True), (5.0, False)])
def test_what_training_images_refute_is_dropped_within_the_uncertainty_of_their_states(
    deviation_mm: float, dropped: bool
) -> None:
    session = session_of(Scene())
    session.frames_along_poses = lambda count: [0, 1]
    session.refinement = SimpleNamespace(
        counts=lambda index: True, instants=[0, 1], pose_sd=torch.full((2, 1, 6), deviation_mm)
    )
    canonical = session.scene.canonical
    left, confirmed = drop_refuted(session, judge_frames(session))
    assert torch.equal(left.means[left.body(0)], canonical.means[canonical.body(0)])
    columns, kept = (
        project_world(means[means[:, 1].abs() < 20], CAMERA)[0][:, 0]  # in the image
        for means in (canonical.means[canonical.body(1)], left.means[left.body(1)])
    )
    assert (float(columns.min()), float(columns.max())) == pytest.approx((32.5, 62.0), abs=1)
    assert (float(kept.min()) > 33.5) == dropped  # the image shows the instrument in columns 36 .. 61
    assert int(((columns > 38) & (columns < 59)).sum()) == int(((kept > 38) & (kept < 59)).sum())
    assert float(confirmed[left.body(0)].max()) == 0  # tissue is never on an instrument
    inside = confirmed[left.body(1)][left.means[left.body(1), 1].abs() < 20][(kept > 40) & (kept < 57)]
    assert float(inside.median()) > 0.9


def test_a_checkpoint_brings_them_back(capture: Path) -> None:
    views = TrainingViews.read(read_capture(capture).split("train"))
    first, second = (
        begin_session(
            read_capture(capture), views, training_config("nps", {"iterations": 20}, ["deformation.width=16"]), print
        )
        for _ in range(2)
    )
    frames = (torch.arange(6, dtype=torch.uint8).view(2, 3), torch.arange(8, dtype=torch.uint8).view(4, 2))
    second.restore(*first.pack())
    assert second.silhouettes is None
    first.silhouettes = Silhouettes(frames, 0.0125)
    second.restore(*first.pack())
    back = second.silhouettes
    assert back is not None
    assert back.noise == 0.0125
    assert all(torch.equal(a, b) for a, b in zip(back.values, frames, strict=True))
