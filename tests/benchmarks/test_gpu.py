"""benchmarks/gpu.py measures what it says, and says in one line where it cannot."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import ClassVar

import pytest
import torch
from device_params import DEVICES

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
KINDS = ("draw", "frame", "draw+backward", "step")
STAGES = ["project", "bin", "composite", "composite_backward", "project_backward"]
SMALL = ["--workload", "300,32x24", "--repeats", "2"]


@pytest.fixture(scope="module")
def script() -> Iterator[ModuleType]:
    sys.path.insert(0, str(BENCHMARKS))
    try:
        spec = importlib.util.spec_from_file_location("gpu", BENCHMARKS / "gpu.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules["gpu"] = module  # dataclasses look their module up
        spec.loader.exec_module(module)
        yield module
    finally:
        sys.path.remove(str(BENCHMARKS))
        sys.modules.pop("gpu", None)


@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU is there")
def test_without_a_gpu_it_ends_in_one_line(script: ModuleType, capsys) -> None:
    assert script.main([]) == 1
    told = capsys.readouterr()
    assert told.out == ""
    assert len(told.err.splitlines()) == 1
    assert told.err.startswith("gpu.py: --device: cuda: PyTorch finds no CUDA device")
    assert script.main(["--device", "cpu", "--workload", "many"]) == 1
    assert "write GAUSSIANS,WIDTHxHEIGHT" in capsys.readouterr().err


@pytest.mark.parametrize("device", DEVICES)
def test_every_backend_and_kind_is_timed(device: str, script: ModuleType, tmp_path: Path, environment, capsys) -> None:
    torch.set_num_threads(1)
    environment["CUBLAS_WORKSPACE_CONFIG"] = ":4096:8"
    assert script.main([*SMALL, "--device", device, "--output", str(tmp_path)]) == 0
    result = json.loads((tmp_path / "gpu.json").read_text())
    assert (tmp_path / "gpu.md").read_text() == capsys.readouterr().out
    assert (result["hardware"]["gpu"] is not None) == (device == "cuda")
    (case,) = result["workloads"]
    assert case["workload"] == {"gaussians": 300, "width": 32, "height": 24}
    for row in case["ms"]:
        assert all(row[kind] > 0 for kind in KINDS)
    for stages in case["stages"].values():
        check_stages(stages)
    assert bool(case["stages"]) == any("triton" in row["backend"] for row in case["ms"])


def check_stages(stages: dict[str, float]) -> None:
    assert list(stages) == STAGES
    assert all(milliseconds > 0 for milliseconds in stages.values())


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="needs triton")
def test_stages_are_told_apart(tmp_path: Path) -> None:
    """By Triton's interpreter, in a process of its own."""
    words = ["--device", "cpu", "--workload", "40,16x16", "--repeats", "1", "--output", str(tmp_path)]
    command = [sys.executable, str(BENCHMARKS / "gpu.py"), *words]
    result = subprocess.run(command, env={**os.environ, "TRITON_INTERPRET": "1"}, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    (case,) = json.loads((tmp_path / "gpu.json").read_text())["workloads"]
    assert [row["backend"] for row in case["ms"]] == ["cpu", "triton", "triton, fixed order"]
    assert list(case["stages"]) == ["triton", "triton, fixed order"]
    for stages in case["stages"].values():
        check_stages(stages)


class Event:
    """A CUDA event: the place that it has in its stream, one a millisecond."""

    recorded: ClassVar[list[str]] = []

    def __init__(self, enable_timing: bool) -> None:
        assert enable_timing

    def record(self, stream: str) -> None:
        self.at = len(self.recorded)
        self.recorded.append(stream)

    def elapsed_time(self, end: Event) -> float:
        return float(end.at - self.at)


def test_a_gpu_is_timed_by_events_in_its_own_stream_and_named(script: ModuleType, monkeypatch) -> None:
    card = SimpleNamespace(total_memory=8 * 2**30, major=8, minor=9)
    monkeypatch.setattr(Event, "recorded", [])
    stand_ins = {
        "Event": Event,
        "current_stream": lambda device: f"stream of {device}",
        "get_device_name": lambda device: "Some Card",
        "get_device_properties": lambda device: card,
    }
    for name, stands_in in stand_ins.items():
        monkeypatch.setattr(torch.cuda, name, stands_in)
    device = torch.device("cuda:1")
    marks = sys.modules["stages"].Marks(device)
    first, _, third = (marks.mark() for _ in range(3))
    assert marks.between(first, third) == 2.0
    assert Event.recorded == ["stream of cuda:1"] * 3
    facts = script.hardware(device)
    assert (facts["gpu"], facts["capability"], facts["memory"]) == ("Some Card", "8.9", 8 * 2**30)
    assert {"driver", "cuda", "torch", "triton", "gsplat", "commit", "neeco"} <= facts.keys()
