"""The learned model and how it is posed."""

from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.drawable import Drawable, gaussian_scene
from neeco.scene.scene import Recording, Scene

__all__ = ["CanonicalGaussians", "Drawable", "Recording", "Scene", "gaussian_scene"]
