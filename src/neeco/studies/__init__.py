"""Experiments: many independent runs (jobs) on one capture, and their combined results."""
