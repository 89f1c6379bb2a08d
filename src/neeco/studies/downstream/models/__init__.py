"""Detectors and segmenters, one file each. Every class with a `model` name in a public module is registered."""
