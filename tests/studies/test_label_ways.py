"""Both ways to label a scene, scored as synthesis draws them."""

from __future__ import annotations

from pathlib import Path

import pytest

from neeco.capture.writer import write_capture
from neeco.studies.masks import score_label_ways
from neeco.training.config import training_config
from neeco.training.run import load_run
from neeco.training.train import train


@pytest.mark.parametrize(("method", "known"), [("nps", True), ("3dgs", False)])
def test_each_way_has_an_overlap_for_each_split_or_none(method: str, known: bool, world, tmp_path: Path) -> None:
    root = tmp_path / "capture"
    write_capture(world.make_capture(root, world.TinyScene(), ("train",) * 4 + ("test", "unseen")), root)
    small = ["deformation.width=8", "deformation.depth=2", "deformation.warm_up=0"] if known else []
    path = train(root, tmp_path / "run", training_config(method, {"iterations": 10}, small))
    run = load_run(path)
    scores = score_label_ways(run, run.capture(), ("test", "unseen"))
    assert list(scores) == ["composited", "threshold"]
    for way in scores.values():
        assert list(way) == ["test", "unseen"]
        assert all((value is not None and 0 <= value <= 1) if known else value is None for value in way.values())
