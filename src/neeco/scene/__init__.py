"""The learned model and how it is posed."""

from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.drawable import Drawable, Recorded
from neeco.scene.scene import Scene, gaussian_scene

__all__ = ["CanonicalGaussians", "Drawable", "Recorded", "Scene", "gaussian_scene"]
