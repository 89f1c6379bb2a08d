"""viser's camera and scene for one browser: conversion from and to ours, recorded cameras, sparse points, gizmos.

viser keeps depth up to 168 of its units and sees 1000 far, so mm do not fit; a `unit` is how many of them a mm is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from neeco.capture.model import PointCloud, evenly_spaced
from neeco.geometry.camera import Camera
from neeco.geometry.rotations import rigid
from neeco.labels.drawing import to_numpy
from neeco.viewer.runs import VIEW

if TYPE_CHECKING:
    import viser


@dataclass(frozen=True, kw_only=True)
class SceneSettings:
    """Sizes and limits of what the viewer places in a scene."""

    max_aspect: float = 8.0  # of a window's width to its height, or the reverse
    narrowest: float = 0.01  # rad, field of view
    widest: float = 3.0  # rad, field of view
    same_place: float = 2e-4  # of the distance to what is looked at
    same_turn: float = 1e-3  # rad
    max_frusta: int = 24  # of cameras
    max_points: int = 20_000  # of a sparse cloud
    frustum_units: float = 0.06 * VIEW.distance_units  # size of a camera's frustum
    gizmo_units: float = 0.2 * VIEW.distance_units  # length of axes
    point_units: float = 0.005 * VIEW.distance_units  # size of a point
    frustum_color: tuple[int, int, int] = (255, 200, 0)


SCENE = SceneSettings()


def aspect_of(window: viser.CameraHandle) -> float:
    """Width of the window by its height, within reason: a browser may say anything."""
    return min(max(float(window.aspect), 1 / SCENE.max_aspect), SCENE.max_aspect) if window.aspect > 0 else 1.0


def upward(cameras: Sequence[Camera]) -> np.ndarray:
    """The direction [3] that is up in most recorded images; orbiting keeps it up."""
    up = -np.mean([to_numpy(camera.world_from_camera)[:3, 1] for camera in cameras], axis=0)
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


def browser_camera(window: viser.CameraHandle, unit: float, height: int) -> Camera:
    """The camera of the browser's window, rendered `height` px high."""
    width = max(1, round(height * aspect_of(window)))
    focal = height / 2 / math.tan(min(max(window.fov, SCENE.narrowest), SCENE.widest) / 2)
    pose = torch.from_numpy(pose_of(window.wxyz, window.position, unit))
    return Camera(pose, focal, focal, width / 2, height / 2, width=width, height=height)


def stands_at(window: Camera, recorded: Camera, distance: float) -> bool:
    """Whether the window's camera has the recorded camera's pose, whatever part it shows. distance:
    `LoadedRun.distance`, mm."""
    one, two = to_numpy(window.world_from_camera), to_numpy(recorded.world_from_camera)
    apart = float(np.linalg.norm(one[:3, 3] - two[:3, 3]))
    turned = Rotation.from_matrix(one[:3, :3].T @ two[:3, :3]).magnitude()
    return apart <= SCENE.same_place * distance and turned <= SCENE.same_turn


def fitting_view(camera: Camera, aspect: float) -> float:
    """The vertical field of view in rad with which a window of that width by height shows all that `camera` saw."""
    across = camera.width / 2 / camera.fx / aspect
    return 2 * math.atan(max(camera.height / 2 / camera.fy, across))


def jump(client: viser.ClientHandle, camera: Camera, unit: float, distance: float) -> None:
    """Send the browser's camera exactly to a recorded one; it orbits about what lies `distance` mm ahead."""
    pose = to_numpy(camera.world_from_camera)
    with client.atomic():
        # the up direction first, or the orbit controls keep the old roll
        client.camera.up_direction = -pose[:3, 1]
        client.camera.position = pose[:3, 3] * unit
        client.camera.look_at = (pose[:3, 3] + distance * pose[:3, 2]) * unit
        client.camera.fov = fitting_view(camera, aspect_of(client.camera))


class Overlays:
    """Overlays that viser draws over the picture. Nodes are named by number: names of a run go into no path."""

    def __init__(
        self,
        client: viser.ClientHandle,
        cameras: Sequence[Camera],
        points: PointCloud | None,
        unit: float,
        clicked: Callable[[int], None],
        dragged: Callable[[], None],
    ) -> None:
        """clicked: gets the frame whose camera was clicked on; dragged: called when a gizmo moved."""
        self._scene, self._unit, self._dragged = client.scene, unit, dragged
        self.cameras = self._scene.add_frame("/cameras", show_axes=False, visible=False)
        poses = [to_numpy(camera.world_from_camera) for camera in cameras]
        spread = evenly_spaced(len(cameras), SCENE.max_frusta)  # some from everywhere, none twice in one place
        places = np.unique([poses[frame].round(3) for frame in spread], axis=0, return_index=True)[1]
        for frame in (spread[place] for place in places.tolist()):
            camera, pose = cameras[frame], poses[frame]
            frustum = self._scene.add_camera_frustum(
                f"/cameras/{frame}",
                fov=field_of_view(camera),
                aspect=camera.width / camera.height,
                scale=SCENE.frustum_units,
                thickness=1.5,
                thickness_units="screen",
                color=SCENE.frustum_color,
                wxyz=wxyz_of(pose),
                position=pose[:3, 3] * unit,
            )
            frustum.on_click(lambda _, frame=frame: clicked(frame))
        self.points: Any = None
        if points is not None and len(points.positions):
            chosen = evenly_spaced(len(points.positions), SCENE.max_points)
            self.points = self._scene.add_point_cloud(
                "/points",
                (points.positions[chosen] * unit).astype(np.float32),
                points.colors[chosen].astype(np.float32),
                point_size=SCENE.point_units,
                point_shape="circle",
                precision="float32",
                visible=False,
            )
        self._gizmos: dict[str, Any] = {}

    @property
    def shown(self) -> bool:
        """Whether there is anything that the picture's depth must hide or show."""
        return bool(self.cameras.visible or (self.points is not None and self.points.visible) or self._gizmos)

    def show(self, cameras: bool, points: bool) -> None:
        """Set which of them are visible."""
        for node, visible in ((self.cameras, cameras), (self.points, points)):
            if node is not None and node.visible != visible:
                node.visible = visible

    def add_gizmo(self, name: str, number: int, pose: np.ndarray) -> None:
        """Show the gizmo of an instrument that stands at `pose` [4, 4] mm."""
        gizmo = self._scene.add_transform_controls(
            f"/gizmos/{number}",
            scale=SCENE.gizmo_units,
            wxyz=wxyz_of(pose),
            position=pose[:3, 3] * self._unit,
            depth_test=False,
        )
        gizmo.on_update(lambda _: self._dragged())
        self._gizmos[name] = gizmo

    def remove_gizmo(self, name: str) -> None:
        """Take an instrument's gizmo away."""
        if name in self._gizmos:
            self._gizmos.pop(name).remove()

    def gizmo_pose(self, name: str) -> np.ndarray | None:
        """Pose [4, 4] in mm of an instrument's gizmo; None without one."""
        gizmo = self._gizmos.get(name)
        return None if gizmo is None else pose_of(gizmo.wxyz, gizmo.position, self._unit)
