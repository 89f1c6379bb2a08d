"""The session before its first step, with its initial scene."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from neeco.base.errors import NeecoError
from neeco.capture.images import has_alpha
from neeco.capture.model import Capture, Frame, Instrument
from neeco.scene.canonical import neighbour_spacing, seed_gaussians
from neeco.scene.drawable import DrawableScene, Recorded
from neeco.scene.gaussian_scene import GaussianScene
from neeco.scene.method_registry import make_deformation, method_class
from neeco.scene.training_session import Report, Session
from neeco.scene.training_views import TrainingViews, mean_pixels
from neeco.training.config import TrainConfig
from neeco.training.session import GaussianSession


@dataclass(frozen=True, kw_only=True)
class JointSettings:
    """Thresholds for joints that are learned."""

    max_pose_explained: float = 0.98  # maximum share of a joint's variance explained by its instrument's pose
    n_stretches: int = 4  # contiguous intervals of the recording for cross-validation
    min_held_out_explained: float = 0.5  # minimum share explained on held-out intervals


JOINTS = JointSettings()


def begin_session(
    capture: Capture, views: TrainingViews, config: TrainConfig, report: Report, scene: DrawableScene | None = None
) -> Session:
    """Return a session of any method at iteration 0, on the device of the views.

    scene: from a checkpoint; None: a new one, for which the method's `begin` is called.
    """
    method = method_class(config.method)
    if not method.has_gaussians:
        return method.session(capture, views, config.deformation, config.length, config.seed, scene)
    is_new = scene is None
    if scene is None:
        scene = initial_scene(capture, views.frames, config, report)
    assert isinstance(scene, GaussianScene)
    session = GaussianSession(scene.to(views.device), views, config, report)
    session.timed = capture.timed
    if is_new and (trees := scene.deformation.begin(session)):
        instruments = [replace(item, kinematics=trees.get(item.name, item.kinematics)) for item in capture.instruments]
        return begin_session(replace(capture, instruments=tuple(instruments)), views, config, report)
    session.start()
    return session


def initial_scene(capture: Capture, frames: tuple[Frame, ...], config: TrainConfig, report: Report) -> GaussianScene:
    """Seed the tissue's Gaussians and the method's deformation from the sparse points and the training frames.

    Raises NeecoError when `config.joints` has an unknown one, or an image cannot be read.
    """
    # the grey behind transparent images, which is not learned; read first, as files may disappear during training
    background = next((frame.background for frame in frames if has_alpha(frame.image_path)), 0.0)
    instruments = tuple(_learned_instrument(item, frames, config, report) for item in capture.instruments)
    # at their recorded size, independent of the learning scale
    recorded = Recorded.of(
        capture.split("train"),
        instruments,
        lens=capture.lens,
        scale=config.scale,
        still=capture.still,
    )
    positions, colors = capture.points.positions, capture.points.colors
    limit, _ = config.gaussian_limits(mean_pixels(frames))
    most = min(limit, config.initial_points or limit)
    if len(positions) > most:  # at most as many as the tissue may have Gaussians
        chosen = np.sort(np.random.default_rng(config.seed).choice(len(positions), most, replace=False))
        positions, colors = positions[chosen], colors[chosen]
    positions, colors = np.ascontiguousarray(positions), np.ascontiguousarray(colors)
    tissue = seed_gaussians(torch.from_numpy(positions), torch.from_numpy(colors), neighbour_spacing(positions))
    deformation = make_deformation(config.method, instruments, config.deformation)
    deformation.fit_ranges(list(recorded.states), tissue.means)
    center = torch.from_numpy(np.median(positions, 0))
    tissue = tissue.with_extras(**deformation.initial_extras(tissue))
    scene = GaussianScene(config.method, tissue, deformation, instruments, recorded, center)
    scene.background = background
    return scene


def _learned_instrument(
    instrument: Instrument, frames: tuple[Frame, ...], config: TrainConfig, report: Report
) -> Instrument:
    """Return the instrument with its learned joints.

    These are `config.joints`; else those of its stated kinematics, if the method moves such links; else those that may
    move parts (`moving_joints`) and that the method can learn.
    """
    method, tree = method_class(config.method), instrument.kinematics
    if config.joints is None and tree is not None and method.moves_stated_links(config.deformation):
        if missing := [reading for reading in tree.readings if reading not in instrument.joints]:
            raise NeecoError(
                f"instruments: {instrument.name}: its kinematics take {missing[0]!r}, which is no joint of it; name "
                "recorded readings, or train with --set deformation.kinematics=false"
            )
        unrecorded = tuple(joint for joint in instrument.unrecorded if joint in tree.readings)
        stated = {reading: instrument.joints[reading] for reading in tree.readings}
        left_out = tuple(sorted(set(instrument.joints) - set(stated)))
        return replace(instrument, joints=stated, unrecorded=unrecorded, left_out=left_out)
    joints = moving_joints(instrument, frames, config, report)
    if config.joints is None:
        joints = method.learned_joints(instrument, joints, config.deformation, report)
    learned = {joint: instrument.joints[joint] for joint in joints}
    return Instrument(instrument.name, learned, left_out=tuple(sorted(set(instrument.joints) - set(learned))))


def moving_joints(
    instrument: Instrument, frames: tuple[Frame, ...], config: TrainConfig, report: Report
) -> tuple[str, ...]:
    """Return joints that may move parts of the tracked body: `config.joints`, or those that its pose does not explain.

    A robot arm's joints upstream of the tracked frame are a function of its pose; a jaw angle is not.
    Raises NeecoError for an unknown name.
    """
    wanted = config.joints
    if wanted is not None:
        unknown = [joint for joint in wanted if joint not in instrument.joints]
        if unknown:
            raise NeecoError(
                f"--joints: {instrument.name} has no joint {unknown[0]!r}; it has {', '.join(instrument.joints)}"
            )
        return wanted
    states = [frame.state.instruments[instrument.name] for frame in frames]
    poses = np.stack([state.pose[:3].double().numpy().ravel() for state in states])
    _, first = np.unique(np.round(poses, 6), axis=0, return_index=True)
    first = first[np.argsort([frames[i].state.time for i in first], kind="stable")]
    design = np.column_stack([poses[first] - poses[first].mean(0), np.ones(len(first))])
    moving = []
    for joint in instrument.joints:
        if joint in instrument.unrecorded:
            report(f"{instrument.name}: joint {joint} is not recorded; it can only be estimated with its kinematics")
            continue
        reading = np.array([states[i].joints[joint] for i in first])
        if (
            reading.var() > 1e-8
            and _explained(design, reading, 1) > JOINTS.max_pose_explained
            and _explained(design, reading, JOINTS.n_stretches) > JOINTS.min_held_out_explained
        ):
            report(f"{instrument.name}: joint {joint} follows from the pose; it moves no part of its own")
        else:
            moving.append(joint)
    return tuple(moving)


def _explained(design: np.ndarray, values: np.ndarray, stretches: int) -> float:
    """Return the share of the variance of values [N] explained by a linear fit to design [N, P], each interval by a fit
    to the others: smooth frames fit the dozen numbers of a pose by chance."""
    residuals = np.zeros(len(values))
    for test in np.array_split(np.arange(len(values)), stretches):
        use = np.setdiff1d(np.arange(len(values)), test) if stretches > 1 else test
        residuals[test] = values[test] - design[test] @ np.linalg.lstsq(design[use], values[use], rcond=1e-6)[0]
    return 1 - float(np.square(residuals).mean() / values.var())
