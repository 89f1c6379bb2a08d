"""Whatever stands in the files that a command reads, it works or refuses in one line.

    python benchmarks/mutations.py [--cases N] [--seed S] [--case K] [--verbs check train …] [--work DIR]

Every case takes fresh copies of a small capture, run, data set or recording, damages what one verb reads in one to
three places (`damage.py`), and runs the verb in a fork of this process. It must end with exit status 0 or 1 within 10 s
of the processor's time and 2 GiB of memory; a refusal is one line on stderr that names an input; nothing leaves a
traceback, a class of Python's or a terminal's control characters, replaces a pipe or link, writes out of its output or
shows what lies outside the capture it was given.

Case K of seed S is always the same: `--seed S --case K` plays it again and shows everything. Exit status 1 where
anything was wrong.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import random
import shutil
import signal
import stat
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml
from damage import EDITORS, SCRIPT, edit_bytes, edit_file
from forked import DRAW, Child, Ended, limit_memory
from mutated_world import make_world, prepare

from neeco.base.files import LOCK, TEMPORARY

SECONDS = 10.0  # of the processor
GIB = 2.0
PATIENCE = 40.0  # s on the wall: the machine may be busy
CANARY = "a-secret-outside-the-folder"


@dataclass(frozen=True)
class Case:
    """How one verb is tried. `reads`: globs in the world of what is damaged; `words`: its command line."""

    reads: tuple[str, ...]
    words: tuple[str, ...]
    weight: float = 1.0
    needs: tuple[str, ...] = ()  # folders of the world beside those that `reads` names


CAPTURE = ("capture/transforms.json", "capture/transforms.json", "capture/sparse.ply", "capture/*/*.png")
RUN = ("run/config.yaml", "run/scene.safetensors", "run/scene.safetensors", "run/metrics.jsonl")
RECORDING = ("recording/*.yaml", "recording/*.yaml", "recording/*.csv", "recording/*.csv", "recording/video.mp4")
SET = ("set/dataset.json", "set/.records/*", "set/.records/*", "set/images/*", "set/states.jsonl")
STEPS = ("--iterations", "3", "--set", "max_tissue_gaussians=200")
OUT = ("--output", "out")
CASES: dict[str, Case] = {
    "check": Case(CAPTURE, ("check", "capture"), 6),
    "train": Case(CAPTURE, ("train", "capture", *STEPS, *OUT), 3),
    "train --resume": Case(
        ("cut/config.yaml", "cut/checkpoint/*", "cut/checkpoint/*", "cut/metrics.jsonl"),
        ("train", "capture", "--output", "cut", "--resume"),
        2,
        ("capture",),
    ),
    "evaluate": Case((*RUN, *CAPTURE[:2], "capture/truth/masks/*"), ("evaluate", "run"), 1, ("capture", "run")),
    "render --states": Case(
        ("states.jsonl", *RUN), ("render", "run", "--states", "states.jsonl", *OUT), 3, ("capture", "run")
    ),
    "synthesize": Case(RUN, ("synthesize", "run", "--count", "1", *DRAW, *OUT), 2),
    "synthesize --camera-effects": Case(
        ("effects.yaml",),
        ("synthesize", "run", "--count", "1", "--camera-effects", "effects.yaml", *DRAW, *OUT),
        2,
        ("run",),
    ),
    "synthesize --resume": Case(
        SET, ("synthesize", "run", "--count", "4", *DRAW, "--output", "set", "--resume"), 2, ("run",)
    ),
    "annotate": Case((*RUN, *CAPTURE), ("annotate", "run", "--min-trust", "0", "--force", *OUT), 0.4),
    "view --export": Case(RUN, ("view", "run", "--export", "out.html"), 2),
    "export": Case((*RUN, "states.jsonl"), ("export", "run", "--states", "states.jsonl", "--output", "out.ply"), 2),
    "score-masks": Case(
        ("predicted/*", "predicted/*", "capture/truth/masks/*", "capture/transforms.json"),
        ("score-masks", "predicted", "capture"),
        3,
    ),
    "compare": Case(
        ("compared/sweep.json", *(f"compared/runs/*/*.{kind}" for kind in ("json", "jsonl", "yaml", "safetensors"))),
        ("compare", "capture", "--methods", "3dgs", "--iterations", "3", "--output", "compared"),
        1,
        ("capture",),
    ),
    "ingest": Case(RECORDING, ("ingest", "recording/recording.yaml", *OUT), 3),
    "ingest FOLDER": Case(
        ("capture/transforms.json", "capture/images/*"), ("ingest", "capture", *OUT), 2, ("capture",)
    ),
}


def is_small(path: Path) -> bool:
    """Return whether it is a file that no earlier damage made huge."""
    return path.is_file() and path.stat().st_size < 2**26


def folders_of(case: Case) -> set[str]:
    """What of the world a case takes."""
    return {*(glob.split("/")[0] for glob in case.reads), *case.needs}


@dataclass(frozen=True)
class Outcome:
    """What one case did, and what was wrong with that."""

    verb: str
    words: tuple[str, ...]
    damage: list[str]
    ended: Ended
    wrong: list[str]


class Bench:
    """Plays cases on copies of one world."""

    def __init__(self, work: Path, verbs: Sequence[str], seed: int) -> None:
        self.work, self.verbs, self.seed = work.resolve(), list(verbs), seed
        self.desk, self.world = self.work / "desk", self.work / "world"
        self.desk.mkdir(parents=True)
        make_world(self.desk, {name for verb in self.verbs for name in folders_of(CASES[verb])})
        self.desk.rename(self.world)
        self.outside = self.work / "outside"
        self.outside.mkdir()
        (self.outside / "secret.txt").write_text(CANARY)
        (self.outside / "secret.json").write_text(json.dumps({CANARY: CANARY}))
        for name in ("png", "jpg"):
            shutil.copy(self.world / "capture" / "images" / "000001.png", self.outside / f"secret.{name}")
        self.before = self._outside()
        self.inputs = [*sorted(path.name for path in self.world.rglob("*")), "desk", "out", "secret", "passwd"]

    def play(self, number: int) -> Outcome:
        """Case `number` of this seed."""
        pick = random.Random(f"{self.seed}/{number}")
        verb = pick.choices(self.verbs, [CASES[name].weight for name in self.verbs])[0]
        case = CASES[verb]
        self._lay_out(case)
        damage = [self._damage(case, pick) for _ in range(pick.choice((1, 1, 1, 2, 3)))]
        self.nodes = self._nodes()
        child = Child(case.words, self.work, lambda: limit_memory(GIB))
        return self._judged(verb, case.words, damage, child.wait(PATIENCE))

    def require_sound(self) -> None:
        """Play every verb on what is not damaged: one that is refused there would try nothing."""
        for verb in self.verbs:
            self._lay_out(CASES[verb])
            ended = Child(CASES[verb].words, self.work).wait()
            assert ended.status == 0, f"{verb}: {ended.told}"

    def _lay_out(self, case: Case) -> None:
        os.chdir(self.work)
        shutil.rmtree(self.desk, ignore_errors=True)
        self.desk.mkdir()
        for name in sorted(folders_of(case)):
            source = self.world / name
            shutil.copytree(source, self.desk / name) if source.is_dir() else shutil.copy(source, self.desk / name)
        os.chdir(self.desk)

    def _damage(self, case: Case, pick: random.Random) -> str:
        """Damage one file; says which and how."""
        found = self.desk.glob(pick.choice(case.reads))
        files = sorted(path for path in found if not path.is_symlink() and is_small(path))
        if not files:
            return "nothing left to damage"
        path = pick.choice(files)
        edited = EDITORS.get(path.suffix, edit_bytes)
        how = pick.random()
        try:
            if how < 0.72:
                edited(path, pick)
                told = edited.__name__
            elif how < 0.88:
                edit_bytes(path, pick)
                told = "edit_bytes"
            else:
                others = sorted(other for other in self.desk.rglob("*") if is_small(other) and other != path)
                edit_file(path, others, self.outside, pick)
                told = "edit_file"
        except Exception:
            return f"{path.relative_to(self.desk)}: as it was"  # does not apply to what another left
        return f"{path.relative_to(self.desk)}: {told}"

    def _judged(self, verb: str, words: tuple[str, ...], damage: list[str], ended: Ended) -> Outcome:
        wrong = []
        texts = ended.said + ended.told
        if ended.status < 0 and verb == "train --resume" and self._long_training():
            pass  # it does as it is told
        elif ended.status not in (0, 1):
            wrong.append(f"exit status {ended.status} after {ended.seconds:.1f} s: {ended.told[-1500:]}")
        elif ended.status == 1 and not (words[0] == "check" and ended.said and not ended.told):
            complaint = ended.in_one_line()
            wrong += [complaint] if complaint else []
            last = (ended.told.strip().splitlines() or [""])[-1]
            if not complaint and not any(name in last for name in [*self.inputs, "--"]):
                wrong.append(f"names no input: {last}")
        if "Traceback" in texts:
            wrong.append("a traceback")
        if "<class " in texts:
            wrong.append("shows a class of Python's")
        if any(ord(letter) < 32 and letter not in "\n\t" for letter in texts) or "\x1b" in texts:
            wrong.append("control characters")
        if ended.processor > SECONDS:
            wrong.append(f"{ended.processor:.1f} s of the processor")
        if ended.peak_mb > GIB * 1024:
            wrong.append(f"{ended.peak_mb:.0f} MiB")
        # whoever names a link themselves wants what it leads to
        if CANARY in texts and not any((self.desk / word).is_symlink() for word in words):
            wrong.append("shows what lies outside")
        gone = [name for name, kind in self.nodes.items() if self._nodes().get(name) != kind]
        if gone:
            wrong.append(f"replaced {gone[0]}, which was no regular file")
        if self._outside() != self.before:
            wrong.append("changed what lies outside")
        pages = [path for path in self.desk.rglob("*.html") if path.is_file() and SCRIPT.encode() in path.read_bytes()]
        if pages:
            wrong.append(f"{pages[0].name} runs what a name says")
        if (self.desk / "pwned").exists():
            wrong.append("ran what a file told it to")
        left = [path for path in self.desk.rglob(".*") if path.name == LOCK or path.name.startswith(TEMPORARY)]
        if left and ended.status >= 0:
            wrong.append(f"left {left[0].name}")
        return Outcome(verb, words, damage, ended, wrong)

    def _long_training(self) -> bool:
        """Whether config.yaml, damaged as it is, asks for more steps than there is patience for."""
        try:
            config = yaml.safe_load((self.desk / "cut" / "config.yaml").read_text())
            return config["iterations"] > 1000 or config["minutes"] is not None
        except (OSError, yaml.YAMLError, LookupError, TypeError):
            return False

    def _nodes(self) -> dict[str, int]:
        """Kinds of all links, pipes and devices on the desk."""
        modes = {str(path.relative_to(self.desk)): path.lstat().st_mode for path in self.desk.rglob("*")}
        return {
            name: stat.S_IFMT(mode) for name, mode in modes.items() if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))
        }

    def _outside(self) -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in self.outside.iterdir()}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--case", type=int, help="play this one only, and show what it did")
    parser.add_argument(
        "--verbs", nargs="+", choices=list(CASES), default=list(CASES), help="case numbers depend on it"
    )
    parser.add_argument("--work", type=Path, help="an absent folder to work in; kept (default: a temporary one)")
    args = parser.parse_args()
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    prepare()
    gc.freeze()  # what is there is never collected in a child, so its pages stay shared
    began, counts, wrong = time.monotonic(), Counter[str](), Counter[str]()
    with tempfile.TemporaryDirectory() as temporary:
        bench = Bench(args.work or Path(temporary) / "work", args.verbs, args.seed)
        if args.case is None:
            bench.require_sound()
        for number in [args.case] if args.case is not None else range(args.cases):
            outcome = bench.play(number)
            counts[outcome.verb] += 1
            if outcome.wrong or args.case is not None:
                wrong[outcome.verb] += bool(outcome.wrong)
                told = f"neeco {' '.join(outcome.words)}: {'; '.join(outcome.damage)}"
                print(f"--seed {args.seed} --case {number}: {told}")
                for line in outcome.wrong:
                    print("    " + line.strip().replace("\n", "\n    "), flush=True)
            if args.case is not None:
                print(outcome.ended)
        os.chdir("/")
    for verb in sorted(counts):
        print(f"{verb}: {counts[verb]} cases, {wrong[verb]} wrong")
    print(f"{sum(counts.values())} cases, {sum(wrong.values())} wrong, {time.monotonic() - began:.0f} s")
    return 1 if sum(wrong.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
