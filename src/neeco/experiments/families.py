"""The methods that `neeco ablate` takes parts away from, and what differs in how their runs are made and read."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from neeco.scene.deformations.nps import WARM_UP
from neeco.training.config import LOG_INTERVAL, TrainConfig
from neeco.training.schedule import MIN_RESET_INTERVAL

PUBLISHED_STEPS = 20_000
PHASE_1_STEPS = 8_000
PHASE_1_SHARE = PHASE_1_STEPS / PUBLISHED_STEPS
REST_STEPS = 100  # of the network, where its usual share of a short run is less: an empty image throws it out of sight
LONGEST_REST = 0.25  # of the run
INITIAL_SHARE = 0.25  # of the tissue's budget: density control can only differ where it has room to grow
KINEMATIC_LEAST = 1_000  # its shaft starts to spin and its hinges to learn after 600


@dataclass(frozen=True)
class Family:
    """A method with parts to take away. What is common to its runs: `settings` as for `--set`, and how they start."""

    method: str
    settings: Callable[[int], tuple[str, ...]]  # for a run of so many iterations
    started: Callable[[TrainConfig], TrainConfig]  # what depends on other settings, where the user left it open
    shortcomings: Callable[[int], list[str]]  # what runs of so many steps are too short to show, in words
    least_steps: int = 1  # unless the user asks for fewer
    phased: bool = False  # trained in phases: how good it was in the first and on the way is told


def _paper_settings(iterations: int) -> tuple[str, ...]:
    """The paper's schedule is stated for its own 20,000 steps and scaled to the run. The network rests for its usual
    share of the run or REST_STEPS, whichever is longer."""
    rest = max(WARM_UP, min(LONGEST_REST, REST_STEPS / iterations))
    return (
        f"schedule.published_steps={PUBLISHED_STEPS}",
        f"schedule.earliest={PHASE_1_STEPS}",
        f"deformation.warm_up={round(rest, 4)}",
    )


def _with_room(config: TrainConfig) -> TrainConfig:
    """With INITIAL_SHARE of the tissue's budget: were it full of sparse points, density control could do nothing."""
    if config.initial_points is not None:
        return config
    return replace(config, initial_points=max(1, round(INITIAL_SHARE * config.max_tissue_gaussians)))


def _missing_phases(steps: int) -> list[str]:
    told = []
    if PHASE_1_SHARE * steps < LOG_INTERVAL:
        told.append(
            f"phase-1 PSNR: not known, phase 1 of {steps} steps ends before the first row of metrics.jsonl "
            f"({LOG_INTERVAL} steps); give --iterations {math.ceil(LOG_INTERVAL / PHASE_1_SHARE)} or more"
        )
    if TrainConfig().density_stop * steps <= MIN_RESET_INTERVAL:
        told.append(
            f"opacity reset: none comes in {steps} steps (intervals do not scale below {MIN_RESET_INTERVAL}, and density "
            "control ends half-way), so P_oi changes nothing here"
        )
    return told


def _missing_motion(steps: int) -> list[str]:
    if steps >= KINEMATIC_LEAST:
        return []
    return [
        f"kinematic: {steps} steps are few: hinges begin to learn and the shaft to spin after 600, labels to "
        f"sharpen after 1,000; give --kinematic-iterations {KINEMATIC_LEAST} or more"
    ]


NEECO_RUNS = Family("neeco", _paper_settings, _with_room, _missing_phases, phased=True)
KINEMATIC_RUNS = Family(
    "kinematic", lambda steps: (), lambda config: config, _missing_motion, least_steps=KINEMATIC_LEAST
)
