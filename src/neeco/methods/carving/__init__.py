"""Shapes of instruments carved from training frames by their poses alone, for methods that need a start."""
