"""The kernels draw what the float64 reference defines, gradients included."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parent))
from raster_scenes import Scene, assert_same_as_reference, decided_pixels, draw, error, leaves, make_scene, on_cuda
from rendering_checks import *  # noqa: F403
from rendering_checks import Backend, selected

from neeco.base.errors import NeecoError
from neeco.raster import rasterize
from neeco.raster.native import native, set_threads


@pytest.fixture
def backend(simd: str) -> Backend:
    return Backend("cpu", 45, 37)


@pytest.mark.parametrize("sh_count", [1, 4, 9, 16])
@pytest.mark.parametrize("channels", [0, 1, 3, 32])
def test_image_and_every_gradient_match_the_reference(simd: str, sh_count: int, channels: int) -> None:
    assert_same_as_reference(make_scene(90, sh_count, channels, seed=sh_count + channels))


@settings(max_examples=25, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    count=st.sampled_from([1, 2, 7, 40, 120]),
    sh_count=st.sampled_from([1, 4, 9, 16]),
    channels=st.integers(0, 9),
    seed=st.integers(0, 10_000),
    width=st.integers(1, 40),
    height=st.integers(1, 70),
    size=st.sampled_from([0.01, 0.5, 3.0, 40.0]),
    opacity=st.sampled_from([None, 1 / 255 + 1e-4, 0.5, 0.9999]),
)
def test_any_scene_matches_the_reference(simd: str, **shape: object) -> None:
    assert_same_as_reference(make_scene(**shape))  # type: ignore[arg-type]


@pytest.mark.parametrize("sh_count", [1, 4, 9, 16])
@pytest.mark.parametrize("count", [3, 5, 8, 17])
def test_counts_that_do_not_fill_the_vectors(simd: str, count: int, sh_count: int) -> None:
    assert_same_as_reference(make_scene(count, sh_count, count % 2, seed=count + sh_count))


@pytest.mark.parametrize("width", [257, 700])
def test_gaussians_that_cross_many_columns_of_tiles(simd: str, width: int) -> None:
    scene = make_scene(60, 4, 1, seed=11, width=width, height=9, size=12.0)
    scene.tensors["means"][:, 0] *= width / 45
    assert_same_as_reference(scene)


@pytest.mark.parametrize("sh_count", [1, 4, 9, 16])
def test_gaussians_out_of_sight_change_nothing_for_those_between_them(simd: str, sh_count: int) -> None:
    scene = make_scene(90, sh_count, 1, seed=12)
    hidden = torch.arange(90) % 7 != 3  # six of seven: every vector holds both kinds, or none that is seen
    scene.tensors["means"][hidden, 2] = -100.0
    scene.tensors["sh"][hidden] = 1e30
    weights = torch.ones(scene.height, scene.width)
    out, gradients = draw(scene, torch.float32, "cpu", weights)
    expected, expected_gradients = draw(selected(scene, ~hidden), torch.float32, "cpu", weights)
    assert expected.visible.any()
    assert torch.equal(out.color, expected.color)
    assert torch.equal(out.depth, expected.depth)
    for name, gradient in gradients.items():
        if gradient.dim() and gradient.shape[0] == 90:
            assert torch.equal(gradient[~hidden], expected_gradients[name]), name
            assert not gradient[hidden].any(), name


def test_a_pixel_is_one_gaussian_by_hand(simd: str) -> None:
    scene = make_scene(1, 1, 0, frames=False, light=False, width=9, height=9)
    t = scene.tensors
    t["world_from_camera"], t["background"] = torch.eye(4), torch.tensor([0.0, 0.0, 1.0])
    t["means"], t["scales"] = torch.tensor([[-1.3 + 0.0, 0.7 / 1.03, 60.0]]), torch.full((1, 3), 5.0)
    t["opacities"], t["sh"] = torch.tensor([0.25]), torch.full((1, 1, 3), 0.5 / 0.28209479177387814)
    _, gaussians, camera = leaves(scene, torch.float32)
    out = rasterize(gaussians, camera, background=t["background"])
    assert torch.allclose(out.color[4, 4], torch.tensor([0.25, 0.25, 1.0]), atol=1e-4)
    assert out.alpha[4, 4].item() == pytest.approx(0.25, abs=1e-4)
    assert out.depth[4, 4].item() == pytest.approx(60.0, abs=1e-3)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_the_background_stands_in_where_no_background_is_asked_for(backend: str) -> None:
    scene = make_scene(6)
    _, gaussians, camera = leaves(scene, torch.float32)
    white, grey = torch.ones(3), torch.full((3,), 0.5)
    before = replace(gaussians, background=white)
    out = rasterize(before, camera, backend=backend)
    assert torch.equal(out.color, rasterize(gaussians, camera, background=white, backend=backend).color)
    assert not torch.equal(out.color, rasterize(gaussians, camera, backend=backend).color)
    over = rasterize(before, camera, background=grey, backend=backend).color
    assert torch.equal(over, rasterize(gaussians, camera, background=grey, backend=backend).color)


def everything_drawn(scene: Scene) -> list[torch.Tensor]:
    out, gradients = draw(scene, torch.float32, "cpu", torch.ones(scene.height, scene.width))
    return [out.color, out.alpha, out.depth, out.radii, *gradients.values()]


def test_the_same_bits_every_time_and_with_any_number_of_threads(simd: str) -> None:
    scene = make_scene(20_000, 4, 1, seed=9, size=1.0, width=133, height=97)
    try:
        runs = []
        for threads in (1, 2, 2, 5):
            set_threads(threads)
            runs.append(everything_drawn(scene))
    finally:
        set_threads(0)
    for run in runs[1:]:
        assert all(torch.equal(a, b) for a, b in zip(runs[0], run, strict=True))


def test_two_drawings_can_wait_for_their_gradients() -> None:
    scene = make_scene(60)
    t, gaussians, camera = leaves(scene, torch.float32)
    first, second = rasterize(gaussians, camera), rasterize(gaussians, camera)
    (first.color.sum() + second.color.sum()).backward()
    both = t["means"].grad.clone()
    t["means"].grad = None
    rasterize(gaussians, camera).color.sum().backward()
    assert torch.allclose(both, 2 * t["means"].grad, rtol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"quats": torch.zeros(3, 3)}, "quats"),
        ({"sh": torch.zeros(3, 5, 3)}, "sh: 5 coefficients"),
        ({"channels": torch.zeros(3, 33)}, "channels"),
        ({"background": torch.zeros(4)}, "background"),
    ],
)
def test_shapes_that_do_not_fit_are_named(change: dict[str, torch.Tensor], message: str) -> None:
    scene = make_scene(3)
    scene.tensors |= change
    t, gaussians, camera = leaves(scene, torch.float32)
    with pytest.raises(NeecoError, match=message):
        rasterize(gaussians, camera, channels=t["channels"], background=t["background"])


def test_unknown_and_missing_backends_are_named() -> None:
    _, gaussians, camera = leaves(make_scene(3), torch.float32)
    with pytest.raises(NeecoError, match="unknown"):
        rasterize(gaussians, camera, backend="metal")
    if not torch.cuda.is_available():
        with pytest.raises(NeecoError, match="backend: triton: "):
            rasterize(gaussians, camera, backend="triton")


def test_an_instruction_set_that_is_not_there_is_refused() -> None:
    code = """
from neeco.base.errors import NeecoError
from neeco.raster.native import simd
try:
    simd()
except NeecoError as error:
    print(error)
"""
    result = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "NEECO_SIMD": "altivec"}, capture_output=True, text=True
    )
    assert "NEECO_SIMD: 'altivec' cannot run here" in result.stdout


@pytest.mark.parametrize("channels", [0, 3])
def test_the_reference_needs_no_numbers_of_a_device(channels: int) -> None:
    scene = make_scene(20, 4, channels)
    moved = {name: tensor.to("meta") for name, tensor in scene.tensors.items()}
    t, gaussians, camera = leaves(Scene(moved, scene.width, scene.height), torch.float32)
    out = rasterize(gaussians, camera, channels=t.get("channels"), background=t["background"])
    images = [image for image in (out.color, out.alpha, out.depth, out.channels) if image is not None]
    assert all(image.device.type == "meta" and image.shape[:2] == (37, 45) for image in images)
    torch.cat([image.flatten() for image in images]).sum().backward()
    assert {tensor.grad.device.type for name, tensor in t.items() if name != "sh_frames"} == {"meta"}
    assert out.center_offsets.grad.device.type == "meta"


def test_the_reference_refuses_what_was_left_on_another_device() -> None:
    t, gaussians, camera = leaves(make_scene(20), torch.float32)
    with pytest.raises(RuntimeError, match="device"):
        rasterize(gaussians.to("meta"), camera, channels=t["channels"])
    with pytest.raises(RuntimeError, match="device"):
        rasterize(replace(gaussians.to("meta"), scales=gaussians.scales), camera)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_reference_keeps_its_type(dtype: torch.dtype) -> None:
    out, _ = draw(make_scene(20), dtype, "reference", torch.ones(37, 45))
    images = (out.color, out.alpha, out.depth, out.channels, out.radii, out.center_offsets)
    assert [image.dtype for image in images if image is not None] == [dtype] * 6


def test_gaussians_and_camera_move_whole() -> None:
    _, gaussians, camera = leaves(make_scene(5), torch.float32)
    gaussians = replace(gaussians, background=torch.ones(3)).to("meta")
    assert gaussians.headlight is not None
    held = [*vars(gaussians).values(), *vars(gaussians.headlight).values(), camera.to("meta").world_from_camera]
    assert {item.device.type for item in held if isinstance(item, torch.Tensor)} == {"meta"}


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize(("sh_count", "channels"), [(1, 0), (16, 3)])
def test_triton_draws_the_references_image_and_gradients_on_a_gpu(sh_count: int, channels: int) -> None:
    """Those of the camera's pose too."""
    pytest.importorskip("triton")
    scene = make_scene(150, sh_count, channels)
    decided = decided_pixels(scene)
    expected, expected_gradients = draw(scene, torch.float64, "reference", decided)
    actual, gradients = draw(on_cuda(scene), torch.float32, "triton", decided)
    assert actual.color.device.type == "cuda"
    for name in ("color", "alpha", "depth", "channels"):
        if getattr(expected, name) is not None:
            seen = decided.reshape(decided.shape + (1,) * (getattr(expected, name).dim() - 2))
            image, wanted = getattr(actual, name).detach().cpu(), getattr(expected, name)
            assert error(image * seen, wanted * seen) < 5e-3, name
    for name in ("means", "quats", "scales", "opacities", "sh", "background", "world_from_camera"):
        assert error(gradients[name], expected_gradients[name]) < 2e-2, f"gradient of {name}"


@pytest.mark.parametrize("size", [1.0, 12.0])
@pytest.mark.parametrize("learned_fx", [None, 120.0, 30.0])
def test_gaussians_alone_in_a_rendering_are_those_rendered_without_the_others(simd, size, learned_fx):
    scene = make_scene(400, 4, 5, seed=3, width=131, height=97, size=size)
    _, gaussians, camera = leaves(scene, torch.float32)
    camera = replace(camera, learned_fx=learned_fx)
    right = gaussians.means[:, 0] > 10  # some tiles show both, some one of them
    sets = [right, ~right, torch.zeros_like(right), torch.ones_like(right)]
    channels = scene.tensors["channels"]
    for backend in ("cpu", "reference"):
        with torch.no_grad():
            found = rasterize(gaussians, camera, channels=channels, alone=sets, backend=backend).alone
            for layer, chosen in zip(found, sets, strict=True):
                expected = rasterize(gaussians.select(chosen), camera, backend=backend)
                assert torch.equal(layer.alpha, expected.alpha)
                assert torch.equal(layer.depth, expected.depth)
        if learned_fx is not None or size > 1 or simd != native().runnable_simd()[0]:
            break  # the reference is slow, and knows no instruction sets


def test_gaussians_alone_pass_no_gradient_and_change_none() -> None:
    scene = make_scene(60, 1, 1, seed=4)
    gradients = []
    for alone in ((), [torch.arange(60) % 2 == 0]):
        t, gaussians, camera = leaves(scene, torch.float32)
        rendering = rasterize(gaussians, camera, channels=t["channels"], alone=alone)
        assert not any(layer.alpha.requires_grad or layer.depth.requires_grad for layer in rendering.alone)
        rendering.color.sum().backward()
        gradients.append(t["means"].grad)
    assert torch.equal(*gradients)
