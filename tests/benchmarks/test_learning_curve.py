"""The learning curves' chart: drawn from CSVs, also of captures without true masks."""

from __future__ import annotations

import argparse
import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree

import pytest

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "learning_curve.py"


@pytest.fixture(scope="module")
def curves() -> ModuleType:
    spec = importlib.util.spec_from_file_location("learning_curve", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["learning_curve"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("masked", [True, False])
def test_the_chart_has_a_line_per_run_and_split(curves: ModuleType, masked: bool, tmp_path: Path) -> None:
    inside = 12.0 if masked else float("nan")
    first = curves.Row("a", 30.0, 100, 1000, 1, "test", 20.0, inside)
    for name in ("a", "b"):
        rows = [replace(first, name=name, split=split) for split in ("test", "unseen")]
        later = [replace(row, cpu_seconds=60.0, psnr=22.0) for row in rows]
        curves.write_rows(tmp_path / f"{name}.csv", [*rows, *later])
    curves.plot(argparse.Namespace(folder=tmp_path))
    paths = ElementTree.parse(tmp_path / "curves.svg").getroot().iter("{http://www.w3.org/2000/svg}path")
    styles = [path.get("style", "") for path in paths if path.get("clip-path")]
    lines = [style for style in styles if "stroke-width: 1.8" in style]
    assert len(lines) == 4
    assert sum("stroke-dasharray" in line for line in lines) == 2
    assert "nan" not in (tmp_path / "curves.svg").read_text(encoding="utf-8")
    assert (tmp_path / "curves_instrument.svg").exists() is masked
