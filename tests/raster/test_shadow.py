"""The shadow falls where geometry says, softly, and its gradients are those of what is drawn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from neeco.raster import Camera, Gaussians, Headlight, depth_maps, kernels, rasterize
from neeco.raster.native import Family, set_threads
from neeco.raster.shadow import GAMMA, SHADOWS, Casting, blocked, blocked_reference, blur, light_camera
from neeco.raster.types import Layer, Shadow

CAMERA = Camera(torch.eye(4), fx=80.0, fy=80.0, cx=40.0, cy=32.0, width=80, height=64)
WALL, ROD = 100.0, 60.0  # mm, depths
LAMP = torch.tensor([[-30.0, 0.0, 0.0]]), torch.tensor([0.5]), torch.tensor(0.005)  # offsets, strengths, width


def scene(
    offset: Tensor | None = None, strength: Tensor | float = 0.5, width: Tensor | float = 0.005, sh_count: int = 1
) -> Gaussians:
    """A white wall and, before its middle, a black vertical rod that casts."""
    x, y = torch.meshgrid(torch.arange(-60.0, 61.0, 1.5), torch.arange(-50.0, 51.0, 1.5), indexing="ij")
    wall = torch.stack([x.flatten(), y.flatten(), torch.full((x.numel(),), WALL)], 1)
    wall = wall[torch.randperm(len(wall), generator=torch.Generator().manual_seed(0))]  # equal depths: order by index
    steps = torch.arange(-40.0, 41.0, 0.5)
    rod = torch.stack([torch.zeros_like(steps), steps, torch.full_like(steps, ROD)], 1)
    count = len(wall) + len(rod)
    casters = torch.arange(count) >= len(wall)
    sh = torch.zeros(count, sh_count, 3)
    sh[:, 0] = torch.where(casters, -0.5, 0.5)[:, None] / 0.28209479177387814
    shadow = None
    if offset is not None:
        offsets = offset if offset.dim() == 2 else offset[None]
        strengths = torch.as_tensor(strength).expand(len(offsets))
        shadow = Shadow(casters, offsets, strengths, torch.as_tensor(width))
    return Gaussians(
        torch.cat([wall, rod]),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        torch.where(casters, 1.0, 1.2)[:, None].repeat(1, 3),
        torch.full((count,), 0.99),
        sh,
        headlight=Headlight(torch.zeros(count), torch.zeros(2), shadow),
    )


def image(gaussians: Gaussians) -> Tensor:
    return rasterize(gaussians, CAMERA).color


def test_the_shadow_falls_on_the_side_away_from_the_light() -> None:
    offset = torch.tensor([30.0, 0.0, 0.0])
    darkened = (image(scene()) - image(scene(offset)))[32, :, 0]  # [W]
    # the rod's shadow on the wall: from the light at x = 30 through (0, 60) to x = 30 - 30 * 100 / 60 = -20 mm
    expected = CAMERA.cx + CAMERA.fx * -20.0 / WALL
    middle = float((darkened * (torch.arange(80) + 0.5)).sum() / darkened.sum())
    assert middle == pytest.approx(expected, abs=0.5)
    assert float(darkened.max()) == pytest.approx(1 - 0.5 ** (1 / GAMMA), abs=0.03)  # half the light
    assert float(darkened[45:].abs().max()) < 1e-3


def beside(shift: float) -> Camera:
    """The camera `shift` mm to the right of CAMERA, beside which the lamps are."""
    pose = torch.eye(4)
    pose[0, 3] = shift
    return replace(CAMERA, world_from_camera=pose, world_from_lamps=CAMERA.world_from_camera)


def test_a_camera_beside_sees_the_shadow_where_the_first_cameras_lamps_cast_it() -> None:
    offset, camera = torch.tensor([30.0, 0.0, 0.0]), beside(6.0)
    darkened = (rasterize(scene(), camera).color - rasterize(scene(offset), camera).color)[32, :, 0]  # [W]
    expected = CAMERA.cx + CAMERA.fx * (-20.0 - 6.0) / WALL  # it stays at -20 mm on the wall
    middle = float((darkened * (torch.arange(80) + 0.5)).sum() / darkened.sum())
    assert middle == pytest.approx(expected, abs=0.5)


def test_light_dims_with_the_distance_from_the_lamps_whichever_camera_sees_it() -> None:
    gaussians, place = scene(), torch.tensor([40.0, 10.0, WALL])
    falloff = torch.full_like(gaussians.opacities, 2.0)
    for shadow in (None, Shadow(scene(torch.zeros(3)).headlight.shadow.casters, *LAMP)):  # type: ignore[union-attr]
        lit = replace(gaussians, headlight=Headlight(falloff, torch.zeros(2), shadow))
        seen = []
        for camera in (CAMERA, beside(25.0)):
            x, y = camera.fx * (place[0] - camera.world_from_camera[0, 3]) / WALL, camera.fx * place[1] / WALL
            seen.append(rasterize(lit, camera).color[int(camera.cy + y), int(camera.cx + x), 0])
        assert float(seen[1]) == pytest.approx(float(seen[0]), rel=0.02)  # pixels are not at the same place of the wall


def test_a_light_at_the_lens_hides_its_shadow_behind_what_casts_it() -> None:
    beside = image(scene()) - image(scene(torch.tensor([30.0, 0.0, 0.0])))
    behind = image(scene()) - image(scene(torch.zeros(3)))
    assert 0 <= float(behind.sum()) < 0.35 * float(beside.sum())  # the map has half the image's resolution


def test_what_casts_keeps_its_colour_and_nothing_else_changes() -> None:
    plain, shaded = scene(), scene(torch.tensor([30.0, 0.0, 0.0]))
    a, b = rasterize(plain, CAMERA), rasterize(shaded, CAMERA)
    assert torch.equal(a.alpha, b.alpha)
    assert torch.equal(a.depth, b.depth)
    assert torch.allclose(a.color[:, 39:41], b.color[:, 39:41], atol=1e-3)


def test_a_shadow_falls_on_nothing_before_what_casts_it() -> None:
    gaussians = scene(torch.tensor([30.0, 0.0, 0.0]))
    nearer = gaussians.means.clone()
    nearer[: int((~gaussians.headlight.shadow.casters).sum()), 2] = 40.0
    shaded = replace(gaussians, means=nearer)
    plain = replace(shaded, headlight=replace(shaded.headlight, shadow=None))
    assert torch.allclose(image(shaded), image(plain), atol=1e-4)


def test_a_wider_light_makes_a_softer_shadow() -> None:
    offset = torch.tensor([30.0, 0.0, 0.0])
    sharp, soft = (image(scene()) - image(scene(offset, width=width)) for width in (0.002, 0.04))
    assert float(soft.max()) < 0.8 * float(sharp.max())
    lost = [float((1 - (1 - darker) ** GAMMA).sum()) for darker in (sharp, soft)]  # of white light
    assert lost[1] == pytest.approx(lost[0], rel=0.05)


def test_two_lamps_cast_a_shadow_each() -> None:
    left, right = torch.tensor([-30.0, 0.0, 0.0]), torch.tensor([30.0, 0.0, 0.0])
    both, *each = (image(scene()) - image(scene(offsets)) for offsets in (torch.stack([left, right]), left, right))
    assert torch.allclose(both, each[0] + each[1], atol=1e-5)  # they fall on different places
    half, whole = (image(scene(torch.stack([right] * count), strength=0.5)) for count in (1, 2))
    behind = slice(20, 28)  # the shadow on the wall, beside the rod
    assert float(whole[32, behind].min()) < 0.2 < float(half[32, behind].min())  # where both miss, nothing is left


def test_without_strength_or_casters_the_bits_are_the_same() -> None:
    offset = torch.tensor([30.0, 0.0, 0.0])
    plain = image(scene())
    assert torch.equal(image(scene(offset, strength=0.0)), plain)
    none = scene(offset)
    shadow = replace(none.headlight.shadow, casters=torch.zeros(len(none), dtype=torch.bool))
    assert torch.equal(image(replace(none, headlight=replace(none.headlight, shadow=shadow))), plain)


@pytest.mark.parametrize("name", ["x", "y", "z", "strength", "width"])
def test_gradients_are_those_of_the_picture(name: str) -> None:
    start = {"x": 12.0, "y": 4.0, "z": 2.0, "strength": 0.6, "width": 0.02}
    weights = torch.linspace(-1, 1, 80)[None, :, None] * torch.linspace(-1, 1.5, 64)[:, None, None]

    def value(changed: Tensor) -> Tensor:
        numbers = {key: changed if key == name else torch.tensor(number) for key, number in start.items()}
        offset = torch.stack([numbers[axis] for axis in "xyz"])
        return (image(scene(offset, numbers["strength"], numbers["width"])) * weights).sum()

    # wide steps: the map is read between its pixels
    step, tolerance = {"strength": (0.05, 0.02), "width": (0.002, 0.05), "z": (5.0, 0.3)}.get(name, (1.5, 0.1))
    assert gradient(value, start[name]) == pytest.approx(slope(value, start[name], step), rel=tolerance, abs=0.05)


def gradient(value: Callable[[Tensor], Tensor], at: float) -> float:
    number = torch.tensor(at, requires_grad=True)
    value(number).backward()
    assert number.grad is not None
    return float(number.grad)


def slope(value: Callable[[Tensor], Tensor], at: float, step: float) -> float:
    with torch.no_grad():
        return float((value(torch.tensor(at + step)) - value(torch.tensor(at - step))) / (2 * step))


@settings(max_examples=25, deadline=None)
@given(
    size=st.tuples(st.integers(1, 40), st.integers(1, 30)),
    count=st.integers(0, 300),
    seed=st.integers(0, 2**31),
    offset=st.tuples(*[st.floats(-20, 20, width=32)] * 3),
    width=st.sampled_from([0.0, 0.03, 0.1]),
    turned=st.booleans(),
)
def test_the_kernel_finds_behind_what_the_reference_finds(size, count, seed, offset, width, turned):
    """Of a map that may be of a single pixel; values and the gradients of the lamp's place and width."""
    g = torch.Generator().manual_seed(seed)
    pose = torch.eye(4)
    if turned:
        pose[:3, :3] = torch.linalg.qr(torch.randn(3, 3, generator=g)).Q
        pose[:3, 3] = torch.randn(3, generator=g) * 20
    camera = replace(CAMERA, world_from_camera=pose, width=size[0], height=size[1], cx=size[0] / 2, cy=size[1] / 2)
    camera = replace(camera, fx=30.0, fy=25.0)
    local = torch.randn(count, 3, generator=g) * 30 + torch.tensor([0.0, 0.0, 60.0])
    means = local @ pose[:3, :3].T + pose[:3, 3]
    casters = torch.rand(count, generator=g) < 0.2
    at_light = light_camera(camera, torch.tensor(offset))
    shape = (at_light.height, at_light.width)
    alpha = torch.rand(shape, generator=g) * (torch.rand(shape, generator=g) < 0.7)
    depth = 40 + 30 * torch.rand(shape, generator=g)
    weights, found = torch.rand(count, generator=g), []

    def draw(gaussians: Gaussians, seen_by: Sequence[Camera]) -> list[Layer]:
        assert [(lamp.height, lamp.width) for lamp in seen_by] == [shape]
        return [Layer(alpha, depth)]

    for dtype in (torch.float32, torch.float64):
        among = Casting(casters, scene(), means.to(dtype), camera)
        lamp, wide = (torch.tensor(number, dtype=dtype, requires_grad=True) for number in (offset, width))
        if dtype == torch.float32:
            (share,) = blocked(among, wide, lamp[None], draw)
        else:
            share = blocked_reference(alpha.double(), depth.double(), wide, lamp, among, at_light)
        (share * weights.to(dtype)).sum().backward()
        found.append([share.detach(), lamp.grad, wide.grad])
    for ours, theirs in zip(*found, strict=True):
        # at the edge of a pixel, or just as deep as what casts, rounding decides: of few
        off = (ours.double() - theirs).abs()
        assert float(off.sum()) <= 2e-3 + 0.01 * float(theirs.abs().sum())


def test_a_lamp_that_does_not_shine_is_not_drawn() -> None:
    gaussians = scene(torch.tensor([[30.0, 0.0, 0.0], [-30.0, 0.0, 0.0]]))
    among = Casting.of(gaussians, gaussians.headlight.shadow.casters, CAMERA)
    drawn = []

    def draw(bare: Gaussians, cameras: Sequence[Camera]) -> tuple[Layer, ...]:
        drawn.extend(cameras)
        return depth_maps(bare, cameras)

    for family in ("native", "torch"):
        with kernels(family):
            shares = blocked(among, torch.tensor(0.005), gaussians.headlight.shadow.offsets, draw, [True, False])
        assert len(drawn) == 1
        assert float(shares[0].max()) > 0.9
        assert float(shares[1].abs().max()) == 0
        drawn.clear()


def _found(offsets: Tensor, family: Family = "native") -> list[Tensor]:
    """Shares of two lamps behind the rod, and the gradients of their width and places."""
    gaussians = scene(offsets)
    among = Casting.of(gaussians, gaussians.headlight.shadow.casters, CAMERA)
    width, places = torch.tensor(0.02, requires_grad=True), offsets.clone().requires_grad_()
    with kernels(family):
        shares = blocked(among, width, places, partial(depth_maps, backend="cpu"))
        (shares * torch.linspace(-1, 2, len(gaussians))).sum().backward()
    return [shares.detach(), width.grad, places.grad]


def test_every_instruction_set_finds_the_same_shadow(simd: str) -> None:
    offsets = torch.tensor([[30.0, 2.0, -1.0], [-20.0, 5.0, 3.0]])
    for ours, theirs in zip(_found(offsets), _found(offsets, "torch"), strict=True):
        assert float(theirs.abs().max()) > 0
        assert torch.allclose(ours, theirs, rtol=5e-3, atol=1e-3)


def test_the_same_bits_whatever_the_number_of_threads(simd: str) -> None:
    offsets = torch.tensor([[30.0, 2.0, -1.0], [-20.0, 5.0, 3.0]])
    results = []
    try:
        for count in (1, 3):
            set_threads(count)
            results.append(_found(offsets))
    finally:
        set_threads(0)
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


@settings(max_examples=30, deadline=None, derandomize=True)
@given(height=st.integers(13, 40), width=st.integers(13, 40), sigma=st.floats(0.01, 30.0))
def test_a_blur_moves_light_and_loses_none(height: int, width: int, sigma: float) -> None:
    image = torch.zeros(height, width, dtype=torch.float64)
    image[height // 2, width // 2] = 1
    out = blur(image, torch.tensor(sigma, dtype=torch.float64))
    assert float(out.sum()) == pytest.approx(1)
    spread = (out.sum(0) * (torch.arange(width) - width // 2) ** 2).sum().sqrt()
    assert float(spread) <= max(sigma, SHADOWS.min_window_sd) + 1e-9
    assert torch.equal(out, out.clamp(0, 1))


def test_depth_maps_are_alpha_and_depth_of_the_whole_rendering(simd: str) -> None:
    gaussians = scene()
    poses = [torch.eye(4), torch.eye(4)]
    poses[1][:3, 3] = torch.tensor([20.0, -5.0, 2.0])
    cameras = [replace(CAMERA, world_from_camera=pose, width=77, height=61) for pose in poses]
    for layer, camera in zip(depth_maps(gaussians, cameras), cameras, strict=True):
        whole = rasterize(replace(gaussians, headlight=None), camera)
        assert float(whole.alpha.max()) > 0.9
        assert torch.equal(layer.alpha, whole.alpha)
        assert torch.equal(layer.depth, whole.depth)


def test_kernels_and_reference_cast_the_same_shadow() -> None:
    gaussians = scene(torch.tensor([12.0, 5.0, 1.0]), sh_count=4)
    camera = replace(CAMERA, fx=40.0, fy=40.0, cx=20.0, cy=16.0, width=40, height=32)
    with torch.no_grad():
        ours, theirs = (rasterize(gaussians, camera, backend=backend).color for backend in ("cpu", "reference"))
        unlit = rasterize(replace(gaussians, headlight=None), camera, backend="cpu").color
    assert float((ours - theirs).abs().max()) < 1e-3
    assert float((ours - unlit).abs().max()) > 0.1
