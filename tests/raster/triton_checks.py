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
from raster_scenes import TOLERANCE, Scene, assert_same_as_reference, decided_pixels, draw, error, leaves, make_scene

from neeco.base.errors import NeecoError
from neeco.raster import rasterize
from neeco.raster import triton_backend as backend
from neeco.raster.triton import binning

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numpy's, of the interpreter

ONES = torch.ones(16, 24)


def scene_of(count: int = 40, sh_count: int = 4, channels: int = 1, seed: int = 0, **more: object) -> Scene:
    """Small, and most of it in the image."""
    return make_scene(count, sh_count, channels, seed, **{"width": 24, "height": 16} | more)  # type: ignore[arg-type]


def same(scene: Scene, tolerance: float = TOLERANCE) -> None:
    assert_same_as_reference(scene, "triton", tolerance)


@pytest.fixture
def deterministic() -> Iterator[None]:
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)


@pytest.mark.parametrize(("sh_count", "channels"), [(1, 0), (4, 5), (9, 4), (16, 1)])
def test_image_and_every_gradient_match_the_reference(sh_count: int, channels: int) -> None:
    same(scene_of(24, sh_count, channels, seed=sh_count + channels))


def test_as_many_channels_as_there_may_be() -> None:
    same(scene_of(12, 16, 32, seed=1))


@pytest.mark.parametrize(("sh_count", "channels"), [(1, 0), (4, 6), (16, 3)])
def test_deterministic_gradients_match_the_reference(deterministic: None, sh_count: int, channels: int) -> None:
    same(scene_of(24, sh_count, channels, seed=sh_count + channels))


def test_deterministic_gradients_of_a_gaussian_across_many_tiles(deterministic: None) -> None:
    scene = scene_of(3, 1, 0, seed=2, width=100, height=60, size=20.0, opacity=0.5)
    scene.tensors["means"][:, :2] = 0
    same(scene)


@pytest.mark.parametrize(("frames", "light"), [(False, False), (True, False), (False, True)])
def test_without_sh_frames_or_headlight(frames: bool, light: bool) -> None:
    same(scene_of(24, 9, 1, seed=5, frames=frames, light=light))


@settings(max_examples=5, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
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
    monkeypatch.setattr(backend, "TILE_PX", 8)
    same(scene_of(40, 4, 2, seed=2))


def test_more_gaussians_than_a_program_takes() -> None:
    same(scene_of(300, 1, 0, seed=9, size=1.0))


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
        patch.setattr(backend, "list_per_tile", listen)
        # the inverse of a covariance of 36 px by .56 px (60 and .2 mm at 100 mm, with the low pass of .3 px^2) has a
        # condition of 36^2 / .31 and enters a gradient twice: that many times float32's rounding (2^-24), through some
        # 16 operations
        same(scene, tolerance=2 * 16 * 2**-24 * 36**2 / 0.31)
    listed = lists[0]
    tiles = len(listed.starts) - 1
    assert tiles == 18
    assert 8 < len(listed.gaussians) < 0.5 * 8 * tiles
    assert int(listed.starts[-1]) == len(listed.gaussians), "every slot found its tile"


def test_many_opaque_layers_fill_pixels() -> None:
    same(scene_of(16, 1, 1, seed=3, size=25.0, opacity=0.8))


def test_equal_depths_are_drawn_by_index() -> None:
    scene = scene_of(40, 1, 1, seed=4)
    scene.tensors["world_from_camera"] = torch.eye(4)
    scene.tensors["means"][:, 2] = 100.0
    same(scene)


def test_gaussians_behind_the_camera_and_off_screen_draw_nothing() -> None:
    scene = scene_of(4, seed=6)
    scene.tensors["means"] = torch.tensor([[0.0, 0, -100], [4000, 0, 50], [0, -4000, 50], [0, 0, 2.001]])
    scene.tensors["world_from_camera"] = torch.eye(4)
    scene.near = 5.0
    out, gradients = draw(scene, torch.float32, "triton", ONES)
    assert not out.visible.any()
    assert torch.equal(out.color, scene.tensors["background"].expand_as(out.color))
    assert not out.alpha.any()
    assert not out.depth.any()
    assert all(not gradients[name].any() for name in ("means", "quats", "sh", "world_from_camera", "center_offsets"))


def test_a_gaussian_beside_the_camera_does_not_blind_the_image() -> None:
    scene = scene_of(1, sh_count=1, seed=6, channels=0, frames=False, opacity=0.9)
    scene.tensors |= {
        "means": torch.tensor([[30.0, 0.0, 0.9]]),
        "scales": torch.full((1, 3), 20.0),
        "vignette": torch.tensor([0.014, 0.009]),
        "falloff": torch.zeros(1),
        "sh": torch.ones(1, 1, 3),
        "background": torch.zeros(3),
        "world_from_camera": torch.eye(4),
    }
    same(scene)


NOT_FINITE = [
    (field, value)
    for value in (float("nan"), float("inf"), -float("inf"))
    for field in ("means", "quats", "scales", "opacities", "sh", "channels", "falloff", "left", "sh_frames")
]


def test_gaussians_that_are_not_finite_draw_nothing() -> None:
    count = 2 * len(NOT_FINITE)
    scene = scene_of(count, 4, 1, seed=7)
    keep = torch.arange(count) % 2 == 0
    for place, (field, value) in enumerate(NOT_FINITE):
        scene.tensors[field].view(count, -1)[2 * place + 1, -1] = value
    out, gradients = draw(scene, torch.float32, "triton", ONES)
    assert not out.visible[~keep].any(), [NOT_FINITE[int(i)] for i in out.visible[~keep].nonzero()]
    without = Scene(
        {k: v[keep] if v.dim() and v.shape[0] == count else v for k, v in scene.tensors.items()},
        scene.width,
        scene.height,
    )
    expected, expected_gradients = draw(without, torch.float32, "triton", ONES)
    assert expected.visible.any()
    assert torch.equal(out.color, expected.color)
    for name, gradient in gradients.items():
        per_gaussian = gradient.dim() > 0 and gradient.shape[0] == count
        assert error(gradient[keep] if per_gaussian else gradient, expected_gradients[name]) < 1e-5, name
        assert not per_gaussian or not gradient[~keep].any(), name


def test_a_quaternion_of_length_zero_draws_nothing() -> None:
    scene = scene_of(3, seed=8)
    scene.tensors["quats"][1] = 0
    same(scene)
    assert not draw(scene, torch.float32, "triton", ONES)[0].visible[1]


def test_no_gaussians_show_the_background() -> None:
    scene = scene_of(0)
    out, gradients = draw(scene, torch.float32, "triton", ONES)
    assert torch.equal(out.color, scene.tensors["background"].expand_as(out.color))
    assert out.radii.shape == (0,)
    assert error(gradients["background"], torch.zeros(3)) > 0
    assert not gradients["world_from_camera"].any()


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


def test_drawing_without_gradients_gives_the_same_image_and_no_graph() -> None:
    _, gaussians, camera = leaves(scene_of(30), torch.float32)
    first = rasterize(gaussians, camera, backend="triton")
    with torch.no_grad():
        second = rasterize(gaussians, camera, backend="triton")
    assert torch.equal(first.color, second.color)
    assert not second.color.requires_grad


def test_an_input_changed_before_the_backward_pass_is_noticed() -> None:
    _, gaussians, camera = leaves(scene_of(10), torch.float32)
    loss = rasterize(gaussians, camera, backend="triton").color.sum()
    with torch.no_grad():
        gaussians.means.add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


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
