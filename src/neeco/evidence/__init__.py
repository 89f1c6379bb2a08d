"""Foreground of images: which pixels show an instrument, from residuals of the learned tissue."""
