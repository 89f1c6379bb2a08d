"""Columns of a Jacobian from the kernels are those of images rendered, composited, reduced and blurred one by one."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from neeco.fitting.crop_rendering import composite, downsampled
from neeco.fitting.minimise import difference_columns
from neeco.raster import Camera, Gaussians, Headlight, rasterize
from neeco.raster.columns import MovedLayer, layer_columns, runs_columns
from neeco.raster.native import set_threads, threads
from neeco.raster.types import Shadow

CAMERA = Camera(torch.eye(4), 70.0, 70.0, 36.0, 28.0, 72, 56)


def random_layer(count: int = 200, framed: bool = True) -> Gaussians:
    generator = torch.Generator().manual_seed(3)
    means = torch.rand(count, 3, generator=generator) * torch.tensor([60.0, 40.0, 30.0]) - torch.tensor([30.0, 20, -80])
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=1)
    scales = torch.rand(count, 3, generator=generator) * 3 + 0.3
    sh = 0.3 * torch.randn(count, 4, 3, generator=generator)
    light = Headlight(torch.full((count,), 1.4), torch.tensor([-0.2, 0.05]))
    opacities = torch.rand(count, generator=generator) * 0.9 + 0.05
    return Gaussians(
        means,
        quats,
        scales,
        opacities,
        sh,
        sh_frames=quats.flip(0) if framed else None,
        headlight=light if framed else None,
    )


def moved_layers(layer: Gaussians) -> list[MovedLayer]:
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([0.3, -0.2, 0.1])
    bent = replace(layer, means=layer.means + torch.tensor([0.2, 0.0, 0.1]), scales=layer.scales * 1.01)
    moved_camera = replace(CAMERA, world_from_camera=pose)
    return [MovedLayer(layer, moved_camera, 0.3), MovedLayer(bent, CAMERA, -0.2), MovedLayer(bent, moved_camera, 0.01)]


@pytest.mark.parametrize(("size", "framed"), [(1.0, True), (0.5, True), (0.125, False)])
def test_columns_are_differences_of_images_rendered_one_by_one(size: float, framed: bool) -> None:
    generator = torch.Generator().manual_seed(1)
    layer, under = random_layer(framed=framed), torch.rand(56, 72, 3, generator=generator)
    shape = round(56 * size), round(72 * size)
    image, weight = torch.rand(*shape, 3, generator=generator), torch.rand(shape, generator=generator).round()

    def composed(each: MovedLayer) -> torch.Tensor:
        rendering = rasterize(each.posed, each.camera, background=torch.zeros(3))
        return downsampled(composite(rendering.color, rendering.alpha, under), size)

    layers = moved_layers(layer)
    expected = difference_columns(((composed(each), each.change) for each in layers), image, weight)
    before, found = threads(), []
    try:
        for count in (1, 3):
            set_threads(count)
            found.append(layer_columns(layers, under, image, weight))
    finally:
        set_threads(before)
    assert np.abs(found[0] - expected).max() < 1e-5 * np.abs(expected).max()
    assert np.array_equal(*found)


def test_what_needs_more_than_one_rendering_is_rendered_one_by_one() -> None:
    layer = random_layer()
    assert runs_columns(layer, CAMERA)
    assert not runs_columns(layer, replace(CAMERA, learned_fx=60.0))
    assert not runs_columns(replace(layer, means=layer.means.double()), CAMERA)
    shadow = Shadow(torch.ones(200, dtype=torch.bool), torch.zeros(1, 3), torch.ones(1), torch.tensor(0.1))
    assert layer.headlight is not None
    assert not runs_columns(replace(layer, headlight=replace(layer.headlight, shadow=shadow)), CAMERA)


def test_an_image_of_another_shape_than_a_whole_share_is_refused() -> None:
    with pytest.raises(ValueError, match="whole number"):
        layer_columns(moved_layers(random_layer()), torch.zeros(56, 72, 3), torch.zeros(50, 72, 3), torch.zeros(50, 72))
