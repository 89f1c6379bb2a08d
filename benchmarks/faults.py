"""Is anything lost when a command is killed, or when the disk fails under it?

    python benchmarks/faults.py [--kills N] [--seed S] [--verbs train synthesize …] [--faults …] [--work DIR]

Kills train, synthesize, annotate, compare and ingest with SIGKILL: half of the times at a moment of the clock, half of
them at one of the command's own operations on files, a third of them in the last tenth of its life. After every kill
each file there that is not a temporary one by its name must be whole; then the command is given again (with --resume
where it has one) and must end in the files that an undisturbed run writes, byte for byte, with no temporary one left
beside them. The clocks that durations are taken from stand still, so that no file has to be left out of this.

Then the other faults, for every verb: a full disk (RLIMIT_FSIZE), an I/O error (a failing fsync), two processes at once
on one output. Each must end in exit status 1 and one line on stderr, or in the same files, and lose nothing. Exit
status 1 where anything did.
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
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from fault_world import Verb, make_verbs, prepare
from forked import Child, Ended
from whole_files import clear, differences, digests, half_files

LAST = 0.34  # share of kills in the last tenth
WEIGHTS = {"train": 4, "synthesize": 5, "annotate": 1, "compare": 1, "ingest": 5}  # of slow ones fewer
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


def undisturbed(verb: Verb, work: Path) -> Undisturbed:
    """Run it twice: the files must be the same, else nothing here means anything."""
    runs = []
    for _ in range(2):
        clear(verb.shelf)
        told = work / "operations"
        ended = Child(verb.words, work, counting(verb.shelf, None, told)).wait()
        assert ended.status == 0, f"{verb.name}: {ended.told}"
        operations, syncs = json.loads(told.read_text())
        runs.append(Undisturbed(digests(verb.shelf), ended.seconds, operations, syncs))
    told = differences(runs[0].files, runs[1].files)
    assert not told, f"{verb.name}: two undisturbed runs differ: {told}"
    assert not half_files(verb.shelf), f"{verb.name}: {half_files(verb.shelf)}"
    return min(runs, key=lambda run: run.seconds)


def kill_once(verb: Verb, whole: Undisturbed, work: Path, pick: random.Random) -> tuple[str, bool]:
    """Start it, kill it; what was done in words, and whether it was still alive."""
    share = pick.uniform(0.9, 1.0) if pick.random() < LAST else pick.random()
    if pick.random() < 0.5:
        at = max(1, round(share * whole.operations))
        ended = Child(verb.words, work, counting(verb.shelf, at)).wait()
        return f"before its operation {at} of {whole.operations}", ended.status == -signal.SIGKILL
    child = Child(verb.words, work)
    time.sleep(share * whole.seconds)
    if child.running():
        child.kill()
    return f"after {share * whole.seconds:.2f} s", child.wait().status == -signal.SIGKILL


def resumed(verb: Verb, whole: Undisturbed, work: Path) -> list[str]:
    """Give the command again; what is wrong with what it ends in."""
    ended = Child([*verb.words, *verb.resume], work).wait()
    if ended.status == 1 and "nothing was begun" in ended.told:
        ended = Child(verb.words, work).wait()
    if ended.status == 1 and "already exists" in ended.told and not verb.resume:
        return differences(whole.files, digests(verb.shelf))  # it was whole when it was killed
    if ended.status != 0:
        return [f"resumption ended with {ended.status}: {ended.told[-1500:]}"]
    return differences(whole.files, digests(verb.shelf))


def kills(
    verbs: Sequence[Verb], wholes: Mapping[str, Undisturbed], count: int, seed: int, work: Path, tally: Tally
) -> None:
    """Kill commands `count` times, and give each again."""
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
        tally.count(f"kills {verb.name}", found + resumed(verb, wholes[verb.name], work), where)


def refused(ended: Ended, shelf: Path) -> list[str]:
    """What is wrong with a failure: it must be one line, and leave no half file."""
    complaint = ended.in_one_line()
    return ([complaint] if complaint else []) + half_files(shelf)


def full_disk(verb: Verb, whole: Undisturbed, work: Path, pick: random.Random) -> list[str]:
    """No file may grow beyond a size; then there is room again."""
    clear(verb.shelf)
    largest = pick.choice((2_000, 5_000))  # bytes; what it says must fit
    ended = Child(verb.words, work, lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (largest,) * 2)).wait()
    return refused(ended, verb.shelf) + resumed(verb, whole, work)


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
    "two-at-once": two_at_once,
}


def main() -> int:
    """Kill, disturb, and print what was done and what was wrong."""
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
        for verb in verbs:
            for name in args.faults:
                pick = random.Random(f"{args.seed}/{verb.name}/{name}")
                tally.count(name, FAULTS[name](verb, wholes[verb.name], work, pick), f"{verb.name}: {name}")
    for what, count in sorted(tally.done.items()):
        print(f"{what}: {count}")
    print(f"{len(tally.wrong)} wrong, {time.monotonic() - began:.0f} s")
    return 1 if tally.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
