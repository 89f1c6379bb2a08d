"""neeco beside renderers of meshes: images a second with mask and depth, of the same size and coverage, in one run.

    python benchmarks/peers.py RUN                              # neeco, and the renderers that this Python has
    python benchmarks/peers.py RUN --python OTHER/bin/python    # renderers of another environment

    pip install pyrender pybullet mitsuba bpy                   # of all four; bpy is Blender, run as a program (GPL)

Every renderer runs in a process of its own with OMP_NUM_THREADS threads where it heeds that; what is not installed is
skipped. Images are made in turns, `--turns` times; the table has medians. `cpu` is processor time, which other work on
the machine disturbs less.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro

import neeco
from neeco.raster.native import keep_freed_memory, set_threads
from neeco.studies.machine import hardware_words, machine

RENDERERS = ("pyrender", "pybullet", "mitsuba", "blender")
MISSING = 3  # exit status of peer_renderers.py


@dataclass(frozen=True)
class Peers:
    """Compare neeco with renderers of meshes."""

    run: tyro.conf.Positional[Path]
    """Run folder that neeco's images are rendered from."""
    python: Path = Path(sys.executable)
    """Python that has the other renderers."""
    count: int = 20
    """Images of each renderer in a turn; Blender makes a tenth."""
    turns: int = 3
    """Turns."""
    threads: int = 1
    """Threads of each renderer."""
    json: Path | None = None
    """File for the numbers."""


def of_neeco(run: Path, count: int) -> dict[str, Any]:
    """Labelled images for a network: image, parts, masks, boxes, keypoints, poses and depth."""
    images = neeco.LabelledImages(run, count + 1)
    shares = [float((images[0]["parts"] > 0).float().mean())]
    wall, cpu = time.perf_counter(), time.process_time()
    for index in range(1, count + 1):
        shares.append(float((images[index]["parts"] > 0).float().mean()))
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    how = "learned Gaussians; parts, boxes, keypoints and poses as well"
    found = {"renderer": "neeco", "how": how, "images_per_second": count / wall, "cpu_s_per_image": cpu / count}
    return found | {"instrument_share": statistics.mean(shares)}


def of_peer(name: str, args: Peers, size: str) -> dict[str, Any] | None:
    """One turn of another renderer; None where it is not installed."""
    count = max(1, args.count // 10) if name == "blender" else args.count
    script = Path(__file__).with_name("peer_renderers.py")
    ended = subprocess.run(
        [args.python, script, name, "--count", str(count), "--size", size],
        env=os.environ | {"OMP_NUM_THREADS": str(args.threads), "LP_NUM_THREADS": str(args.threads)},
        capture_output=True,
        text=True,
    )
    if ended.returncode == MISSING:
        return None
    if ended.returncode:
        raise SystemExit(f"{name} failed: {ended.stderr[-2000:]}")
    found: dict[str, Any] = json.loads(ended.stdout.splitlines()[-1])
    return found


def main(args: Peers) -> None:
    hardware = machine(torch.device("cpu"))
    print(hardware_words(hardware))
    set_threads(args.threads)
    keep_freed_memory()
    camera = neeco.LabelledImages(args.run, 1)[0]["camera"]
    turns: dict[str, list[dict[str, Any]]] = {"neeco": []}
    skipped: set[str] = set()
    for _ in range(args.turns):
        turns["neeco"].append(of_neeco(args.run, args.count))
        for name in RENDERERS:
            found = None if name in skipped else of_peer(name, args, f"{camera.width}x{camera.height}")
            if found is not None:
                turns.setdefault(name, []).append(found)
            elif name not in skipped:
                skipped.add(name)
                print(f"{name}: skipped, {args.python} does not have it")
    rows = []
    for found in turns.values():
        row = found[0] | {
            key: statistics.median(one[key] for one in found) for key in ("images_per_second", "cpu_s_per_image")
        }
        rows.append(row)
        share = "" if row["instrument_share"] is None else f"{row['instrument_share']:6.1%} instrument"
        print(
            f"{row['renderer']:>9}  {row['images_per_second']:8.2f} images/s  {row['cpu_s_per_image']:8.4f} s cpu  "
            f"{share:18}  {row['how']}"
        )
    if args.json is not None:
        args.json.write_text(json.dumps({"machine": hardware, "renderers": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Peers))
