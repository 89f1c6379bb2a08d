"""Cameras of the chosen frames: structure from motion, or a still scope; and the tissue they observe."""
