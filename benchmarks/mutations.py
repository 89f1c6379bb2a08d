"""Whatever stands in the files that a command reads, it works or refuses in one line.

    python benchmarks/mutations.py [--cases N] [--seed S] [--first K] [--case K] [--verbs check train …] [--work DIR]

Every case takes fresh copies of a small capture, run, data set, recording and so on, damages what one verb reads in one
to three places (fields deleted, doubled, of other types, huge, not finite, nested; files cut, with flipped bits,
swapped with one another, absent, folders, pipes, devices, links, 20 GB long; other kinds of image; keys given twice;
logs whose time begins anew; captures changed since training; headers that promise more than there is), gives options
that are out of range or an output that is a pipe, a link or a device, and runs the verb in a fork of this process. It
must end with exit status 0 or 1 (2 for an option's value that cannot be parsed) within 10 s of the processor's time and
2 GiB of memory; a refusal is one line on stderr that names an input; nothing leaves a traceback, a class of Python's or
a terminal's control characters, replaces a pipe, link or device, writes out of its output or shows what lies outside
the capture it was given.

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
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml
from damage import EDITORS, SCRIPT, edit_bytes, edit_file
from forked import Child, Ended, limit_memory
from mutated_world import DRAW, make_world, prepare

from neeco.files import LOCK, TEMPORARY

SECONDS = 10.0  # of the processor
GIB = 2.0
PATIENCE = 40.0  # s on the wall: the machine may be busy
CANARY = "a-secret-outside-the-folder"


@dataclass(frozen=True)
class Case:
    """How one verb is tried. `reads`: globs in the world of what is damaged; `words`: its command line."""

    reads: tuple[str, ...]
    words: Callable[[random.Random], list[str]]
    weight: float = 1.0
    needs: tuple[str, ...] = ()  # folders of the world beside those that `reads` names


CAPTURE = (
    "capture/transforms.json",
    "capture/transforms.json",
    "capture/sparse.ply",
    "capture/images/*",
    "capture/masks/*",
)
RUN = ("run/config.yaml", "run/scene.safetensors", "run/scene.safetensors", "run/metrics.jsonl")
RECORDING = (
    "recording/*.yaml",
    "recording/*.yaml",
    "recording/*.csv",
    "recording/*.csv",
    "recording/sync.json",
    "recording/video.mp4",
)
STEPS = ["--iterations", "3", "--set", "max_tissue_gaussians=200"]


def out(*words: str) -> Callable[[random.Random], list[str]]:
    return lambda pick: [*words, "--output", "out"]


COUNTS = ("-1", "0", "1.5", "nan", "abc", "", "9999999999999", "9" * 30)
SHARES = ("-1", "0", "2", "nan", "inf", "1e400", "abc", "1e-300")
SYNTHESIZE = ("synthesize", "run", *DRAW, "--output", "out")
TRAIN = ("train", "capture", "--output", "out", *STEPS)
OPTIONS: tuple[tuple[tuple[str, ...], str, tuple[str, ...]], ...] = (  # command, option, values: none works for long
    (SYNTHESIZE, "--count", COUNTS),
    ((*SYNTHESIZE, "--count", "1"), "--seed", COUNTS),
    ((*SYNTHESIZE, "--count", "1"), "--size", ("0x0", "-3x4", "1x1", "99999999x99999999", "axb", "3", "")),
    ((*SYNTHESIZE, "--count", "1"), "--min-share", SHARES),
    ((*SYNTHESIZE, "--count", "1"), "--workers", ("-1", "0", "abc", "1e9")),
    (TRAIN, "--seed", COUNTS),
    (TRAIN, "--scale", ("-1", "0", "nan", "inf", "1e-9", "1e9", "0.5", "abc")),
    (TRAIN, "--minutes", ("-1", "0", "nan", "1e-9", "abc", "")),
    (TRAIN[:4], "--iterations", ("-1", "0", "1.5", "nan", "abc", "")),
    (TRAIN, "--set", ("density_start=-1", "density_start=nan", "max_tissue_gaussians=1e400", "nothing=1", "=", "a")),
    (("view", "run"), "--port", ("-1", "65536", "99999999999", "abc", "1.5", "")),
    (("annotate", "run", "--output", "out"), "--min-trust", ("-1", "2", "nan", "inf", "abc", "")),
)


def odd_option(pick: random.Random) -> list[str]:
    words, option, values = pick.choice(OPTIONS)
    return [*words, f"{option}={pick.choice(values)}"]


def onto_a_node(pick: random.Random) -> list[str]:
    """Make an output that is a pipe, a link or a device; return a command that writes there."""
    words = pick.choice(
        (
            ["export", "run", "--output", "out.ply"],
            ["export", "run", "--output", "out.spz"],
            ["view", "run", "--export", "out.html"],
            ["render", "run", "--output", "out"],
            ["train", "capture", "--output", "out", *STEPS],
            ["synthesize", "run", "--count", "1", *DRAW, "--output", "out"],
        )
    )
    node = Path(words[words.index("--export" if "--export" in words else "--output") + 1])
    match pick.randrange(4):
        case 0:
            os.mkfifo(node)
        case 1:
            Path("linked").write_text("kept")
            node.symlink_to("linked")
        case 2:
            node.symlink_to("nothing")
        case _:
            try:
                os.mknod(node, stat.S_IFCHR | 0o600, os.makedev(1, 3))  # swallows what is written
            except PermissionError:
                os.mkfifo(node)
    return words


CASES: dict[str, Case] = {
    "options": Case((), odd_option, 3, ("capture", "run")),
    "outputs": Case((), onto_a_node, 2, ("capture", "run")),
    "check": Case(CAPTURE, lambda pick: ["check", "capture", *(["--json"] if pick.random() < 0.3 else [])], 6),
    "check-others": Case(
        (
            "endonerf/poses_bounds.npy",
            "endonerf/images/*",
            "endonerf/masks/*",
            "colmap/sparse/0/*",
            "colmap/sparse/0/*",
        ),
        lambda pick: ["check", pick.choice(("endonerf", "colmap"))],
        3,
        ("endonerf", "colmap"),
    ),
    "train": Case(
        CAPTURE,
        lambda pick: ["train", "capture", "--output", "out", "--method", pick.choice(("3dgs", "kinematic")), *STEPS],
        3,
    ),
    "train --resume": Case(
        ("cut/config.yaml", "cut/checkpoint/*", "cut/checkpoint/*", "cut/metrics.jsonl"),
        lambda pick: ["train", "capture", "--output", "cut", "--resume"],
        2,
        ("capture",),
    ),
    "evaluate": Case(
        (*RUN, *CAPTURE[:2], "capture/truth/masks/*"), lambda pick: ["evaluate", "run"], 1, ("capture", "run")
    ),
    "render": Case(RUN, out("render", "run"), 2, ("capture",)),
    "render --states": Case(
        ("states.jsonl", *RUN[:2]), out("render", "run", "--states", "states.jsonl"), 3, ("capture", "run")
    ),
    "synthesize": Case(RUN, out("synthesize", "run", "--count", "1", *DRAW), 2),
    "synthesize --states": Case(
        ("states.jsonl",), out("synthesize", "run", "--count", "1", "--states", "states.jsonl", *DRAW), 2, ("run",)
    ),
    "synthesize --camera-effects": Case(
        ("effects.yaml",),
        out("synthesize", "run", "--count", "1", "--camera-effects", "effects.yaml", *DRAW),
        2,
        ("run",),
    ),
    "synthesize --resume": Case(
        ("set/dataset.json", "set/.records/*", "set/.records/*", "set/images/*", "set/states.jsonl"),
        lambda pick: ["synthesize", "run", "--count", "4", *DRAW, "--output", "set", "--resume"],
        2,
        ("run",),
    ),
    "annotate": Case((*RUN, *CAPTURE), out("annotate", "run", "--min-trust", "0", "--force"), 0.4),
    "annotate --resume": Case(
        ("annotated/dataset.json", "annotated/.records/*", "annotated/.records/*"),
        lambda pick: ["annotate", "run", "--min-trust", "0", "--force", "--output", "annotated", "--resume"],
        1,
        ("capture", "run"),
    ),
    "view --export": Case(RUN, lambda pick: ["view", "run", "--export", "out.html"], 2),
    "export": Case(
        (*RUN, "states.jsonl"),
        lambda pick: (
            ["export", "run", "--output", pick.choice(("out.ply", "out.spz"))]
            + (["--states", "states.jsonl"] if pick.random() < 0.5 else [])
        ),
        2,
    ),
    "score-masks": Case(
        ("predicted/*", "predicted/*", "capture/truth/masks/*", "capture/transforms.json"),
        lambda pick: ["score-masks", "predicted", pick.choice(("capture", "truth"))],
        3,
        ("capture", "truth"),
    ),
    "compare": Case(
        (
            "compared/sweep.json",
            "compared/runs/*/*.json",
            "compared/runs/*/*.jsonl",
            "compared/runs/*/*.yaml",
            "compared/runs/*/*.safetensors",
        ),
        lambda pick: ["compare", "capture", "--methods", "3dgs", "--iterations", "3", "--output", "compared"],
        1,
        ("capture",),
    ),
    "downstream": Case(
        (
            "set/dataset.json",
            "set/dataset.json",
            "set/images/*",
            "set/parts/*",
            "set/masks/*",
            "annotated/dataset.json",
            "annotated/states.jsonl",
            "capture/transforms.json",
            "capture/truth/masks/*",
        ),
        lambda pick: [
            "downstream",
            "capture",
            "--sets",
            "a=set",
            "b=annotated",
            "--steps",
            "1",
            "--folds",
            "1",
            "--num-real",
            "0",
            "--size",
            "32",
            "--batch",
            "2",
            "--output",
            "out",
            "--conditions",
            pick.choice(("a", "b", "a+strong")),
        ],
        0.5,
        ("capture", "set", "annotated"),
    ),
    "ingest": Case(RECORDING, out("ingest", "recording/recording.yaml"), 3),
    "ingest --calibration": Case(
        ("recording/lens.yaml", "recording/*.csv"),
        out(
            "ingest",
            "--video",
            "recording/video.mp4",
            "--instrument",
            "recording/instrument.csv",
            "--laparoscope",
            "recording/camera.csv",
            "--sync",
            "recording/sync.json",
            "--calibration",
            "recording/lens.yaml",
        ),
        1,
        ("recording",),
    ),
    "ingest FOLDER": Case(
        (
            "endonerf/*.npy",
            "endonerf/images/*",
            "endonerf/masks/*",
            "colmap/sparse/0/*",
            "colmap/sparse/0/*",
            "capture/transforms.json",
        ),
        lambda pick: ["ingest", pick.choice(("endonerf", "colmap", "capture")), "--output", "out"],
        2,
        ("endonerf", "colmap", "capture"),
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
    words: list[str]
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
        self.inputs = [*sorted(path.name for path in self.world.rglob("*")), "desk", "out", "secret"]

    def play(self, number: int) -> Outcome:
        """Case `number` of this seed."""
        pick = random.Random(f"{self.seed}/{number}")
        verb = pick.choices(self.verbs, [CASES[name].weight for name in self.verbs])[0]
        case = CASES[verb]
        self._lay_out(case)
        damage = [self._damage(case, pick) for _ in range(pick.choice((1, 1, 1, 2, 3)) if case.reads else 0)]
        words = case.words(pick)
        self.nodes = self._nodes()
        child = Child(words, self.work, lambda: limit_memory(GIB))
        return self._judged(verb, words, damage, child.wait(PATIENCE))

    def require_sound(self) -> None:
        """Play every verb on what is not damaged: one that is refused there would try nothing."""
        for verb in self.verbs:
            if not CASES[verb].reads:
                continue  # nothing is sound there
            self._lay_out(CASES[verb])
            ended = Child(CASES[verb].words(random.Random(self.seed)), self.work).wait()
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

    def _judged(self, verb: str, words: list[str], damage: list[str], ended: Ended) -> Outcome:
        wrong = []
        texts = ended.said + ended.told
        if ended.status < 0 and verb == "train --resume" and self._long_training():
            pass  # it does as it is told
        elif ended.status == 2 and verb == "options":
            pass  # the parser's usage
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
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--case", type=int, help="play this one only, and show what it did")
    parser.add_argument(
        "--verbs", nargs="+", choices=list(CASES), default=list(CASES), help="case numbers depend on it"
    )
    parser.add_argument("--work", type=Path, help="an absent folder to work in; kept (default: a temporary one)")
    args = parser.parse_args()
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    prepare(args.verbs)
    gc.freeze()  # what is there is never collected in a child, so its pages stay shared
    began, counts, refusals, wrong = time.monotonic(), Counter[str](), Counter[str](), Counter[str]()
    spent = Counter[str]()
    with tempfile.TemporaryDirectory() as temporary:
        bench = Bench(args.work or Path(temporary) / "work", args.verbs, args.seed)
        if args.case is None:
            bench.require_sound()
        for number in [args.case] if args.case is not None else range(args.first, args.first + args.cases):
            outcome = bench.play(number)
            counts[outcome.verb] += 1
            refusals[outcome.verb] += outcome.ended.status == 1
            spent[outcome.verb] += outcome.ended.processor
            if outcome.wrong or args.case is not None:
                wrong[outcome.verb] += bool(outcome.wrong)
                print(
                    f"--seed {args.seed} --case {number}: neeco {' '.join(outcome.words)}: {'; '.join(outcome.damage)}"
                )
                for line in outcome.wrong:
                    print("    " + line.strip().replace("\n", "\n    "), flush=True)
            if args.case is not None:
                print(outcome.ended)
            elif (done := sum(counts.values())) % 500 == 0:
                print(f"{done} cases, {sum(wrong.values())} wrong, {time.monotonic() - began:.0f} s", flush=True)
        os.chdir("/")
    for verb in sorted(counts):
        print(f"{verb}: {counts[verb]} cases, {refusals[verb]} refused, {wrong[verb]} wrong; {spent[verb]:.0f} s")
    print(f"{sum(counts.values())} cases, {sum(wrong.values())} wrong, {time.monotonic() - began:.0f} s")
    return 1 if sum(wrong.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
