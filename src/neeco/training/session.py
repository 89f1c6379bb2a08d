"""Everything that changes while training, and how one step changes it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import mse_loss

from neeco.capture.model import Camera, Frame, State
from neeco.raster import Rendering, rasterize
from neeco.raster.devices import constant, tf32_products
from neeco.raster.losses import photometric_loss
from neeco.raster.optimizer import Adam
from neeco.scene.deformations.base import FINAL_RATE, UNPERTURBED, Perturbation, floored_decay, log_linear
from neeco.scene.scene import Scene
from neeco.scene.training_session import GaussianTraining, Report, StepResult, check_finite, numbers
from neeco.scene.training_views import TrainingViews
from neeco.training.config import TrainConfig
from neeco.training.density import BodyLimit, GradientStatistics, control_density, reset_opacity
from neeco.training.refinement import Refinement
from neeco.training.schedule import Schedule, due, order_by_pose

POSITION_RATE = 1.6e-4  # times the scene's extent (3DGS)
GAUSSIAN_RATES = {
    "quats": 1e-3,
    "log_scales": 5e-3,
    "opacity_logits": 5e-2,
    "sh_dc": 2.5e-3,
    "sh_rest": 1.25e-4,
}
LIGHT_RATE = 3e-3
SHADOW_RATES = {"shadow_offsets": 3e-2, "shadow_strengths": 2e-3, "shadow_width": 2e-5}  # mm, share, slope
REGISTRATION_RATES = (1e-4, 1e-4, 1e-4, 1e-2, 1e-2, 1e-2, 1e-4)  # rad, mm, log scale
SETTLE_INTERVAL = 200  # iterations between prunings, and between re-centrings of the refinement


@dataclass
class GaussianSession(GaussianTraining):
    """One training run in memory, of any method that deforms Gaussians. Its hooks are `Deformation`'s."""

    scene: Scene
    config: TrainConfig
    pose_order: np.ndarray
    extent: float  # mm; positions' learning rates and the dense size scale with it
    refinement: Refinement
    rng: np.random.Generator
    schedule: Schedule = field(init=False)
    given: list[tuple[State, Camera]] = field(init=False)  # of every frame, as recorded, on the views' device
    statistics: GradientStatistics = field(init=False)
    queue: list[int] = field(default_factory=list)
    queue_phase: int = 1

    def __post_init__(self) -> None:
        self.adam = Adam(self.batch_size)
        self.schedule = Schedule(self.config.schedule, self.config.iterations)
        device = self.views.device
        self.given = [(frame.state.to(device), frame.camera.to(device)) for frame in self.views.frames]

    def start(self) -> None:
        """Make ready to step, once the canonical Gaussians are there: what is learned a leaf, no gradient counted."""
        scene = self.scene
        self.statistics = GradientStatistics(len(scene.canonical), scene.center.device)
        scene.requires_grad_(True)
        scene.registration.requires_grad_(self.config.refine.registration)
        self.watch_gradients()

    def watch_gradients(self) -> None:
        """Make the canonical tensors leaves again after they were replaced."""
        for name, tensor in self.scene.canonical.tensors().items():
            tensor.requires_grad_(name == "means" or name in self.gaussian_rates)

    @property
    def gaussian_rates(self) -> dict[str, float]:
        """Adam's learning rate of every canonical tensor but the means, by name."""
        extras = self.scene.deformation.extra_rates
        return GAUSSIAN_RATES | {f"extras.{name}": rate for name, rate in extras.items()}

    @property
    def phase(self) -> int:
        """1 or 2 of the dynamic training adjustment."""
        return self.schedule.phase

    @property
    def forced(self) -> bool:
        """Whether phase 2 began because the run was late."""
        return self.schedule.forced

    def step(self) -> StepResult:
        """Draw `views_per_step` frames, compare, learn, and from time to time add and remove Gaussians.

        Iterations count frames. Of the device's numbers a step asks once, when all its work has been handed over.
        """
        views = self.batch_size
        self.iteration += views
        progress, scene = self.progress, self.scene
        scene.sh_degree = self.schedule.sh_degree(self.iteration)
        scene.deformation.warming_up = progress < scene.deformation.warm_up
        chosen = [self._next_frame() for _ in range(views)]
        asked: list[Tensor] = []
        for index, following in zip(chosen, [*chosen[1:], *self.queue[:1], None], strict=False):
            asked += self._learn_from(index, progress, following)
        self._update(progress)
        values = numbers(*asked)
        results = []
        for index, total, loss, squared_error in zip(chosen, values[::3], values[1::3], values[2::3], strict=True):
            check_finite(total, self.iteration, f", frame {self.views.frames[index].name}")
            results.append(StepResult.of(loss, squared_error))
            self.schedule.observe(self.iteration, loss, results[-1].psnr, progress)
        self._control_density(progress)
        return StepResult.mean(results)

    def _learn_from(self, index: int, progress: float, following: int | None) -> tuple[Tensor, Tensor, Tensor]:
        """Add one frame's share to all gradients; returns what it minimises, the image's loss and squared error."""
        scene, views = self.scene, self.batch_size
        state, camera, penalty = self.refinement.apply(index, *self.given[index], self.iteration)
        channels = scene.deformation.training_channels(scene.canonical, self.iteration)
        rendering = rasterize(scene.at(state, self._perturbation(progress)), camera, channels=channels)
        target, mask = self.views.target(index), self.views.mask(index)
        if following is not None:
            self.views.announce(following)
        loss = photometric_loss(rendering.color, target, mask, ssim_weight=self.config.ssim_weight)
        total = loss + self._regularisation(rendering, penalty)
        with tf32_products(self.views.device) if scene.deformation.large_operations else nullcontext():
            total.backward(torch.full_like(total, 1 / views))
        gradient = rendering.center_offsets.grad
        assert gradient is not None
        self.statistics.record(gradient, views * camera.width, views * camera.height)  # of the frame's own loss
        self.refinement.step(index, progress)
        return total, loss, _squared_error(rendering.color.detach(), target, mask)

    def corrected(self, index: int) -> tuple[State, Camera]:
        """The state and camera of training frame `index` as refined so far."""
        return self.refinement.apply(index, *self.given[index], self.iteration)[:2]

    def _next_frame(self) -> int:
        phase = self.schedule.phase
        if not self.queue or self.queue_phase != phase:
            self.queue = self.schedule.frames(self.pose_order, self.rng)
        self.queue_phase = phase
        return self.queue.pop(0)

    def _perturbation(self, progress: float) -> Perturbation:
        noise = self.schedule.state_noise(progress)
        given = Perturbation(noise) if noise else UNPERTURBED
        return self.scene.deformation.perturb(given, self.iteration, progress, self.rng)

    def _regularisation(self, rendering: Rendering, penalty: Tensor | None) -> Tensor | float:
        """Small corrections, and what the method adds of its own."""
        deformation = self.scene.deformation
        own = None
        if not deformation.warming_up:
            own = deformation.regularisation(self.scene.canonical, rendering, self.iteration)
        return sum(term for term in (penalty, own) if term is not None)

    def _update(self, progress: float) -> None:
        """One optimiser step on everything that has a gradient: of a shadow none until one was found."""
        scene, gaussian_rates = self.scene, self.gaussian_rates
        rates = gaussian_rates | {"means": POSITION_RATE * self.extent * log_linear(1.0, FINAL_RATE, progress)}
        learned = [(name, tensor, rates[name]) for name, tensor in scene.canonical.tensors().items() if name in rates]
        still = scene.deformation.warming_up or self.iteration < scene.deformation.start_iteration
        own_rates = scene.deformation.learning_rates(progress)
        for name, parameter in scene.deformation.named_parameters():
            if own_rates[name] > 0 and not still:
                learned.append((f"deformation.{name}", parameter, own_rates[name]))
            else:
                parameter.grad = None
        learned += [("falloff", scene.falloff, LIGHT_RATE), ("vignette", scene.vignette, LIGHT_RATE)]
        fall = floored_decay(progress)
        learned += [(name, getattr(scene, name), rate * fall) for name, rate in SHADOW_RATES.items()]
        self.adam.step(learned)
        self._learn_registration(progress)

    def _learn_registration(self, progress: float) -> None:
        """Adam on unit-free coordinates, so that radians and millimetres each move at their own rate."""
        registration = self.scene.registration
        if registration.grad is None:
            return
        if self.iteration < self.config.refine.start:
            registration.grad = None
            return
        with torch.no_grad():
            before = registration.detach().clone()
            self.adam.step([("registration", registration, 1.0)])
            change = registration.detach() - before
            rates = constant(REGISTRATION_RATES, change.device)
            registration.copy_(before + change * rates * floored_decay(progress))

    def _control_density(self, progress: float) -> None:
        settings, config, scene = self.schedule.density(), self.config, self.scene
        settles = self._due(SETTLE_INTERVAL)
        if settles:
            self.refinement.center()
        if self.iteration < self.schedule.scaled(config.density_start):
            return
        grows = self._due(settings.interval) and progress < config.density_stop
        if grows or (settles and progress < 0.95):
            scene.canonical = control_density(
                scene.canonical,
                self.adam,
                self.statistics,
                self._limits(),
                settings.threshold if grows else math.inf,
                self.generator,
                scene.deformation.prune_mask(scene.canonical, [camera for _, camera in self.given]),
            )
            self.statistics = GradientStatistics(len(scene.canonical), scene.center.device)
            self.watch_gradients()
        if settings.opacity_reset and self._due(settings.opacity_reset) and progress < config.density_stop:
            reset_opacity(scene.canonical, self.adam)

    def _due(self, interval: int) -> bool:
        """Whether this step reached a multiple of `interval` iterations."""
        return due(interval, self.iteration - self.batch_size, self.iteration)

    def _limits(self) -> list[BodyLimit]:
        dense = 0.01 * self.extent
        instruments = [BodyLimit(self.config.instrument_budget, dense)] * (len(self.scene.canonical.counts) - 1)
        return [BodyLimit(self.config.tissue_budget, dense), *instruments]

    def between_steps(self, before: float) -> None:
        """What the method has due."""
        self.scene.deformation.between_steps(self, before)

    def pack(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """What a checkpoint needs beside scene, optimiser and random numbers."""
        groups = {
            "refinement": self.refinement.tensors(),
            "statistics": {"total": self.statistics.total, "seen": self.statistics.seen},
        }
        tensors = {f"{group}/{name}": tensor for group, named in groups.items() for name, tensor in named.items()}
        return tensors, {
            "schedule": self.schedule.state_dict(),
            "rng": self.rng.bit_generator.state,
            "queue": self.queue,
            "queue_phase": self.queue_phase,
        }

    def restore(self, tensors: Mapping[str, Tensor], fields: Mapping[str, Any]) -> None:
        """The inverse of `pack`."""
        self.refinement.restore(members(tensors, "refinement"))
        self.statistics.total, self.statistics.seen = tensors["statistics/total"], tensors["statistics/seen"]
        self.schedule.load_state_dict(fields["schedule"])
        self.rng.bit_generator.state = fields["rng"]
        self.queue, self.queue_phase = fields["queue"], fields["queue_phase"]

    def finish(self) -> None:
        """Hold everything still, note how it was learned, and let the method find out the rest."""
        scene = self.scene
        scene.requires_grad_(False)
        for tensor in scene.canonical.tensors().values():
            tensor.requires_grad_(False)
        scene.diagnostics["iterations"] = self.iteration
        scene.diagnostics["phase_2_began"] = self.schedule.phase_started
        scene.diagnostics["phase_2_forced"] = self.schedule.forced
        scene.deformation.finish(self)
        scene.visibility()


def new_session(
    scene: Scene, views: TrainingViews, config: TrainConfig, report: Report = lambda text: None
) -> GaussianSession:
    """A session at iteration 0, on the device of the views; `start` it before the first step."""
    names = tuple(instrument.name for instrument in scene.instruments)
    return GaussianSession(
        scene,
        config.length,
        torch.Generator(views.device).manual_seed(config.seed),
        views,
        report,
        config.views_per_step,
        config,
        pose_order(views.frames, names),
        scene_extent(views.frames, scene.center.cpu()),
        Refinement(config.refine, views.frames, names, views.device),
        np.random.default_rng(config.seed),
    )


def scene_extent(frames: tuple[Frame, ...], center: Tensor) -> float:
    """Half the median distance from the cameras to the scene's middle, mm: scales the positions' learning rate."""
    distances = [float((frame.camera.world_from_camera[:3, 3].float() - center).norm()) for frame in frames]
    return 0.5 * float(np.median(distances))


def pose_order(frames: tuple[Frame, ...], instruments: tuple[str, ...]) -> np.ndarray:
    """Frames in the order of a walk through instrument positions and directions (see `order_by_pose`)."""
    if not instruments:
        return np.arange(len(frames))
    rows = [
        np.concatenate([frame.state.instruments[name].pose[:3, 1:].double().numpy().ravel() for name in instruments])
        for frame in frames
    ]
    return order_by_pose(np.stack(rows))


def members(tensors: Mapping[str, Tensor], group: str) -> dict[str, Tensor]:
    """The tensors called GROUP/NAME, by NAME."""
    return {key.removeprefix(f"{group}/"): t for key, t in tensors.items() if key.startswith(f"{group}/")}


def _squared_error(image: Tensor, target: Tensor, mask: Tensor | None) -> Tensor:
    if mask is None:
        return mse_loss(image, target)
    squared = (image - target).square()  # [H, W, 3]
    return (squared * mask[..., None]).sum() / (3 * mask.sum()).clamp_min(1)
