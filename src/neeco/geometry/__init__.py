"""Cameras, lenses, rotations and rigid transforms: numpy and torch alone, below every other room."""
