"""Experiments: many runs on one capture, each a job that stands on its own, and what is read off them together."""
