"""Drawing Gaussians: `rasterize(gaussians, camera)`, differentiable, on the CPU or on CUDA."""

from neeco.raster.api import rasterize
from neeco.raster.types import Camera, Gaussians, Headlight, Rendering

__all__ = ["Camera", "Gaussians", "Headlight", "Rendering", "rasterize"]
