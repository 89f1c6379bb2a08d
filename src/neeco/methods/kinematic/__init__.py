"""Method `kinematic`: rigid links on joints."""

from neeco.methods.kinematic.deformation import Kinematic

__all__ = ["Kinematic"]
