"""PLUS sequences for tests, by `benchmarks/rendered/pluswriter.py`."""

from __future__ import annotations

from rendered_truth import rendered_module

frame_fields, write_mha, write_nrrd = (
    getattr(rendered_module("pluswriter"), name) for name in ("frame_fields", "write_mha", "write_nrrd")
)
