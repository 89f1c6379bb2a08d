"""BOP, for 6-DoF pose: `bop/{train,val}/000000/` with rgb/, depth/, mask/, mask_visib/ and the scene's three files.

https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md. Objects are the instruments, numbered
from 1 in their order (`bop/objects.json`); lengths in mm, OpenCV axes, an instrument's frame being its tracked one.
`cam_K` counts px from the image's corner, as the renderers of bop_toolkit do. There are no meshes (models/): a scene
knows how an instrument looks, not its surface.

Numbers follow scripts/calc_gt_info.py of bop_toolkit: `px_count_all`, `visib_fract` and `bbox_obj` are of the whole
silhouette, beyond the image's border too, in a canvas three times as wide and high as the image; boxes are the first
column and row and the distance to the last ones, and -1 where no pixel is visible.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from neeco.base.files import write_json, write_unsynced
from neeco.capture.images import encoded_png, open_image, read_labels
from neeco.capture.model import InstrumentState, State
from neeco.geometry.camera import Camera
from neeco.geometry.conventions import swap_camera_axes
from neeco.geometry.lens import INTRINSICS
from neeco.labels.annotation import bounding_box
from neeco.labels.drawing import extended_silhouettes
from neeco.synthesis.writers import DEPTH_MM_PER_COUNT, Record, Writer, WrittenImages, link, stem

NOWHERE = [-1, -1, -1, -1]


class Bop(Writer):
    """Poses, masks and depth of every instrument, in images without distortion."""

    format = "bop"
    description = "`bop/{train,val}/`, for 6-DoF pose"
    accepts_distortion = False

    def write(self, images: WrittenImages) -> None:
        """(Re)write everything. Raises NeecoError."""
        root, instruments = images.root, images.instruments
        write_json(root / self.format / "objects.json", {str(k): name for k, name in enumerate(instruments, 1)})
        for split in sorted({record["split"] for record in images.records}):
            folder = root / self.format / split / "000000"
            cameras, infos = {}, {}
            poses: dict[str, list[dict[str, Any]]] = {}
            for record in (record for record in images.records if record["split"] == split):
                name, key = stem(record["index"]), str(record["index"])
                link(root / record["image"], folder / "rgb" / Path(record["image"]).name)
                link(root / "depth" / f"{name}.png", folder / "depth" / f"{name}.png")
                fx, fy, cx, cy = (record["intrinsics"][name] for name in INTRINSICS)
                camera_from_world = np.linalg.inv(swap_camera_axes(np.array(record["camera"])))
                cameras[key] = {
                    "cam_K": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
                    "depth_scale": DEPTH_MM_PER_COUNT,
                    "cam_R_w2c": camera_from_world[:3, :3].ravel().tolist(),
                    "cam_t_w2c": camera_from_world[:3, 3].tolist(),
                }
                poses[key] = []
                for label in record["labels"]:
                    pose, number = np.array(label["camera_from_instrument"]), instruments.index(label["name"]) + 1
                    rotation, translation = pose[:3, :3].ravel().tolist(), pose[:3, 3].tolist()
                    poses[key].append({"cam_R_m2c": rotation, "cam_t_m2c": translation, "obj_id": number})
                infos[key] = _masks(images, folder, record)
            write_json(folder / "scene_camera.json", cameras)
            write_json(folder / "scene_gt.json", poses)
            write_json(folder / "scene_gt_info.json", infos)


def _masks(images: WrittenImages, folder: Path, record: Record) -> list[dict[str, Any]]:
    """Write whole and visible mask of every instrument; returns their scene_gt_info entries."""
    root, labeller = images.root, images.labeller
    name, width, height = stem(record["index"]), record["width"], record["height"]
    parts = read_labels(root / "parts" / f"{name}.png").numpy()
    bits = read_labels(root / "silhouettes" / f"{name}.png").numpy()
    depth = np.asarray(open_image(root / "depth" / f"{name}.png"))
    states = {item["name"]: InstrumentState(item["pose"], item["joints"]) for item in record["instruments"]}
    fx, fy, cx, cy = (record["intrinsics"][key] for key in INTRINSICS)
    pose = swap_camera_axes(np.array(record["camera"]))
    camera = Camera(pose, fx, fy, cx, cy, width=width, height=height)
    extended = extended_silhouettes(images.scene, labeller, State(states, record["time"]), camera)
    infos = []
    for place, label in enumerate(record["labels"]):
        ids = [k for k, (owner, _) in enumerate(labeller.names, 1) if owner == label["instrument"]]
        visible = np.isin(parts, ids)
        mask = visible | (bits >> place & 1 > 0)
        whole = extended[label["instrument"]]
        whole[height : 2 * height, width : 2 * width] = mask
        for kind, pixels in (("mask", mask), ("mask_visib", visible)):
            write_unsynced(folder / kind / f"{name}_{place:06d}.png", encoded_png(pixels.astype(np.uint8) * 255))
        seen, every = int(visible.sum()), int(whole.sum())
        infos.append(
            {
                "bbox_obj": _box(whole, width, height) if seen else NOWHERE,
                "bbox_visib": _box(visible) if seen else NOWHERE,
                "px_count_all": every,
                "px_count_valid": int((mask & (depth > 0)).sum()),
                "px_count_visib": seen,
                "visib_fract": seen / max(1, every),
            }
        )
    return infos


def _box(mask: np.ndarray, left: int = 0, top: int = 0) -> list[int]:
    """First column and row, counted from `left` and `top`, and the distance to the last ones, px (bop_toolkit)."""
    x, y, width, height = bounding_box(mask)
    return [x - left, y - top, width - 1, height - 1]
