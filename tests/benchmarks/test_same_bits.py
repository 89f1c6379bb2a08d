"""The comparison of runs and of builds can fail: one bit, field or file counts, and only times and places do not."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

pytest.importorskip("rosbags")
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

from golden import table
from same_bits import differences, digests_of, main

TENSORS = {
    "canonical.means": torch.tensor([[1.0, float("nan"), 3.0]]),
    "canonical.extras.part_logits": torch.zeros(2),
    "count": torch.tensor(7),
    "empty": torch.zeros(0, 3),
}
HEADER = {"version": "1", "seconds": 3.5, "steps": {"part_logits": 4}, "recorded": [{"time": 0.1}], "none": []}


def make_run(path: Path, tensors: dict[str, torch.Tensor] | None = None, **header: object) -> Path:
    (path / "checkpoint").mkdir(parents=True)
    save_file(TENSORS | (tensors or {}), path / "scene.safetensors", {"neeco": json.dumps(HEADER | header)})
    (path / "metrics.jsonl").write_text('{"loss": 0.25, "seconds": 1}\n{"loss": 0.125, "seconds": 2}\n')
    (path / "config.yaml").write_text("seed: 3\ncapture: " + str(path))
    (path / "checkpoint" / "picture.png").write_bytes(b"picture")
    (path / "report.html").write_text(str(path))
    return path


def test_times_versions_and_places_do_not_count(tmp_path: Path) -> None:
    before, after = make_run(tmp_path / "before"), make_run(tmp_path / "after", version="2", seconds=9.0)
    assert list(differences(before, after)) == []
    assert digests_of(before) == digests_of(after)
    assert len(digests_of(before)) == 4


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("canonical.means", torch.tensor([[1.0, float("nan"), 3.0000002]]), "canonical.means: torch.float32 [1, 3]"),
        ("canonical.extras.part_logits", torch.tensor([0.0, -0.0]), "part_logits: torch.float32 [2]"),
        ("canonical.extras.part_logits", torch.zeros(2, 1), "torch.float32 [2, 1]"),
        ("count", torch.tensor(7, dtype=torch.int32), "torch.int32"),
        ("new", torch.zeros(1), "new: nothing before"),
    ],
)
def test_one_bit_of_a_tensor_counts(name: str, value: torch.Tensor, message: str, tmp_path: Path) -> None:
    before, after = make_run(tmp_path / "before"), make_run(tmp_path / "after", {name: value})
    (line,) = differences(before, after)
    assert line.startswith("scene.safetensors: ")
    assert message in line
    assert digests_of(before) != digests_of(after)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("metrics.jsonl", '{"loss": 0.25}\n{"loss": 0.126}\n', "1.loss: 0.125 before, 0.126 after"),
        ("config.yaml", "seed: 4", "seed: 3 before, 4 after"),
        ("config.yaml", "seed: 3.0", "seed: 3 before, 3.0 after"),
        ("checkpoint/picture.png", "Picture", "checkpoint/picture.png: bytes"),
        ("checkpoint/other.png", "", "checkpoint/other.png: not in"),
    ],
)
def test_one_field_byte_or_file_counts(file: str, text: str, message: str, tmp_path: Path) -> None:
    before, after = make_run(tmp_path / "before"), make_run(tmp_path / "after")
    (after / file).write_text(text)
    assert message in "\n".join(differences(before, after))
    assert digests_of(before) != digests_of(after)


def test_a_field_of_the_header_counts(tmp_path: Path) -> None:
    before, after = make_run(tmp_path / "before"), make_run(tmp_path / "after", recorded=[{"time": 0.2}])
    (line,) = differences(before, after)
    assert line.endswith("header.neeco.recorded.0.time: 0.1 before, 0.2 after")


def test_nothing_to_compare_is_not_the_same(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["same_bits.py", str(tmp_path), str(tmp_path)])
    assert main() == 1
    make_run(tmp_path / "run")
    assert main() == 0
    assert "4 files are the same" in capsys.readouterr().out


def test_builds_agree_where_all_files_do_and_nothing_failed() -> None:
    old = {"still-scope train": {"scene.safetensors": "a", "metrics.jsonl": "b"}}
    other = {"still-scope train": {"scene.safetensors": "c", "metrics.jsonl": "b"}}
    failed = {"still-scope train": {"failed": "neeco: error"}}
    assert table({"old": old, "new": old}) == (
        "| | files | new |\n|---|---|---|\n| still-scope train | 2 | same |",
        True,
    )
    text, agree = table({"old": old, "new": other})
    assert "1 differ: scene.safetensors" in text
    assert not agree
    assert not table({"old": failed, "new": failed})[1]
