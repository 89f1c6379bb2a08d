"""Trains and evaluates builds of neeco on drawn worlds: one job a build and world, each in processes of its own.

A build is a commit, "." for this checkout or the folder of another, optionally less one mechanism:
"COMMIT:without-NAME" (`WITHOUT`).
"""

from __future__ import annotations

import itertools
import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from rendered.draws import SIZES, World, draw_world
from rendered.world_capture import write_world

from neeco.base.errors import NeecoError
from neeco.base.files import finite, read_json, write_json

ROOT = Path(__file__).resolve().parents[1]
METHOD = "import neeco.methods.kinematic.deformation as m; "
SEARCH = "import neeco.methods.kinematic.discovery as m; "
SESSION = "import neeco.training.session as m; "
FINISH = "import neeco.methods.kinematic.finish as m; "
NOTHING = "lambda *_, **__: None"
TOUCHED = "-touched"  # ends the names of worlds whose instrument touches the tissue
Name = int | str  # of a world: its seed, or that with TOUCHED


def always(world: World) -> bool:
    """Every world."""
    return True


def jointed(world: World) -> bool:
    """Joints are logged."""
    return world.joints


def linked(world: World) -> bool:
    """Links are stated, and joints are logged."""
    return world.links != "none" and world.joints


def unstated_wrist(world: World) -> bool:
    """A wrist whose joints are logged and whose links nothing states."""
    return world.links == "none" and world.joints and world.kind == "wrist"


def erring(world: World) -> bool:
    """States have errors."""
    return world.states != "exact"


def mistaken(world: World) -> bool:
    """States have larger errors than a tracker's, or some are wrong altogether."""
    return world.states == "independent" or world.wrong > 0


def mistaken_links(world: World) -> bool:
    """The same, and links are stated."""
    return mistaken(world) and linked(world)


def misplaced(world: World) -> bool:
    """Stated links of a wrist are off along the shaft."""
    return linked(world) and world.kind == "wrist" and world.frame_off != 0


@dataclass(frozen=True)
class Mechanism:
    """What can be left out, by a statement before the command or by options of `train`, and the worlds it works on."""

    left_out: str | tuple[str, ...]
    applies_to: Callable[[World], bool] = always


def _option(words: str, applies_to: Callable[[World], bool] = always) -> Mechanism:
    return Mechanism(("--set", words), applies_to)


WITHOUT: dict[str, Mechanism] = {
    "silhouettes": Mechanism(f"{METHOD}m.observe_silhouettes = {NOTHING}"),
    "states-before-training": Mechanism(f"{SEARCH}m.register_states = {NOTHING}", mistaken_links),
    "pose-registration": Mechanism(f"{SEARCH}m.correct_poses = {NOTHING}", misplaced),
    "links-aligned": Mechanism(
        f"{SEARCH}m.align_to_links = lambda session, links, evidence, name, shape, generator: shape", linked
    ),
    "state-fits": Mechanism(f"{METHOD}m.fit_states = {NOTHING}", mistaken),
    "contradictions": Mechanism(
        METHOD
        + "; ".join(f"m.{name} = {NOTHING}" for name in ("refit_outliers", "judge_again", "leave_out_unexplained")),
        mistaken,
    ),
    "judging-again": Mechanism(f"{METHOD}m.judge_again = {NOTHING}", mistaken),
    "carving-again": Mechanism(f"{METHOD}m.carve_again = {NOTHING}", mistaken),
    "refuted-dropped": Mechanism(
        f"{FINISH}m.drop_refuted = lambda run, _: (run.scene.canonical, run.scene.canonical.opacity_logits * 0)"
    ),
    "detached-dropped": Mechanism(f"{FINISH}m.drop_detached = lambda canonical, *_: canonical"),
    "distinct-frames": Mechanism(
        f"{FINISH}import neeco.evidence.carving as c, neeco.methods.tissue_fit as t; "
        "c.distinct_frames = t.distinct_frames = m.distinct_frames = lambda views: list(range(len(views)))"
    ),
    "wrists-found": Mechanism(
        f"import neeco.methods.kinematic.discovery as m; m.search_wrist = {NOTHING}", unstated_wrist
    ),
    "wrists-placed": Mechanism(f"{METHOD}m.place_wrists = {NOTHING}", jointed),
    "wrists-again": _option("deformation.refine_wrists=false", jointed),
    "shadow": _option("deformation.shadow=false"),
    "breathing": _option("deformation.breathing=false"),
    "label-sharpness": _option("deformation.label_sharpness=0"),
    "spun-shaft": _option("deformation.shaft_roll=0"),
    "opacity-penalty": _option("deformation.opacity_penalty=0"),
    "extrapolated-tissue": _option("deformation.extrapolate_tissue=false"),
    "corrected-axes": _option("deformation.stated_axes=false", linked),
    "corrected-readings": _option("deformation.stated_readings=false", linked),
    "predicted-errors": Mechanism(f"{SESSION}m.GaussianSession._predict_states = {NOTHING}", erring),
    "frame-poses": _option("refine.frame_poses=false", erring),
    "frame-joints": _option("refine.frame_joints=false", jointed),
}
START = "import sys; from neeco.cli import main; sys.exit(main())"
LAST_LINES = 12
ERRORS_OVER_SD = re.compile(r"(, wrong states)? \((\d+) frames\): .*; / sd (\S+) (\S+) (\S+)")


@dataclass(frozen=True)
class Build:
    """A checkout with its kernels, and what is left out of it."""

    title: str
    checkout: Path
    without: str = ""

    def words(self, verb: str, *words: str) -> list[str]:
        """A command line of this build."""
        left_out = WITHOUT[self.without].left_out if self.without else ()
        if isinstance(left_out, str):
            return [*self.python, "-c", f"{left_out}\n{START}", verb, *words]
        return [*self.python, "-c", START, verb, *words, *(left_out if verb == "train" else ())]

    @property
    def python(self) -> list[str]:
        """The interpreter; of other checkouts than this one without what an editable installation puts before them."""
        return [sys.executable] if self.checkout == ROOT else [sys.executable, "-S"]

    @property
    def environment(self) -> dict[str, str]:
        """One thread each: jobs run side by side."""
        threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        paths = os.pathsep.join([str(self.checkout / "src"), sysconfig.get_path("purelib")])
        return {**os.environ, **threads, "PYTHONPATH": paths}


@dataclass(frozen=True)
class Ended:
    """A command that has ended: exit status, what it said, processor seconds and peak memory (GiB)."""

    status: int
    said: str
    seconds: float
    gib: float


def builds_of(names: Sequence[str], work: Path) -> list[Build]:
    """The builds of these names; commits are checked out below `work`. Raises NeecoError for unknown ones."""
    found = []
    for name in names:
        commit, _, without = name.partition(":")
        without = without.removeprefix("without-")
        if without and without not in WITHOUT:
            raise NeecoError(f"{name}: {without} cannot be left out; one of {', '.join(WITHOUT)} can")
        found.append(Build(name, ROOT if commit == "." else _checked_out(commit, work / "builds"), without))
    return found


def _checked_out(commit: str, folder: Path) -> Path:
    """The checkout of a commit, its kernels built once."""
    said = subprocess.run(["git", "rev-parse", "--short=10", f"{commit}^{{commit}}"], cwd=ROOT, capture_output=True)
    if said.returncode:
        if (Path(commit) / "src" / "neeco").is_dir():
            return Path(commit).resolve()
        raise NeecoError(f"--commits: {commit} is no commit of this repository, and no checkout")
    path = folder / said.stdout.decode().strip()
    if not (path / "src" / "neeco").exists():
        path.mkdir(parents=True)
        archive = subprocess.run(["git", "archive", commit], cwd=ROOT, capture_output=True, check=True)
        subprocess.run(["tar", "-x"], cwd=path, input=archive.stdout, check=True)
    if not list((path / "src" / "neeco").glob("_native*")):
        with tempfile.TemporaryDirectory() as scratch:
            options = ["--quiet", "--no-deps", "--no-build-isolation", "--target", scratch]
            subprocess.run([sys.executable, "-m", "pip", "install", *options, str(path)], check=True)
            (kernels,) = Path(scratch).glob("neeco/_native*")
            shutil.copy(kernels, path / "src" / "neeco")
    return path


def world_of(name: Name) -> World:
    """The world of a name."""
    seed = str(name).removesuffix(TOUCHED)
    return draw_world(int(seed), touched=seed != str(name))


def worlds_of(mechanism: str, first: int, count: int) -> list[int]:
    """Seeds, from `first` on, of as many worlds that have what the mechanism works on."""
    suited = (seed for seed in itertools.count(first) if WITHOUT[mechanism].applies_to(draw_world(seed)))
    return list(itertools.islice(suited, count))


def run_all(
    worlds: Mapping[Name, Sequence[Build]], work: Path, options: Sequence[str], workers: int, *, quick: bool
) -> None:
    """Run what is not there yet: `worlds` has the builds by name. Says each result as it comes."""
    jobs = [
        (build, seed)
        for seed, builds in worlds.items()
        for build in builds
        if not result_path(work, build.title, seed).exists()
    ]
    began = time.monotonic()
    with ProcessPoolExecutor(workers) as pool:
        drawn = {}
        for seed in dict.fromkeys(seed for _, seed in jobs):
            drawn[seed] = pool.submit(_drawn, seed, work, quick)
        for seed, future in drawn.items():
            if (fault := future.result()) is not None:
                print(f"world {seed}: {fault}", flush=True)
        jobs = [(build, seed) for build, seed in jobs if (capture_path(work, seed) / "world.json").exists()]
        running = {pool.submit(_run, build, seed, work, tuple(options)): (build, seed) for build, seed in jobs}
        for count, future in enumerate(as_completed(running), 1):
            build, seed = running[future]
            result, passed = future.result(), time.monotonic() - began
            left = passed / count * (len(jobs) - count)
            score = "refused" if result["iou"] is None else f"IoU {result['iou']:.3f}"
            print(f"{count} of {len(jobs)}, {left / 60:.0f} min left: world {seed}, {build.title}: {score}", flush=True)


def result_path(work: Path, title: str, seed: Name) -> Path:
    """Where the result of a job lies."""
    return work / "results" / _name(title) / f"{seed}.json"


def run_path(work: Path, title: str, seed: Name) -> Path:
    """The run folder of a job."""
    return work / "runs" / _name(title) / str(seed)


def _name(title: str) -> str:
    return "here" if title == "." else re.sub(r"[^\w.-]+", "-", title).strip("-")


def capture_path(work: Path, seed: Name) -> Path:
    """Where a world lies."""
    return work / "worlds" / str(seed)


def _drawn(seed: Name, work: Path, quick: bool) -> str | None:
    """Draw a world where it is absent; return why it cannot be drawn."""
    torch.set_num_threads(1)
    path = capture_path(work, seed)
    if (path / "world.json").exists():
        return None
    shutil.rmtree(path, ignore_errors=True)
    try:
        world = world_of(seed)
        write_world(replace(world, size=SIZES[0], scale=1.0) if quick else world, path)
    except NeecoError as error:
        return str(error)
    return None


def _run(build: Build, seed: Name, work: Path, options: tuple[str, ...]) -> dict[str, Any]:
    """One job; writes and returns its result."""
    capture, run = capture_path(work, seed), run_path(work, build.title, seed)
    world = read_json(capture / "world.json")
    shutil.rmtree(run, ignore_errors=True)
    checked = Ended(0, "", 0, 0) if build.without else _command(build, "check", str(capture), "--json", "-")
    scale = () if world["scale"] == 1.0 else ("--scale", str(world["scale"]))
    trained = _command(build, "train", str(capture), "--output", str(run), *scale, *options)
    result: dict[str, Any] = {
        "seed": seed,
        "build": build.title,
        "world": world,
        "check": [problem["message"] for problem in json.loads(checked.said)["problems"]] if checked.said else [],
        "status": trained.status,
        "warnings": [line for line in trained.said.splitlines() if "warning:" in line],
        "said": trained.said.splitlines()[-LAST_LINES:],
        "train_seconds": trained.seconds,
        "gib": trained.gib,
        "iou": None,
        "doubts": [],
    }
    if trained.status == 0:
        result |= _evaluated(build, run)
    write_json(result_path(work, build.title, seed), finite(result))
    return result


def _evaluated(build: Build, run: Path) -> dict[str, Any]:
    """Scores, doubts and errors over stated deviations of a run."""
    ended = _command(build, "evaluate", str(run), "--align")
    if ended.status:
        return {"status": ended.status, "said": ended.said.splitlines()[-LAST_LINES:]}
    evaluation = read_json(run / "evaluation.json")
    aligned, given = evaluation["aligned"], evaluation["given"]
    keys = ("mask_iou", "mask_precision", "shaft_recall", "part_iou", "psnr", "psnr_instrument", "estimated_iou")
    scores = {kind: {split: {key: rows.get(key) for key in keys} for split, rows in splits.items()}
              for kind, splits in (("aligned", aligned), ("given", given))}  # fmt: skip
    ious = [rows["mask_iou"] for rows in aligned.values()]
    recalls = [rows["shaft_recall"] for rows in aligned.values() if rows["shaft_recall"] is not None]
    found: dict[str, Any] = {
        "iou": sum(ious) / len(ious),
        "recall": min(recalls) if recalls else None,
        "scores": scores,
        "doubts": evaluation.get("doubts", []),
        "evaluate_seconds": ended.seconds,
    }
    script = str(build.checkout / "benchmarks" / "state_scores.py")
    states = subprocess.run(
        [*build.python, script, str(run)], env=build.environment, capture_output=True, text=True
    ).stdout
    for wrong, count, *values in ERRORS_OVER_SD.findall(states):
        key = "over_sd_wrong" if wrong else "over_sd"
        found[key] = {"frames": int(count), "turn_shift_joints": [float(value) for value in values]}
    return found


def _command(build: Build, verb: str, *words: str) -> Ended:
    """Run one command of a build. What it says on stderr follows what it says on stdout."""
    with tempfile.TemporaryFile("w+") as said, tempfile.TemporaryFile("w+") as noted:
        child = subprocess.Popen(build.words(verb, *words), env=build.environment, stdout=said, stderr=noted)
        _, status, used = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        text = ""
        for file in (said, noted):
            file.seek(0)
            text += "" if file is noted and verb == "check" else file.read()
    return Ended(child.returncode, text, used.ru_utime + used.ru_stime, used.ru_maxrss / 2**20)
