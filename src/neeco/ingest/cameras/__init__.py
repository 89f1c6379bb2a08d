"""Cameras of the chosen frames: structure from motion, or a scope that does not move, and the tissue they observe."""
