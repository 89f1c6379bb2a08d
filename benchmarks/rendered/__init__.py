"""Rendered captures with exact truth: scenes, a small ray tracer, motion with realistic errors, and the writer."""
