"""BOP, for 6-DoF pose: `bop/{train,val}/000000/` with rgb/, depth/, mask/, mask_visib/ and the scene's three files.

https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md. Objects are the instruments, numbered
from 1 in their order (`bop/objects.json`); lengths in mm, OpenCV axes, an instrument's frame being its tracked one.
There are no meshes (models/): a scene knows how an instrument looks, not its surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from neeco.capture.images import read_labels, write_labels
from neeco.capture.model import swap_camera_axes
from neeco.files import write_json
from neeco.labels.annotation import bounding_box
from neeco.synthesis.writers.folder import DEPTH_MM_PER_COUNT, Record, link, stem

FOLDER, SCENE = "bop", "000000"
NOWHERE = [-1, -1, -1, -1]


def write_bop(root: Path, records: Sequence[Record], names: Sequence[tuple[str, str]]) -> None:
    """(Re)write everything. names: (instrument, part) of part id 1, 2, ... Raises NeecoError."""
    instruments = list(dict.fromkeys(instrument for instrument, _ in names))
    ids = {k: [i + 1 for i, (owner, _) in enumerate(names) if owner == name] for k, name in enumerate(instruments)}
    write_json(root / FOLDER / "objects.json", {str(k + 1): name for k, name in enumerate(instruments)})
    for split in sorted({record["split"] for record in records}):
        folder = root / FOLDER / split / SCENE
        cameras, poses, infos = {}, {}, {}
        for record in records:
            if record["split"] != split:
                continue
            name, key = stem(record["index"]), str(record["index"])
            link(root / record["image"], folder / "rgb" / Path(record["image"]).name)
            link(root / "depth" / f"{name}.png", folder / "depth" / f"{name}.png")
            cameras[key] = _camera(record)
            poses[key] = [_pose(label, instruments.index(label["name"]) + 1) for label in record["labels"]]
            infos[key] = _masks(root, folder, record, instruments, ids)
        write_json(folder / "scene_camera.json", cameras)
        write_json(folder / "scene_gt.json", poses)
        write_json(folder / "scene_gt_info.json", infos)


def _camera(record: Record) -> dict[str, Any]:
    """Intrinsics, where the world is from here, and mm per count of the depth image."""
    given = record["intrinsics"]
    matrix = [given["fl_x"], 0.0, given["cx"], 0.0, given["fl_y"], given["cy"], 0.0, 0.0, 1.0]
    pose = np.linalg.inv(swap_camera_axes(np.array(record["camera"])))
    return {
        "cam_K": matrix,
        "depth_scale": DEPTH_MM_PER_COUNT,
        "cam_R_w2c": pose[:3, :3].ravel().tolist(),
        "cam_t_w2c": pose[:3, 3].tolist(),
    }


def _pose(label: dict[str, Any], number: int) -> dict[str, Any]:
    pose = np.array(label["camera_from_instrument"])
    return {"cam_R_m2c": pose[:3, :3].ravel().tolist(), "cam_t_m2c": pose[:3, 3].tolist(), "obj_id": number}


def _masks(
    root: Path, folder: Path, record: Record, instruments: Sequence[str], ids: dict[int, list[int]]
) -> list[dict[str, Any]]:
    """Write whole and visible mask of every instrument; returns their scene_gt_info entries."""
    name = stem(record["index"])
    parts = read_labels(root / "parts" / f"{name}.png").numpy()
    bits = read_labels(root / "silhouettes" / f"{name}.png").numpy()
    depth = cv2.imread(str(root / "depth" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
    assert depth is not None
    infos = []
    for place, label in enumerate(record["labels"]):
        k = instruments.index(label["name"])
        visible = np.isin(parts, ids[k])
        whole = visible | (bits >> place & 1 > 0)
        for kind, mask in (("mask", whole), ("mask_visib", visible)):
            pixels = torch.from_numpy(mask.astype(np.uint8) * 255)
            write_labels(folder / kind / f"{name}_{place:06d}.png", pixels)
        infos.append(
            {
                "bbox_obj": list(bounding_box(whole)) if whole.any() else NOWHERE,
                "bbox_visib": list(bounding_box(visible)) if visible.any() else NOWHERE,
                "px_count_all": int(whole.sum()),
                "px_count_valid": int((whole & (depth > 0)).sum()),
                "px_count_visib": int(visible.sum()),
                "visib_fract": round(float(visible.sum() / max(1, whole.sum())), 6),
            }
        )
    return infos
