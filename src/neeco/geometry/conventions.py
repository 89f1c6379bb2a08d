"""Axis conventions of cameras, by producer, and their conversion to OpenCV's, which the rest of the program uses.

Two producers may call a frame by one name and mean other axes, so readers name the producer. Frames of robots' bases
and of trackers have no axes known relative to a camera: registration finds how they stand. `docs/capture.md` shows the
same table.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_DIRECTIONS = {
    "right": (1, 0, 0), "left": (-1, 0, 0), "down": (0, 1, 0), "up": (0, -1, 0), "forward": (0, 0, 1),
    "back": (0, 0, -1),
}  # in OpenCV's axes  # fmt: skip


@dataclass(frozen=True)
class AxisConvention:
    """Axes of a camera. name: as `frame` in recording.yaml; x, y, z: their directions from the camera."""

    name: str
    producer: str
    x: str
    y: str
    z: str

    @property
    def words(self) -> str:
        """`x left, y up, z forward`"""
        return f"x {self.x}, y {self.y}, z {self.z}"

    @property
    def opencv_from_own(self) -> np.ndarray:
        """[4, 4] rotation from these axes to OpenCV's."""
        matrix = np.eye(4)
        matrix[:3, :3] = np.array([_DIRECTIONS[axis] for axis in (self.x, self.y, self.z)]).T
        return matrix

    def poses_to_opencv(self, camera_from_body: np.ndarray) -> np.ndarray:
        """Poses [..., 4, 4] of bodies stated in these axes, in OpenCV's."""
        return np.asarray(self.opencv_from_own @ camera_from_body)

    def camera_to_opencv(self, world_from_camera: np.ndarray) -> np.ndarray:
        """Poses [..., 4, 4] of cameras with these axes, as poses of cameras with OpenCV's."""
        return np.asarray(world_from_camera @ self.opencv_from_own.T)


OPENCV = AxisConvention("opencv", "OpenCV", "right", "down", "forward")
COLMAP = AxisConvention("colmap", "COLMAP", "right", "down", "forward")
ROS_OPTICAL = AxisConvention("ros_optical", "ROS, optical frame", "right", "down", "forward")
ROS_BODY = AxisConvention("ros_body", "ROS, body frame (REP 103)", "forward", "left", "up")
DVRK_ECM = AxisConvention("ecm", "dVRK, ECM", "left", "up", "forward")
OPENGL = AxisConvention("opengl", "OpenGL, Blender, nerfstudio", "right", "up", "back")
LLFF = AxisConvention("llff", "LLFF, EndoNeRF", "down", "right", "back")
CONVENTIONS = {item.name: item for item in (OPENCV, COLMAP, ROS_OPTICAL, ROS_BODY, DVRK_ECM, OPENGL, LLFF)}


def swap_camera_axes(world_from_camera: np.ndarray) -> np.ndarray:
    """Turn camera poses [..., 4, 4] from OpenGL axes (x right, y up, z back) to OpenCV axes (y down, z forward), or
    back.

    The only place where the two conventions meet.
    """
    return world_from_camera * np.diag(OPENGL.opencv_from_own)  # exact, and its own inverse
