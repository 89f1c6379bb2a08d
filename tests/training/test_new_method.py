"""A new method is one new file; it is found there, and training asks its class for the rest."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from capture_files import write_capture

from neeco.base.errors import NeecoError
from neeco.scene.io import load_scene
from neeco.scene.method_registry import methods
from neeco.training.config import method_defaults, training_config
from neeco.training.train import train

FILE = '''
import torch
from torch import nn

from neeco.scene.deformation import UNPERTURBED, Deformation, Posed


class Drift(Deformation):
    """Everything moves with time along one learned direction [3] mm."""

    method = "drift"
    needs_instruments = True
    label_names = (("grasper", "instrument"),)

    def __init__(self, instruments, settings=None) -> None:
        super().__init__(instruments, settings)
        self.direction = nn.Parameter(torch.zeros(3))

    def pose(self, canonical, state, perturbation=UNPERTURBED):
        return Posed(canonical.means + self.direction * state.time, canonical.quats, canonical.log_scales.exp())

    def learning_rates(self, progress):
        return {"direction": 1e-2 * (1 - progress)}


class Shared(Drift):
    method = "shared"
    extra_rates = {"share": 1e-2}

    def initial_extras(self, canonical):
        ones = torch.ones(len(canonical))
        return {"share": 0 * ones, "still": ones}

    def pose(self, canonical, state, perturbation=UNPERTURBED):
        posed = super().pose(canonical, state)
        extent = canonical.extras["share"] * canonical.extras["still"]
        return Posed(canonical.means + extent[:, None], posed.quats, posed.scales)


called = []


def noting(name):
    def hook(self, *args):
        called.append(name)
        return getattr(Drift, name)(self, *args)

    return hook


HOOKS = ("fit_ranges", "initial_extras", "begin", "perturb", "training_channels", "regularisation")
Noted = type("Noted", (Drift,), {name: noting(name) for name in (*HOOKS, "between_steps", "act", "finish")})
Noted.__module__, Noted.method = __name__, "noted"
'''


@pytest.fixture(autouse=True)
def drift(methods_folder: Path) -> None:
    """The class in a new file."""
    (methods_folder / "drift.py").write_text(FILE)


def test_methods_are_found_in_their_files_the_default_one_first() -> None:
    assert list(methods()) == [
        "kinematic",
        *sorted(["3dgs", "4dgs", "deformable-3dgs", "drift", "nerfies", "noted", "nps", "shared"]),
    ]


def test_two_files_of_one_method_are_refused(methods_folder: Path) -> None:
    (methods_folder / "drifting.py").write_text(FILE)
    with pytest.raises(NeecoError, match=r"drifting: method 'drift' is also in neeco.methods.drift"):
        methods()


def test_a_new_method_that_needs_instruments_says_so(tmp_path: Path) -> None:
    capture = write_capture(tmp_path / "capture", instruments=False)
    with pytest.raises(NeecoError, match="instruments: no states are recorded; method drift needs them"):
        train(capture, tmp_path / "run", method_defaults("drift"))
    assert not (tmp_path / "run").exists()


def test_extras_with_a_rate_are_learned_and_others_hold_still(tmp_path):
    run = train(write_capture(tmp_path / "capture"), tmp_path / "run", training_config("shared", {"iterations": 12}))
    extras = load_scene(run / "scene.safetensors").canonical.extras
    assert bool((extras["share"] != 0).any())
    assert bool((extras["still"] == 1).all())


def test_hooks_are_called_in_their_order(tmp_path: Path) -> None:
    train(write_capture(tmp_path / "capture"), tmp_path / "run", training_config("noted", {"iterations": 2}))
    called = sys.modules["neeco.methods.drift"].called
    step = ["training_channels", "perturb", "regularisation", "between_steps"]
    assert called == ["fit_ranges", "initial_extras", "begin", *step, *step, "finish"]
