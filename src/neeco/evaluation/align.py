"""Aligned scoring: fit instrument state and camera pose of one frame to its recorded image, the scene frozen.

Trackers are off by a millimetre, which moves the drawn instrument by pixels whatever the model does. Fitting the pose
separates what the scene learned from the tracker's error. The fit is Levenberg-Marquardt on the photometric residual
(Huber weights), coarse to fine, with Jacobian columns by finite differences of drawings: it needs no gradient of the
scene, so every method is aligned the same way, and a handful of steps does what gradient descent needs dozens for.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from neeco.capture.images import area_averaged
from neeco.capture.model import Frame, State
from neeco.evaluation.photometric_fit import Observed, minimise
from neeco.geometry.camera import Camera
from neeco.geometry.rotations import rigid_from_vector
from neeco.raster import rasterize
from neeco.raster.shadow import shadowed
from neeco.raster.types import Gaussians

if TYPE_CHECKING:
    from neeco.scene import GaussianScene


@dataclass(frozen=True)
class AlignConfig:
    """How far poses may move and how hard to look. Increments are rotation vector (rad) and translation (mm)."""

    sigma_instrument_mm: float = 1.0
    sigma_instrument_deg: float = 0.5
    sigma_joint_deg: float = 1.5  # of joints in stated kinematics: play and noise of encoders
    sigma_joint_mm: float = 0.5  # of those that slide
    sigma_camera_mm: float = 1.5
    sigma_camera_deg: float = 0.3
    levels: tuple[float, ...] = (0.25, 0.5, 1.0)  # sizes of the images compared, coarse to fine
    max_pixels: int = 160_000  # of the largest of them, to which larger images are reduced
    steps: tuple[int, ...] = (3, 2, 2)  # Gauss-Newton steps at each
    huber: float = 0.05  # colour residual beyond which a pixel pulls linearly: highlights and unobserved tissue
    correlation_px: float = 100.0  # neighbouring pixels err together: so many count as one observation
    step_mm: float = 0.1  # finite difference at the last level, larger at coarse ones
    step_deg: float = 0.1


@dataclass(frozen=True)
class Fit:
    """A frame's fitted poses, drawable like the given ones, and the increments that led to them."""

    state: State
    camera: Camera
    increments: Tensor  # [P] float64: rotation vector rad and translation mm of each instrument, joints, the camera


@dataclass(frozen=True)
class _Level:
    """The recorded image at one resolution."""

    camera: Camera  # size and intrinsics; its pose is the given one
    target: Tensor  # [h, w, 3]
    weight: Tensor  # [h, w], 0 where pixels do not count
    step: Tensor  # [6] finite difference of a pose


@dataclass(frozen=True)
class _Joint:
    """A reading that is fitted."""

    instrument: str
    reading: str
    slides: bool
    spread: float | None  # rad or mm, of one that nobody recorded


@dataclass(frozen=True)
class _Problem:
    """What is fitted: one increment of 6 numbers per instrument, in the instrument's frame, then of every reading in
    stated kinematics, then one of 6 for the camera."""

    scene: GaussianScene
    state: State
    names: tuple[str, ...]
    joints: tuple[_Joint, ...]
    config: AlignConfig

    @property
    def sigmas(self) -> Tensor:
        """Prior standard deviation of every parameter, [P]."""
        config = self.config
        instrument = [config.sigma_instrument_deg * torch.pi / 180] * 3 + [config.sigma_instrument_mm] * 3
        joints = [
            joint.spread or (config.sigma_joint_mm if joint.slides else config.sigma_joint_deg * torch.pi / 180)
            for joint in self.joints
        ]
        camera = [config.sigma_camera_deg * torch.pi / 180] * 3 + [config.sigma_camera_mm] * 3
        return torch.tensor(instrument * len(self.names) + joints + camera, dtype=torch.float64)

    def steps(self, level: _Level) -> Tensor:
        """Finite difference of every parameter, [P]."""
        joints = [level.step[3 if joint.slides else 0] for joint in self.joints]
        return torch.cat([*[level.step] * len(self.names), torch.tensor(joints, dtype=torch.float64), level.step])

    @property
    def scale(self) -> float:
        """Weight of a squared residual against the prior: errors of about `huber`, many pixels and 3 colours
        correlated."""
        return 1.0 / (self.config.huber**2 * self.config.correlation_px * 3)

    def moved_state(self, parameters: Tensor) -> State:
        """The state with each instrument moved by its increment."""
        instruments = dict(self.state.instruments)
        for index, name in enumerate(self.names):
            given = instruments[name]
            increment = rigid_from_vector(parameters[6 * index : 6 * index + 6])
            instruments[name] = replace(given, pose=given.pose.double() @ increment)
        for joint, change in zip(self.joints, parameters[6 * len(self.names) : -6], strict=True):
            given = instruments[joint.instrument]
            joints = {**given.joints, joint.reading: given.joints[joint.reading] + float(change)}
            instruments[joint.instrument] = replace(given, joints=joints)
        return replace(self.state, instruments=instruments)

    def moved_camera(self, camera: Camera, parameters: Tensor) -> Camera:
        """The camera moved by the last increment, in the camera's frame."""
        pose = camera.world_from_camera
        return replace(camera, world_from_camera=(pose.double() @ rigid_from_vector(parameters[-6:])).to(pose.dtype))

    def gaussians(self, parameters: Tensor) -> Gaussians:
        """The posed scene."""
        return self.scene.at(self.moved_state(parameters))

    def render(self, gaussians: Gaussians, level: _Level, parameters: Tensor) -> Tensor:
        """The image [h, w, 3] at the moved camera, on the CPU, where the small systems are solved."""
        return rasterize(gaussians, self.moved_camera(level.camera, parameters)).color.cpu()

    def observed(self, level: _Level) -> Observed:
        """The recorded image at one resolution."""
        return Observed(level.target, level.weight, self.config.huber, self.scale)

    @property
    def precision(self) -> Tensor:
        """Of the prior, [P, P]."""
        return torch.diag(self.sigmas**-2)


@torch.no_grad()
def fit_frame(
    scene: GaussianScene, frame: Frame, image: Tensor, start: Tensor | None = None, config: AlignConfig | None = None
) -> Fit:
    """Fit the state of `frame` to its recorded `image` [H, W, 3], by about 7 * (6 * instruments + joints + 8) small
    renderings.

    One SE(3) increment per instrument (world_from_instrument @ exp), one for the camera (world_from_camera @ exp), and
    one of every joint in stated kinematics, with weak Gaussian priors at zero; other joints and intrinsics stay.
    Pixels outside the frame's loss mask do not count.
    `start`: a neighbouring frame's increments, begun from where they explain the image better than none.
    """
    config = config or AlignConfig()
    names = tuple(instrument.name for instrument in scene.instruments if instrument.name in frame.state.instruments)
    problem, mask = _Problem(scene, frame.state, names, _stated_joints(scene, names), config), frame.load_mask()
    largest = min(1.0, math.sqrt(config.max_pixels / (frame.camera.width * frame.camera.height)))
    levels = [_level(frame.camera, image, mask, factor, largest, config) for factor in config.levels]
    increments = torch.zeros(len(problem.sigmas), dtype=torch.float64)
    if start is not None and len(start) == len(increments):

        def cost(tried: Tensor) -> float:
            image = problem.render(problem.gaussians(tried), levels[0], tried)
            return problem.observed(levels[0]).cost(image) + 0.5 * float(tried @ problem.precision @ tried)

        increments = min((increments, start), key=cost)
    for level, steps in zip(levels, config.steps, strict=True):
        increments = _fit_level(problem, level, increments, steps)
    return Fit(problem.moved_state(increments), problem.moved_camera(frame.camera, increments), increments)


def _stated_joints(scene: GaussianScene, names: tuple[str, ...]) -> tuple[_Joint, ...]:
    """Every reading in stated kinematics; of those that nobody recorded a quarter of their limits is their spread."""
    found = []
    for item in scene.instruments:
        if item.kinematics is None or item.name not in names:
            continue
        for reading in item.kinematics.readings:
            limits = item.joints[reading] if reading in item.unrecorded else None
            spread = None if limits is None else (limits[1] - limits[0]) / 4
            found.append(_Joint(item.name, reading, item.slides(reading), spread))
    return tuple(found)


def _level(
    camera: Camera, image: Tensor, mask: Tensor | None, factor: float, largest: float, config: AlignConfig
) -> _Level:
    """The level of `factor` times the size of the last one, which has `largest` times the image's."""
    small = camera.scaled(factor * largest)
    counted = torch.ones(camera.height, camera.width) if mask is None else mask.float()
    weight = area_averaged(counted[..., None], small.width, small.height)[..., 0]
    step = torch.tensor([config.step_deg * torch.pi / 180] * 3 + [config.step_mm] * 3, dtype=torch.float64)
    target = area_averaged(image, small.width, small.height)
    return _Level(small, target, torch.where(weight > 0.99, 1.0, 0.0), step / factor)


def _fit_level(problem: _Problem, level: _Level, parameters: Tensor, steps: int) -> Tensor:
    """A few Levenberg-Marquardt steps at one resolution; every accepted step lowers the cost."""

    def draw(at: Tensor) -> tuple[Gaussians, Tensor]:
        gaussians = problem.gaussians(at)
        return gaussians, problem.render(gaussians, level, at)

    def differences(at: Tensor, gaussians: Gaussians) -> Iterator[tuple[Tensor, float]]:
        # drawn a dozen times: the shadows, which move as little as what casts them, once
        still = shadowed(gaussians, problem.moved_camera(level.camera, at), rasterize)
        for index, step in enumerate(problem.steps(level).tolist()):
            moved = at.clone()
            moved[index] += step
            is_camera = index >= len(at) - 6
            posed = still if is_camera else replace(problem.gaussians(moved), headlight=still.headlight)
            yield problem.render(posed, level, moved), step

    return minimise(draw, differences, problem.observed(level), problem.precision, parameters, steps).parameters


def pose_changes(frame: Frame, state: State, camera: Camera) -> dict[str, dict[str, float]]:
    """How far a fit moved every instrument, by name, and the `camera` (see `pose_change`)."""
    moved = {
        name: pose_change(given.pose, state.instruments[name].pose) for name, given in frame.state.instruments.items()
    }
    return moved | {"camera": pose_change(frame.camera.world_from_camera, camera.world_from_camera)}


def pose_change(given: Tensor, fitted: Tensor) -> dict[str, float]:
    """How far pose `fitted` [4, 4] is from `given`: {"mm": distance of the origins, "deg": angle of the rotation}."""
    relative = torch.linalg.inv(given.double()) @ fitted.double()
    cosine = ((torch.diagonal(relative[:3, :3]).sum() - 1) / 2).clamp(-1, 1)
    return {"mm": float(relative[:3, 3].norm()), "deg": float(torch.rad2deg(torch.arccos(cosine)))}
