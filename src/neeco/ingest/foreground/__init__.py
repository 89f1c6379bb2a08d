"""Masks of foreground objects: what moves in front of the tissue."""
