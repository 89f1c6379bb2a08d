"""Detectors and segmenters to train: one model, one file. A public module's class with a `model` name is one."""
