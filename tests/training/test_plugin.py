"""A method in a package of its own does what ours do once it is installed; one that cannot be loaded is named."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from capture_files import write_grasper
from plugin_site import install_plugin

from neeco.cli import main
from neeco.errors import NeecoError
from neeco.scene.method_registry import methods
from neeco.training.run import load_run
from neeco.viewer.views import picture, views_of


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of installed packages of this process."""
    site = tmp_path / "site"
    monkeypatch.syspath_prepend(site)
    methods.cache_clear()
    yield site
    methods.cache_clear()
    sys.modules.pop("neeco_rigid", None)


def test_an_installed_method_trains_evaluates_renders_synthesizes_and_is_viewed(site: Path, tmp_path: Path) -> None:
    install_plugin(site, tmp_path)
    capture, run = write_grasper(tmp_path / "capture", frames=12, sizes=((64, 48),)), tmp_path / "run"
    settings = ["--set", "deformation.carving.tissue_steps=60", "--set", "deformation.carving.seeds=200"]
    assert (
        main(["train", str(capture), "--method", "rigid", "--output", str(run), "--iterations", "40", *settings]) == 0
    )
    assert main(["evaluate", str(run), "--json", str(tmp_path / "scores.json")]) == 0
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert scores["given"]["test"]["psnr"] > 12
    data = ["--output", str(tmp_path / "data"), "--min-share", "0.0001", "--no-tissue-check"]
    assert main(["synthesize", str(run), "--count", "2", *data]) == 0
    assert main(["render", str(run), "--split", "test", "--output", str(tmp_path / "renders")]) == 0
    scene = load_run(run).scene
    for view in views_of(scene, has_images=False):  # of `neeco view`
        picture(scene, scene.recorded.states[0], scene.recorded.cameras[0], view)


def test_an_entry_point_that_cannot_be_loaded_is_named(site: Path) -> None:
    about = site / "broken-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[neeco.methods]\nbroken = broken_module:Method\n")
    importlib.invalidate_caches()
    with pytest.raises(
        NeecoError, match=r"broken_module:Method: entry point of broken in neeco.methods cannot be load"
    ):
        methods()
