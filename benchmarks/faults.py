"""Is anything lost when a command is killed, or when disk, clock or files fail under it?

    python benchmarks/faults.py [--kills N] [--seed S] [--verbs train synthesize …] [--faults …] [--work DIR]

Kills train, synthesize, annotate, compare and ingest with SIGKILL: half of the times at a moment of the clock, half of
them at one of the command's own operations on files, counted from its start; moments are spread over the whole life of
the command, a third of them over its last tenth. Workers of `synthesize --workers 2` are killed alone, with the whole
group, or left behind. After every kill each file there that is not a temporary one by its name must be whole; then the
command is given again (with --resume where it has one) and must end in the files that an undisturbed run writes, byte
for byte, with no temporary one left beside them. The clocks that durations are taken from stand still, so that no file
has to be left out of this.

Then the other faults, one of each for every verb: a full disk (a small tmpfs, where this user may mount one, else
RLIMIT_FSIZE), an I/O error (a failing fsync), a folder that cannot be written to (root: a read-only tmpfs), a capture
that changes between kill and resumption, a clock set back, two processes at once on one output, an output that is a
pipe or a link. Each must end in exit
status 1 and one line on stderr, or in the same files, and lose nothing.

Exit status 1 where anything did. Structure from motion is answered from known cameras, as in tests/ingest.
"""

from __future__ import annotations

import argparse
import errno
import gc
import json
import os
import random
import resource
import signal
import stat
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from fault_world import Verb, make_verbs, prepare
from forked import Child, Ended
from PIL import Image
from whole_files import clear, differences, digests, files_in, half_files

LAST = 0.34  # share of kills in the last tenth
WEIGHTS = {"train": 4, "synthesize": 5, "workers": 1, "annotate": 1, "compare": 1, "ingest": 5}  # of slow ones fewer
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT
FILE_EVENTS = ("os.rename", "os.mkdir", "os.rmdir", "os.remove", "os.link", "tempfile.mkstemp")


@dataclass
class Tally:
    """What was done and what was found."""

    done: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)

    def count(self, what: str, wrong: Sequence[str], where: str) -> None:
        self.done[what] += 1
        for line in wrong:
            self.wrong.append(f"{where}: {line}")
            print(f"WRONG {where}: {line}", flush=True)


# --- kills -----------------------------------------------------------------------------------------------------------


def counting(shelf: Path, at: int | None, told: Path | None = None) -> Callable[[], None]:
    """For a child: count its operations on files under `shelf`, write how many and how many syncs to `told` at its end,
    and kill it right before number `at`."""

    def begin() -> None:
        count, place = 0, str(shelf)

        def hook(event: str, args: tuple[object, ...]) -> None:
            nonlocal count
            writes = event == "open" and isinstance(args[2], int) and bool(args[2] & WRITING)
            if not (writes or event in FILE_EVENTS) or place not in f"{args[0]}":
                return
            count += 1
            if count == at:
                os.kill(os.getpid(), signal.SIGKILL)

        sys.addaudithook(hook)
        if told is not None:
            end, sync, syncs = os._exit, os.fsync, []

            def last_words(status: int) -> None:
                told.write_text(json.dumps([count, len(syncs)]))
                end(status)

            os._exit = last_words  # type: ignore[assignment]
            os.fsync = lambda descriptor: syncs.append(descriptor) or sync(descriptor)

    return begin


@dataclass(frozen=True)
class Undisturbed:
    """What a verb does when nobody disturbs it."""

    files: dict[str, str]
    seconds: float
    operations: int
    syncs: int
    kib: int  # on a disk of 4 KiB blocks


Wholes = Mapping[str, Undisturbed]  # by the verb's name


def undisturbed(verb: Verb, work: Path) -> Undisturbed:
    """Run it twice: the files must be the same, else nothing here means anything."""
    runs = []
    for _ in range(2):
        clear(verb.shelf)
        told = work / "operations"
        ended = Child(verb.words, work, counting(verb.shelf, None, told)).wait()
        assert ended.status == 0, f"{verb.name}: {ended.told}"
        operations, syncs = json.loads(told.read_text())
        blocks = {path.stat().st_ino: -(-path.stat().st_size // 4096) for path in files_in(verb.shelf)}  # linked: once
        kib = 4 * sum(blocks.values())
        runs.append(Undisturbed(digests(verb.shelf), ended.seconds, operations, syncs, kib))
    told = differences(runs[0].files, runs[1].files)
    assert not told, f"{verb.name}: two undisturbed runs differ: {told}"
    assert not half_files(verb.shelf), f"{verb.name}: {half_files(verb.shelf)}"
    return min(runs, key=lambda run: run.seconds)


def moment(pick: random.Random) -> float:
    """Share of a life, in [0, 1]."""
    return pick.uniform(0.9, 1.0) if pick.random() < LAST else pick.random()


def kill_once(verb: Verb, whole: Undisturbed, work: Path, pick: random.Random) -> tuple[str, bool]:
    """Start it, kill it; what was done in words, and whether it was still alive."""
    share = moment(pick)
    if pick.random() < 0.5 and not verb.workers:
        at = max(1, round(share * whole.operations))
        ended = Child(verb.words, work, counting(verb.shelf, at)).wait()
        return f"before its operation {at} of {whole.operations}", ended.status == -signal.SIGKILL
    child = Child(verb.words, work)
    after = share * whole.seconds
    time.sleep(after)
    alive, whom = child.running(), pick.choice(("group", "main", "worker")) if verb.workers else "group"
    if alive and whom == "worker":
        workers = [pid for pid in children_of(child.pid) if b"spawn_main" in cmdline(pid)]
        if not workers:
            whom = "main"
        else:
            os.kill(pick.choice(workers), signal.SIGKILL)
            ended = child.wait()  # it takes another
            return f"one worker after {after:.2f} s", ended.status == 0
    if alive:
        child.kill(whom == "group")
    ended = child.wait()
    return f"{whom} after {after:.2f} s", ended.status == -signal.SIGKILL


def children_of(pid: int) -> list[int]:
    text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    return [int(word) for word in text.split()]


def cmdline(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


def resumed(verb: Verb, whole: Undisturbed, work: Path) -> list[str]:
    """Give the command again; what is wrong with what it ends in."""
    ended = Child([*verb.words, *verb.resume], work).wait()
    if ended.status == 1 and "nothing was begun" in ended.told:
        ended = Child(verb.words, work).wait()
    if ended.status == 1 and "exists already" in ended.told and not verb.resume:
        return differences(whole.files, digests(verb.shelf))  # it was whole when it was killed
    if ended.status != 0:
        return [f"resumption ended with {ended.status}: {ended.told[-1500:]}"]
    return differences(whole.files, digests(verb.shelf))


def kills(verbs: Sequence[Verb], wholes: Wholes, count: int, seed: int, work: Path, tally: Tally) -> None:
    number = attempt = 0
    while number < count:
        pick = random.Random(f"{seed}/{attempt}")
        verb = pick.choices(verbs, [WEIGHTS[verb.name] for verb in verbs])[0]
        attempt += 1
        clear(verb.shelf)
        how, killed = kill_once(verb, wholes[verb.name], work, pick)
        if not killed:
            continue  # it had ended already
        number += 1
        where = f"{verb.name} killed {how} (attempt {attempt - 1})"
        found = half_files(verb.shelf)
        if pick.random() < 0.25:  # killed once more on its way
            again = Child([*verb.words, *verb.resume], work, counting(verb.shelf, pick.randint(1, 30))).wait()
            tally.done["killed once more while resuming"] += again.status == -signal.SIGKILL
            found += half_files(verb.shelf)
        found += resumed(verb, wholes[verb.name], work)
        tally.count(f"kills {verb.name}", found, where)
        if number % 20 == 0:
            print(f"{number} kills, {len(tally.wrong)} wrong", flush=True)


# --- other faults ----------------------------------------------------------------------------------------------------


def may_mount(folder: Path) -> bool:
    return os.geteuid() == 0 and mount(folder, "size=1m") and umount(folder)


def mount(folder: Path, options: str) -> bool:
    return not subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder], capture_output=True).returncode


def umount(folder: Path) -> bool:
    return not subprocess.run(["umount", folder], capture_output=True).returncode


def refused(ended: Ended, shelf: Path) -> list[str]:
    """What is wrong with a failure: it must be one line, and leave no half file."""
    complaint = ended.in_one_line()
    return ([complaint] if complaint else []) + half_files(shelf)


def full_disk(verb: Verb, whole: Undisturbed, work: Path, pick: random.Random) -> list[str]:
    """The disk is full somewhere on the way; then there is room again."""
    clear(verb.shelf)
    kib = round(pick.uniform(0.05, 0.8) * whole.kib)
    if not may_mount(verb.shelf):
        largest = pick.choice((64, 1_000, 5_000, 20_000))
        ended = Child(verb.words, work, lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (largest,) * 2)).wait()
        return refused(ended, verb.shelf) + resumed(verb, whole, work)
    mount(verb.shelf, f"size={max(4, kib)}k")
    try:
        found = refused(Child(verb.words, work).wait(), verb.shelf)
        subprocess.run(["mount", "-o", "remount,size=1g", verb.shelf], check=True)
        return found + resumed(verb, whole, work)
    finally:
        umount(verb.shelf)


def input_output_error(verb: Verb, whole: Undisturbed, work: Path, pick: random.Random) -> list[str]:
    """A file cannot be synced to the disk."""
    clear(verb.shelf)
    good = round(pick.uniform(0.0, 0.9) * whole.syncs)

    def begin() -> None:
        left, real = iter(range(good)), os.fsync

        def failing(descriptor: int) -> None:
            if next(left, None) is None:
                raise OSError(errno.EIO, os.strerror(errno.EIO))
            real(descriptor)

        os.fsync = failing

    return refused(Child(verb.words, work, begin).wait(), verb.shelf) + resumed(verb, whole, work)


def read_only(verb: Verb, whole: Undisturbed, work: Path, pick: random.Random) -> list[str]:
    """Nothing may be written there."""
    clear(verb.shelf)
    mounted = may_mount(verb.shelf) and mount(verb.shelf, "size=1m,ro")
    if not mounted:
        verb.shelf.chmod(0o555)
    try:
        found = refused(Child(verb.words, work).wait(), verb.shelf)
    finally:
        umount(verb.shelf) if mounted else verb.shelf.chmod(0o755)
    return found + resumed(verb, whole, work)


def changed_capture(verb: Verb, whole: Undisturbed, work: Path, pick: random.Random) -> list[str]:
    """What it reads is another one when it goes on; then it is as it was."""
    if verb.touched is None:
        return []
    clear(verb.shelf)
    ended = Child(verb.words, work, counting(verb.shelf, round(pick.uniform(0.6, 0.9) * whole.operations))).wait()
    assert ended.status == -signal.SIGKILL
    content = verb.touched.read_bytes()
    if verb.touched.suffix == ".png":
        Image.new("RGB", Image.open(verb.touched).size, (10, 200, 30)).save(verb.touched)
    else:
        verb.touched.write_bytes(content.replace(b'"cx"', b'"cy"')[:-4] + b"\0\0\0\1")
    before = digests(verb.shelf)
    try:
        ended = Child([*verb.words, *verb.resume], work).wait()
        found = [complaint] if (complaint := ended.in_one_line()) else []
        now = {name: digest for name, digest in digests(verb.shelf).items() if name in before}
        found += [f"changed by a refusal: {name}" for name in now if now[name] != before[name]]
    finally:
        verb.touched.write_bytes(content)
    return found + resumed(verb, whole, work)


def clock_set_back(verb: Verb, whole: Undisturbed, work: Path, pick: random.Random) -> list[str]:
    """Every clock falls back by an hour, again and again."""
    clear(verb.shelf)

    def begin() -> None:
        from neeco.studies import training_job
        from neeco.training import train

        def falling() -> float:
            return time.monotonic() - 3600 * (time.monotonic_ns() // 50_000_000 % 7)

        train.train.__kwdefaults__["clock"] = falling
        training_job.CLOCKS.update(wall=falling, processor=falling)
        now = time.time
        time.time = lambda: now() - 3600 * (time.monotonic_ns() // 50_000_000 % 7)

    ended = Child(verb.words, work, begin).wait()
    if ended.status:
        return [f"exit status {ended.status}: {ended.told[-800:]}"]
    scenes = {name: digest for name, digest in whole.files.items() if name.endswith(("scene.safetensors", ".png"))}
    now = {name: digest for name, digest in digests(verb.shelf).items() if name in scenes}
    return differences(scenes, now)


def output_is_a_node(verb: Verb, whole: Undisturbed, work: Path, pick: random.Random) -> list[str]:
    """Something else has the output's name: it must stay what it is."""
    clear(verb.shelf)
    found = []
    for make in (os.mkfifo, lambda path: path.symlink_to("nothing"), lambda path: path.symlink_to(verb.shelf / "kept")):
        (verb.shelf / "kept").write_text("kept")
        make(verb.output)
        before = stat.S_IFMT(verb.output.lstat().st_mode)
        complaint = Child(verb.words, work).wait(60.0).in_one_line()
        found += [complaint] if complaint else []
        if stat.S_IFMT(verb.output.lstat().st_mode) != before or (verb.shelf / "kept").read_text() != "kept":
            found.append("replaced what was no file")
        clear(verb.shelf)
    return found + resumed(verb, whole, work)


def holds_a_lock(pid: int) -> bool:
    """Whether a process has locked a file; one that is only there may not be locked yet."""
    return any(f" {pid} " in line and "FLOCK" in line for line in Path("/proc/locks").read_text().splitlines())


def two_at_once(verb: Verb, whole: Undisturbed, work: Path, pick: random.Random) -> list[str]:
    """The same command again while the first is at work."""
    clear(verb.shelf)
    first = Child(verb.words, work)
    while first.running() and not holds_a_lock(first.pid):
        time.sleep(0.002)
    os.kill(first.pid, signal.SIGSTOP)  # however slow this machine is, it is still at work
    found = []
    for words in ([*verb.words, *verb.resume], verb.words):
        complaint = Child(words, work).wait().in_one_line()
        found += [f"the second: {complaint}"] if complaint else []
    os.kill(first.pid, signal.SIGCONT)
    ended = first.wait()
    found += [f"the first: {ended.told[-800:]}"] if ended.status else []
    return found + differences(whole.files, digests(verb.shelf))


FAULTS = {
    "full-disk": full_disk,
    "input-output-error": input_output_error,
    "read-only": read_only,
    "changed-capture": changed_capture,
    "clock-set-back": clock_set_back,
    "two-at-once": two_at_once,
    "output-is-a-node": output_is_a_node,
}


def faults(verbs: Sequence[Verb], wholes: Wholes, names: Sequence[str], seed: int, work: Path, tally: Tally) -> None:
    for verb in verbs:
        whole = wholes[verb.name]
        for name in names:
            for turn in range(3 if name in ("full-disk", "input-output-error") else 1):
                pick = random.Random(f"{seed}/{verb.name}/{name}/{turn}")
                tally.count(name, FAULTS[name](verb, whole, work, pick), f"{verb.name}: {name} {turn}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--verbs", nargs="+", choices=list(WEIGHTS), default=list(WEIGHTS))
    parser.add_argument("--faults", nargs="*", choices=list(FAULTS), default=list(FAULTS))
    parser.add_argument("--work", type=Path, help="a folder to work in; kept (default: a temporary one)")
    args = parser.parse_args()
    tally, began = Tally(), time.monotonic()
    prepare()
    gc.freeze()  # what is there is never collected in a child, so its pages stay shared
    with tempfile.TemporaryDirectory() as temporary:
        work = args.work or Path(temporary)
        work.mkdir(parents=True, exist_ok=True)
        verbs = make_verbs(work.resolve(), args.verbs)
        wholes = {verb.name: undisturbed(verb, work) for verb in verbs}
        for name, whole in wholes.items():
            print(f"{name}: {len(whole.files)} files, {whole.operations} operations, {whole.seconds:.1f} s", flush=True)
        kills(verbs, wholes, args.kills, args.seed, work, tally)
        faults(verbs, wholes, args.faults, args.seed, work, tally)
    for what, count in sorted(tally.done.items()):
        print(f"{what}: {count}")
    print(f"{len(tally.wrong)} wrong, {time.monotonic() - began:.0f} s")
    return 1 if tally.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
