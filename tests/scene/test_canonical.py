"""The canonical Gaussians give out their harmonics."""

from __future__ import annotations

import torch

from neeco.scene.canonical import seed_gaussians


def test_harmonics_are_joined_once_until_they_change_or_are_learned() -> None:
    gaussians = seed_gaussians(torch.rand(5, 3), torch.rand(5, 3), torch.rand(5))
    joined = gaussians.spherical_harmonics(1)
    assert joined.shape == (5, 4, 3)
    assert gaussians.spherical_harmonics(1) is joined
    assert gaussians.spherical_harmonics(2).shape == (5, 9, 3)
    gaussians.sh_rest.fill_(2.0)
    assert bool((gaussians.spherical_harmonics(1)[:, 1:] == 2.0).all())
    gaussians.sh_rest.requires_grad_()
    gaussians.spherical_harmonics(1).sum().backward()
    assert gaussians.sh_rest.grad is not None
    assert "_joined" not in gaussians.tensors()
