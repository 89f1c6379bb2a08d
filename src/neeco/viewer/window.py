"""The browser's camera and ours: where it stands, how it is sent to a recorded one, what scale viser is told.

viser keeps depth up to 168 of its units and sees 1000 far, so mm do not fit; a `unit` is how many of them a mm is.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from neeco.labels.drawing import to_numpy
from neeco.raster.types import Camera
from neeco.synthesis.samplers import moved_camera
from neeco.synthesis.states import rigid

if TYPE_CHECKING:
    import viser

    from neeco.viewer.source import Loaded

DISTANCE_UNITS = 10.0  # viser's, from a recorded camera to what it looks at
MOST_ASPECT = 8.0
NARROWEST, WIDEST = 0.01, 3.0  # rad
SAME_PLACE = 2e-4  # of that distance
SAME_TURN = 1e-3  # rad


def aspect_of(view: viser.CameraHandle) -> float:
    """Width of the window by its height, within reason: a browser may say anything."""
    return min(max(float(view.aspect), 1 / MOST_ASPECT), MOST_ASPECT) if view.aspect > 0 else 1.0


def upward(loaded: Loaded) -> np.ndarray:
    """The direction [3] that is up in most recorded images; orbiting keeps it up."""
    up = -np.mean([to_numpy(camera.world_from_camera)[:3, 1] for camera in loaded.recorded.cameras], axis=0)
    length = float(np.linalg.norm(up))
    return up / length if length > 1e-6 else np.array([0.0, -1.0, 0.0])


def wxyz_of(pose: np.ndarray) -> np.ndarray:
    """The unit quaternion [4] of a pose [4, 4]."""
    return Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)


def pose_of(wxyz: np.ndarray, position: np.ndarray, unit: float) -> np.ndarray:
    """The pose [4, 4] in mm of a quaternion and a position in viser's units."""
    return rigid(Rotation.from_quat(wxyz, scalar_first=True).as_matrix(), np.asarray(position) / unit)


def field_of_view(camera: Camera) -> float:
    """Vertical, in rad, about the middle of the image."""
    return 2 * math.atan(camera.height / 2 / camera.fy)


def seen_camera(view: viser.CameraHandle, unit: float, height: int, share: float = 1.0) -> Camera:
    """What the browser's window sees, drawn `height` px high and `share` of the window wide."""
    width = max(1, round(height * aspect_of(view) * share))
    focal = height / 2 / math.tan(min(max(view.fov, NARROWEST), WIDEST) / 2)
    pose = torch.from_numpy(pose_of(view.wxyz, view.position, unit))
    return Camera(pose, focal, focal, width / 2, height / 2, width, height)


def stands_at(seen: Camera, recorded: Camera, distance: float) -> bool:
    """Does the window look from where the recorded camera did, whatever part of that it shows? distance:
    `Loaded.distance`, mm."""
    one, two = to_numpy(seen.world_from_camera), to_numpy(recorded.world_from_camera)
    apart = float(np.linalg.norm(one[:3, 3] - two[:3, 3]))
    turned = Rotation.from_matrix(one[:3, :3].T @ two[:3, :3]).magnitude()
    return apart <= SAME_PLACE * distance and turned <= SAME_TURN


def carried_over(camera: Camera, here: Camera, there: Camera, scale: float) -> Camera:
    """What stands to `there` as `camera` stands to `here`, in a world that is `scale` times as large."""
    pose, start, end = (to_numpy(item.world_from_camera) for item in (camera, here, there))
    moved = np.linalg.inv(start) @ pose
    moved[:3, 3] *= scale
    return moved_camera(camera, end @ moved)


def fitting_view(camera: Camera, aspect: float) -> float:
    """The vertical field of view in rad with which a window of that width by height shows all that `camera` saw."""
    across = camera.width / 2 / camera.fx / aspect
    return 2 * math.atan(max(camera.height / 2 / camera.fy, across))


def jump(client: viser.ClientHandle, camera: Camera, unit: float, distance: float, share: float = 1.0) -> None:
    """Send the browser's camera exactly to a recorded one; it orbits about what lies `distance` mm ahead. share: of the
    window's width, that is to show it all."""
    pose = to_numpy(camera.world_from_camera)
    with client.atomic():
        # the up direction first, or the orbit controls keep the old roll
        client.camera.up_direction = -pose[:3, 1]
        client.camera.position = pose[:3, 3] * unit
        client.camera.look_at = (pose[:3, 3] + distance * pose[:3, 2]) * unit
        client.camera.fov = fitting_view(camera, aspect_of(client.camera) * share)
