"""Random Gaussians, and drawing them with gradients of everything."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neeco.geometry.rotations import quat_to_matrix
from neeco.raster import Camera, Gaussians, Headlight, Rendering, rasterize
from neeco.raster.optimizer import BETAS, EPS, Update, adam_steps
from neeco.raster.reference import (
    MAX_ALPHA,
    MIN_ALPHA,
    MIN_TRANSMITTANCE,
    alphas_at_pixels,
    camera_from_world,
    depth_keys,
    project,
    usable_gaussians,
)

TOLERANCE = 1e-3


@dataclass
class Scene:
    """float32 values; `draw` copies them into leaves of the wanted type."""

    tensors: dict[str, Tensor]
    width: int
    height: int
    focal: float = 60.0
    near: float = 0.01


def make_scene(
    count: int, sh_count: int = 16, channels: int = 1, seed: int = 0, width: int = 45, height: int = 37,
    frames: bool = True, light: bool = True, size: float = 3.0, opacity: float | None = None,
) -> Scene:  # fmt: skip
    g = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g)

    tensors = {
        "means": normal(count, 3) * torch.tensor([40.0, 30.0, 20.0]) + torch.tensor([0.0, 0.0, 100.0]),
        "quats": normal(count, 4),
        "scales": torch.exp(normal(count, 3) * 0.5) * size,
        "opacities": torch.sigmoid(normal(count)) if opacity is None else torch.full((count,), opacity),
        "sh": normal(count, sh_count, 3) * 0.4,
        "background": torch.rand(3, generator=g),
    }
    if light:
        left = torch.rand(count, generator=torch.Generator().manual_seed(seed)) + 0.1
        tensors |= {"falloff": normal(count) * 0.3 + 1, "vignette": normal(2) * 0.3, "left": left}
    if frames:
        tensors["sh_frames"] = torch.nn.functional.normalize(normal(count, 4), dim=-1)
    if channels:
        tensors["channels"] = normal(count, channels)
    pose = torch.eye(4)
    pose[:3, :3] = quat_to_matrix(torch.nn.functional.normalize(torch.tensor([[1.0, 0.05, -0.08, 0.1]]), dim=-1))[0]
    pose[:3, 3] = torch.tensor([3.0, -5.0, 2.0])
    tensors["world_from_camera"] = pose
    return Scene(tensors, width, height)


def leaves(scene: Scene, dtype: torch.dtype) -> tuple[dict[str, Tensor], Gaussians, Camera]:
    t = {k: v.to(dtype).clone().requires_grad_(k != "sh_frames") for k, v in scene.tensors.items()}
    light = Headlight(t["falloff"], t["vignette"], left=t["left"]) if "falloff" in t else None
    gaussians = Gaussians(
        t["means"], t["quats"], t["scales"], t["opacities"], t["sh"], sh_frames=t.get("sh_frames"), headlight=light
    )
    camera = Camera(
        t["world_from_camera"], scene.focal, scene.focal * 1.03, scene.width / 2 + 1.3, scene.height / 2 - 0.7,
        scene.width, scene.height, scene.near,
    )  # fmt: skip
    return t, gaussians, camera


def on_cuda(scene: Scene) -> Scene:
    """The same, where `draw` then draws."""
    return replace(scene, tensors={name: tensor.cuda() for name, tensor in scene.tensors.items()})


def draw(scene: Scene, dtype: torch.dtype, backend: str, weights: Tensor) -> tuple[Rendering, dict[str, Tensor]]:
    """The image, and the gradients of a weighted sum of everything drawn. weights [H, W], 0: left out."""
    t, gaussians, camera = leaves(scene, dtype)
    out = rasterize(gaussians, camera, channels=t.get("channels"), background=t["background"], backend=backend)
    g = torch.Generator().manual_seed(1)
    loss = torch.zeros((), dtype=dtype, device=out.color.device)
    for image in (out.color, out.alpha, 0.01 * out.depth, out.channels):
        if image is not None:
            pixels = weights.reshape(weights.shape + (1,) * (image.dim() - 2))
            loss = loss + (image * (pixels * torch.randn(image.shape, generator=g)).to(image)).sum()
    loss.backward()
    t["center_offsets"] = out.center_offsets
    return out, {k: torch.zeros_like(v) if v.grad is None else v.grad for k, v in t.items() if k != "sh_frames"}


def decided_pixels(scene: Scene, tolerance: float = 1e-4) -> Tensor:
    """[H, W] 1 where no cut-off is so close that float32 may decide it otherwise than float64, else 0."""
    _, gaussians, camera = leaves(scene, torch.float64)
    with torch.no_grad():
        index = usable_gaussians(gaussians, camera, scene.tensors.get("channels")).nonzero()[:, 0]
        rotation, translation = camera_from_world(camera.world_from_camera)
        means = gaussians.means[index]
        chosen = Gaussians(
            means, gaussians.quats[index], gaussians.scales[index], gaussians.opacities[index], gaussians.sh[index]
        )
        projection = project(chosen, camera, means @ rotation.T + translation, rotation, torch.zeros(len(index), 2))
        alphas = alphas_at_pixels(projection, chosen.opacities, camera)
        alphas = alphas[:, torch.argsort(depth_keys(means, camera), stable=True)]
        close = ((alphas / MIN_ALPHA - 1).abs() < tolerance) | ((alphas / MAX_ALPHA - 1).abs() < tolerance)
        left = torch.cumprod(1 - torch.where(alphas >= MIN_ALPHA, alphas.clamp(max=MAX_ALPHA), 0.0), dim=1)
        close |= (left / MIN_TRANSMITTANCE - 1).abs() < 100 * tolerance
    return (~close.any(dim=1)).reshape(camera.height, camera.width).float()


def error(actual: Tensor, expected: Tensor) -> float:
    """|actual - expected| / |expected|, or |actual| where nothing is expected."""
    expected = expected.detach().cpu().double()
    scale = expected.norm()
    return float((actual.detach().cpu().double() - expected).norm() / (scale if scale > 1e-9 else 1.0))


_drawn: dict[tuple, tuple[Tensor, Rendering, dict[str, Tensor]]] = {}


def reference_of(scene: Scene) -> tuple[Tensor, Rendering, dict[str, Tensor]]:
    """The decided pixels, and there the image and the gradients that the definition gives.

    The last ones are kept: every instruction set draws the same scenes.
    """
    values = [(name, tuple(tensor.shape), tensor.numpy().tobytes()) for name, tensor in scene.tensors.items()]
    key = (scene.width, scene.height, scene.focal, scene.near, *values)
    if key not in _drawn:
        while len(_drawn) > 64:
            del _drawn[next(iter(_drawn))]
        decided = decided_pixels(scene)
        _drawn[key] = (decided, *draw(scene, torch.float64, "reference", decided))
    return _drawn[key]


def assert_same_as_reference(scene: Scene, backend: str = "cpu", tolerance: float = TOLERANCE) -> None:
    """Image, visibility and every gradient, where no cut-off leaves the choice to rounding."""
    decided, expected, expected_gradients = reference_of(scene)
    actual, gradients = draw(scene, torch.float32, backend, decided)
    for name in ("color", "alpha", "depth", "channels"):
        image, wanted = getattr(actual, name), getattr(expected, name)
        assert (image is None) == (wanted is None)
        if image is not None:
            pixels = decided.reshape(decided.shape + (1,) * (image.dim() - 2))
            assert error(image * pixels, wanted * pixels) < tolerance, name
    for name, wanted in expected_gradients.items():
        assert error(gradients[name], wanted) < tolerance, f"gradient of {name}"
    assert bool((actual.visible | (expected.radii == 0)).all()), "a Gaussian that is drawn counts as visible"
    both = actual.visible & (expected.radii > 0)
    assert error(actual.radii[both], expected.radii[both]) < tolerance


def adam_step(
    param: Tensor,
    grad: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    *,
    lr: float,
    step: int,
    betas: tuple[float, float] = BETAS,
    eps: float = EPS,
) -> None:
    """`adam_steps` for one tensor, whose gradient may have another float type."""
    adam_steps([Update(param, grad.detach().to(param.dtype), exp_avg, exp_avg_sq, lr, step)], betas, eps)
