"""Read a data set back by the tools that its formats are for, and hold it against its own masks, parts and poses.

    neeco synthesize RUN --count 20 --formats coco yolo webdataset bop imagefolder --output DATASET
    python benchmarks/read_back.py DATASET

One line per format and tool; exit status 1 where any of them reads something else than was written. Needs NumPy, Pillow
and PyYAML, and of the tools whichever are to read (pip install pycocotools webdataset datasets; bop_toolkit from its
repository), in an environment of its own: neeco itself is not needed. A tool that is not installed
is said so.
"""

from __future__ import annotations

import argparse
import io
import json
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image

VARIANTS = ("", "segment", "pose", "obb", "parts")  # of yolo/


def pixels(path: Path | io.BytesIO) -> np.ndarray:
    """An image file as an array."""
    with Image.open(path) as image:
        return np.array(image)


def document(path: Path) -> Any:
    """A JSON file."""
    return json.loads(path.read_text(encoding="utf-8"))


def require(true: object, what: str) -> None:
    """Raise ValueError that says `what` is wrong unless it is true."""
    if not true:
        raise ValueError(what)


def read_pycocotools(root: Path) -> str:
    """Filled again, polygons and run lengths are the masks and parts; ids of parts are those of dataset.json."""
    from pycocotools.coco import COCO

    info = document(root / "dataset.json")
    ids = {item["id"]: f"{info['classes'][item['instrument']]}/{item['part']}" for item in info["ids"][1:]}
    shares, count = [], 0
    for kind in ("instances", "parts"):
        for file in sorted((root / "coco").glob(f"**/{kind}*.json")):
            coco = COCO(str(file))
            if kind == "parts":
                require({k: item["name"] for k, item in coco.cats.items()} == ids, f"{file}: ids are not the parts'")
            for number, image in coco.imgs.items():
                require(
                    (root / "coco/images" / image["file_name"]).is_file(), f"{file}: {image['file_name']} is missing"
                )
                parts = pixels(root / "parts" / f"{Path(image['file_name']).stem}.png")
                for annotation in coco.imgToAnns[number]:
                    wanted = (
                        parts == annotation["category_id"] if kind == "parts" else _of(coco, annotation, parts, ids)
                    )
                    filled = coco.annToMask(annotation) > 0
                    shares.append(((filled & wanted).sum(), (filled | wanted).sum()))
                    require(wanted.sum() == annotation["area"], f"{file}: area of annotation {annotation['id']}")
                    count += 1
    overlap, union = np.sum(shares, axis=0)
    require(overlap == union, f"polygons overlap with masks by {overlap / union:.3f} only")
    return f"{count} annotations, IoU with masks and parts {overlap / union:.3f}"


def _of(coco: Any, annotation: dict[str, Any], parts: np.ndarray, ids: dict[int, str]) -> np.ndarray:
    name = coco.cats[annotation["category_id"]]["name"]
    return np.isin(parts, [number for number, part in ids.items() if part.startswith(f"{name}/")])


def read_yolo_rules(root: Path) -> str:
    """What ultralytics' checker asks for, restated: columns, ranges, classes, and a label file of every image."""
    count = 0
    for variant in (name for name in VARIANTS if (root / "yolo" / name / "data.yaml").is_file()):
        data = yaml.safe_load((root / "yolo" / variant / "data.yaml").read_text())
        for _, label in _yolo_files(root / "yolo" / variant):
            for line in label.read_text().splitlines():
                values = np.array(line.split(), dtype=float)
                size, points = len(values) - 1, values[1:]
                if variant == "pose":
                    keypoints, numbers = data["kpt_shape"]
                    require(size == 4 + keypoints * numbers, f"{label}: {size} columns")
                    points = np.delete(points, np.s_[4 + numbers - 1 :: numbers])
                polygon = size >= 6 and size % 2 == 0
                fits = {"": size == 4, "pose": True, "obb": size == 8, "segment": polygon, "parts": polygon}
                require(fits[variant], f"{label}: {size} columns")
                require(values[0] in data["names"], f"{label}: class {values[0]}")
                if variant == "obb":  # corners may lie outside: the centre and size of their box are checked
                    low, high = points.reshape(4, 2).min(0), points.reshape(4, 2).max(0)
                    points = np.concatenate([(low + high) / 2, high - low]) / 1.01
                require(points.min() >= 0 and points.max() <= 1, f"{label}: beyond the image")
                count += 1
    return f"{count} rows"


def _yolo_files(folder: Path) -> Iterator[tuple[Path, Path]]:
    """(image, label file) of every image, the latter found as tools find it."""
    data = yaml.safe_load((folder / "data.yaml").read_text())
    for split in sorted({data["train"], data["val"]}):
        for image in sorted((folder / split).iterdir()):
            before, _, after = str(image).rpartition("/images/")
            label = Path(f"{before}/labels/{after}").with_suffix(".txt")
            require(label.is_file(), f"{label}: no such file")
            yield image, label


def read_webdataset(root: Path) -> str:
    """Every sample whole, its pixels those of the folders."""
    import webdataset

    count = 0
    for shard in sorted((root / "webdataset").glob("*.tar")):
        for sample in webdataset.WebDataset(str(shard), shardshuffle=False):
            key = sample["__key__"]
            for ending, folder in (("mask.png", "masks"), ("parts.png", "parts"), ("depth.png", "depth")):
                same = np.array_equal(pixels(io.BytesIO(sample[ending])), pixels(root / folder / f"{key}.png"))
                require(same, f"{shard}: {key}.{ending}")
            require(json.loads(sample["json"])["image"].startswith(f"images/{key}."), f"{shard}: {key}.json")
            count += 1
    require(count == document(root / "dataset.json")["images"], f"{count} samples")
    return f"{count} samples"


def read_datasets(root: Path) -> str:
    """The hub's library: splits, images, and boxes that lie on the masks."""
    import datasets

    with tempfile.TemporaryDirectory() as cache:
        found = datasets.load_dataset("imagefolder", data_dir=str(root / "imagefolder"), cache_dir=cache)
        for split in found.values():
            for row in split:
                mask = np.array(row["mask"]) > 0
                for (x, y, width, height), area in zip(row["objects"]["bbox"], row["objects"]["area"], strict=True):
                    box = mask[int(y) : int(y + height), int(x) : int(x + width)]
                    require(box.sum() >= area and box.shape == (height, width), "a box lies beside its mask")
    return ", ".join(f"{len(split)} {name}" for name, split in found.items())


def read_bop(root: Path) -> str:
    """The rules of bop_toolkit's scripts/calc_gt_info.py, restated; also read by its loaders where they are there."""
    try:
        from bop_toolkit_lib import inout
    except ImportError:
        inout = None
    cut = count = 0
    for folder in sorted((root / "bop").glob("*/000000")):
        if inout is not None:
            inout.load_scene_camera(folder / "scene_camera.json")
            inout.load_scene_gt(folder / "scene_gt.json")
        cameras, poses, infos = (document(folder / f"scene_{name}.json") for name in ("camera", "gt", "gt_info"))
        for key, camera in cameras.items():
            depth = pixels(folder / "depth" / f"{int(key):06d}.png") * camera["depth_scale"]
            for place, (pose, info) in enumerate(zip(poses[key], infos[key], strict=True)):
                mask, visible = (
                    pixels(folder / kind / f"{int(key):06d}_{place:06d}.png") > 0 for kind in ("mask", "mask_visib")
                )
                where = f"{folder}: image {key}, annotation {place}"
                seen, every, (height, width) = int(visible.sum()), info["px_count_all"], mask.shape
                require(info["px_count_visib"] == seen <= mask.sum() <= every, f"{where}: counts")
                require(info["px_count_valid"] == (mask & (depth > 0)).sum(), f"{where}: px_count_valid")
                require(np.isclose(info["visib_fract"], seen / every if every else 0), f"{where}: visib_fract")
                require(info["bbox_visib"] == _bop_box(visible), f"{where}: bbox_visib")
                require(np.linalg.det(np.reshape(pose["cam_R_m2c"], (3, 3))) > 0.999, f"{where}: cam_R_m2c")
                x, y, across, down = info["bbox_obj"]
                beyond = x < 0 or y < 0 or x + across >= width or y + down >= height
                require(not seen or beyond == (every > mask.sum()), f"{where}: px_count_all and bbox_obj")
                require(not seen or beyond or info["bbox_obj"] == _bop_box(mask), f"{where}: bbox_obj")
                cut, count = cut + beyond, count + 1
    return f"{count} instruments, {cut} cut by the border" + ("" if inout is None else "; bop_toolkit's loaders")


def _bop_box(mask: np.ndarray) -> list[int]:
    """x, y, width and height as misc.calc_2d_bbox has them, -1 of nothing."""
    rows, columns = np.nonzero(mask)
    found = [columns.min(), rows.min(), np.ptp(columns), np.ptp(rows)] if len(rows) else [-1] * 4
    return [int(value) for value in found]


READERS: dict[tuple[str, str], Callable[[Path], str]] = {
    ("coco", "pycocotools"): read_pycocotools,
    ("yolo", "its rules"): read_yolo_rules,
    ("webdataset", "webdataset"): read_webdataset,
    ("imagefolder", "datasets"): read_datasets,
    ("bop", "bop_toolkit's rules"): read_bop,
}


def read_back(root: Path) -> tuple[list[str], bool]:
    """A line per reader, and whether all that are installed read what was written."""
    lines, good = [], True
    for (name, tool), reader in READERS.items():
        if not (root / name).is_dir():
            said = "not written"
        else:
            try:
                said = reader(root)
            except ImportError as error:
                said = f"not installed ({error.name})"
            except Exception as error:
                said, good = f"WRONG: {type(error).__name__}: {error}", False
        lines.append(f"{name:12} {tool:20} {said}")
    return lines, good


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    lines, good = read_back(parser.parse_args().dataset)
    print("\n".join(lines))
    sys.exit(0 if good else 1)
