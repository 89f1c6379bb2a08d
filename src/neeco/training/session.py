"""The training session of methods that deform Gaussians: the state of a run in memory, and one step of it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import mse_loss

from neeco.capture.model import Camera, State
from neeco.evidence.foreground import Comparison, Foreground
from neeco.evidence.label_quality import LABEL_QUALITY, QUALITY, label_counts, quality_of
from neeco.raster import rasterize
from neeco.raster.devices import constant, tf32_products
from neeco.raster.losses import photometric_loss
from neeco.raster.optimizer import Adam
from neeco.scene.deformation import DEFORMATION, Perturbation, floored_decay, log_linear
from neeco.scene.gaussian_scene import GaussianScene
from neeco.scene.training_session import Report, Session, StepResult, check_finite, members, numbers
from neeco.scene.training_views import TrainingViews
from neeco.states.prediction import predict_corrections
from neeco.states.refinement import Refinement
from neeco.training.config import TrainConfig
from neeco.training.density import GradientStatistics, control_density, reset_opacity
from neeco.training.resolution import Resolution
from neeco.training.schedule import Schedule, due, order_by_pose
from neeco.training.silhouettes import Silhouettes


class GaussianSession(Session):
    """One training run of any method that deforms Gaussians, at iteration 0 and on the device of the views; `start` it
    before the first step. Its hooks are `Deformation`'s."""

    scene: GaussianScene

    def __init__(
        self, scene: GaussianScene, views: TrainingViews, config: TrainConfig, report: Report = lambda text: None
    ) -> None:
        super().__init__(scene, config.length, torch.Generator(views.device).manual_seed(config.seed))
        self.config, self.report = config, report
        self.batch_size = config.batch_size  # frames per step
        self.timed = True  # `State.time` is in seconds
        self.full_views = views  # at full size; `views` are the current ones, of the size `scale`
        self.resolution = Resolution(config.resolution, views)
        self.limits = config.gaussian_limits(self.resolution.pixels)  # Gaussians of the tissue, and of each instrument
        self.recorded = scene.recorded  # as it was before training
        self.adam = Adam(self.batch_size)
        self.refinement = Refinement(config.refine, views.frames, scene.instruments, views.device)
        self.schedule = Schedule(config.schedule, config.iterations)
        states = [frame.state.instruments for frame in views.frames]
        tracked = [[of[item.name].pose[:3, 1:].double().numpy() for item in scene.instruments] for of in states]
        self.pose_order = order_by_pose(np.reshape(tracked, (len(states), -1)))  # by positions and directions
        self.rng = np.random.default_rng(config.seed)
        self.silhouettes: Silhouettes | None = None  # of the instruments, once a method has observed them
        self.queue: list[int] = []
        self.queue_phase = 1
        self._use_views(views, 1.0)

    @cached_property
    def extent(self) -> float:
        """Half the median distance of the cameras from the scene, mm: unit of the positions' learning rate and the
        dense size."""
        center = self.scene.center.cpu()
        poses = [frame.camera.world_from_camera for frame in self.full_views.frames]
        return 0.5 * float(np.median([float((pose[:3, 3].float() - center).norm()) for pose in poses]))

    def _use_views(self, views: TrainingViews, scale: float) -> None:
        """Render and compare with these views from now on, whose images are scaled by `scale`."""
        self.views, self.scale = views, scale
        # state and camera of every frame as recorded
        self.given = [(frame.state.to(views.device), frame.camera.to(views.device)) for frame in views.frames]

    @contextmanager
    def searching(self, as_learned: bool = False) -> Iterator[None]:
        """Set `views` to the size for searches of instruments, joints and shadows within the block.

        as_learned: at most the current size, as detail that the scene lacks would hide what is searched.
        """
        views, scale = self.views, self.scale
        if not (as_learned and scale < self.resolution.search_scale):
            self._use_views(self.search_views, self.resolution.search_scale)
        try:
            yield
        finally:
            self._use_views(views, scale)

    @cached_property
    def search_views(self) -> TrainingViews:
        """Return the views at search size; cached, as a run searches about ten times."""
        return self.full_views.scaled(self.resolution.search_scale)

    def start(self) -> None:
        """Make the scene's tensors leaves of autograd and clear the statistics, once the canonical Gaussians exist."""
        scene = self.scene
        scene.requires_grad_(True)
        scene.registration.requires_grad_(self.config.refine.registration)
        scene.base_corrections.requires_grad_(False)  # estimated before the first step: gradients hardly change them
        self.begin_statistics()

    def begin_statistics(self) -> None:
        """Make the canonical tensors leaves of autograd and clear the statistics, after they were replaced."""
        self.statistics = GradientStatistics(len(self.scene.canonical), self.scene.center.device)
        for name, tensor in self.scene.canonical.tensors().items():
            tensor.requires_grad_(name == "means" or name in self.gaussian_rates)

    @property
    def gaussian_rates(self) -> dict[str, float]:
        """Adam's learning rates of the canonical tensors except the means, by name."""
        optimizer, extras = self.config.optimizer, self.scene.deformation.extra_rates
        return {
            "quats": optimizer.rotation_rate,
            "log_scales": optimizer.scale_rate,
            "opacity_logits": optimizer.opacity_rate,
            "sh_dc": optimizer.color_rate,
            "sh_rest": optimizer.sh_rate,
        } | {f"extras.{name}": rate for name, rate in extras.items()}

    @property
    def phase(self) -> int:
        return self.schedule.phase

    @property
    def forced(self) -> bool:
        return self.schedule.forced

    def step(self) -> StepResult:
        """Render `batch_size` frames, minimise their mean loss, and control density when due.

        Iterations count frames. A step reads numbers from the device once, after all its work is queued.
        """
        views = self.batch_size
        self.iteration += views
        progress, scene = self.progress, self.scene
        if (scale := self.resolution.scale(progress)) != self.scale:
            self._use_views(self.full_views.scaled(scale), scale)
        scene.sh_degree = self.schedule.sh_degree(self.iteration)
        scene.deformation.warming_up = progress < scene.deformation.warm_up
        chosen = []
        for _ in range(views):
            if not self.queue or self.queue_phase != self.phase:
                self.queue = self.schedule.frames(self.pose_order, self.rng)
            self.queue_phase = self.phase
            chosen.append(self.queue.pop(0))
        terms: list[Tensor] = []
        for index, following in zip(chosen, [*chosen[1:], *self.queue[:1], None], strict=False):
            terms += self._accumulate(index, progress, following)
        self._update(progress)
        values = numbers(*terms)
        results = []
        for index, total, loss, squared_error in zip(chosen, values[::3], values[1::3], values[2::3], strict=True):
            for value in (total, squared_error):
                check_finite(value, self.iteration, f", frame {self.views.frames[index].name}")
            results.append(StepResult.of(loss, squared_error))
            self.schedule.observe(self.iteration, loss, results[-1].psnr, progress)
        self._control_density(progress)
        return StepResult.mean(results)

    def _accumulate(self, index: int, progress: float, following: int | None) -> tuple[Tensor, Tensor, Tensor]:
        """Accumulate one frame's share of all gradients; return minimised total, image loss and squared error.

        The pixels of the `following` frame are prefetched.
        """
        scene, views = self.scene, self.batch_size
        state, camera, penalty = self.refinement.apply(index, *self.given[index], self.iteration)
        channels = scene.deformation.training_channels(scene.canonical, self.iteration)
        if channels is None and self.silhouettes is not None:
            channels = scene.canonical.of_instruments.to(scene.canonical.means.dtype)[:, None]
        noise = Perturbation(self.schedule.state_noise(progress))
        perturbation = scene.deformation.perturb(noise, self.iteration, progress, self.rng)
        rendering = rasterize(scene.at(state, perturbation), camera, channels=channels)
        target, mask = self.views.target(index), self.views.mask(index)
        if following is not None:
            self.views.prefetch(following)
        loss = photometric_loss(rendering.color, target, mask, ssim_weight=self.config.ssim_weight)
        fitted = loss
        if self.silhouettes is not None:
            assert rendering.channels is not None
            fitted = loss + self.silhouettes.loss(index, rendering.channels[..., 0])
        weight = trust_of(self.given[index][0]) * float(self.refinement.counts(index))
        own = None
        if not scene.deformation.warming_up:
            own = scene.deformation.regularisation(scene.canonical, rendering, self.iteration)
        total = weight * fitted + sum(term for term in (penalty, own) if term is not None)
        with tf32_products(self.views.device) if scene.deformation.large_operations else nullcontext():
            (total / views).backward()  # passing a gradient would make torch import sympy: 2 s per training
        gradient = rendering.center_offsets.grad
        assert gradient is not None
        self.statistics.record(gradient, views * camera.width, views * camera.height)  # of the frame's own loss
        self.refinement.step(index, progress)
        image = rendering.color.detach()  # [H, W, 3]
        if mask is None:
            return total, loss, mse_loss(image, target)
        return total, loss, ((image - target).square() * mask[..., None]).sum() / (3 * mask.sum()).clamp_min(1)

    def corrected(self, index: int) -> tuple[State, Camera]:
        """Return the state and camera of training frame `index` as refined so far."""
        return self.refinement.apply(index, *self.given[index], self.iteration)[:2]

    def compared(self, index: int) -> Comparison:
        """Return the comparison of training frame `index` with the scene as learned and refined so far."""
        return Comparison.of(self.scene, *self.corrected(index), self.views.target(index), self.views.mask(index))

    def frames_along_poses(self, count: int) -> list[int]:
        """Return indices of at most `count` training frames, evenly spaced in the order of poses."""
        order = self.pose_order
        # float32, rounded down: other roundings would select other frames and change runs
        return [int(order[int(place)]) for place in torch.linspace(0, len(order) - 1, min(count, len(order)))]

    def _update(self, progress: float) -> None:
        """Take an optimiser step on everything that has a gradient; shadows have none before one is detected."""
        scene, optimizer = self.scene, self.config.optimizer
        # by progress alone, positions would be stiff before there is detail to fit
        done = self.resolution.rendered_share(progress)
        position_rate = optimizer.position_rate * self.extent * log_linear(1.0, DEFORMATION.final_rate, done)
        rates = self.gaussian_rates | {"means": position_rate}
        learned = [(name, tensor, rates[name]) for name, tensor in scene.canonical.tensors().items() if name in rates]
        still = scene.deformation.warming_up or self.iteration < scene.deformation.start_iteration
        own_rates = scene.deformation.learning_rates(progress)
        for name, parameter in scene.deformation.named_parameters():
            if own_rates[name] > 0 and not still:
                learned.append((f"deformation.{name}", parameter, own_rates[name]))
            else:
                parameter.grad = None
        decay = floored_decay(progress)
        learned += [
            ("falloff", scene.falloff, optimizer.light_rate),
            ("vignette", scene.vignette, optimizer.light_rate),
            ("shadow_offsets", scene.shadow_offsets, optimizer.shadow_offset_rate * decay),
            ("shadow_strengths", scene.shadow_strengths, optimizer.shadow_strength_rate * decay),
            ("shadow_width", scene.shadow_width, optimizer.shadow_width_rate * decay),
        ]
        self.adam.step(learned)
        self._update_registration(progress)

    def _update_registration(self, progress: float) -> None:
        """Adam on unit-free coordinates, so that radians and millimetres each move at their own rate."""
        registration = self.scene.registration
        if registration.grad is None:
            return
        refine = self.config.refine
        if self.iteration < refine.start:
            registration.grad = None
            return
        rotation, translation = refine.registration_rotation_rate, refine.registration_translation_rate
        rates = (rotation,) * 3 + (translation,) * 3 + (refine.registration_scale_rate,)
        with torch.no_grad():
            before = registration.detach().clone()
            self.adam.step([("registration", registration, 1.0)])
            change = registration.detach() - before
            registration.copy_(before + change * constant(rates, change.device) * floored_decay(progress))

    def _control_density(self, progress: float) -> None:
        settings, config, scene = self.schedule.density(), self.config, self.scene
        reached = partial(due, before=self.iteration - self.batch_size, now=self.iteration)
        prunes = reached(config.density.prune_interval)
        if prunes:
            self.refinement.center()
        if self.iteration < self.schedule.scaled(config.density_start):
            return
        grows = reached(settings.interval) and progress < config.growth_stop
        if grows or (prunes and progress < config.density.prune_stop):
            instruments = len(scene.canonical.counts) - 1
            tissue, instrument = self.limits
            limits = [self.resolution.limit_at(progress, limit) for limit in (tissue, *[instrument] * instruments)]
            scene.canonical = control_density(
                scene.canonical,
                self.adam,
                self.statistics,
                max_gaussians=limits,
                dense_size=config.density.dense_size * self.extent,
                threshold=self.resolution.threshold_at(progress, settings.threshold) if grows else math.inf,
                generator=self.generator,
                config=config.density,
                unsupported=scene.deformation.prune_mask(scene.canonical, [camera for _, camera in self.given]),
            )
            self.begin_statistics()
        if settings.opacity_reset and reached(settings.opacity_reset) and progress < config.growth_stop:
            reset_opacity(scene.canonical, self.adam, config.density.reset_opacity)

    def between_steps(self, before: float) -> None:
        """Run the method's own hook, then the events of the schedule that the last step passed."""
        deformation = self.scene.deformation
        deformation.between_steps(self)
        progress, iterations = (before, self.progress), (self.iteration - self.batch_size, self.iteration)
        for event in self.config.schedule.events:
            if event.passed(progress, iterations):
                deformation.act(self, event.action)

    def pack(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return what a checkpoint needs besides scene, optimiser and random numbers."""
        statistics = {"statistics/total": self.statistics.total, "statistics/seen": self.statistics.seen}
        refinement = {f"refinement/{name}": tensor for name, tensor in self.refinement.tensors().items()}
        observed = {} if self.silhouettes is None else self.silhouettes.tensors()
        silhouettes = {f"silhouettes/{name}": tensor for name, tensor in observed.items()}
        return refinement | statistics | silhouettes, {
            "schedule": self.schedule.state_dict(),
            "rng": self.rng.bit_generator.state,
            "queue": self.queue,
            "queue_phase": self.queue_phase,
        }

    def restore(self, tensors: Mapping[str, Tensor], fields: Mapping[str, Any]) -> None:
        """Restore what `pack` returned."""
        self.refinement.restore(members(tensors, "refinement"))
        observed = members(tensors, "silhouettes")
        self.silhouettes = Silhouettes.of_tensors(observed) if observed else None
        self.statistics.total, self.statistics.seen = tensors["statistics/total"], tensors["statistics/seen"]
        self.schedule.load_state_dict(fields["schedule"])
        self.rng.bit_generator.state = fields["rng"]
        self.queue, self.queue_phase = fields["queue"], fields["queue_phase"]

    def training_states(self) -> dict[str, Any]:
        states = map(self.scene.state_corrections.corrected, self.recorded.states)
        return self.refinement.to_json(replace(self.recorded, states=tuple(states)))

    def _predict_states(self) -> None:
        """Correct new states by what predicts the training frames' corrections, and report it."""
        parts = predict_corrections(self.scene.state_corrections, self.refinement, self.views.frames)
        self.scene.diagnostics["state_errors"] = {
            part: {"explained": round(item.explained, 4), "corrected": item.applied} for part, item in parts.items()
        }
        for part, item in parts.items():
            if item.applied:
                self.report(
                    f"{part}: similar recorded states have similar errors ({item.explained:.0%} of their variance is "
                    "predicted from other frames), so new states are corrected, too"
                )

    def finish(self) -> None:
        """Freeze the scene, record diagnostics of the run, and run the method's own hook."""
        scene = self.scene
        scene.requires_grad_(False)
        for tensor in scene.canonical.tensors().values():
            tensor.requires_grad_(False)
        scene.diagnostics["iterations"] = self.iteration
        if scene.recorded.still:
            places = {tuple(camera.world_from_camera.flatten().tolist()) for camera in scene.recorded.cameras}
            depth = "measured with a second camera" if len(places) > 1 else "not measured: no view shows it"
            scene.diagnostics["still_scope"] = f"the tissue's depth is {depth}; render views near the recorded ones"
        scene.diagnostics["phase_2_began"] = self.schedule.phase_started
        scene.diagnostics["phase_2_forced"] = self.schedule.forced
        shares = self.refinement.prior_shares()  # before predicted parts are subtracted from the corrections
        self._predict_states()
        self.refinement.scale_deviations(shares)
        scene.deformation.finish(self)
        if scene.instruments:
            self._judge_labels()
        scene.visibility()

    @torch.no_grad()
    def _judge_labels(self) -> None:
        """Record the share of instrument pixels in training images that are labelled."""
        views = [self.compared(index) for index in self.frames_along_poses(QUALITY.n_views)]
        foreground = Foreground.learned(views)
        if foreground is None:
            return
        quality = quality_of([label_counts(view, foreground) for view in views])
        if quality is not None:
            self.scene.diagnostics[LABEL_QUALITY] = quality.as_json()


def trust_of(state: State) -> float:
    """Return the weight of a frame in the loss: the minimum trust of its states, 1 for recorded ones."""
    return min((1.0 if item.trust is None else item.trust for item in state.instruments.values()), default=1.0)
