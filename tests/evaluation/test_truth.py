"""What a frame is scored against."""

from neeco.evaluation.truth import truth_file


def test_exact_truth_comes_before_a_reference_mask(tmp_path):
    assert truth_file(tmp_path, "000") is None
    for folder in ("reference_masks", "truth/masks"):
        (tmp_path / folder).mkdir(parents=True)
        file = tmp_path / folder / "000.png"
        file.touch()
        assert truth_file(tmp_path, "000") == file
