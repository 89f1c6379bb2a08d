"""The demo finds its sample and never writes over anything."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from neeco.base.errors import NeecoError
from neeco.cli.demo import Arguments, run, sample_capture


def test_the_bundled_sample_is_found_with_its_masks() -> None:
    """That it is sound is a test of check's."""
    assert len(list((sample_capture() / "truth" / "masks").glob("*.png"))) > 0  # without them no mask score


def test_a_folder_with_something_in_it_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("precious")
    with pytest.raises(NeecoError, match="already exists"):
        run(Arguments(output=tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


@pytest.mark.parametrize("minutes", [0.0, -1.0, float("nan")])
def test_no_time_to_train_is_refused(minutes: float, tmp_path: Path) -> None:
    with pytest.raises(NeecoError, match="--minutes"):
        run(Arguments(output=tmp_path / "new", minutes=minutes))
    assert not (tmp_path / "new").exists()


@pytest.mark.skipif(torch.cuda.is_available(), reason="CUDA is there")
def test_a_device_that_is_not_there_is_told_before_anything_else(tmp_path: Path, capsys) -> None:
    with pytest.raises(NeecoError, match="--device: cuda: PyTorch finds no CUDA device"):
        run(Arguments(output=tmp_path / "new", device="cuda"))
    assert capsys.readouterr().out == ""
    assert not (tmp_path / "new").exists()
