"""The paper's dynamic training adjustment, what its ablations turn off or round, and the events of a run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from capture_files import write_capture

from neeco.base.errors import NeecoError
from neeco.methods.kinematic.deformation import Kinematic
from neeco.methods.static import Static
from neeco.training.config import method_defaults, training_config
from neeco.training.schedule import DensityPhase, Schedule, ScheduleConfig, order_by_pose
from neeco.training.train import train

SPARSE, DENSE = DensityPhase(500, 10_000, 4e-4), DensityPhase(200, 3_000, 2e-4)
PLAIN = DensityPhase(100, 3_000, 2e-4)


def in_phase_2(config: ScheduleConfig | None = None, began: int = 2000) -> Schedule:
    schedule = Schedule(config or ScheduleConfig())
    schedule.phase, schedule.phase_started = 2, began
    return schedule


@pytest.mark.parametrize(
    ("part", "first", "second"), [("on", SPARSE, DENSE), ("inverse", DENSE, SPARSE), ("off", PLAIN, PLAIN)]
)
@pytest.mark.parametrize(
    ("name", "constant"),
    [("density_interval", "interval"), ("opacity_reset", "opacity_reset"), ("gradient_threshold", "threshold")],
)
def test_each_part_of_density_control_switches_alone(name, constant, part, first, second):
    config = ScheduleConfig(**{name: part})
    assert Schedule(config).density() == replace(SPARSE, **{constant: getattr(first, constant)})
    assert in_phase_2(config).density() == replace(DENSE, **{constant: getattr(second, constant)})


def test_a_schedule_stated_for_more_steps_scales_with_the_run() -> None:
    config = ScheduleConfig(published_steps=20_000)
    schedule = Schedule(config, 2_000)
    assert schedule.density() == DensityPhase(50, 1_000, 4e-4)
    assert settle(schedule, 2_000) == 100  # `earliest`, a tenth; the moving averages are 20 steps long
    degrees = [schedule.sh_degree(i) for i in (199, 200, 300, 1_000)]
    assert degrees == [0, 1, 2, 3]
    assert Schedule(config, 20_000).density() == SPARSE
    assert Schedule(config, 20).density().interval == 1


def test_opacity_has_time_to_come_back_between_resets_however_short_the_run() -> None:
    config = ScheduleConfig(opacity_reset="off", published_steps=20_000)
    assert [Schedule(config, n).density().opacity_reset for n in (20_000, 4_000, 1_000, 100)] == [3_000, 600, 300, 300]


def test_no_opacity_reset_stays_none_however_short_the_run() -> None:
    plain = DensityPhase(200, 0, 2e-4)
    config = ScheduleConfig(opacity_reset="off", plain_density=plain, published_steps=20_000)
    assert Schedule(config, 100).density().opacity_reset == 0


def test_colour_is_flat_in_phase_1_and_gains_an_order_every_thousand_in_phase_2() -> None:
    assert [Schedule(ScheduleConfig()).sh_degree(i) for i in (1, 999, 5000)] == [0, 0, 0]
    degrees = [in_phase_2(began=2000).sh_degree(i) for i in (2000, 2999, 3000, 4000, 5000, 9000)]
    assert degrees == [0, 0, 1, 2, 3, 3]


def test_state_noise_fades_in_phase_1_and_is_none_in_phase_2() -> None:
    config = ScheduleConfig(beta=0.3, sigma=2.0)
    assert [Schedule(config).state_noise(p) for p in (0.0, 0.25, 1.0)] == pytest.approx([0.6, 0.45, 0.0])
    assert in_phase_2(config).state_noise(0.25) == 0
    assert Schedule(ScheduleConfig(compensation="off")).state_noise(0.0) == 0


def test_frames_come_by_pose_in_phase_1_and_at_random_in_phase_2() -> None:
    order, rng = np.array([3, 1, 4, 0, 2, 5, 9, 7, 8, 6]), np.random.default_rng(0)
    for _ in range(10):
        assert Schedule(ScheduleConfig()).frames(order, rng) in (order.tolist(), order[::-1].tolist())
    epochs = [in_phase_2().frames(order, rng) for _ in range(10)]
    assert all(sorted(epoch) == list(range(10)) for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) == 10


def settle(schedule: Schedule, iterations: int, psnr: float = 25.0, total: int = 100_000) -> int | None:
    """The iteration at which phase 2 begins while the loss keeps falling."""
    for iteration in range(1, iterations + 1):
        schedule.observe(iteration, 1 / iteration, psnr, iteration / total)
        if schedule.phase == 2:
            return iteration
    return None


def test_phase_2_never_begins_before_iteration_1000() -> None:
    schedule = Schedule(ScheduleConfig())
    assert settle(schedule, 3000) == 1000
    assert not schedule.forced


def test_phase_2_waits_for_the_psnr_and_is_forced_at_forty_percent() -> None:
    schedule = Schedule(ScheduleConfig())
    assert settle(schedule, 5000, psnr=15.0, total=10_000) == 4000
    assert schedule.forced
    assert schedule.phase_started == 4000


def test_a_restored_schedule_goes_on_the_same() -> None:
    first, second = Schedule(ScheduleConfig()), Schedule(ScheduleConfig())
    settle(first, 700)
    second.load_state_dict(first.state_dict())
    for iteration in range(701, 1001):
        for schedule in (first, second):
            schedule.observe(iteration, 1 / iteration, 25.0, 0.1)
    assert first.state_dict() == second.state_dict()
    assert second.phase == 2


def test_poses_on_a_line_are_walked_from_end_to_end() -> None:
    places = np.random.default_rng(1).permutation(20).astype(float)
    walk = order_by_pose(np.stack([places, 2 * places, -places], 1))
    walked = places[walk].tolist()
    assert walked in (sorted(walked), sorted(walked, reverse=True))
    assert sorted(walk.tolist()) == list(range(20))


@pytest.mark.parametrize("batch_size", [1, 3])
def test_an_event_comes_once_by_share_or_by_iteration_in_the_order_of_the_schedule(batch_size, tmp_path, registered):
    """However many iterations a step has; one stated in iterations not at the end, where no step would follow."""
    acted: list[str] = []

    @registered
    class Acts(Static):
        method, actions = "acts", Kinematic.actions

        def act(self, training, action: str) -> None:
            acted.append(action)

    events = "[{at: 0.5, action: place_wrists}, {at: 0.1, action: fit_states}, {at: 0.1, action: find_shadow}"
    events += ", {at: 7, action: observe_silhouettes}, {at: 12, action: refine_wrists}]"
    config = training_config("acts", {"iterations": 12, "batch_size": batch_size}, [f"schedule.events={events}"])
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
