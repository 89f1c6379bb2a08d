"""`--set` of an experiment: one list of settings for runs of several methods."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence

from neeco.errors import NeecoError
from neeco.scene.methods import method_class

OWN_OPTION = {"transforms": "--transforms", "iterations": "the budget's option", "minutes": "the budget's option"}


def check_settings(assignments: Sequence[str], methods: Collection[str], seed_option: str) -> None:
    """Raises NeecoError for a NAME=VALUE that has an option of its own, or that none of `methods` has."""
    for assignment in assignments:
        name = assignment.partition("=")[0]
        if option := (OWN_OPTION | {"seed": seed_option}).get(name):
            raise NeecoError(f"--set {name}: use {option}; all runs share it")
        if not any(_takes(method, name) for method in methods):
            raise NeecoError(f"--set {name}: no such field in the methods {', '.join(methods)}")


def settings_for(method: str, assignments: Sequence[str]) -> list[str]:
    """Those of `assignments` that `method` has: `deformation.FIELD` is a method's own, all others are everybody's."""
    return [assignment for assignment in assignments if _takes(method, assignment.partition("=")[0])]


def _takes(method: str, name: str) -> bool:
    group, _, field = name.partition(".")
    return group != "deformation" or field in {own.name for own in dataclasses.fields(method_class(method).Settings)}
