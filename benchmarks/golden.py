"""The golden table: does another build write the same bits? Six small captures, every verb that learns or draws.

    python benchmarks/golden.py --commits OLD NEW --work DIR

A build is a commit, "." (this checkout) or a checkout's folder. Each trains 300 iterations on each capture, then runs
evaluate --align, synthesize, annotate and track, and ingests a bag. DIR/golden.json has, by build, the SHA-256 of every
file written, times and versions left aside; the table says for each capture and verb whether all builds agree. Exit
status 1 where they do not. What a build wrote stays in DIR/BUILD, so that same_bits.py
can say how two files differ. Five minutes a build.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from rendered.draws import SIZES, World, draw_world
from rendered.world_capture import write_world
from same_bits import digests_of
from scipy.spatial.transform import Rotation
from world_runs import ROOT, Build, builds_of

from neeco.base.errors import NeecoError
from neeco.base.files import read_json, write_json, write_text
from neeco.capture import read_capture

sys.path.append(str(ROOT / "tests"))
from bagwriter import BagWriter

SEED = 11
BAG_HZ = 10.0
ITERATIONS, IMAGES = 300, 20
TRACKED = ("stated-links", "still-scope")  # of which footage is made
RECORDING = """video: {file: recording.bag, stream: /left/image_raw}
camera: still
instruments:
  - name: instrument
    poses: {file: recording.bag, stream: /arm/measured_cp, frame: camera}
    joints: {jaw_angle: {file: recording.bag, stream: /arm/jaw/measured_js, columns: {value: jaw_angle_rad}}}
"""


def captures() -> dict[str, World]:
    """What is drawn: exact links, several joints, a still scope, wrong states."""
    usual = replace(draw_world(SEED), size=SIZES[0], frames=20, joints=True, stated=False, wrong=0.0, scale=1.0)
    return {
        "stated-links": replace(usual, kind="hinge", links="exact", scope="moving", states="exact"),
        "several-joints": replace(usual, kind="wrist", links="none", scope="moving", states="tracker"),
        "still-scope": replace(usual, kind="hinge", links="off", scope="still", states="encoders"),
        "wrong-states": replace(usual, kind="wrist", links="exact", states="independent", wrong=0.1),
    }


def draw_all(folder: Path) -> None:
    """Write the captures that are absent, a bag of the still scope's, and one without instrument."""
    for name, world in captures().items():
        if not (folder / name / "world.json").exists():
            shutil.rmtree(folder / name, ignore_errors=True)
            write_world(world, folder / name)
    if not (folder / "bag" / "recording.yaml").exists():
        shutil.rmtree(folder / "bag", ignore_errors=True)
        _write_bag(folder / "still-scope", folder / "bag")
    bare = folder / "no-instrument"
    if not bare.exists():
        scratch = folder / "no-instrument.part"
        shutil.rmtree(scratch, ignore_errors=True)
        shutil.copytree(folder / "stated-links", scratch)
        shutil.rmtree(scratch / "truth")
        document = read_json(scratch / "transforms.json")
        document.pop("instruments")
        for frame in document["frames"]:
            frame.pop("instruments", None)
        write_json(scratch / "transforms.json", document)
        scratch.rename(bare)


def _write_bag(capture_folder: Path, folder: Path) -> None:
    """The frames of a capture with a still scope as a ROS 1 bag, poses in the camera's frame."""
    capture = read_capture(capture_folder)
    folder.mkdir(parents=True)
    with BagWriter(folder, "recording.bag") as bag:
        for number, frame in enumerate(capture.frames):
            time, (state,) = number / BAG_HZ, frame.state.instruments.values()
            pose = frame.camera.camera_from_world @ state.pose.numpy()
            turn = Rotation.from_matrix(pose[:3, :3]).as_quat()[[3, 0, 1, 2]]
            bag.pose("/arm/measured_cp", time, pose[:3, 3] / 1e3, turn, "camera")
            bag.joints("/arm/jaw/measured_js", time, **{name: float(value) for name, value in state.joints.items()})
            with Image.open(frame.image_path) as image:
                bag.image("/left/image_raw", time, np.array(image.convert("RGB")), "rgb8")
        lens = capture.frames[0].camera
        bag.camera_info("/left/camera_info", 0.0, (lens.width, lens.height), (lens.fx, lens.fy, lens.cx, lens.cy))
    write_text(folder / "recording.yaml", RECORDING)


def commands(capture: Path, output: Path, *, instrument: bool) -> dict[str, tuple[str, ...]]:
    """The verbs to run on a capture, and the words of each, in order."""
    run = str(output / "train")
    method = () if instrument else ("--method", "3dgs")
    verbs: dict[str, tuple[str, ...]] = {
        "train": (str(capture), "--output", run, "--iterations", str(ITERATIONS), *method),
        "evaluate": (run, *(("--align",) if instrument else ()), "--json", str(output / "evaluation.json")),
    }
    if instrument:
        verbs |= {
            "synthesize": (run, "--count", str(IMAGES), "--output", str(output / "synthesize"), "--force"),
            "annotate": (run, "--min-trust", "0", "--output", str(output / "annotate"), "--force"),
        }
    if capture.name in TRACKED:
        verbs["track"] = (run, str(capture), "--start", "first", "--min-trust", "0", "--output", str(output / "track"))
    return verbs


def run_build(build: Build, folder: Path, output: Path) -> dict[str, dict[str, str]]:
    """Run all verbs of a build; return, by "capture verb", the digest of each file, or what the verb said as it
    failed."""
    digests: dict[str, dict[str, str]] = {}
    ingested = output / "bag" / "capture"
    digests["bag ingest"] = _run(
        build, "ingest", (str(folder / "bag" / "recording.yaml"), "--output", str(ingested)), ingested
    )
    sources = {name: folder / name for name in [*captures(), "no-instrument"]} | {"bag": ingested}
    for name, capture in sources.items():
        for verb, words in commands(capture, output / name, instrument=name != "no-instrument").items():
            written = output / name / ("evaluation.json" if verb == "evaluate" else verb)
            digests[f"{name} {verb}"] = _run(build, verb, words, written)
            print(f"{build.title}: {name} {verb}: {len(digests[f'{name} {verb}'])} files", flush=True)
    return digests


def _run(build: Build, verb: str, words: tuple[str, ...], written: Path) -> dict[str, str]:
    ended = subprocess.run(build.words(verb, *words), env=build.environment, capture_output=True, text=True)
    if ended.returncode:
        return {"failed": ended.stderr.splitlines()[-1] if ended.stderr else f"exit status {ended.returncode}"}
    return digests_of(written) or {"failed": "nothing was written"}


def table(digests: dict[str, dict[str, dict[str, str]]]) -> tuple[str, bool]:
    """A row for each capture and verb, and whether all builds agree; one that failed does not."""
    first, *others = digests
    lines, agree = [f"| | files | {' | '.join(others)} |", "|---|---|" + "---|" * len(others)], True
    for key, before in digests[first].items():
        cells = []
        for other in others:
            after = digests[other].get(key, {})
            names = sorted(name for name in before.keys() | after.keys() if before.get(name) != after.get(name))
            agree = agree and not names and "failed" not in after
            cells.append(f"{len(names)} differ: {', '.join(names[:3])}" if names else "same")
        count = f"failed: {before['failed']}" if "failed" in before else str(len(before))
        lines.append(f"| {key} | {count} | {' | '.join(cells)} |")
    return "\n".join(lines), agree


def main() -> int:
    """Run the builds that have not run yet, and compare all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--commits", nargs="+", required=True, metavar="COMMIT")
    parser.add_argument("--work", type=Path, required=True, help="folder for captures, outputs and golden.json")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    work: Path = arguments.work
    draw_all(work / "captures")
    path = work / "golden.json"
    known = read_json(path) if path.exists() else {}
    for build in builds_of(arguments.commits, work):
        if build.title in known and build.checkout != ROOT:
            continue
        output = work / folder_name(build.title)
        shutil.rmtree(output, ignore_errors=True)
        known[build.title] = run_build(build, work / "captures", output)
        write_json(path, known)
    text, agree = table({title: known[title] for title in arguments.commits})
    print(text)
    return 0 if agree else 1


def folder_name(title: str) -> str:
    """The folder of a build's outputs."""
    return "here" if title == "." else title.replace("/", "-").strip("-")


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except NeecoError as error:
        raise SystemExit(f"golden: {error}") from None
