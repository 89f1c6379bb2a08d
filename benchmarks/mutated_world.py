"""What `mutations.py` damages: a small capture, run, data set, recording and so on, made by the verbs themselves."""

from __future__ import annotations

import json
import os
import shutil
import sys
from pathlib import Path

import numpy as np
import yaml
from forked import DRAW, TESTS, Child, hasten_ingest, import_modules, module_at
from PIL import Image


def prepare() -> None:
    """Import what the verbs need; SfM answers from known cameras."""
    import torch

    import_modules()

    torch.set_num_threads(1)
    hasten_ingest()


def make_world(desk: Path, wanted: set[str]) -> None:
    """All that is read, in `desk`; made by the verbs themselves, those things that take longer only where `wanted`."""
    os.chdir(desk)
    capture = module_at(TESTS / "training" / "capture_files.py").write_grasper(
        desk / "capture", frames=6, sizes=((32, 24),)
    )
    document = json.loads((capture / "transforms.json").read_text())
    for folder in (capture / "masks", capture / "truth" / "masks", desk / "predicted"):
        folder.mkdir(parents=True)
    for k, frame in enumerate(document["frames"]):
        name = Path(frame["file_path"]).name
        frame["mask_path"] = f"masks/{name}"
        frame["split"] = "test" if k in (0, 3) else "train"
        Image.new("L", (32, 24), 255).save(capture / "masks" / name)
        ids = np.zeros((24, 32), np.uint8)
        for part in range(4):
            ids[6:18, 6 + 4 * part : 10 + 4 * part] = part + 1
        for folder in (capture / "truth" / "masks", desk / "predicted"):
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
        "compared": ["compare", "capture", "--methods", "3dgs", "--iterations", "3"],
    }
    for name in sorted(longer.keys() & wanted):
        run([*longer[name], "--output", name], desk)
    if "recording" in wanted:
        make_recording(desk / "recording")


def run(words: list[str], desk: Path) -> None:
    ended = Child(words, desk).wait()
    assert ended.status == 0, f"{words}: {ended.told}"


def make_recording(folder: Path) -> None:
    folder.mkdir()
    world = sys.modules["ingest_world"]
    recorded = world.Recorded(world.World(folder))
    recorded.frames = 14
    recorded.write()
