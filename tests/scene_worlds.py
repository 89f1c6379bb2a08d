"""A grasper of random Gaussians over a few of tissue: 20 of tissue, 40 of the instrument."""

from __future__ import annotations

import torch
from torch import Tensor

from neeco.capture.model import Instrument, InstrumentState, State
from neeco.geometry.camera import Camera
from neeco.geometry.rotations import rigid_from_vector
from neeco.methods.kinematic.articulation import LINK_LOGITS
from neeco.methods.nerfies.field import NerfiesSettings, NerfScene
from neeco.scene import CanonicalGaussians, GaussianScene, Recorded
from neeco.scene.method_registry import make_deformation, method_settings

TISSUE, INSTRUMENT = 20, 40
GRASPER = Instrument("grasper", {"jaw_angle": (0.0, 1.5)})
SMALL = {"4dgs": {"resolution": 8, "channels": 4, "time_resolution": 5, "width": 16}, "deformable-3dgs": {"width": 32}}
SURE = 30.0  # a part logit that leaves no doubt
CAMERA = Camera(torch.eye(4, dtype=torch.float64), fx=60.0, fy=61.0, cx=32.0, cy=24.0, width=64, height=48)


def rounding(scale: float, products: int) -> float:
    """By how much two float32 sums of `products` terms may differ where a library adds them in another order, as it
    does for tensors of another shape: errors of eps * `scale` (the largest sum) each, most of which cancel."""
    return 4 * torch.finfo(torch.float32).eps * products**0.5 * scale


def pose_of(*vector: float) -> Tensor:
    """[4, 4] float64 from a rotation vector (rad) and a translation (mm)."""
    return rigid_from_vector(torch.tensor(vector, dtype=torch.float64))


def grasper_state(pose: Tensor, jaw: float = 0.4, time: float = 0.0) -> State:
    return State({"grasper": InstrumentState(pose, {"jaw_angle": jaw})}, time)


def random_canonical(generator: torch.Generator, counts: tuple[int, ...] = (TISSUE, INSTRUMENT)) -> CanonicalGaussians:
    count = sum(counts)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    return CanonicalGaussians(
        means=10 * normal(count, 3),
        quats=normal(count, 4),
        log_scales=0.3 * normal(count, 3),
        opacity_logits=normal(count),
        sh_dc=normal(count, 1, 3),
        sh_rest=0.1 * normal(count, 15, 3),
        counts=counts,
    )


def make_scene(method: str) -> GaussianScene:
    """A scene of `method` with everything that is learned at random, and eight recorded states."""
    generator = torch.Generator().manual_seed(3)
    canonical = random_canonical(generator)
    if method == "kinematic":
        canonical = canonical.with_extras(**{LINK_LOGITS: torch.randn(len(canonical), 3, generator=generator)})
    instruments = () if method == "3dgs" else (GRASPER,)
    states = tuple(
        grasper_state(pose_of(0.3 * k - 1, 0.2 * k, 0.1, k, 2 * k, 60 - k), 0.1 * k, 0.04 * k)
        if instruments
        else State()
        for k in range(8)
    )
    names = tuple(f"{k:06d}" for k in range(8))
    recorded = Recorded(names, ("train",) * 8, states, (CAMERA,) * 8)
    torch.manual_seed(0)
    deformation = make_deformation(method, instruments, method_settings(method, SMALL.get(method, {})))
    canonical = canonical.with_extras(**deformation.initial_extras(canonical) | dict(canonical.extras))
    scene = GaussianScene(method, canonical, deformation, instruments, recorded, torch.tensor([1.0, 2.0, 80.0]))
    scene.sh_degree = 2
    if method == "kinematic":
        hinges = scene.deformation.articulations[0]
        hinges.base.copy_(pose_of(0.4, -0.3, 0.2, 1.0, -2.0, 3.0))
        hinges.wrist_start.fill_(2.0)
        hinges.extent.copy_(torch.tensor([-20.0, 15.0]))
        with torch.no_grad():
            for parameter in hinges.parameters():
                parameter += 0.1 * torch.randn(parameter.shape, generator=generator)
            hinges.hinge_depth.fill_(5.0)
    if method not in ("kinematic", "3dgs"):
        torch.manual_seed(0)
        deformation.fit_ranges(list(states), canonical.means)
    return scene


STATES = [grasper_state(pose_of(0.3 * k - 1, 0.2 * k, 0.1, k, 2 * k, 60 - k), 0.2 * k, 0.5 * k**2) for k in range(5)]


def rigid_scene() -> GaussianScene:
    """A scene whose Gaussians belong to one link each."""
    scene = make_scene("kinematic")
    logits = scene.canonical.extras[LINK_LOGITS]
    sure = torch.where(logits == logits.max(1, keepdim=True).values, SURE, -SURE)
    scene.canonical = scene.canonical.with_extras(**{LINK_LOGITS: sure})
    scene.deformation.articulations[0].wrist_start.fill_(-1e3)
    return scene.requires_grad_(False)


SMALL_NERF = {"rays": 16, "coarse_samples": 6, "width": 8, "depth": 2, "warp_width": 8, "warp_depth": 3, "chunk": 7}
NERF_TIMES = (0.0, 1.0, 3.0)


def make_nerf(**changes) -> NerfScene:
    """Three moments of one instrument before one camera, the heads of the warp large enough to move things."""
    torch.manual_seed(3)
    pose = torch.eye(4, dtype=torch.float64)
    states = tuple(State({"rod": InstrumentState(pose, {})}, time) for time in NERF_TIMES)
    camera = Camera(torch.eye(4, dtype=torch.float64), 9.0, 9.0, 4.0, 3.0, 8, 6)
    recorded = Recorded(("a", "b", "c"), ("train",) * 3, states, (camera,) * 3)
    instruments = (Instrument("rod"),)
    scene = NerfScene("nerfies", NerfiesSettings(**SMALL_NERF | changes), instruments, recorded)
    scene.center.copy_(torch.tensor([0.0, 0.0, 50.0]))
    scene.scale.fill_(40.0)
    scene.bounds.copy_(torch.tensor([20.0, 80.0]))
    scene.opened.fill_(8.0)
    for head in (scene.warp.rotation, scene.warp.velocity):
        torch.nn.init.normal_(head.weight, std=0.3)
    torch.nn.init.normal_(scene.codes)
    return scene.requires_grad_(False)
