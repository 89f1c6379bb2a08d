"""How far the hot paths are from what the machine can do: measured time beside the floor of bandwidth or arithmetic.

    python benchmarks/floors.py RUN [--images FOLDER]     # one thread; --images: frames for structure from motion

The floors are a copy of what a stage must read and write at least once, at the bandwidth of a copy that no cache holds,
or its arithmetic at the rate of a matrix product; both are measured here. Times are the least of `--repeats`, since
other work only adds; of one thread, so that they are processor times. What fits into a cache may beat the floor.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from raster import FLOPS_FORWARD, blended_pairs, peak_flops
from stages import peaks
from torch import Tensor

from neeco.capture.images import encoded_image, encoded_png, image_files, image_size
from neeco.labels.drawing import draw_layers
from neeco.labels.labellers import CompositedLabels
from neeco.raster import depth_maps
from neeco.raster.cpu_backend import last_statistics, rasterize_cpu
from neeco.raster.native import keep_freed_memory, set_threads
from neeco.raster.shadow import Casting, light_camera, shadowed
from neeco.scene.gaussian_scene import require_gaussians
from neeco.studies.machine import hardware_words, machine
from neeco.training.run import load_run

RECORD, PAIR, CHANNELS = 64, 12, 4  # bytes of a projected Gaussian and of its entry in a tile's list; label channels
DESCRIPTOR = 128  # numbers of a SIFT descriptor
SCALES, TAPS = 6, 2 * 13  # images of an octave of SIFT's pyramid, and taps of the two passes that blur one
MATCHING = """
import json, sys, time, pycolmap
images, names, database = json.loads(sys.argv[1])
options = pycolmap.FeatureExtractionOptions()
options.use_gpu, options.num_threads = False, 1
clock = time.process_time
start = clock()
pycolmap.extract_features(database, images, image_names=names, extraction_options=options, device=pycolmap.Device.cpu)
extracted = clock()
matching = pycolmap.FeatureMatchingOptions()
matching.use_gpu, matching.num_threads = False, 1
pycolmap.match_exhaustive(database, matching_options=matching, device=pycolmap.Device.cpu)
matched = clock()
with pycolmap.Database.open(database) as opened:
    counts = [opened.num_keypoints_for_image(image.image_id) for image in opened.read_all_images()]
print(json.dumps([extracted - start, matched - extracted, counts]))
"""


@dataclass(frozen=True)
class Floors:
    """Measure the stages of a run's rendering and writing beside their floors."""

    run: tyro.conf.Positional[Path]
    """Run folder."""
    images: Path | None = None
    """Folder with frames for structure from motion; default: that row is left out."""
    frames: int = 6
    """Frames of these."""
    repeats: int = 30
    """Of every measurement."""
    json: Path | None = None
    """File for the numbers."""


@dataclass(frozen=True)
class Row:
    """A stage: ms measured, ms at least, and what bounds it."""

    stage: str
    measured: float
    floor: float
    bound: str

    def __str__(self) -> str:
        factor = self.measured / self.floor
        return f"| {self.stage} | {self.measured:.2f} | {self.floor:.2f} | {factor:.1f} | {self.bound} |"


def least(call: Callable[[], object], repeats: int) -> float:
    """Least ms of a call."""
    found = []
    for _ in range(repeats):
        start = time.process_time()
        call()
        found.append(time.process_time() - start)
    return 1e3 * min(found)


def size(*tensors: Tensor | np.ndarray | bytes | None) -> int:
    """Bytes of them all."""
    return sum(len(t) if isinstance(t, bytes) else t.nbytes for t in tensors if t is not None)


@torch.no_grad()
def of_rendering(args: Floors, bandwidth: float, flops: float) -> list[Row]:
    """Posing, projection, lists, compositing, shadows and the unobserved share of one recorded state."""
    scene = require_gaussians(load_run(args.run).scene, "RUN")
    state, camera = scene.recorded.states[0], scene.recorded.as_learned(scene.recorded.cameras[0])
    labeller = CompositedLabels(scene)
    posed, canonical = scene.at(state), scene.canonical
    unobserved = scene.unobserved(posed, camera)
    channels = torch.cat([labeller.channels, unobserved[:, None]], 1)
    lit = shadowed(posed, camera, depth_maps)
    stages: dict[str, list[float]] = {"project": [], "bin": [], "composite": []}
    for _ in range(args.repeats):
        rendering = rasterize_cpu(lit, camera, channels, None)
        for name, found in stages.items():
            found.append(last_statistics()[name])
    visible, pairs = int(last_statistics()["visible"]), int(last_statistics()["pairs"])

    def copied(nbytes: float) -> float:
        return 1e3 * nbytes / bandwidth

    geometry = size(posed.means, posed.quats, posed.scales)
    logits = next((t for name, t in canonical.extras.items() if name == "part_logits"), None)
    work = blended_pairs(posed, camera) * (FLOPS_FORWARD + 2 * channels.shape[1])
    seen = size(lit.sh) * visible / len(lit) + visible * RECORD + size(posed.opacities, posed.sh_frames, channels)
    images = size(rendering.color, rendering.alpha, rendering.depth, rendering.channels)
    casting = Casting.of(posed, canonical.of_instruments, camera)
    lamps = [k for k, strength in enumerate(scene.shadow_strengths.tolist()) if strength > 0]
    light = (size(posed.means) + 5 * len(posed)) * len(lamps)  # casters in, shares out
    maps = (
        sum(blended_pairs(casting.bare, light_camera(camera, scene.shadow_offsets[k])) for k in lamps) * FLOPS_FORWARD
    )
    shadow = least(lambda: shadowed(posed, camera, depth_maps), args.repeats)
    whole = least(lambda: draw_layers(scene, labeller, state, camera, 0.01), args.repeats)
    once = copied(3 * geometry + images + seen + light) + 1e3 * (work + maps) / flops
    return [
        Row("pose", least(lambda: scene.at(state), args.repeats), copied(2 * geometry + size(posed.sh_frames, logits)),
            "bandwidth"),
        Row("project, harmonics", min(stages["project"]), copied(geometry + seen), "bandwidth"),
        Row("list per tile", min(stages["bin"]), copied(visible * RECORD + 2 * pairs * PAIR), "bandwidth"),
        Row("composite", min(stages["composite"]), max(1e3 * work / flops, copied(images)), "arithmetic"),
        Row("shadows", shadow, copied(light) + 1e3 * maps / flops, "both"),
        Row("unobserved share", least(lambda: scene.unobserved(posed, camera), args.repeats),
            copied(size(posed.means, posed.sh_frames, scene.visibility(), unobserved)), "bandwidth"),
        Row("an image with all labels", whole, once, "both"),
    ]  # fmt: skip


@torch.no_grad()
def of_writing(args: Floors, bandwidth: float) -> list[Row]:
    """PNGs of one image: the image, its depth, and its part ids."""
    scene = require_gaussians(load_run(args.run).scene, "RUN")
    camera = scene.recorded.cameras[0]
    drawing = draw_layers(scene, CompositedLabels(scene), scene.recorded.states[0], camera, 0.01)
    depth = np.clip(np.round(drawing.depth / 0.05), 0, 65535).astype(np.uint16)
    parts = drawing.parts.numpy()
    made = {
        "PNG of the image": (lambda: encoded_image(drawing.image), 3 * depth.size),
        "PNG of the depth": (lambda: encoded_png(depth), depth.nbytes),
        "PNG of the part ids": (lambda: encoded_png(parts), parts.nbytes),
    }
    return [
        Row(name, least(encode, args.repeats), 1e3 * (2 * pixels + len(encode())) / bandwidth, "bandwidth")
        for name, (encode, pixels) in made.items()
    ]


def of_structure(args: Floors, folder: Path, flops: float) -> list[Row]:
    """SIFT and exhaustive matching of a few frames by COLMAP, in a process of its own."""
    files = image_files(folder)[: args.frames]
    database = args.run.parent / f".floors-{os.getpid()}.db"
    try:
        given = json.dumps([str(folder), [file.name for file in files], str(database)])
        ended = subprocess.run([sys.executable, "-c", MATCHING, given], capture_output=True, text=True)
        if ended.returncode:
            raise SystemExit(f"pycolmap failed: {ended.stderr[-1000:]}")
        extraction, matching, counts = json.loads(ended.stdout.splitlines()[-1])
    finally:
        database.unlink(missing_ok=True)
    pixels = math.prod(image_size(files[0]))
    pyramid = 4 * pixels * 4 / 3 * SCALES * TAPS * 2  # COLMAP begins with the image doubled
    pairs = [a * b for k, a in enumerate(counts) for b in counts[k + 1 :]]
    products = float(np.mean(pairs)) * 2 * DESCRIPTOR
    return [
        Row("SIFT of a frame", 1e3 * extraction / len(files), 1e3 * pyramid / flops, "arithmetic of the pyramid"),
        Row("matching two frames", 1e3 * matching / len(pairs), 1e3 * products / flops, "arithmetic"),
    ]


def main(args: Floors) -> None:
    set_threads(1)
    torch.set_num_threads(1)
    keep_freed_memory()
    hardware = machine(torch.device("cpu"))
    bandwidth, flops = peaks(torch.device("cpu"))["bytes"], peak_flops(1)
    print(hardware_words(hardware))
    print(f"one thread: {bandwidth / 1e9:.1f} GB/s copied, {flops / 1e9:.0f} GF/s in a matrix product\n")
    rows = of_rendering(args, bandwidth, flops) + of_writing(args, bandwidth)
    rows += [] if args.images is None else of_structure(args, args.images, flops)
    print("| stage | ms | floor, ms | factor | bound by |\n|---|---|---|---|---|")
    print("\n".join(map(str, rows)))
    if args.json is not None:
        numbers: dict[str, Any] = {"machine": hardware, "bytes": bandwidth, "flops": flops}
        args.json.write_text(json.dumps(numbers | {"rows": [vars(row) for row in rows]}, indent=1) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Floors))
