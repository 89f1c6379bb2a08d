"""The comparison of runs can fail: it finds one bit, one field, one file, and forgives only what it says it does."""

from __future__ import annotations

import importlib.util
import json
import shutil
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch
from safetensors.torch import save_file

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "same_bits.py"


@pytest.fixture(scope="module")
def bits() -> ModuleType:
    spec = importlib.util.spec_from_file_location("same_bits", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["same_bits"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


TENSORS = {
    "canonical.means": torch.tensor([[1.0, float("nan"), 3.0]]),
    "canonical.extras.part_logits": torch.zeros(2),
    "count": torch.tensor(7),
    "empty": torch.zeros(0, 3),
}
HEADER = {"version": "1", "seconds": 3.5, "steps": {"extras.part_logits": 4}, "recorded": [{"time": 0.1}], "none": []}


def write_tensors(path: Path, tensors: dict[str, torch.Tensor], header: dict[str, object]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    save_file(tensors, path, {"neeco": json.dumps(header)})


def make_run(path: Path) -> Path:
    write_tensors(path / "scene.safetensors", TENSORS, HEADER)
    write_tensors(path / "checkpoint" / "session.safetensors", TENSORS, HEADER)
    (path / "metrics.jsonl").write_text('{"loss": 0.25, "seconds": 1}\n{"loss": 0.125, "seconds": 2}\n')
    (path / "config.yaml").write_text("seed: 3\n")
    return path


def make_dataset(path: Path) -> Path:
    (path / "images").mkdir(parents=True)
    (path / "images" / "000000.png").write_bytes(b"picture")
    (path / "dataset.json").write_text(json.dumps({"seed": 1, "version": "0.1", "scene": str(path)}))
    return path


def told(bits: ModuleType, before: Path, after: Path, **rules: object) -> tuple[bool, str]:
    lines: list[str] = []
    same = bits.compare(before, after, bits.Rules(**rules), lines.append)
    return same, "\n".join(lines)


@pytest.fixture
def runs(tmp_path: Path) -> tuple[Path, Path]:
    """Two folders of one run each, equal but for the times."""
    before, after = make_run(tmp_path / "before" / "a"), make_run(tmp_path / "after" / "a")
    write_tensors(after / "scene.safetensors", TENSORS, HEADER | {"version": "2", "seconds": 9.0})
    return before.parent, after.parent


def test_times_and_versions_do_not_count(bits: ModuleType, runs: tuple[Path, Path]) -> None:
    same, text = told(bits, *runs)
    assert same
    assert text.count("same: a/") == 4


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("canonical.means", torch.tensor([[1.0, float("nan"), 3.0000002]]), "1 of 3 elements, by up to"),
        ("canonical.means", torch.tensor([[1.0, 2.0, 3.0]]), "1 of 3 elements"),
        ("canonical.extras.part_logits", torch.tensor([0.0, -0.0]), "1 of 2 elements"),
        ("canonical.extras.part_logits", torch.zeros(2, 1), r"[2] before, torch.float32 [2, 1] after"),
        ("count", torch.tensor(7, dtype=torch.int32), "torch.int32"),
        ("new", torch.zeros(1), "new: only after"),
    ],
)
def test_one_bit_of_a_tensor_counts(
    bits: ModuleType, runs: tuple[Path, Path], name: str, value: torch.Tensor, message: str
) -> None:
    write_tensors(runs[1] / "a" / "checkpoint" / "session.safetensors", TENSORS | {name: value}, HEADER)
    same, text = told(bits, *runs)
    assert not same
    assert "DIFFERS: a/checkpoint/session.safetensors" in text
    assert message in text
    assert told(bits, *runs, aside=(*bits.TIMES, name))[0]


def test_a_field_of_the_header_counts(bits: ModuleType, runs: tuple[Path, Path]) -> None:
    write_tensors(runs[1] / "a" / "scene.safetensors", TENSORS, HEADER | {"recorded": [{"time": 0.2}]})
    same, text = told(bits, *runs)
    assert not same
    assert "header: neeco.recorded.0.time: 0.1 before, 0.2 after" in text
    assert told(bits, *runs, aside=(*bits.TIMES, "recorded"))[0]


def test_what_was_renamed_is_the_same_and_what_was_not_is_not(bits: ModuleType, runs: tuple[Path, Path]) -> None:
    tensors = {name.replace("extras.part_logits", "parts.logits"): tensor for name, tensor in TENSORS.items()}
    header = HEADER | {"steps": {"parts.logits": 4}}
    write_tensors(runs[1] / "a" / "scene.safetensors", tensors, header)
    assert not told(bits, *runs)[0]
    assert not told(bits, *runs, renamed=(("part_logits", "logits"),))[0]
    write_tensors(runs[1] / "a" / "checkpoint" / "session.safetensors", tensors, header)
    assert told(bits, *runs, renamed=(("extras.part_logits", "parts.logits"),))[0]


def test_the_config_is_told_but_counts_only_when_asked(bits: ModuleType, runs: tuple[Path, Path]) -> None:
    (runs[1] / "a" / "config.yaml").write_text("seed: 4\n")
    same, text = told(bits, *runs)
    assert same
    assert "differs, not counted: a/config.yaml\n    seed: 3 before, 4 after" in text
    assert not told(bits, *runs, config=True)[0]


def test_a_loss_in_the_metrics_counts(bits: ModuleType, runs: tuple[Path, Path]) -> None:
    (runs[1] / "a" / "metrics.jsonl").write_text('{"loss": 0.25, "seconds": 1}\n{"loss": 0.126, "seconds": 2}\n')
    assert not told(bits, *runs)[0]


def test_a_run_on_one_side_only_counts(bits: ModuleType, runs: tuple[Path, Path]) -> None:
    make_run(runs[0] / "b")
    same, text = told(bits, *runs)
    assert not same
    assert "DIFFERS: b/scene.safetensors\n    not there after" in text


def test_every_file_of_a_data_set_counts(bits: ModuleType, tmp_path: Path) -> None:
    before, after = make_dataset(tmp_path / "before"), make_dataset(tmp_path / "after")
    assert told(bits, before, after)[0]
    (after / "dataset.json").write_text('{"seed": 2}')
    assert not told(bits, before, after)[0]
    shutil.copy(before / "dataset.json", after)
    (after / "images" / "000000.png").write_bytes(b"Picture")
    assert not told(bits, before, after)[0]
    shutil.rmtree(after / "images")
    assert not told(bits, before, after)[0]


def test_numbers_of_evaluations_are_equal_exactly(bits: ModuleType, tmp_path: Path) -> None:
    before, after = tmp_path / "before.json", tmp_path / "evaluation.json"
    before.write_text('{"given": {"test": {"psnr": 30.1, "lpips": null, "fps": 3.0}}}')
    after.write_text('{"given": {"test": {"psnr": 30.1, "lpips": null, "fps": 4.0}}}')
    assert told(bits, before, after)[0]
    after.write_text('{"given": {"test": {"psnr": 30.100000000000001, "lpips": 0, "fps": 4.0}}}')
    same, text = told(bits, before, after)
    assert not same
    assert "given.test.lpips: null before, 0 after" in text


def test_nothing_to_compare_is_not_the_same(
    bits: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["same_bits.py", str(tmp_path), str(tmp_path)])
    assert bits.main() == 1
    assert "nothing to compare" in capsys.readouterr().out
    make_run(tmp_path)
    assert bits.main() == 0
