"""Times whole commands of two checkouts in turns: what a user waits for, at an old commit and now.

    git worktree add ../old COMMIT                       # each with its kernels built: pip install --no-deps -e .
    python benchmarks/turns.py ../old . OLD_RUN NEW_RUN CAPTURE [--turns 5] [--only track check]

OLD_RUN, NEW_RUN: what each trained of CAPTURE, which is a rendered capture with images, states and, for `ingest`,
`video.mp4` and `logs/` (instrument.csv, camera.csv, jaw.csv, jaw_calibration.csv). Nothing of these is written to.

Every command runs in a process of its own, start included; the table has the medians, every turn, and the ratio of the
medians, by wall and by processor time of the process and its workers. Of `images` and `track` the time is per image
and per frame: a long command less a short one. Leave the machine alone meanwhile, or read the processor time only.
"""

from __future__ import annotations

import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

from neeco.capture import read_capture
from neeco.studies.machine import hardware_words, machine

START = "import sys; from neeco.cli import main; sys.exit(main())"
IMAGES = 300
FRAMES = (40, 160)  # at most, of the two stretches that are tracked
COMMANDS = ("help", "check", "one image", "images 320x256", "images 240x192", "track", "ingest")


@dataclass(frozen=True)
class Turns:
    """Time whole commands of two checkouts in turns."""

    old: tyro.conf.Positional[Path]
    """Checkout of the old commit."""
    new: tyro.conf.Positional[Path]
    """Checkout of the new one."""
    old_run: tyro.conf.Positional[Path]
    """Run that the old commit trained."""
    new_run: tyro.conf.Positional[Path]
    """Run that the new one trained."""
    capture: tyro.conf.Positional[Path]
    """Capture that both were trained on."""
    turns: int = 5
    """Turns."""
    only: tuple[str, ...] = COMMANDS
    """Of these commands."""


@dataclass(frozen=True)
class Took:
    """Seconds of a command: wall time, and processor time of it and its workers."""

    wall: float
    cpu: float

    def less(self, other: Took, share: int) -> Took:
        """What each of `share` more images or frames took."""
        return Took((self.wall - other.wall) / share, (self.cpu - other.cpu) / share)


@dataclass(frozen=True)
class Side:
    """One checkout with its run."""

    checkout: Path
    run: Path
    capture: Path
    folder: Path  # for outputs
    footage: tuple[Path, ...]  # a short stretch to track and a longer one

    def time(self, command: str) -> Took:
        """Run one of COMMANDS. Exits with what it said where it fails."""
        run = str(self.run)
        if command == "help":
            return self._neeco("--help")
        if command == "check":
            return self._neeco("check", str(self.capture))
        if command == "one image":
            return self._neeco("synthesize", run, "--count", "1", "--output", self._output())
        if command.startswith("images"):
            options = ["--workers", "2", "--size", command.split()[1]]
            few, many = (
                self._neeco("synthesize", run, "--count", str(count), *options, "--output", self._output())
                for count in (1, 1 + IMAGES)
            )
            return many.less(few, IMAGES)
        if command == "track":
            few, many = (
                self._neeco("track", run, str(path), "--output", self._output(), "--start", "first")
                for path in self.footage
            )
            short, long = (len(read_capture(path).frames) for path in self.footage)  # CAPTURE may have fewer than asked
            return many.less(few, long - short)
        logs, camera = self.capture / "logs", read_capture(self.capture).frames[0].camera
        joint = ["--joint", "jaw_angle", str(logs / "jaw.csv"), str(logs / "jaw_calibration.csv")]
        lens = [str(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy)]
        tracked = ["--instrument", str(logs / "instrument.csv"), "--laparoscope", str(logs / "camera.csv")]
        video = ["--video", str(self.capture / "video.mp4")]
        return self._neeco("ingest", *video, *tracked, *joint, "--intrinsics", *lens, "--output", self._output())

    def _output(self) -> str:
        output = self.folder / "output"
        shutil.rmtree(output, ignore_errors=True)
        return str(output)

    def _neeco(self, *words: str) -> Took:
        return self._python("-c", START, *words)

    def _python(self, *words: str) -> Took:
        environment = {**os.environ, "PYTHONPATH": str(self.checkout.resolve() / "src")}
        before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        done = subprocess.run([sys.executable, *words], env=environment, capture_output=True, text=True)
        wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
        if done.returncode:
            sys.exit(f"{self.checkout}: {' '.join(words[2:4])}: {done.stderr.strip().splitlines()[-1]}")
        return Took(wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)


def main() -> None:
    arguments, hardware = tyro.cli(Turns, description=__doc__), machine(torch.device("cpu"))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        footage = tuple(folder / f"footage-{count}" for count in FRAMES)
        if "track" in arguments.only:
            for count, path in zip(FRAMES, footage, strict=True):
                script = str(Path(__file__).parent / "tracking.py")
                words = [script, "footage", str(arguments.capture), str(path), "--splits", "train", "test"]
                subprocess.run([sys.executable, *words, "--count", str(count), "--first-state"], check=True)
        sides = {
            "old": Side(arguments.old, arguments.old_run, arguments.capture, folder, footage),
            "new": Side(arguments.new, arguments.new_run, arguments.capture, folder, footage),
        }
        took: dict[str, dict[str, list[Took]]] = {what: {"old": [], "new": []} for what in arguments.only}
        for turn in range(arguments.turns):
            for what in arguments.only:
                for side in sorted(sides, reverse=bool(turn % 2)):  # neither is always the first
                    took[what][side].append(sides[side].time(what))
                    print(f"turn {turn + 1}: {what}, {side}: {took[what][side][-1].wall:.4g} s", flush=True)
    print(f"\n{hardware_words(hardware)}\n")
    print("| what | old, s | new, s | ratio | ratio of processor time |\n|---|---|---|---|---|")
    for what, both in took.items():
        cells, ratios = [], []
        for attribute in ("wall", "cpu"):
            values = {side: [getattr(one, attribute) for one in both[side]] for side in sides}
            medians = {side: statistics.median(values[side]) for side in sides}
            ratios.append(f"{medians['new'] / medians['old']:.2f}")
            if attribute == "wall":
                cells = [
                    f"{medians[side]:.3g} ({', '.join(f'{one:.3g}' for one in sorted(values[side]))})" for side in sides
                ]
        print(f"| {what} | {' | '.join(cells + ratios)} |")


if __name__ == "__main__":
    main()
