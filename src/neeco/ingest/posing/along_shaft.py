"""Images stabilised along an instrument's shaft, and its cylindrical part unrolled about its axis.

The instrument's frame: z along the shaft towards the tip, the origin where the shaft ends and the wrist begins. In
every frame two unit vectors across the shaft belong to the view: `towards` the camera, and `across` = z x towards. Roll
is the angle about z from `towards` to the instrument's x axis; at roll 0 that points at the camera.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from neeco.base.errors import NeecoError
from neeco.capture.model import Capture, Instrument
from neeco.geometry.lines import unit
from neeco.geometry.projection import project

NEAREST_MM = 1.0  # in front of the camera
Load = Callable[[int], np.ndarray]  # frame's index -> image uint8 [H, W, 3]


@dataclass(frozen=True, eq=False)
class Shafts:
    """Poses of an instrument's shaft in every frame, in the camera's axes (OpenCV)."""

    origins: np.ndarray  # [F, 3] mm, on the axis where the shaft ends
    directions: np.ndarray  # [F, 3] unit, towards the tip
    world_from_camera: np.ndarray  # [F, 3, 3] rotations
    intrinsics: np.ndarray  # [F, 4] fx, fy, cx, cy, px
    diameter_mm: float
    working_length_mm: float

    def __len__(self) -> int:
        return len(self.origins)

    @classmethod
    def of(cls, capture: Capture, instrument: Instrument) -> Shafts:
        """Return those of an instrument found in the video. Raises NeecoError for one that was not, or not in every
        frame."""
        shaft_video = instrument.from_video
        if shaft_video is None:
            raise NeecoError(
                f"{capture.root}: instrument {instrument.name}: was not found in the video, its poses are known; "
                "give a capture made by `neeco ingest --shaft-diameter`"
            )
        if any(instrument.name not in frame.state.instruments for frame in capture.frames):
            raise NeecoError(f"{capture.root}: frames: {instrument.name} has no pose in some; leave those frames out")
        cameras = [frame.camera for frame in capture.frames]
        world_from_camera = np.stack([camera.world_from_camera.double().cpu().numpy() for camera in cameras])
        pose = np.stack([frame.state.instruments[instrument.name].pose.cpu().numpy() for frame in capture.frames])
        camera_from_instrument = np.linalg.inv(world_from_camera) @ pose
        return cls(
            camera_from_instrument[:, :3, 3],
            camera_from_instrument[:, :3, 2],
            world_from_camera[:, :3, :3],
            np.array([[camera.fx, camera.fy, camera.cx, camera.cy] for camera in cameras], np.float64),
            shaft_video.shaft_diameter_mm,
            shaft_video.working_length_mm,
        )

    @cached_property
    def view_axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Unit vectors `towards` the camera and `across` [F, 3], both orthogonal to the shaft, in the camera's axes."""
        across = np.cross(self.directions, -self.origins)
        across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-9)
        return np.cross(across, self.directions), across

    def rolls(self, x_axes: np.ndarray) -> np.ndarray:
        """Roll [F] rad of instruments whose x axis is [F, 3] in the camera's axes."""
        towards, across = self.view_axes
        return np.arctan2((x_axes * across).sum(-1), (x_axes * towards).sum(-1))

    def x_axes(self, rolls: np.ndarray) -> np.ndarray:
        """The inverse of `rolls`: [F, 3] in the camera's axes."""
        towards, across = self.view_axes
        return np.cos(rolls)[:, None] * towards + np.sin(rolls)[:, None] * across

    def rotation(self, frame: int, roll: float) -> np.ndarray:
        """world_from_instrument [3, 3] of one frame at a roll, rad."""
        towards, across = (axis[frame] for axis in self.view_axes)
        z, x = unit(self.directions[frame]), np.cos(roll) * towards + np.sin(roll) * across
        x = unit(x - (x @ z) * z)
        return np.asarray(self.world_from_camera[frame] @ np.stack([x, np.cross(z, x), z], -1))

    def carried(self) -> np.ndarray:
        """Changes [F - 1] rad of the roll from each frame to the next under parallel transport in the world: the view's
        share in a roll's change."""
        towards, across = (np.einsum("fij,fj->fi", self.world_from_camera, axis) for axis in self.view_axes)
        directions = np.einsum("fij,fj->fi", self.world_from_camera, self.directions)
        before, after, moved = directions[:-1], directions[1:], towards[:-1]
        normal = np.cross(before, after)
        # Rodrigues' formula with sine and cosine given by the two directions
        cosine = (before * after).sum(-1, keepdims=True)
        inner = (normal * moved).sum(-1, keepdims=True)
        moved = cosine * moved + np.cross(normal, moved) + normal * inner / np.maximum(1 + cosine, 1e-9)
        return np.arctan2((moved * across[1:]).sum(-1), (moved * towards[1:]).sum(-1))

    def project(self, points: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """Pixels [N, ..., 2] (centres at +0.5) of points [N, ..., 3] in the camera's axes of `frames` [N]; far outside
        the image where a point is not in front of the camera."""
        fx, fy, cx, cy = (value.reshape(-1, *[1] * (points.ndim - 2)) for value in self.intrinsics[frames].T)
        pixels = np.stack(project(points, fx, fy, cx, cy, nearest=NEAREST_MM), -1)
        return np.where(points[..., 2:] < NEAREST_MM, -1e4, pixels)


def crop(shafts: Shafts, frame: int, image: np.ndarray, along: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Sample an image [H, W(, C)] in the plane through the shaft that faces the camera: [A, B(, C)] at `along` [A] mm
    from the origin towards the tip and `across` [B] mm. Black outside the image."""
    sideways = shafts.view_axes[1][frame]
    points = shafts.origins[frame] + along[:, None, None] * shafts.directions[frame] + across[None, :, None] * sideways
    return _sample(image, shafts.project(points[None], np.array([frame]))[0])


def unroll(shafts: Shafts, frame: int, image: np.ndarray, along: np.ndarray, azimuths: np.ndarray) -> np.ndarray:
    """Sample an image [H, W, C] on the shaft's cylinder: [A, B, C] at `along` [A] mm and `azimuths` [B] rad about the
    shaft, from the direction `towards` the camera. Black outside the image."""
    towards, sideways = (axis[frame] for axis in shafts.view_axes)
    round_ = np.cos(azimuths)[:, None] * towards + np.sin(azimuths)[:, None] * sideways
    points = shafts.origins[frame] + along[:, None, None] * shafts.directions[frame] + shafts.diameter_mm / 2 * round_
    return _sample(image, shafts.project(points[None], np.array([frame]))[0])


def _sample(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    places = (pixels - 0.5).astype(np.float32)
    return np.asarray(
        cv2.remap(image, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    )
