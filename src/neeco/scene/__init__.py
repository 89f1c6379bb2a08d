"""The learned model: canonical Gaussians, the deformation that poses them, their light, and their files."""

from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.drawable import DrawableScene, Recorded
from neeco.scene.gaussian_scene import GaussianScene, require_gaussians
from neeco.scene.io import load_gaussians, load_scene, save_scene

__all__ = [
    "CanonicalGaussians",
    "DrawableScene",
    "GaussianScene",
    "Recorded",
    "load_gaussians",
    "load_scene",
    "require_gaussians",
    "save_scene",
]
