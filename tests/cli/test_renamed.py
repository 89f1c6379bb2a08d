"""What had another name in version 0.1 is read for one more version, with a warning."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import pytest

from neeco.cli import RENAMED, main
from neeco.settings import RenamedWarning, new_name, structure, with_fields
from neeco.studies.ablation_study import chosen_ablations


@dataclass(frozen=True)
class Inner:
    renamed: ClassVar[Mapping[str, str]] = {"speed": "rate"}
    rate: float = 1.0


@dataclass(frozen=True)
class Outer:
    renamed: ClassVar[Mapping[str, str]] = {"core": "inner"}
    inner: Inner = field(default_factory=Inner)


def test_settings_are_read_under_their_old_names():
    assert structure(Outer, {"core": {"speed": 2.0}}) == Outer(Inner(2.0))
    assert structure(Outer, {"inner": {"rate": 2.0}}) == Outer(Inner(2.0))
    assert with_fields(Outer(), {"core.speed": 3.0}) == Outer(Inner(3.0))
    assert new_name(Inner, "rate") == "rate"


@pytest.mark.parametrize(("verb", "old"), sorted(RENAMED))
def test_an_old_flag_is_read_with_a_warning_that_names_the_new_one(verb, old, capsys):
    with pytest.raises(SystemExit):
        main([verb, old, "3", "--help"])
    error = capsys.readouterr().err
    assert f"neeco: warning: {old} is called {RENAMED[verb, old]} now" in error


@pytest.mark.parametrize(("verb", "old"), sorted(RENAMED))
def test_the_new_flag_is_one_that_the_verb_has(verb, old, capsys):
    with pytest.raises(SystemExit):
        main([verb, "--help"])
    told = capsys.readouterr().out
    assert RENAMED[verb, old] in told
    assert f"{old} " not in told


def test_an_ablation_is_found_under_its_old_name():
    with pytest.warns(RenamedWarning, match="--tables rim is called --tables extrapolation now"):
        (table,) = chosen_ablations(["rim"])
    assert table.name == "extrapolation"
