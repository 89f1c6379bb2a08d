"""Gaussians of bodies at random, and their posing with a loss that every number of it matters to."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from hypothesis import strategies as st
from torch import Tensor

from neeco.geometry.rotations import rigid_from_vector
from neeco.raster.articulated import ArticulatedBody, pose_bodies

GAUSSIANS = ("means", "quats", "log_scales", "logits")
LEARNED = ("world_from_body", "origins", "axes", "values", "shaft_origin", "shaft_direction")
ENDS = ("spin_end", "gate_start", "gate_width", "longest")


@dataclass
class World:
    """float64; `bodies` are None or a dict of `ArticulatedBody`'s tensors and roll."""

    gaussians: dict[str, Tensor | None]
    counts: tuple[int, ...]
    bodies: list[dict | None]
    weights: list[Tensor]  # of the loss, for means, quats and scales


@dataclass(frozen=True)
class Tree:
    """The joints of one body, each of which joins a link to its parent: the joint that joins that (-1: it is link 0),
    and which of them slide."""

    parents: tuple[int, ...] = ()
    slides: tuple[bool, ...] = ()

    def beyond(self) -> Tensor:
        """[J, J] 1 where link 1 + column lies beyond joint row, the outermost joint first."""
        count = len(self.parents)
        found = torch.zeros(count, count, dtype=torch.float64)
        for link in range(count):
            joint = link
            while joint >= 0:
                found[joint, link] = 1
                joint = self.parents[joint]
        return found.flip(0)  # parents come before their children


def hinges(count: int | None) -> Tree | None:
    """Joints that follow each other on no chain: each moves a link of its own about link 0."""
    return None if count is None else Tree((-1,) * count, (False,) * count)


@st.composite
def trees(draw: st.DrawFn, most: int = 6) -> Tree:
    """Any tree, of joints of any kind."""
    count = draw(st.integers(0, most))
    parents = tuple(draw(st.integers(-1, joint - 1)) for joint in range(count))
    kinds = draw(st.lists(st.booleans(), min_size=count, max_size=count))
    return Tree(parents, tuple(kinds))


def make_world(counts: tuple[int, ...], joints: tuple[Tree | None, ...], seed: int = 0, roll: float = 0.0) -> World:
    """`joints` of every body; None: it stands still."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        # what float32 holds, so that both kinds of numbers begin alike
        return torch.randn(shape, generator=g).double()

    def unit(*shape: int) -> Tensor:
        return torch.nn.functional.normalize(normal(*shape), dim=-1).float().double()

    count = sum(counts)
    most = max((1 + len(tree.parents) for tree in joints if tree and tree.parents), default=0)
    bodies = [
        None
        if tree is None
        else {
            "world_from_body": rigid_from_vector(normal(6)).float().double(),
            "origins": normal(len(tree.parents), 3),
            "axes": unit(len(tree.parents), 3),
            # links that a joint moves may do so by different values, as two jaws on one axis
            "values": tree.beyond() * normal(len(tree.parents), len(tree.parents)),
            "shaft_origin": 0.1 * normal(3),
            "shaft_direction": unit(3),
            "spin_end": normal(),
            "gate_start": normal(),
            "gate_width": 0.3 + normal().abs(),
            "longest": 0.5 + normal().abs(),
            "roll": roll,
            "slides": tree.slides[::-1],
        }
        for tree in joints
    ]
    gaussians = {
        "means": 2 * normal(count, 3),
        "quats": normal(count, 4),
        "log_scales": 0.5 * normal(count, 3),
        "logits": 2 * normal(count, most + 1) if most else None,
    }
    return World(gaussians, counts, bodies, [normal(count, k) for k in (3, 4, 3)])


def posed(world: World, dtype: torch.dtype, device: str = "cpu") -> tuple[list[Tensor], dict[str, Tensor]]:
    """What `pose_bodies` makes of a world, and the gradients of all that takes one."""
    leaves = {
        name: None if t is None else t.detach().to(device, dtype).requires_grad_()
        for name, t in world.gaussians.items()
    }
    bodies: list[ArticulatedBody | None] = []
    for index, given in enumerate(world.bodies):
        if given is None:
            bodies.append(None)
            continue
        own = {name: given[name].detach().to(device, dtype).requires_grad_() for name in LEARNED}
        leaves |= {f"{index}.{name}": tensor for name, tensor in own.items()}
        ends = {name: given[name].to(device, dtype) for name in ENDS}
        bodies.append(ArticulatedBody(**own, **ends, roll=given["roll"], slides=given["slides"]))
    out = list(pose_bodies(*(leaves[name] for name in GAUSSIANS), world.counts, bodies))
    sum((tensor * weight.to(tensor)).sum() for tensor, weight in zip(out, world.weights, strict=False)).backward()
    gradients = {name: None if t.grad is None else t.grad.cpu() for name, t in leaves.items() if t is not None}
    return [t.detach().cpu() for t in out], gradients


def assert_same_as_definition(world: World, tolerance: float = 2e-5, device: str = "cpu") -> None:
    """Float32 and float64 agree, in what is posed and in every gradient."""
    expected, gradients = posed(world, torch.float64)
    found, to = posed(world, torch.float32, device)
    for name, a, b in zip(("means", "quats", "scales", "sh_frames"), found, expected, strict=True):
        assert torch.allclose(a.double(), b, rtol=tolerance, atol=tolerance), name
    for name, gradient in gradients.items():
        if gradient is None:
            assert to[name] is None or not to[name].any(), name
            continue
        scale = max(1.0, float(gradient.abs().max())) if gradient.numel() else 1.0
        assert torch.allclose(to[name].double(), gradient, rtol=1e-4, atol=tolerance * scale), name
