"""What the kernels of every backend draw: the float64 reference's image and gradients, and nothing where it draws none.

Imported by the tests of each backend, which define the fixture `backend`.
"""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from raster_scenes import Scene, assert_same_as_reference, draw, error, leaves, make_scene

from neeco.raster import Rendering, rasterize


@dataclass(frozen=True)
class Backend:
    """One backend, and the size of its images, px."""

    name: str
    width: int
    height: int

    def scene_of(self, count: int = 40, sh_count: int = 4, channels: int = 1, seed: int = 0, **more: object) -> Scene:
        size = {"width": self.width, "height": self.height}
        return make_scene(count, sh_count, channels, seed, **size | more)  # type: ignore[arg-type]

    def same(self, scene: Scene) -> None:
        assert_same_as_reference(scene, self.name)

    def draw(self, scene: Scene) -> tuple[Rendering, dict[str, torch.Tensor]]:
        return draw(scene, torch.float32, self.name, torch.ones(scene.height, scene.width))


def selected(scene: Scene, keep: torch.Tensor) -> Scene:
    """The scene of the Gaussians `keep` [N] bool alone."""
    count = len(keep)
    tensors = {k: v[keep] if v.dim() and v.shape[0] == count else v for k, v in scene.tensors.items()}
    return Scene(tensors, scene.width, scene.height)


@pytest.mark.parametrize(("frames", "light"), [(False, False), (True, False), (False, True)])
def test_without_sh_frames_or_headlight(backend: Backend, frames: bool, light: bool) -> None:
    backend.same(backend.scene_of(24, 9, 1, seed=5, frames=frames, light=light))


def test_many_opaque_layers_fill_pixels(backend: Backend) -> None:
    backend.same(backend.scene_of(16, 1, 1, seed=3, size=25.0, opacity=0.8))


def test_equal_depths_are_drawn_by_index(backend: Backend) -> None:
    scene = backend.scene_of(40, 1, 1, seed=4)
    scene.tensors["world_from_camera"] = torch.eye(4)
    scene.tensors["means"][:, 2] = 100.0
    backend.same(scene)


def test_gaussians_behind_the_camera_and_off_screen_draw_nothing(backend: Backend) -> None:
    scene = backend.scene_of(4, seed=6)
    scene.tensors["means"] = torch.tensor([[0.0, 0, -100], [4000, 0, 50], [0, -4000, 50], [0, 0, 2.001]])
    scene.tensors["world_from_camera"] = torch.eye(4)
    scene.near = 5.0
    out, gradients = backend.draw(scene)
    assert not out.visible.any()
    assert torch.equal(out.color, scene.tensors["background"].expand_as(out.color))
    assert not out.alpha.any()
    assert not out.depth.any()
    assert all(not gradients[name].any() for name in ("means", "quats", "sh", "world_from_camera", "center_offsets"))


def test_a_gaussian_beside_the_camera_does_not_blind_the_image(backend: Backend) -> None:
    """Its slope x / z of 33 lies far outside the field; to the fourth power it would make the vignette e^11000."""
    scene = backend.scene_of(1, sh_count=1, seed=6, channels=0, frames=False, opacity=0.9)
    scene.tensors |= {
        "means": torch.tensor([[30.0, 0.0, 0.9]]),
        "scales": torch.full((1, 3), 20.0),
        "vignette": torch.tensor([0.014, 0.009]),
        "falloff": torch.zeros(1),
        "sh": torch.ones(1, 1, 3),
        "background": torch.zeros(3),
        "world_from_camera": torch.eye(4),
    }
    backend.same(scene)
    assert 0.1 < float(backend.draw(scene)[0].color.detach().max()) < 1


NOT_FINITE = [
    (field, value)
    for value in (float("nan"), float("inf"), -float("inf"))
    for field in ("means", "quats", "scales", "opacities", "sh", "channels", "falloff", "left", "sh_frames")
]


def test_gaussians_that_are_not_finite_draw_nothing(backend: Backend) -> None:
    count = 2 * len(NOT_FINITE)
    scene = backend.scene_of(count, 4, 1, seed=7)
    keep = torch.arange(count) % 2 == 0
    for place, (field, value) in enumerate(NOT_FINITE):
        scene.tensors[field].view(count, -1)[2 * place + 1, -1] = value
    out, gradients = backend.draw(scene)
    assert not out.visible[~keep].any(), [NOT_FINITE[int(i) // 2] for i in out.visible.nonzero() if int(i) % 2]
    expected, expected_gradients = backend.draw(selected(scene, keep))
    assert expected.visible.any()
    assert torch.equal(out.color, expected.color)
    for name, gradient in gradients.items():
        per_gaussian = gradient.dim() > 0 and gradient.shape[0] == count
        assert error(gradient[keep] if per_gaussian else gradient, expected_gradients[name]) < 1e-5, name
        assert not per_gaussian or not gradient[~keep].any(), name


def test_a_quaternion_of_length_zero_draws_nothing(backend: Backend) -> None:
    scene = backend.scene_of(3, seed=8)
    scene.tensors["quats"][1] = 0
    backend.same(scene)
    assert not backend.draw(scene)[0].visible[1]


def test_no_gaussians_show_the_background(backend: Backend) -> None:
    scene = backend.scene_of(0)
    out, gradients = backend.draw(scene)
    assert torch.equal(out.color, scene.tensors["background"].expand_as(out.color))
    assert out.radii.shape == (0,)
    assert error(gradients["background"], torch.zeros(3)) > 0


def test_drawing_without_gradients_gives_the_same_image_and_no_graph(backend: Backend) -> None:
    t, gaussians, camera = leaves(backend.scene_of(30), torch.float32)
    first = rasterize(gaussians, camera, channels=t["channels"], backend=backend.name)
    with torch.no_grad():
        second = rasterize(gaussians, camera, channels=t["channels"], backend=backend.name)
    assert torch.equal(first.color, second.color)
    assert not second.color.requires_grad


def test_an_input_changed_before_the_backward_pass_is_noticed(backend: Backend) -> None:
    _, gaussians, camera = leaves(backend.scene_of(10), torch.float32)
    loss = rasterize(gaussians, camera, backend=backend.name).color.sum()
    with torch.no_grad():
        gaussians.means.add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()
