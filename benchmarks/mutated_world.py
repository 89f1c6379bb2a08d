"""What `mutations.py` damages: a small capture, run, data set, recording and so on, made by the verbs themselves."""

from __future__ import annotations

import importlib
import json
import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from forked import TESTS, Child, hasten_ingest, import_modules, module_at
from PIL import Image

DRAW = ["--no-tissue-check", "--min-share", "0", "--max-unobserved", "1", "--force"]  # of a run of 20 iterations


def prepare(verbs: Sequence[str]) -> None:
    """Import what the verbs need; SfM answers from known cameras."""
    import torch

    import_modules()
    if "downstream" in verbs:
        for module in ("neeco.studies.downstream.models.unet",):
            importlib.import_module(module)
    from neeco.studies import machine

    torch.set_num_threads(1)
    hasten_ingest()
    machine.N_ROUNDS, machine.TIMED_IMAGES = 1, 1


def make_world(desk: Path, wanted: set[str]) -> None:
    """All that is read, in `desk`; made by the verbs themselves, those things that take longer only where `wanted`."""
    os.chdir(desk)
    capture = module_at(TESTS / "training" / "capture_files.py").write_grasper(
        desk / "capture", frames=6, sizes=((32, 24),)
    )
    document = json.loads((capture / "transforms.json").read_text())
    for folder in (capture / "masks", capture / "truth" / "masks", desk / "predicted", desk / "truth"):
        folder.mkdir(parents=True)
    for k, frame in enumerate(document["frames"]):
        name = Path(frame["file_path"]).name
        frame["mask_path"] = f"masks/{name}"
        frame["split"] = "test" if k in (0, 3) else "train"
        Image.new("L", (32, 24), 255).save(capture / "masks" / name)
        ids = np.zeros((24, 32), np.uint8)
        for part in range(4):
            ids[6:18, 6 + 4 * part : 10 + 4 * part] = part + 1
        for folder in (capture / "truth" / "masks", desk / "predicted", desk / "truth"):
            Image.fromarray(np.roll(ids, k, 1)).save(folder / name)
    (capture / "transforms.json").write_text(json.dumps(document))
    settings = ["--iterations", "20", "--set", "density_start=5", "--set", "max_tissue_gaussians=200"]
    say = ["train", "capture", *settings, "--output"]
    run([*say, "run"], desk)
    shutil.copytree("run", "cut")
    (desk / "cut" / "scene.safetensors").unlink()
    poses = [frame["instruments"] for frame in document["frames"]]
    lines = [{"time": 0.1 * k, "instruments": pose} for k, pose in enumerate(poses)]
    lines[1]["camera"] = document["frames"][1]["transform_matrix"]
    (desk / "states.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    effects = {
        "shutter_s": 0.01,
        "smoke": [0.1, 0.3],
        "exposure_stops": {"range": [-1, 1], "share": 0.5},
        "soft_masks": "mean",
    }
    (desk / "effects.yaml").write_text(yaml.safe_dump(effects))
    longer = {
        "set": ["synthesize", "run", "--count", "3", *DRAW],
        "annotated": ["annotate", "run", "--min-trust", "0", "--force"],
        "compared": ["compare", "capture", "--methods", "3dgs", "--iterations", "3"],
    }
    for name in sorted(longer.keys() & wanted):
        run([*longer[name], "--output", name], desk)
    if "recording" in wanted:
        make_recording(desk / "recording")
    make_endonerf(desk / "endonerf")
    make_colmap(desk / "colmap", document)


def run(words: list[str], desk: Path) -> None:
    ended = Child(words, desk).wait()
    assert ended.status == 0, f"{words}: {ended.told}"


def make_recording(folder: Path) -> None:
    folder.mkdir()
    world = sys.modules["ingest_world"]
    recorded = world.Recorded(world.World(folder))
    recorded.frames = 14
    recorded.write()
    rows = "[60., 0., 32., 0., 60., 24., 0., 0., 1.]"
    (folder / "lens.yaml").write_text(
        f"image_width: 64\nimage_height: 48\ncamera_matrix: {{rows: 3, cols: 3, data: {rows}}}\n"
        "distortion_coefficients: {rows: 1, cols: 5, data: [0.01, 0., 0., 0., 0.]}\n"
    )


def make_endonerf(root: Path) -> None:
    poses = module_at(TESTS / "capture" / "test_endonerf.py", "endonerf_world")
    (root / "images").mkdir(parents=True)
    (root / "masks").mkdir()
    for k in range(12):
        Image.new("RGB", (poses.WIDTH, poses.HEIGHT), (20 * k, 90, 60)).save(root / f"images/frame-{k:06d}.color.png")
        Image.new("L", (poses.WIDTH, poses.HEIGHT)).save(root / f"masks/frame-{k:06d}.mask.png")
    np.save(root / "poses_bounds.npy", poses.table([poses.opencv_pose(k) for k in range(12)]))


def make_colmap(root: Path, document: dict[str, Any]) -> None:
    """A COLMAP model as text."""
    (root / "images").mkdir(parents=True)
    sparse = root / "sparse" / "0"
    sparse.mkdir(parents=True)
    (sparse / "cameras.txt").write_text("1 PINHOLE 32 24 32 32 16 12\n")
    lines, points = [], []
    for k, frame in enumerate(document["frames"], 1):
        name = Path(frame["file_path"]).name
        shutil.copy(root.parent / "capture" / "images" / name, root / "images" / name)
        lines += [f"{k} 1 0 0 0 {k} 0 0 1 {name}", "10.5 11.5 1 12.5 13.5 2"]
    for k in range(1, 20):
        points.append(f"{k} {k}.5 {k % 5} 90.25 200 100 50 0.5 1 0 2 0")
    (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    (sparse / "points3D.txt").write_text("\n".join(points) + "\n")
