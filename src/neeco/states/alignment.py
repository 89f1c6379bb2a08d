"""Aligned scoring: instrument state and camera pose of one frame fitted to its recorded image, with a frozen scene.

Tracker errors of about 1 mm shift the rendered instrument by pixels, whatever the model does. Fitting the pose
separates the model's error from the tracker's. The fit is coarse to fine and uses no gradient of the scene, so that all
methods are aligned in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from neeco.capture.images import area_averaged
from neeco.capture.model import Frame, Instrument, State
from neeco.geometry.camera import Camera
from neeco.raster import depth_maps, rasterize
from neeco.raster.shadow import shadowed
from neeco.raster.types import Gaussians
from neeco.states.crop_rendering import CROPS
from neeco.states.minimise import Differences, ImageResidual, Render, minimise
from neeco.states.parameters import InstrumentParameters, StateParameters, moved_camera

if TYPE_CHECKING:
    from neeco.scene import GaussianScene


@dataclass(frozen=True, kw_only=True)
class AlignConfig:
    """Priors and effort of an alignment. Increments are rotation vectors (rad) and translations (mm)."""

    sigma_instrument_mm: float = 1.0
    sigma_instrument_deg: float = 0.5
    sigma_joint_deg: float = 1.5  # joints in stated kinematics: backlash and encoder noise
    sigma_joint_mm: float = 0.5  # prismatic joints
    sigma_camera_mm: float = 1.5
    sigma_camera_deg: float = 0.3
    levels: tuple[float, ...] = (0.25, 0.5, 1.0)  # scales of the compared images, coarse to fine
    max_pixels: int = CROPS.max_pixels  # maximum size of compared images; larger ones are reduced
    steps: tuple[int, ...] = (3, 2, 2)  # Levenberg-Marquardt iterations per level
    huber: float = 0.05  # colour residual beyond which the cost is linear (highlights, unobserved tissue)
    correlation_px: float = 100.0  # pixels per independent observation, as neighbouring residuals are correlated
    step_mm: float = 0.1  # finite-difference step at the last level, larger at coarse ones
    step_deg: float = 0.1


# for states with errors larger than a tracker's: wide priors, and enough steps for the distance
WIDE = AlignConfig(
    sigma_instrument_mm=1.5, sigma_instrument_deg=3.0, sigma_joint_deg=4.0, sigma_joint_mm=1.5, steps=(10, 6, 4)
)


@dataclass(frozen=True)
class AlignedFrame:
    """Fitted state and camera of a frame, and the increments from the recorded ones."""

    state: State
    camera: Camera
    increments: Tensor  # [P] float64: rotation vector rad and translation mm of each instrument, joints, the camera


@torch.no_grad()
def align_frame(
    scene: GaussianScene, frame: Frame, image: Tensor, start: Tensor | None = None, config: AlignConfig | None = None
) -> AlignedFrame:
    """Fit the state and camera of `frame` to its recorded `image` [H, W, 3].

    Corrects the camera, every instrument's pose and every joint in stated kinematics, with zero-mean Gaussian priors;
    other joints and the intrinsics are fixed. Pixels outside the frame's loss mask are ignored. `start`: increments of
    a neighbouring frame, used as the initial value if they explain the image better than zero. config: by default for a
    tracker's errors, or WIDE if the scene's recording has larger ones. Costs about 7 * (6 * instruments + joints + 8)
    small renderings (WIDE: three times as many).
    """
    config = config or (WIDE if scene.recorded.error_scale else AlignConfig())
    instruments = [item for item in scene.instruments if item.name in frame.state.instruments]
    parameters = StateParameters(tuple(map(InstrumentParameters.of, instruments)), joints_last=True, camera=True)
    mask, precision = frame.load_mask(), torch.diag(_deviations(parameters, instruments, config) ** -2)
    counted = torch.ones(frame.camera.height, frame.camera.width) if mask is None else mask.float()
    radians = config.step_deg * torch.pi / 180
    steps = parameters.vector(radians, config.step_mm, (radians, config.step_mm), (radians, config.step_mm))
    # residuals of about `huber` weigh 1, less for correlated pixels and colours
    scale = 1.0 / (config.huber**2 * config.correlation_px * 3)
    largest = min(1.0, math.sqrt(config.max_pixels / (frame.camera.width * frame.camera.height)))
    starts = [torch.zeros(parameters.size, dtype=torch.float64)]
    if start is not None and len(start) == parameters.size:
        starts.append(start)
    for factor, count in zip(config.levels, config.steps, strict=True):
        camera = frame.camera.scaled(factor * largest)
        weight = area_averaged(counted[..., None], camera.width, camera.height)[..., 0]
        target = area_averaged(image, camera.width, camera.height)
        residual = ImageResidual(target, torch.where(weight > 0.99, 1.0, 0.0), config.huber, scale)
        rendering = _rendering(scene, frame.state, camera, parameters, (steps / factor).tolist())
        starts = [minimise(residual, precision, *rendering, starts, count).parameters]
    (increments,) = starts
    return AlignedFrame(parameters.moved(frame.state, increments), _camera_at(frame.camera, increments), increments)


def _rendering(
    scene: GaussianScene, state: State, camera: Camera, parameters: StateParameters, steps: list[float]
) -> tuple[Render[Gaussians], Differences[Gaussians]]:
    """Return `render` and `differences` of `minimise` for images of a `camera` with the recorded pose and these finite
    differences [P]."""

    def gaussians(at: Tensor) -> Gaussians:
        return scene.at(parameters.moved(state, at))

    def image(posed: Gaussians, at: Tensor) -> Tensor:
        return rasterize(posed, _camera_at(camera, at)).color.cpu()  # where the small systems are solved

    def render(at: Tensor) -> tuple[Gaussians, Tensor]:
        posed = gaussians(at)
        return posed, image(posed, at)

    def differences(at: Tensor, posed: Gaussians) -> Iterator[tuple[Tensor, float]]:
        # shadows are rendered once for all differences, as they move as little as the casters
        still = shadowed(posed, _camera_at(camera, at), depth_maps)
        for index, step in enumerate(steps):
            moved = at.clone()
            moved[index] += step
            is_camera = index >= len(at) - 6
            yield image(still if is_camera else replace(gaussians(moved), headlight=still.headlight), moved), step

    return render, differences


def _camera_at(camera: Camera, at: Tensor) -> Camera:
    """Return the camera moved by the last six parameters, at the precision of its pose."""
    moved = moved_camera(camera, at[-6:])
    return replace(moved, world_from_camera=moved.world_from_camera.to(camera.world_from_camera))


def _deviations(parameters: StateParameters, instruments: list[Instrument], config: AlignConfig) -> Tensor:
    """Return the prior standard deviations [P]; a quarter of the limits for joints that nobody recorded."""
    instrument, joint, camera = (
        degrees * torch.pi / 180
        for degrees in (config.sigma_instrument_deg, config.sigma_joint_deg, config.sigma_camera_deg)
    )
    deviations = parameters.vector(
        instrument, config.sigma_instrument_mm, (joint, config.sigma_joint_mm), (camera, config.sigma_camera_mm)
    )
    for item, layout, (_, rows) in zip(instruments, parameters.instruments, parameters.rows, strict=True):
        for row, reading in enumerate(layout.joints, rows.start):
            limits = item.joints[reading] if reading in item.unrecorded else None
            if limits is not None and limits[1] != limits[0]:
                deviations[row] = (limits[1] - limits[0]) / 4
    return deviations


def pose_changes(frame: Frame, state: State, camera: Camera) -> dict[str, dict[str, float]]:
    """Return the motion of every instrument by a fit, by name, and of the `camera` (see `pose_change`)."""
    moved = {
        name: pose_change(start.pose, state.instruments[name].pose) for name, start in frame.state.instruments.items()
    }
    return moved | {"camera": pose_change(frame.camera.world_from_camera, camera.world_from_camera)}


def pose_change(recorded: Tensor, fitted: Tensor) -> dict[str, float]:
    """Return the distance between pose `fitted` [4, 4] and `given`: {"mm": of the origins, "deg": of the rotations}."""
    relative = torch.linalg.inv(recorded.double()) @ fitted.double()
    cosine = ((torch.diagonal(relative[:3, :3]).sum() - 1) / 2).clamp(-1, 1)
    return {"mm": float(relative[:3, 3].norm()), "deg": float(torch.rad2deg(torch.arccos(cosine)))}
