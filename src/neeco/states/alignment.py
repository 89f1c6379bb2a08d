"""Aligned scoring: instrument state and camera pose of one frame fitted to its recorded image, the scene frozen.

Trackers are off by about 1 mm, which moves the rendered instrument by pixels whatever the model does. Fitting the pose
separates what the scene learned from the tracker's error. The fit runs coarse to fine and takes no gradient of the
scene, so that every method is aligned in the same way.
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
from neeco.states.parameters import InstrumentParameters, StateParameters, moved_camera, precision_of

if TYPE_CHECKING:
    from neeco.scene import GaussianScene


@dataclass(frozen=True, kw_only=True)
class AlignConfig:
    """Priors and effort of an alignment. Increments are rotation vector (rad) and translation (mm)."""

    sigma_instrument_mm: float = 1.0
    sigma_instrument_deg: float = 0.5
    sigma_joint_deg: float = 1.5  # of joints in stated kinematics: play and noise of encoders
    sigma_joint_mm: float = 0.5  # of prismatic ones
    sigma_camera_mm: float = 1.5
    sigma_camera_deg: float = 0.3
    levels: tuple[float, ...] = (0.25, 0.5, 1.0)  # sizes of the images compared, coarse to fine
    max_pixels: int = CROPS.max_pixels  # of the largest of them, to which larger images are reduced
    steps: tuple[int, ...] = (3, 2, 2)  # Levenberg-Marquardt iterations at each
    huber: float = 0.05  # colour residual beyond which the cost is linear: highlights and unobserved tissue
    correlation_px: float = 100.0  # pixels that count as one observation, since residuals of neighbours correlate
    step_mm: float = 0.1  # finite difference at the last level, larger at coarse ones
    step_deg: float = 0.1


# for states whose errors are larger than a tracker's: priors as wide, and steps enough to come from as far
WIDE = AlignConfig(
    sigma_instrument_mm=1.5, sigma_instrument_deg=3.0, sigma_joint_deg=4.0, sigma_joint_mm=1.5, steps=(10, 6, 4)
)


@dataclass(frozen=True)
class AlignedFrame:
    """A frame's fitted state and camera, and the increments that led to them."""

    state: State
    camera: Camera
    increments: Tensor  # [P] float64: rotation vector rad and translation mm of each instrument, joints, the camera


@torch.no_grad()
def align_frame(
    scene: GaussianScene, frame: Frame, image: Tensor, start: Tensor | None = None, config: AlignConfig | None = None
) -> AlignedFrame:
    """Fit the state and camera of `frame` to its recorded `image` [H, W, 3].

    Corrects every instrument's pose, the camera, and every joint in stated kinematics, with Gaussian priors at zero;
    other joints and intrinsics stay. Pixels outside the frame's loss mask do not count. `start`: increments of a
    neighbouring frame, from which the fit begins where they explain the image better than none. config: by default of
    a tracker's errors, or WIDE where the scene's recording has larger ones. Takes about 7 * (6 * instruments + joints +
    8) small renderings (WIDE: three times as many).
    """
    config = config or (WIDE if scene.recorded.error_scale else AlignConfig())
    instruments = [item for item in scene.instruments if item.name in frame.state.instruments]
    parameters = StateParameters(tuple(map(InstrumentParameters.of, instruments)), joints_last=True, camera=True)
    mask, precision = frame.load_mask(), precision_of(_deviations(parameters, instruments, config))
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
    """Return `render` and `differences` of `minimise` for images of a `camera` of the recorded pose, with these finite
    differences [P]."""

    def gaussians(at: Tensor) -> Gaussians:
        return scene.at(parameters.moved(state, at))

    def image(posed: Gaussians, at: Tensor) -> Tensor:
        return rasterize(posed, _camera_at(camera, at)).color.cpu()  # where the small systems are solved

    def render(at: Tensor) -> tuple[Gaussians, Tensor]:
        posed = gaussians(at)
        return posed, image(posed, at)

    def differences(at: Tensor, posed: Gaussians) -> Iterator[tuple[Tensor, float]]:
        # shadows, which move as little as what casts them, are rendered once for all differences
        still = shadowed(posed, _camera_at(camera, at), depth_maps)
        for index, step in enumerate(steps):
            moved = at.clone()
            moved[index] += step
            is_camera = index >= len(at) - 6
            yield image(still if is_camera else replace(gaussians(moved), headlight=still.headlight), moved), step

    return render, differences


def _camera_at(camera: Camera, at: Tensor) -> Camera:
    """Return the camera moved by the last six parameters, its pose as precise as before."""
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
    """Return how far a fit moved every instrument, by name, and the `camera` (see `pose_change`)."""
    moved = {
        name: pose_change(start.pose, state.instruments[name].pose) for name, start in frame.state.instruments.items()
    }
    return moved | {"camera": pose_change(frame.camera.world_from_camera, camera.world_from_camera)}


def pose_change(recorded: Tensor, fitted: Tensor) -> dict[str, float]:
    """Return the distance between pose `fitted` [4, 4] and `given`: {"mm": of the origins, "deg": of the rotations}."""
    relative = torch.linalg.inv(recorded.double()) @ fitted.double()
    cosine = ((torch.diagonal(relative[:3, :3]).sum() - 1) / 2).clamp(-1, 1)
    return {"mm": float(relative[:3, 3].norm()), "deg": float(torch.rad2deg(torch.arccos(cosine)))}
