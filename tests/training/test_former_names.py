"""A method that was renamed is still trained, continued and loaded by its former name, with one line that says so; so
is a run that stored a setting which is none any more."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

import neeco
from neeco.base.errors import NeecoError
from neeco.cli import main
from neeco.scene.method_registry import current_name
from neeco.training.config import config_to_dict, training_config
from neeco.training.run import stored_config

SAID = "method neeco is now called nps"
SMALL = ["deformation.width=16", "deformation.depth=2"]


def test_a_former_name_trains_the_method_of_today() -> None:
    with pytest.warns(FutureWarning, match=f"^{SAID}$"):
        assert training_config("neeco", {}, SMALL) == training_config("nps", {}, SMALL)
    assert [current_name(name) for name in ("nps", "kinematic", "nothing")] == ["nps", "kinematic", "nothing"]


def test_a_run_of_a_former_name_is_continued_under_either(capture, tmp_path, capsys):
    run = tmp_path / "run"
    flags = ["train", str(capture), "--output", str(run), "--iterations", "4", "--set", SMALL[0], "--set", SMALL[1]]
    assert main([*flags, "--method", "neeco"]) == 0
    assert capsys.readouterr().err.count(SAID) == 1
    config = yaml.safe_load((run / "config.yaml").read_text())
    assert config["method"] == "nps"

    (run / "config.yaml").write_text(yaml.safe_dump(config | {"method": "neeco"}, sort_keys=False))  # as 0.2 wrote it
    with pytest.warns(FutureWarning, match=SAID):
        assert neeco.load(run).config["method"] == "nps"
    for name in ("neeco", "nps"):
        assert main([*flags, "--resume", "--method", name]) == 0


def test_a_stored_setting_that_is_none_any_more_is_read_and_not_taken_anew(tmp_path: Path) -> None:
    config = training_config("kinematic", {}, [])
    stored = config_to_dict(config)
    stored["deformation"] |= {"label_shares": True}
    assert stored_config(tmp_path, stored) == config
    with pytest.raises(NeecoError, match="label_shares"):
        training_config("kinematic", {}, ["deformation.label_shares=false"])


def test_a_stored_setting_that_was_removed_is_read_where_it_was_off_and_refused_where_it_was_on(tmp_path: Path) -> None:
    config = training_config("nps", {}, [])
    stored = config_to_dict(config)
    off, on = ({"gate_mm": mm, "carried_places": mm is not None} for mm in (None, 20.0))
    assert stored_config(tmp_path, stored | {"deformation": stored["deformation"] | off}) == config
    with pytest.raises(NeecoError, match="gate_mm"):
        stored_config(tmp_path, stored | {"deformation": stored["deformation"] | on})
