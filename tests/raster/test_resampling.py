"""Images of any size show what was learned, larger or smaller; through a lens they are bent as the lens bends rays."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from torch.nn.functional import avg_pool2d

from neeco.geometry.distortion import distorted, field_pinhole, pixels_of_rays, rays_of_pixels, undistorted
from neeco.geometry.projection import project_world, unproject_world
from neeco.raster import Camera, Gaussians, Rendering, rasterize

LEARNED = Camera(torch.eye(4), 60.0, 60.0, 32.0, 24.0, 64, 48)
BARREL = (-0.3, 0.08, 0.001, -0.002)


def thin_needles(count: int = 60) -> Gaussians:
    """Needles a tenth of a learned pixel thick, in front of a dark wall."""
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=generator) * torch.tensor([90.0, 66.0, 10.0]) - torch.tensor([45.0, 33, -95])
    quats = torch.randn(count, 4, generator=generator)
    colors = torch.rand(count, 1, 3, generator=generator)
    scales = torch.tensor([[8.0, 0.15, 0.15]]).expand(count, 3)
    return Gaussians(means, quats, scales, torch.full((count,), 0.9), colors)


def averaged(image: torch.Tensor, times: int) -> torch.Tensor:
    return avg_pool2d(image.permute(2, 0, 1)[None], times)[0].permute(1, 2, 0)


def squared_error(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a - b).square().mean())


def test_an_image_smaller_than_learned_is_the_learned_one_averaged() -> None:
    gaussians, channels = thin_needles(), torch.ones(60, 1)
    small = rasterize(gaussians, replace(LEARNED.resized(32, 24), learned_fx=60.0), channels=channels)
    learned = rasterize(gaussians, LEARNED, channels=channels)
    assert torch.allclose(small.color, averaged(learned.color, 2), atol=1e-6)
    assert torch.allclose(small.alpha, averaged(learned.alpha[..., None], 2)[..., 0], atol=1e-6)
    assert small.channels is not None
    assert torch.allclose(small.channels[..., 0], small.alpha, atol=1e-5)
    assert ((small.depth == 0) == (small.alpha == 0)).all()
    assert float((small.depth - 100).abs()[small.alpha > 0].max()) < 30


@pytest.mark.parametrize("size", [(48, 36), (60, 45), (28, 21)])
def test_a_pixel_of_any_smaller_size_is_the_mean_over_its_area(size: tuple[int, int]) -> None:
    gaussians = thin_needles()
    camera = replace(LEARNED.resized(*size), learned_fx=60.0)
    small = rasterize(gaussians, camera, alone=[torch.ones(60, dtype=torch.bool)])
    learned = rasterize(gaussians, LEARNED)
    for found, given in ((small.color, learned.color), (small.alpha, learned.alpha)):
        mean = cv2.resize(given.numpy(), size, interpolation=cv2.INTER_AREA)
        assert np.allclose(found, mean, atol=1e-5)
    assert torch.equal(small.alone[0].alpha, small.alpha)
    assert torch.equal(small.alone[0].depth, small.depth)


def test_an_image_larger_than_learned_shows_the_learned_one() -> None:
    gaussians = thin_needles()
    learned = rasterize(gaussians, LEARNED).color
    larger = LEARNED.resized(256, 192)
    plain = averaged(rasterize(gaussians, larger).color, 4)
    widened = averaged(rasterize(gaussians, replace(larger, learned_fx=60.0)).color, 4)
    assert squared_error(widened, learned) < 0.3 * squared_error(plain, learned)


def test_the_learned_size_is_drawn_as_ever() -> None:
    drawn = (rasterize(thin_needles(), replace(LEARNED, learned_fx=learned)).color for learned in (None, 60.0))
    assert torch.equal(*drawn)


@pytest.mark.parametrize("distortion", [BARREL, (0.2, 0.05, 0.0, 0.0), (-0.2, 0.1, 0.001, 0.002, 0.01, 0.02, 0.0, 0.0)])
def test_bending_rays_back_is_the_inverse(distortion: tuple[float, ...]) -> None:
    slopes = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 2))
    assert np.allclose(undistorted(distorted(slopes, distortion), distortion), slopes, atol=1e-9)


def test_a_lens_shows_its_field_and_nothing_beyond_its_border() -> None:
    camera = replace(LEARNED, distortion=BARREL, border=(33.0, 23.0, 22.0))
    pixels = np.array([[33.0, 23.0], [50.0, 30.0], [20.0, 10.0]])
    assert np.allclose(pixels_of_rays(rays_of_pixels(pixels, camera), camera), pixels, atol=1e-6)
    assert np.isnan(pixels_of_rays(np.array([[5.0, 0.0], [0.0, -0.5]]), camera)).all()
    field = field_pinhole(camera)
    corner = rays_of_pixels(np.array([[33.0, 1.5]]), camera)[0] * 60.0 + [field.cx, field.cy]
    assert 0 <= corner[1] < 3  # no larger than it need be
    drawn = rasterize(thin_needles(), camera, background=torch.ones(3))
    rows, columns = np.mgrid[0:48, 0:64] + 0.5
    inside = torch.from_numpy(np.hypot(columns - 33, rows - 23) < 22)
    assert (drawn.color[~inside] == 0).all()
    assert (drawn.alpha[~inside] == 0).all()
    assert (drawn.color[inside].sum(-1) > 0).all()


def test_a_border_alone_moves_no_pixel() -> None:
    gaussians = thin_needles()
    drawn = rasterize(gaussians, replace(LEARNED, border=(32.3, 24.2, 20.0))).color
    inside = drawn.sum(-1) > 0
    assert torch.allclose(drawn[inside], rasterize(gaussians, LEARNED).color[inside], atol=1e-5)


def test_points_fall_where_the_lens_draws_them() -> None:
    camera = replace(LEARNED.resized(256, 192), distortion=BARREL)
    points = torch.tensor([[30.0, 20.0, 100.0], [-25.0, 12.0, 90.0], [0.0, -28.0, 110.0]])
    upright, size = torch.tensor([[1.0, 0, 0, 0]]).repeat(3, 1), torch.full((3, 3), 0.5)
    dots = Gaussians(points, upright, size, torch.full((3,), 0.99), torch.zeros(3, 1, 3))
    drawn: Rendering = rasterize(dots, camera, channels=torch.eye(3))
    assert drawn.channels is not None
    rows, columns = torch.meshgrid(torch.arange(192) + 0.5, torch.arange(256) + 0.5, indexing="ij")
    weight = drawn.channels / drawn.channels.sum((0, 1))
    seen = torch.stack([(columns[..., None] * weight).sum((0, 1)), (rows[..., None] * weight).sum((0, 1))], -1)
    pixels, depths = project_world(points, camera)
    assert torch.allclose(seen, pixels, atol=0.1)
    assert np.allclose(project_world(points.numpy().astype(float), camera)[0], pixels.numpy(), atol=1e-3)
    assert torch.allclose(unproject_world(pixels, depths, camera), points, atol=1e-3)
