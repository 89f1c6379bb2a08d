"""The SE(3) field: which point of the template a point of this moment is."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from neeco.raster.devices import tf32_products
from neeco.scene.encoding import encode_by_octave

HEAD_RANGE = 1e-4  # the heads start in U(-1e-4, 1e-4): the untrained field hardly moves anything
SMALL = 1e-4  # rad^2 below which the series is more exact than the closed form


def exponential_coefficients(angle_squared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """sin t / t, (1 - cos t) / t^2 and (t - sin t) / t^3 of t^2, smooth at zero, where their Taylor series are used."""
    small = angle_squared < SMALL
    square = torch.where(small, torch.ones_like(angle_squared), angle_squared)  # keeps the unused branch finite
    angle = square.sqrt()
    series = (
        1 - angle_squared / 6 + angle_squared**2 / 120,
        0.5 - angle_squared / 24 + angle_squared**2 / 720,
        1 / 6 - angle_squared / 120 + angle_squared**2 / 5040,
    )
    closed = (angle.sin() / angle, (1 - angle.cos()) / square, (angle - angle.sin()) / (square * angle))
    first, second, third = (torch.where(small, s, c) for s, c in zip(series, closed, strict=True))
    return first, second, third


def move_by_screw(points: Tensor, rotation: Tensor, velocity: Tensor) -> Tensor:
    """exp((w, v)) applied to points, all [..., 3]: R x + G v, R = exp([w]) (Rodrigues), G the integral of the turn.

    Nerfies eq. 8-10 (Lynch and Park, Modern Robotics, 3.88); differentiable at w = 0.
    """
    sine, cosine, rest = exponential_coefficients(rotation.square().sum(-1, keepdim=True))
    turned = torch.linalg.cross(rotation, points)
    carried = torch.linalg.cross(rotation, velocity)
    moved = points + sine * turned + cosine * torch.linalg.cross(rotation, turned)
    return moved + velocity + cosine * carried + rest * torch.linalg.cross(rotation, carried)


class Mlp(nn.Module):
    """ReLU layers `depth` x `width`, the input joined again at the fifth (of fewer: the middle) one; Glorot-uniform."""

    def __init__(self, inputs: int, depth: int, width: int) -> None:
        super().__init__()
        self.skip = 4 if depth > 4 else depth // 2 if depth > 2 else 0
        sizes = [inputs] + [width + (inputs if k == self.skip else 0) for k in range(1, depth)]
        layers = [nn.Linear(size, width) for size in sizes]
        self.layers = nn.ModuleList(layers)
        for layer in layers:
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, inputs: Tensor) -> Tensor:
        features = inputs
        for index, layer in enumerate(self.layers):
            if index and index == self.skip:
                features = torch.cat([features, inputs], -1)
            features = torch.relu(layer(features))
        return features


class WarpField(nn.Module):
    """W: (point, code) to a screw (w, v), and by it to the point's place in the template (Nerfies eq. 7)."""

    def __init__(self, frequencies: int, code: int, depth: int, width: int) -> None:
        super().__init__()
        self.frequencies = frequencies
        self.trunk = Mlp(3 * (1 + 2 * frequencies) + code, depth, width)
        self.rotation, self.velocity = nn.Linear(width, 3), nn.Linear(width, 3)
        for head in (self.rotation, self.velocity):
            nn.init.uniform_(head.weight, -HEAD_RANGE, HEAD_RANGE)
            nn.init.zeros_(head.bias)

    def forward(self, points: Tensor, codes: Tensor, opened: Tensor) -> Tensor:
        """points [M, 3] in template units, codes [M, C], `opened` [] frequencies; places in the template [M, 3]."""
        encoded = encode_by_octave(points, self.frequencies, opened)
        with tf32_products(points.device):
            features = self.trunk(torch.cat([encoded, codes], -1))
            rotation, velocity = self.rotation(features), self.velocity(features)
        return move_by_screw(points, rotation, velocity)

    def jacobian(self, points: Tensor, codes: Tensor, opened: Tensor) -> Tensor:
        """d place / d point [M, 3, 3]: one backward pass per coordinate, itself differentiable, so that gradients reach
        the field's parameters and the codes. (Forward mode costs 100 ms of overhead per call in torch 2.13.)"""
        points = points.detach().requires_grad_(True)
        moved = self(points, codes, opened)
        rows = [torch.autograd.grad(moved[:, axis].sum(), points, create_graph=True)[0] for axis in range(3)]
        return torch.stack(rows, -2)
