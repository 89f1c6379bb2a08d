"""The truth of a recording's poses and states, in the tracker's world frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from neeco.geometry.conventions import swap_camera_axes
from rendered.frames import DEPTH_STRIDE, DEPTH_UNIT_MM, Shot, has_depth, image_name
from rendered.motion import Array, Moment
from rendered.render import Lens
from rendered.scenes import SceneSpec

JOINT = "jaw_angle"


@dataclass(frozen=True)
class World:
    """The shots in the tracker's world frame."""

    spec: SceneSpec
    shots: list[Shot]

    def camera(self, moment: Moment) -> Array:
        """world_from_camera [4, 4], OpenCV axes."""
        return self.spec.world_from_scene() @ moment.scene_from_camera

    def sensor(self, moment: Moment) -> Array:
        """world_from_sensor [4, 4]."""
        pose = self.spec.world_from_scene() @ moment.scene_from_mechanical
        return pose @ self.spec.mount.mechanical_from_sensor()


def truth_document(world: World, lens: Lens) -> dict[str, Any]:
    """truth/transforms.json: exact poses and states; paths relative to truth/."""
    header: dict[str, Any] = {"camera_model": "PINHOLE", "fl_x": lens.focal, "fl_y": lens.focal}
    header |= {"cx": lens.width / 2, "cy": lens.height / 2, "w": lens.width, "h": lens.height, "fps": 25}
    header |= {"units": "mm", "world_frame": "em_tracker", "ply_file_path": "../sparse.ply"}
    header |= {"depth_unit_mm": DEPTH_UNIT_MM, "depth_stride": DEPTH_STRIDE}
    header["frames"] = [_truth_frame(world, shot) for shot in world.shots]
    return header


def _truth_frame(world: World, shot: Shot) -> dict[str, Any]:
    spec, moment = world.spec, shot.moment
    joints = {JOINT: round(spec.joint.reading(moment.opening), 6)}
    if moment.wrist:
        joints |= {name: round(v, 6) for name, v in zip(spec.design.wrist_joints, moment.wrist, strict=True)}
    entry: dict[str, Any] = {
        "file_path": f"../{image_name(shot)}",
        "transform_matrix": swap_camera_axes(world.camera(moment)).tolist(),
        "split": shot.split,
        "time": shot.time,
        "instruments": [{"name": spec.design.name, "pose": world.sensor(moment).tolist(), "joints": joints}],
        "part_mask_path": f"masks/{shot.number:06d}.png",
        "state": {"roll": round(moment.roll, 6), "opening": round(moment.opening, 6)},
    }
    if has_depth(shot):
        entry["depth_file_path"] = f"depth/{shot.number:06d}.png"
    return entry
