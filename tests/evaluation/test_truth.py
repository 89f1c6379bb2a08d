"""What a frame is scored against."""

import pytest

from neeco.errors import NeecoError
from neeco.evaluation.truth import truth_file


def test_exact_truth_comes_before_a_reference_mask(tmp_path):
    assert truth_file(tmp_path, "000") is None
    for folder in ("reference_masks", "truth/masks"):
        (tmp_path / folder).mkdir(parents=True)
        file = tmp_path / folder / "000.png"
        file.touch()
        assert truth_file(tmp_path, "000") == file


def test_truth_lies_in_its_capture(tmp_path):
    (tmp_path / "capture" / "truth" / "masks").mkdir(parents=True)
    (tmp_path / "other.png").touch()
    (tmp_path / "capture" / "truth" / "masks" / "000.png").symlink_to(tmp_path / "other.png")
    with pytest.raises(NeecoError, match=r"000.png: a link leads out of .*capture"):
        truth_file(tmp_path / "capture", "000")
