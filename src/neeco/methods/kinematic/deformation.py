"""Method `kinematic`: rigid links on joints. `Kinematic.pose` maps poses and joints to posed Gaussians.

Tissue is static, or moves with the breath where that was found. Each instrument's Gaussians live in its own tracked
frame and move rigidly with its pose; joints move links about axes that are learned from the images, with soft
assignment of Gaussians to links.

The method in order: settings; `EVENTS`, what is searched or fitted between steps, and when; `Kinematic` with the hooks
of training: `begin` (what is searched before the first step), `pose`, the losses, `act` (an event) and `finish`; then
silhouettes and the states of the training frames.

States of the training frames are unknowns of their true size. A tracker's errors are corrected by gradients alone
(`Refinement`). Where a sample of frames shows larger ones, the prior on corrections is as wide, events fit every
frame's state, and the instruments' shapes are carved anew from the fitted states: what wrong states taught is
forgotten.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from neeco.capture.kinematics import KinematicTree
from neeco.capture.model import Instrument, State, evenly_spaced
from neeco.evidence.carving import CarvingSettings
from neeco.evidence.foreground import SETTINGS, Foreground
from neeco.geometry.camera import Camera
from neeco.methods.breathing import RATES as BREATHING_RATES
from neeco.methods.breathing import BreathingTissue
from neeco.methods.kinematic.articulation import LINK_LOGITS, ArticulatedInstruments, Articulation
from neeco.methods.kinematic.discovery import carve_again, find_instruments
from neeco.methods.kinematic.finish import conclude
from neeco.methods.kinematic.hinges import Hinges, hinge_joints
from neeco.methods.kinematic.lamp_search import find_shadow
from neeco.methods.kinematic.wrist import Spin, place_wrists, refine_wrists
from neeco.raster.articulated import ArticulatedBody, pose_bodies
from neeco.raster.types import Rendering
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.deformation import (
    UNPERTURBED,
    Deformation,
    Deltas,
    Perturbation,
    Posed,
    floored_decay,
    state_of,
)
from neeco.scene.drawable import ArticulatedMotion, Skeleton
from neeco.scene.method import PLAIN_TRAINING
from neeco.scene.training_session import Report
from neeco.scene.visibility import extrapolate_tissue, outside_all_views
from neeco.states.contradictions import (
    Misfits,
    describe_contradictions,
    fitted_anew,
    judge_again,
    leave_out_unexplained,
    refit_outliers,
)
from neeco.states.refinement import Verdict
from neeco.states.search import SEARCH, StateSearch
from neeco.training.schedule import Event
from neeco.training.session import GaussianSession
from neeco.training.silhouettes import INSTRUMENT, SILHOUETTES, UNKNOWN, Silhouettes

PRIOR_WEIGHT = 1e-5  # weight of the priors on stated kinematics, which are squared deviations over variances


@dataclass(frozen=True, kw_only=True)
class KinematicSettings:
    """Settings of the method."""

    shaft_roll: float = 0.5  # probability of spinning the shaft (a surface of revolution) by a random angle
    shaft_roll_start: int = 600  # iteration from which it is spun
    opacity_penalty: float = 0.002  # weight of the instruments' mean opacity
    opacity_penalty_stop: int = 1500  # iteration after which that weight drops to a tenth
    label_sharpness: float = 0.02  # weight of l (1 - l) on the rendered instrument label
    label_sharpness_start: int = 1000  # iteration from which it is added
    hinge_start: int = 600  # iteration from which hinges are learned; unformed Gaussians would displace them
    rate_scale: float = 1.0  # factor on the learning rates of hinges
    refine_wrists: bool = True  # whether wrist positions are estimated again at 60 and 80 % of the run
    # whether the instruments' shadow on the tissue is looked for and rendered (see `neeco.raster.shadow`)
    shadow: bool = True
    # whether tissue is extrapolated smoothly beyond what frames observed (see `neeco.scene.visibility`)
    extrapolate_tissue: bool = True
    # whether a period is looked for with which the tissue moves, and its motion learned (see `neeco.methods.breathing`)
    breathing: bool = True
    # whether joints move as the capture's kinematics state, where they do; else as found from the images
    kinematics: bool = True
    stated_axes: bool = True  # whether the axes stated there are corrected
    stated_readings: bool = True  # whether offsets and gains of the readings of joints stated there are corrected
    carving: CarvingSettings = field(default_factory=CarvingSettings)  # of the search for instruments


EVENTS = (
    Event(0.1, "observe_silhouettes"),
    Event(0.12, "judge_states"),  # before the scene has learned from wrong states
    Event(0.2, "fit_states"),
    Event(0.2, "carve_from_states"),
    Event(0.32, "observe_silhouettes"),
    Event(0.32, "size_states"),  # the learned tissue reveals more errors by now
    Event(0.32, "fit_states"),
    Event(0.32, "carve_from_states"),
    Event(0.4, "find_shadow"),
    Event(0.4, "place_wrists"),  # shapes have formed, and enough steps remain
    Event(0.45, "judge_states_again"),
    Event(0.45, "fit_states"),
    Event(0.45, "carve_from_states"),
    Event(0.6, "find_shadow"),
    Event(0.6, "observe_silhouettes"),
    Event(0.6, "fit_states"),
    Event(0.6, "refine_wrists"),
    Event(0.75, "fit_states"),
    Event(0.8, "find_shadow"),
    Event(0.8, "refine_wrists"),
    Event(0.9, "conclude_states"),
    # iterations rather than shares: instruments have a shape by then, but no shadow has been learned as part of them
    Event(1000, "find_shadow"),
    Event(1500, "find_shadow"),
)


class Kinematic(BreathingTissue, ArticulatedInstruments, Deformation):
    """Articulated instruments over static or breathing tissue.

    Bodies of the canonical set: 0 tissue (world frame), then one per instrument (instrument frame)."""

    method = "kinematic"
    Settings = KinematicSettings
    separates_instruments = True
    enough_frames = 60
    training_defaults: ClassVar[Mapping[str, Any]] = {
        **PLAIN_TRAINING,
        "schedule.sh_interval": 500,
        "schedule.plain_density.interval": 200,
        "schedule.plain_density.opacity_reset": 0,
        "schedule.plain_density.threshold": 2e-4,
        "refine.latency": True,
        "refine.frame_poses": True,
        "refine.frame_joints": True,
        "density_start": 400,
        "resolution.full_size_at": 0.55,
        "schedule.events": EVENTS,
    }
    actions = tuple(dict.fromkeys(event.action for event in EVENTS))
    extra_rates: ClassVar[Mapping[str, float]] = {LINK_LOGITS: 1e-2}

    def __init__(self, instruments: tuple[Instrument, ...], settings: KinematicSettings | None = None) -> None:
        super().__init__(instruments, settings)
        self.may_breathe = self.settings.breathing
        self.start_iteration = self.settings.hinge_start
        self.articulate([articulation_of(instrument) for instrument in instruments])
        self.label_names = tuple(
            (instrument.name, part)
            for instrument, articulation in zip(instruments, self.articulations, strict=True)
            for part in articulation.part_names
        )

    @classmethod
    def moves_stated_links(cls, settings: KinematicSettings) -> bool:
        return settings.kinematics

    @classmethod
    def learned_joints(
        cls,
        instrument: Instrument,
        joints: tuple[str, ...],
        settings: KinematicSettings,
        report: Report,
    ) -> tuple[str, ...]:
        return hinge_joints(instrument, joints, report) if settings.kinematics else joints

    def pose(self, canonical: CanonicalGaussians, state: State, perturbation: Perturbation = UNPERTURBED) -> Posed:
        """Pose every instrument as an articulated body: its readings become joint values, these move its links."""
        return self._poser(canonical, perturbation.shaft_roll if isinstance(perturbation, Spin) else 0.0)(state)

    @torch.no_grad()
    def poser(self, canonical: CanonicalGaussians) -> Callable[[State], Posed]:
        return self._poser(canonical, 0.0)

    def _poser(self, canonical: CanonicalGaussians, roll: float) -> Callable[[State], Posed]:
        logits = self.positioned_logits(canonical)
        resting = [articulation.resting_body(roll) for articulation in self.articulations]

        def pose(state: State) -> Posed:
            bodies: list[ArticulatedBody | None] = [None]  # tissue is no articulated body
            for instrument, articulation, body in zip(self.instruments, self.articulations, resting, strict=True):
                instrument_state = state_of(instrument, state)
                values = articulation.values(instrument_state.joints)
                bodies.append(body(world_from_body=instrument_state.pose.to(canonical.means), values=values))
            means = self.breathed(canonical.means, canonical.counts[0], state.time)
            return Posed(*pose_bodies(means, canonical.quats, canonical.log_scales, logits, canonical.counts, bodies))

        return pose

    def label_channels(self, canonical: CanonicalGaussians) -> Tensor:
        labels = canonical.means.new_zeros(len(canonical), len(self.label_names))
        column = 0
        for index, articulation in enumerate(self.articulations):
            rows = canonical.body(index + 1)
            parts = articulation.parts(canonical.means[rows], self.link_weights(canonical, index))
            labels[rows, column : column + parts.shape[1]] = parts
            column += parts.shape[1]
        return labels

    def deltas(self, canonical: CanonicalGaussians, state: State) -> Deltas:
        """Return the change from canonical to posed; exactly 0 for tissue, for the paper's thresholds."""
        deltas = super().deltas(canonical, state)
        tissue = canonical.body(0)
        for tensor in (deltas.means, deltas.quats, deltas.scales):
            tensor[tissue] = 0
        return deltas

    def keypoints(self, state: State) -> dict[str, dict[str, Tensor]]:
        world_points: dict[str, dict[str, Tensor]] = {}
        for instrument, articulation in zip(self.instruments, self.articulations, strict=True):
            instrument_state = state_of(instrument, state)
            points = articulation.keypoints(instrument_state.joints)
            pose = instrument_state.pose.to(points["shaft_far"])
            world_points[instrument.name] = {name: pose[:3, :3] @ point + pose[:3, 3] for name, point in points.items()}
        return world_points

    def skeleton(self) -> Skeleton:
        bones = [bone for articulation in self.articulations for bone in articulation.skeleton]
        return tuple(dict.fromkeys(bones))

    def motion(self, canonical: CanonicalGaussians) -> ArticulatedMotion:
        log_scales = canonical.log_scales.clone()
        axes, moved, links = [], [], []
        for index, articulation in enumerate(self.articulations):
            rows = canonical.body(index + 1)
            weights = self.link_weights(canonical, index)
            links.append((weights, articulation.motion(torch.eye(weights.shape[1], device=weights.device))[1]))
            if articulation.jointed:
                log_scales[rows] = torch.minimum(log_scales[rows], articulation.longest(weights).log())
            motions, amounts = articulation.motion(weights)
            axes.append(tuple(motions))
            moved.append((rows, amounts))
        most = max((len(motions) for motions in axes), default=0)
        amounts = canonical.means.new_zeros(len(canonical), most, 2)
        for rows, own_amounts in moved:
            amounts[rows, : own_amounts.shape[1]] = own_amounts
        return ArticulatedMotion(log_scales, amounts, tuple(axes), tuple(links))

    @classmethod
    def combined(cls, deformations: Sequence[Deformation]) -> Kinematic:
        parts = [part for part in deformations if isinstance(part, Kinematic)]
        instruments = tuple(instrument for part in parts for instrument in part.instruments)
        made = cls(instruments, copy.deepcopy(parts[0].settings))
        made.articulate([copy.deepcopy(articulation) for part in parts for articulation in part.articulations])
        return made

    def fit_extras(self, extras: Mapping[str, Tensor]) -> dict[str, Tensor]:
        logits, columns = extras[LINK_LOGITS], self.logit_count
        logits = nn.functional.pad(logits, (0, max(0, columns - logits.shape[1])))[:, :columns]
        return {LINK_LOGITS: logits}

    def initial_extras(self, canonical: CanonicalGaussians) -> dict[str, Tensor]:
        return {LINK_LOGITS: canonical.means.new_zeros(len(canonical), self.logit_count)}

    def begin(self, session: GaussianSession) -> dict[str, KinematicTree]:
        with session.searching():
            return find_instruments(session, self, wrists=self.settings.kinematics and session.config.joints is None)

    def perturb(
        self, perturbation: Perturbation, iteration: int, progress: float, rng: np.random.Generator
    ) -> Perturbation:
        settings = self.settings
        if settings.shaft_roll > 0 and iteration > settings.shaft_roll_start and rng.random() < settings.shaft_roll:
            return Spin(perturbation.state_noise, float(rng.uniform(-math.pi, math.pi)))
        return perturbation

    def prune_mask(self, canonical: CanonicalGaussians, cameras: Sequence[Camera]) -> Tensor | None:
        """Return Gaussians to prune: tissue whose centre no frame observes, and all out of reach of stated links."""
        mask = torch.zeros(len(canonical), dtype=torch.bool, device=canonical.means.device)
        for index, articulation in enumerate(self.articulations):
            if articulation.stated:
                rows = canonical.body(index + 1)
                mask[rows] = articulation.out_of_reach(canonical.means[rows].detach())
        if self.settings.extrapolate_tissue:
            tissue = canonical.body(0)
            mask[tissue] = outside_all_views(canonical.means[tissue].detach(), cameras)
        return mask

    def training_channels(self, canonical: CanonicalGaussians, iteration: int) -> Tensor | None:
        """Return the label [N, 1] of whole instruments, which is the sum over their parts."""
        settings = self.settings
        if not (settings.label_sharpness > 0 and iteration > settings.label_sharpness_start and self.label_names):
            return None
        return canonical.of_instruments.to(canonical.means.dtype)[:, None]

    def regularisation(self, canonical: CanonicalGaussians, rendering: Rendering, iteration: int) -> Tensor | None:
        """Penalise opaque instruments and soft labels, and add the priors of stated links."""
        settings, terms = self.settings, []
        if settings.opacity_penalty > 0 and len(canonical.counts) > 1:
            weight = settings.opacity_penalty * (1.0 if iteration < settings.opacity_penalty_stop else 0.1)
            terms.append(weight * torch.sigmoid(canonical.opacity_logits[canonical.counts[0] :]).mean())
        priors = (articulation.prior() for articulation in self.articulations)
        terms += [PRIOR_WEIGHT * prior for prior in priors if prior is not None]
        if rendering.channels is not None and iteration > settings.label_sharpness_start:
            label = rendering.channels[..., 0]
            terms.append(settings.label_sharpness * (label * (1 - label)).mean())
        return sum(terms[1:], terms[0]) if terms else None

    @torch.no_grad()
    def act(self, session: GaussianSession, action: str) -> None:
        refinement = session.refinement
        match action:
            case "find_shadow":
                if self.settings.shadow:
                    with session.searching(as_learned=True):
                        find_shadow(session)
            case "observe_silhouettes":
                with session.searching():
                    observe_silhouettes(session)
            case "place_wrists":
                with session.searching():
                    place_wrists(session, self)
            case "refine_wrists":
                if self.settings.refine_wrists:
                    with session.searching():
                        refine_wrists(session, self)
            case "judge_states":
                judge_states(session, self)
            case "size_states":
                judge_states(session, self, refit=False)
            case "judge_states_again":
                suspected = bool(refinement.error_scale) or bool(refinement.verdicts.any())
                if _corrects_states(session) and suspected:
                    judge_again(_search(session, self))
            case "fit_states":
                fit_states(session, self)
            case "carve_from_states":
                if _fits_states(session):
                    with session.searching():
                        carve_again(session, self)
            case "conclude_states":  # with standard deviations of the fits; excludes frames that no state explains
                fit_states(session, self, last=True)
            case _:
                raise KeyError(action)

    def finish(self, session: GaussianSession) -> None:
        scene = session.scene
        conclude(session, self)
        if contradictions := describe_contradictions(session.refinement, session.recorded.names):
            session.report(contradictions)
        if self.breathing is not None:
            scene.diagnostics["breathing"] |= self.breathing.describe(scene.recorded.cameras)
        if self.settings.extrapolate_tissue:
            scene.canonical = extrapolate_tissue(scene.canonical, scene.recorded.cameras)

    def learning_rates(self, progress: float) -> dict[str, float]:
        scale = self.settings.rate_scale * floored_decay(progress)
        rate_of = {}
        for name, _ in self.named_parameters():
            module, _, parameter = name.rpartition(".")
            owner = self.get_submodule(module)
            rates = owner.rates if isinstance(owner, Articulation) else BREATHING_RATES
            fixed = (parameter.startswith("axis_") and not self.settings.stated_axes) or (
                parameter.startswith("reading_") and not self.settings.stated_readings
            )
            rate_of[name] = 0.0 if fixed else rates[parameter] * scale
        return rate_of


def articulation_of(instrument: Instrument) -> Articulation:
    """Return the links that the instrument's kinematics state, else a shaft with one hinge per joint, to be estimated
    from the images."""
    tree = instrument.kinematics
    return Articulation(tree) if tree is not None and tree.readings else Hinges(tuple(instrument.joints))


@torch.no_grad()
def observe_silhouettes(session: GaussianSession) -> None:
    """Update the session's silhouettes from its scene, if the tissue explains the images better than when they were
    last computed."""
    if not session.scene.instruments:
        return
    count = len(session.views.frames)
    sampled = {index: session.compared(index) for index in evenly_spaced(count, SILHOUETTES.n_views)}
    foreground, observed = Foreground.learned(list(sampled.values())), session.silhouettes
    if foreground is None or (observed is not None and foreground.noise >= observed.noise):
        return
    values = []
    for index in range(count):
        view = sampled[index] if index in sampled else session.compared(index)
        certain = UNKNOWN + foreground.certainty(view, SETTINGS.reach) * (INSTRUMENT - UNKNOWN)
        values.append(torch.from_numpy(certain.round().clip(0, 255)).to(torch.uint8))
    session.silhouettes = Silhouettes(tuple(values), foreground.noise)


def _corrects_states(session: GaussianSession) -> bool:
    """Return whether the run has states and corrects them."""
    return bool(session.scene.instruments) and session.config.refine.frame_poses


def _fits_states(session: GaussianSession) -> bool:
    """Return whether states are fitted to images: they are corrected, their errors exceed a tracker's, and one camera
    shows each instant. With several cameras, gradients determine an instant's state better than single images."""
    single = all(len(frames) == 1 for frames in session.refinement.frames_of_instant)
    return _corrects_states(session) and bool(session.refinement.error_scale) and single


@torch.no_grad()
def judge_states(session: GaussianSession, articulated: ArticulatedInstruments, *, refit: bool = True) -> None:
    """Estimate the size of state errors over all training frames, unless they were large before, and report whether
    they exceed a tracker's; with `refit`, search for gross errors, too."""
    if not _corrects_states(session) or session.refinement.error_scale:
        return
    search = _search(session, articulated)
    misfits = Misfits.of(search) if refit else None
    large = search.size_errors(() if misfits is None else misfits.outliers)
    if large:
        session.report("the states' errors are larger than a tracker's: they are corrected by the images")
    if misfits is not None:
        refit_outliers(search, SEARCH.scale if large else SEARCH.large, misfits)


@torch.no_grad()
def fit_states(session: GaussianSession, articulated: ArticulatedInstruments, *, last: bool = False) -> None:
    """Fit the states of all training frames to their images, if their errors exceed a tracker's."""
    if not _fits_states(session):
        return
    search, refinement = _search(session, articulated), session.refinement
    explained: dict[int, float] = {}
    for (index,) in refinement.frames_of_instant:
        if not refinement.counts(index):
            continue
        wrong = refinement.verdict(index) is Verdict.REFITTED
        about = search.state(index) if wrong else None
        refitted = fitted_anew(search, index) if wrong and last else search.fitted(index, SEARCH.scale, about)
        if refitted is not None:
            # until the last fit, gradients continue with the uncertainty of the recorded states
            deviations = refitted[1] if last else search.deviations(index, SEARCH.scale)
            refinement.set_state(index, session.recorded.states[index], refitted[0].state, deviations)
            explained[index] = refitted[0].misfit
    if last:
        leave_out_unexplained(search, explained)


def _search(session: GaussianSession, articulated: ArticulatedInstruments) -> StateSearch:
    shafts = [articulation.shaft()[1].detach().cpu().double() for articulation in articulated.articulations]
    return StateSearch.of(session.scene, session.refinement, session.full_views.frames, shafts)
