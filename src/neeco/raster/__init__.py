"""Differentiable Gaussian rendering: `rasterize(gaussians, camera)`, on the CPU, on CUDA or, slowly, on any device."""

from neeco.geometry.camera import Camera
from neeco.raster.native import kernels
from neeco.raster.rasterization import depth_maps, rasterize
from neeco.raster.types import Gaussians, Headlight, Rendering

__all__ = ["Camera", "Gaussians", "Headlight", "Rendering", "depth_maps", "kernels", "rasterize"]
