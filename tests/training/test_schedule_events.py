"""Every moment of a training is an event of its schedule."""

from __future__ import annotations

import pytest
from capture_files import write_capture

from neeco.base.errors import NeecoError
from neeco.methods.kinematic.deformation import Kinematic
from neeco.training.config import method_defaults, training_config
from neeco.training.train import train


@pytest.mark.parametrize("batch_size", [1, 3])
def test_an_event_comes_once_by_share_or_by_iteration_in_the_order_of_the_schedule(batch_size, tmp_path, monkeypatch):
    """However many iterations a step has."""
    acted: list[str] = []
    monkeypatch.setattr(Kinematic, "act", lambda self, training, action: acted.append(action))
    events = "[{at: 0.5, action: place_wrists}, {at: 0.1, action: fit_states}, {at: 0.1, action: find_shadow}"
    events += ", {at: 7, action: observe_silhouettes}, {at: 13, action: refine_wrists}]"
    small = {"tissue_steps": 5, "long_tissue_steps": 5, "seeds": 300}
    settings = [f"schedule.events={events}", *(f"deformation.carving.{name}={value}" for name, value in small.items())]
    config = training_config("kinematic", {"iterations": 12, "batch_size": batch_size}, settings)
    train(write_capture(tmp_path / "capture"), tmp_path / "run", config)
    assert sorted(acted) == ["find_shadow", "fit_states", "observe_silhouettes", "place_wrists"]
    assert acted.index("fit_states") < acted.index("find_shadow") < acted.index("place_wrists")


@pytest.mark.parametrize(
    ("method", "events", "message"),
    [
        ("kinematic", "[{at: 0.4, action: find_shadows}]", "0: 'find_shadows' is no action of method kinematic; it"),
        ("nps", "[{at: 0.4, action: find_shadow}]", "0: 'find_shadow' is no action of method nps; it has none"),
        ("kinematic", "[{at: 0, action: find_shadow}]", "0: at: 0 is not above 0, the run's start"),
    ],
)
def test_an_event_that_no_run_can_have_is_refused(method: str, events: str, message: str) -> None:
    with pytest.raises(NeecoError, match=f"^--set schedule.events: {message}"):
        training_config(method, {}, [f"schedule.events={events}"])


def test_all_that_a_method_does_between_steps_is_an_event_it_has_by_default() -> None:
    default = method_defaults("kinematic").schedule.events
    assert {event.action for event in default} == set(Kinematic.actions)
