"""Foreground of images: what shows an instrument, by what the learned tissue does not explain."""
