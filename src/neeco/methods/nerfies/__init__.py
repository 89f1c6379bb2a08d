"""Nerfies (Park et al. 2021), method `nerfies`: a radiance field viewed through a learned SE(3) warp."""

from neeco.methods.nerfies.session import Nerfies

__all__ = ["Nerfies"]
