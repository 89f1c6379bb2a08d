"""The paper's dynamic training adjustment: four settings that switch together when the scene has settled.

Phase 1 learns the coarse motion: sparse densification, low SH order, frames sorted by instrument pose, noise on the
encoded state. Phase 2 refines. Each part can be turned off (3DGS's behaviour) or inverted (phases swapped), as in the
paper's ablations; density control has three separate parts: interval, opacity reset and gradient threshold.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np

Part = Literal["on", "off", "inverse"]


@dataclass(frozen=True)
class DensityPhase:
    """Settings of density control in one phase."""

    interval: int  # iterations between its actions
    opacity_reset: int  # iterations between opacity resets; 0: none
    threshold: float  # NDC, of mean image-space gradients above which Gaussians grow


@dataclass(frozen=True)
class Event:
    """An action of the method between two steps of the run."""

    at: float  # share of the run; above 1: iteration
    action: str  # one of the method's `actions`

    def passed(self, progress: tuple[float, float], iterations: tuple[int, int]) -> bool:
        """Return whether the event is after the first and not after the second of two `progress` (shares of the run) or
        `iterations`; at the end of a run, where no step follows, only shares count."""
        before, now = progress if self.at <= 1 else iterations
        return before < self.at <= now and (self.at <= 1 or progress[1] < 1)


# Iterations. Opacity, at its learning rate, is back about 150 steps after a reset. Rates do not scale with the run's
# length, so neither does that: with resets closer than twice this, the scene would stay transparent and never show the
# instrument.
MIN_RESET_INTERVAL = 300


@dataclass(frozen=True, kw_only=True)
class ScheduleConfig:
    """Parts of the adjustment, and choices that the paper leaves open."""

    density_interval: Part = "on"  # the paper's P_di
    opacity_reset: Part = "on"  # P_oi
    gradient_threshold: Part = "on"  # tau
    sh_order: Part = "on"
    frame_order: Part = "on"
    compensation: Part = "on"
    beta: float = 0.3  # the paper's strength of the compensation noise
    sigma: float = 1.0  # standard deviation of its normal variable
    psnr_threshold: float = 20.0
    window: int = 200  # iterations in the moving averages
    earliest: int = 1_000
    latest_fraction: float = 0.4  # share of the run after which phase 2 is forced
    sh_interval: int = 1_000  # iterations between SH orders in phase 2
    max_sh_degree: int = 3
    plain_density: DensityPhase = DensityPhase(100, 3_000, 2e-4)  # 3DGS's, for parts of density control that are off
    phase_1: DensityPhase = DensityPhase(500, 10_000, 4e-4)
    phase_2: DensityPhase = DensityPhase(200, 3_000, 2e-4)
    events: tuple[Event, ...] = ()  # actions of the method between steps; simultaneous ones in this order
    # Numbers of iterations here and in TrainConfig.density_start are stated for a run of so many steps and scale with
    # the run's length; None: they stand as they are, however short the run.
    published_steps: int | None = None


class Schedule:
    """Settings at each iteration of a run of `iterations` steps. Call `observe` after every step."""

    def __init__(self, config: ScheduleConfig, iterations: int | None = None) -> None:
        if config.published_steps is not None and iterations is None:
            raise ValueError("a schedule stated for another number of steps needs the run's own")
        self.config = config
        self.scale = 1.0 if config.published_steps is None else (iterations or 0) / config.published_steps
        self.window = self.scaled(config.window)
        self.phase = 1
        self.phase_started = 0
        self.forced = False
        self.history: deque[tuple[float, float]] = deque(maxlen=2 * self.window)

    def scaled(self, iterations: int) -> int:
        """Scale a number of iterations of the published run to this run; at least 1, but 0 stays 0."""
        return max(1, round(iterations * self.scale)) if iterations else 0

    def observe(self, iteration: int, loss: float, psnr: float, progress: float) -> None:
        """Record one step's loss and PSNR; `progress` in [0, 1] of the run. May start phase 2."""
        self.history.append((loss, psnr))
        if self.phase == 2:
            return
        ready, window = False, self.window
        if iteration >= self.scaled(self.config.earliest) and len(self.history) == 2 * window:
            # PSNR's moving average is above the threshold and the loss fell between two windows
            values = np.array(self.history)
            loss_before, loss_now = values[:window, 0].mean(), values[window:, 0].mean()
            ready = bool(values[window:, 1].mean() > self.config.psnr_threshold and loss_now < loss_before)
        late = progress >= self.config.latest_fraction
        if ready or late:
            self.phase, self.phase_started, self.forced = 2, iteration, not ready

    def _acting_phase(self, part: Part) -> int:
        """Return the phase whose settings of `part` apply; 0: off, as in 3DGS."""
        return {"off": 0, "on": self.phase, "inverse": 3 - self.phase}[part]

    def density(self) -> DensityPhase:
        """Return the current density settings, in iterations of this run."""
        config = self.config
        resets = self._density_of(config.opacity_reset).opacity_reset
        return DensityPhase(
            self.scaled(self._density_of(config.density_interval).interval),
            # but at least MIN_RESET_INTERVAL, or the published value if smaller
            max(self.scaled(resets), min(resets, MIN_RESET_INTERVAL)),
            self._density_of(config.gradient_threshold).threshold,
        )

    def _density_of(self, part: Part) -> DensityPhase:
        return (self.config.plain_density, self.config.phase_1, self.config.phase_2)[self._acting_phase(part)]

    def sh_degree(self, iteration: int) -> int:
        """Return the SH order: 0 in phase 1, then one more every `sh_interval`; from the start if off (3DGS)."""
        config, acting = self.config, self._acting_phase(self.config.sh_order)
        if acting == 1:
            return 0
        since = self.phase_started if acting else 0
        return min(config.max_sh_degree, (iteration - since) // self.scaled(config.sh_interval))

    def state_noise(self, progress: float) -> float:
        """Return the standard deviation of the compensation Delta = N(0, sigma^2) * beta * t_phase, where t_phase falls
        from 1 to 0 within its phase."""
        config = self.config
        if self._acting_phase(config.compensation) != 1:
            return 0.0
        return config.sigma * config.beta * max(0.0, 1.0 - progress)

    def frames(self, pose_order: np.ndarray, rng: np.random.Generator) -> list[int]:
        """Return one epoch of frame indices: sorted by instrument pose (in either direction), or at random."""
        if self._acting_phase(self.config.frame_order) == 1:
            return list(map(int, pose_order if rng.random() < 0.5 else pose_order[::-1]))
        return list(map(int, rng.permutation(len(pose_order))))

    def state_dict(self) -> dict[str, object]:
        """Return a JSON-able state that restores an interrupted run exactly."""
        return {
            "phase": self.phase,
            "phase_started": self.phase_started,
            "forced": self.forced,
            "history": [list(pair) for pair in self.history],
        }

    def load_state_dict(self, state: dict) -> None:
        """Restore what `state_dict` returned."""
        self.phase, self.phase_started, self.forced = state["phase"], state["phase_started"], state["forced"]
        self.history = deque((tuple(pair) for pair in state["history"]), maxlen=2 * self.window)


def due(interval: int, before: int, now: int) -> bool:
    """Return whether a multiple of `interval` iterations was reached after iteration `before`."""
    return now // interval > before // interval


def order_by_pose(states: np.ndarray) -> np.ndarray:
    """Return indices [F] of a walk through states [F, S] that steps to the nearest unvisited one (the paper's uniform
    motion).

    Starts at the state of smallest first principal coordinate, so that the walk sweeps the range once.
    """
    if states.shape[1] == 0 or len(states) < 3:
        return np.arange(len(states))
    centred = (states - states.mean(0)) / (states.std(0) + 1e-9)
    _, _, directions = np.linalg.svd(centred, full_matrices=False)
    current = int((centred @ directions[0]).argmin())
    unvisited = np.ones(len(states), bool)
    walk = []
    for _ in range(len(states)):
        walk.append(current)
        unvisited[current] = False
        if unvisited.any():
            distance = ((centred - centred[current]) ** 2).sum(1)
            distance[~unvisited] = np.inf
            current = int(distance.argmin())
    return np.array(walk)
