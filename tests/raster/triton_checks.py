"""The triton backend draws what the float64 reference defines, gradients included.

Run by test_triton.py in a process of its own, under Triton's interpreter: small images, CPU tensors.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parent))
from raster_scenes import Scene, assert_same_as_reference, decided_pixels, draw, error, leaves, make_scene
from rendering_checks import *  # noqa: F403
from rendering_checks import Backend

from neeco.base.errors import NeecoError
from neeco.raster import rasterize, triton_backend
from neeco.raster.triton import binning

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numpy's, of the interpreter

TRITON = Backend("triton", 24, 16)
scene_of, same = TRITON.scene_of, TRITON.same


@pytest.fixture
def backend() -> Backend:
    return TRITON


@pytest.fixture
def deterministic() -> Iterator[None]:
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)


@pytest.mark.parametrize(("sh_count", "channels"), [(1, 0), (9, 5)])
def test_image_and_every_gradient_match_the_reference(sh_count: int, channels: int) -> None:
    same(scene_of(24, sh_count, channels, seed=sh_count + channels))


def test_as_many_channels_as_there_may_be() -> None:
    same(scene_of(12, 16, 32, seed=1))


@pytest.mark.parametrize(("sh_count", "channels"), [(4, 6)])
def test_deterministic_gradients_match_the_reference(deterministic: None, sh_count: int, channels: int) -> None:
    same(scene_of(24, sh_count, channels, seed=sh_count + channels))


def test_deterministic_gradients_of_a_gaussian_across_many_tiles(deterministic: None) -> None:
    scene = scene_of(3, 1, 0, seed=2, width=60, height=40, size=12.0, opacity=0.5)
    scene.tensors["means"][:, :2] = 0
    same(scene)


@settings(max_examples=4, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    count=st.sampled_from([0, 1, 2, 7, 40]),
    sh_count=st.sampled_from([1, 4, 9, 16]),
    channels=st.integers(0, 6),
    seed=st.integers(0, 10_000),
    width=st.integers(1, 33),
    height=st.integers(1, 33),
    size=st.sampled_from([0.01, 0.5, 3.0, 40.0]),
    opacity=st.sampled_from([None, 1 / 255 + 1e-4, 0.5, 0.9999]),
)
def test_any_scene_matches_the_reference(**shape: int) -> None:
    same(make_scene(**shape))  # type: ignore[arg-type]


def test_tiles_of_another_size_draw_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(triton_backend, "TILE_PX", 8)
    same(scene_of(40, 4, 2, seed=2))


def test_more_gaussians_than_a_program_takes() -> None:
    same(scene_of(150, 1, 0, seed=9, size=1.0))


def test_gaussians_that_cross_many_columns_of_tiles() -> None:
    scene = scene_of(8, 1, 0, seed=11, width=257, height=9, size=12.0)
    scene.tensors["means"][:, 0] *= 257 / 45
    same(scene)


def test_a_tile_is_listed_for_every_gaussian_that_shows_in_it() -> None:
    """And not for all that might, by their boxes: thin Gaussians across the diagonal miss most of theirs."""
    scene = scene_of(8, 1, 0, seed=3, width=96, height=48, frames=False, light=False, opacity=0.9)
    scene.tensors["scales"] = torch.tensor([0.2, 0.2, 60.0]).expand(8, 3).clone()
    lists: list[binning.Lists] = []
    list_per_tile = binning.list_per_tile

    def listen(*args: object) -> binning.Lists:
        lists.append(list_per_tile(*args))  # type: ignore[arg-type]
        return lists[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(triton_backend, "list_per_tile", listen)
        # the inverse of a covariance of 36 px by .56 px (60 and .2 mm at 100 mm, with the low pass of .3 px^2) has a
        # condition of 36^2 / .31 and enters a gradient twice: that many times float32's rounding (2^-24), through some
        # 16 operations
        assert_same_as_reference(scene, "triton", 2 * 16 * 2**-24 * 36**2 / 0.31)
    listed = lists[0]
    tiles = len(listed.starts) - 1
    assert tiles == 18
    assert 8 < len(listed.gaussians) < 0.5 * 8 * tiles
    assert int(listed.starts[-1]) == len(listed.gaussians), "every slot found its tile"


def everything_drawn(scene: Scene) -> list[torch.Tensor]:
    out, gradients = draw(scene, torch.float32, "triton", torch.ones(scene.height, scene.width))
    return [out.color, out.alpha, out.depth, out.radii, *gradients.values()]


def test_the_same_bits_every_time_and_nearly_those_of_the_fast_way(deterministic: None) -> None:
    scene = scene_of(16, 4, 3, seed=9)
    ordered = everything_drawn(scene)
    assert all(torch.equal(a, b) for a, b in zip(everything_drawn(scene), ordered, strict=True))
    torch.use_deterministic_algorithms(False)
    for fast, other in zip(everything_drawn(scene), ordered, strict=True):
        assert error(fast, other) < 1e-5


@pytest.mark.parametrize("image", ["color", "alpha", "depth", "channels"])
def test_a_loss_of_one_image_alone(image: str) -> None:
    scene = scene_of(30, 4, 2, seed=5)
    gradients = []
    weights = decided_pixels(scene)
    for dtype, name in ((torch.float64, "reference"), (torch.float32, "triton")):
        t, gaussians, camera = leaves(scene, dtype)
        out = rasterize(gaussians, camera, channels=t["channels"], backend=name)  # no background either
        drawn = getattr(out, image)
        (drawn.square() * weights.reshape(weights.shape + (1,) * (drawn.dim() - 2))).sum().backward()
        gradients.append([t[name].grad for name in ("means", "opacities", "scales", "world_from_camera")])
    for wanted, found in zip(*gradients, strict=True):
        assert error(found, wanted) < 1e-3


def test_what_needs_no_gradient_gets_none() -> None:
    t, gaussians, camera = leaves(scene_of(20), torch.float32)
    held = replace(gaussians, sh=t["sh"].detach(), means=t["means"].detach())
    rasterize(
        held, replace(camera, world_from_camera=t["world_from_camera"].detach()), backend="triton"
    ).color.sum().backward()
    assert t["sh"].grad is None
    assert t["means"].grad is None
    assert t["scales"].grad.any()


def test_channels_of_width_zero_are_drawn_empty() -> None:
    _, gaussians, camera = leaves(scene_of(5), torch.float32)
    out = rasterize(gaussians, camera, channels=torch.zeros(5, 0), backend="triton")
    assert out.channels is not None
    assert out.channels.shape == (16, 24, 0)


def test_tensors_on_two_devices_are_refused() -> None:
    _, gaussians, camera = leaves(scene_of(5), torch.float32)
    with pytest.raises(NeecoError, match="tensors are on cpu and meta; move them to one device"):
        rasterize(replace(gaussians, scales=gaussians.scales.to("meta")), camera, backend="triton")


def test_more_pairs_than_can_be_numbered_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(binning, "MAX_PAIRS", 3)
    _, gaussians, camera = leaves(scene_of(30), torch.float32)
    with pytest.raises(NeecoError, match="pairs of a tile and a Gaussian are too many"):
        rasterize(gaussians, camera, backend="triton")
