"""`check` opens the truth that evaluation reads: wrong kind, size, ids and names are warnings, no errors."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from neeco.capture.checks import inspect_capture

SAMPLE = Path(__file__).resolve().parents[2] / "samples" / "liver-mini"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    root = tmp_path / "capture"
    shutil.copytree(SAMPLE, root)
    return root


def told_of(root: Path) -> list[str]:
    checked = inspect_capture(root, motion=False)
    assert all(problem.severity == "warning" for problem in checked.problems)  # it can be trained on
    return [str(problem) for problem in checked.problems]


def masks(root: Path) -> list[Path]:
    return sorted((root / "truth" / "masks").glob("*.png"))


def test_a_right_truth_is_not_told_of(root: Path) -> None:
    assert len(masks(root)) > 2
    assert told_of(root) == []


@pytest.mark.parametrize(
    ("pixels", "told"),
    [
        (np.zeros((192, 240, 3), np.uint8), "expected an 8-bit image of part ids, found mode RGB; save it as grey PNG"),
        (np.zeros((96, 120), np.uint8), "120x96"),
    ],
)
def test_a_mask_of_another_kind_or_size_is_named(pixels: np.ndarray, told: str, root: Path) -> None:
    file = masks(root)[0]
    Image.fromarray(pixels).save(file)
    (line,) = told_of(root)
    assert line.startswith(f"truth/masks/{file.name}: ")
    assert told in line


def test_files_that_evaluation_would_pass_over_are_named(root: Path) -> None:
    file = masks(root)[0]
    Image.open(file).convert("L").save(file.with_suffix(".jpg"))
    os.rename(file, file.with_name("unknown.png"))
    jpeg, unknown = sorted(told_of(root))
    assert jpeg.endswith("belongs to no frame; masks must be PNG files with the names of the images")
    assert "unknown.png: belongs to no frame" in unknown


def test_further_files_about_a_frame_that_has_its_mask_are_not_told_of(root: Path) -> None:
    file = masks(root)[0]
    shutil.copy(file, file.with_name(f"{file.stem}_label.png"))
    assert told_of(root) == []
    file.unlink()
    assert len(told_of(root)) == 1, "without its mask the name is wrong"


def test_a_damaged_file_and_a_wrong_list_of_parts_are_named(root: Path) -> None:
    file = masks(root)[0]
    file.write_bytes(file.read_bytes()[:40])
    (root / "truth" / "masks" / "parts.json").write_text(json.dumps({"ids": [3]}))
    lines = told_of(root)
    assert any(line.startswith(f"truth/masks/{file.name}: ") for line in lines)
    assert any(line.startswith("truth/masks/parts.json: ids: expected") for line in lines)
