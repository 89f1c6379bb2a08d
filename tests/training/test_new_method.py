"""A new method is one class and its name in `scene/methods.py`; training asks the class for the rest."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch
from capture_files import write_capture
from torch import Tensor, nn

from neeco.errors import NeecoError
from neeco.scene import CanonicalGaussians
from neeco.scene.deformations.base import UNPERTURBED, Deformation, Perturbation, Posed
from neeco.scene.io import load_scene
from neeco.scene.methods import METHODS
from neeco.training.config import method_defaults
from neeco.training.options import training_config
from neeco.training.train import train


class Drift(Deformation):
    """Everything moves with time along one learned direction [3] mm, each Gaussian by its own learned share."""

    training_defaults: ClassVar[Mapping[str, Any]] = {"schedule.frame_order": "off", "ssim_weight": 0.05}
    extra_rates: ClassVar[Mapping[str, float]] = {}
    needs_instruments = True
    label_names = (("grasper", "instrument"),)

    def __init__(self, instruments, reach: float = 1.0) -> None:
        super().__init__()
        self.reach = reach
        self.direction = nn.Parameter(torch.zeros(3))
        self.register_buffer("duration", torch.ones(()))

    def config(self) -> dict[str, Any]:
        return {"reach": self.reach}

    def fit_ranges(self, states, means: Tensor) -> None:
        self.duration.fill_(max(state.time for state in states))

    def finished(self, canonical: CanonicalGaussians, states) -> CanonicalGaussians:
        return canonical.with_extras(moved=torch.full((len(canonical),), float(len(states))))

    def pose(self, canonical: CanonicalGaussians, state, perturbation: Perturbation = UNPERTURBED) -> Posed:
        shift = self.direction * self.reach * (state.time / float(self.duration))
        return Posed(canonical.means + shift, canonical.quats, canonical.log_scales.exp())

    def learning_rates(self, iteration: int) -> dict[str, float]:
        return {"direction": 1e-2}


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(METHODS, "drift", Drift)


def test_a_new_method_trains_is_finished_and_comes_back_from_disk(tmp_path: Path) -> None:
    config = training_config("drift", {"iterations": 12}, ["deformation.reach=3"])
    assert (config.schedule.frame_order, config.ssim_weight) == ("off", 0.05)
    run = train(write_capture(tmp_path / "capture"), tmp_path / "run", config)
    scene = load_scene(run / "scene.safetensors")
    assert isinstance(scene.deformation, Drift)
    assert scene.deformation.reach == 3
    assert float(scene.deformation.duration) == pytest.approx(0.28)  # fit_ranges was asked
    assert bool((scene.deformation.direction != 0).all())  # it was learned
    assert bool((scene.canonical.extras["moved"] == 8).all())  # finished was asked, with every recorded state


def test_a_new_method_that_needs_instruments_says_so(tmp_path: Path) -> None:
    capture = write_capture(tmp_path / "capture", instruments=False)
    with pytest.raises(NeecoError, match="instruments: no states are recorded; method drift needs them"):
        train(capture, tmp_path / "run", method_defaults("drift"))
    assert not (tmp_path / "run").exists()


def test_a_field_that_the_method_does_not_have_is_refused_by_name() -> None:
    with pytest.raises(NeecoError, match=r"--set: deformation.raech: method drift has no such field; it has reach"):
        training_config("drift", {"iterations": 12}, ["deformation.raech=3"])


def test_extras_with_a_rate_are_learned_and_others_hold_still(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Shared(Drift):
        extra_rates: ClassVar[Mapping[str, float]] = {"share": 1e-2}

        def pose(self, canonical, state, perturbation=UNPERTURBED) -> Posed:
            posed = super().pose(canonical, state)
            extent = canonical.extras["share"] * canonical.extras["still"]
            return Posed(canonical.means + extent[:, None], posed.quats, posed.scales)

    import neeco.training.initial as initial

    real = initial.seed_gaussians

    def seeded(positions: Tensor, *rest: Any) -> CanonicalGaussians:
        ones = torch.ones(len(positions))
        return real(positions, *rest).with_extras(share=0 * ones, still=ones)

    monkeypatch.setitem(METHODS, "drift", Shared)
    monkeypatch.setattr(initial, "seed_gaussians", seeded)
    run = train(write_capture(tmp_path / "capture"), tmp_path / "run", training_config("drift", {"iterations": 12}))
    extras = load_scene(run / "scene.safetensors").canonical.extras
    assert bool((extras["share"] != 0).any())
    assert bool((extras["still"] == 1).all())
