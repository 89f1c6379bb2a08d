"""Times one whole command of two checkouts in turns: what a user waits for, at an old commit and now.

    git worktree add ../old COMMIT                       # with its kernels built: pip install --no-deps -e .
    python benchmarks/turns.py ../old . [--turns 5] -- synthesize runs/liver --count 301 --output {output}

The command runs in a process of its own, start included; `{output}` is a fresh path in every turn. Prints wall time and
processor time of the process and its workers: medians, and the ratio of new to old. Time of an image or a frame: a long
command less a short one. Leave the machine alone meanwhile, or read the processor time only.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

START = "import sys; from neeco.cli import main; sys.exit(main())"


def seconds_of(checkout: Path, words: list[str]) -> tuple[float, float]:
    """Wall and processor time of a command. Exits with what it said where it fails."""
    environment = {**os.environ, "PYTHONPATH": str(checkout.resolve() / "src")}
    with tempfile.TemporaryDirectory() as folder:
        given = [word.replace("{output}", str(Path(folder) / "output")) for word in words]
        before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        done = subprocess.run([sys.executable, "-c", START, *given], env=environment, capture_output=True, text=True)
        wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        sys.exit(f"{checkout}: {' '.join(words)}: {done.stderr.strip().splitlines()[-1]}")
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Time the command in turns and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("words", nargs="+", metavar="COMMAND")
    parser.add_argument("--turns", type=int, default=5)
    arguments = parser.parse_args()
    sides = (arguments.old, arguments.new)
    taken: tuple[list[tuple[float, float]], ...] = ([], [])
    for turn in range(arguments.turns):
        for side in sorted((0, 1), reverse=bool(turn % 2)):  # neither is always the first
            taken[side].append(seconds_of(sides[side], arguments.words))
            print(f"turn {turn + 1}: {sides[side]}: {taken[side][-1][0]:.4g} s", flush=True)
    print("| time | old, s | new, s | ratio |\n|---|---|---|---|")
    for kind, name in enumerate(("wall", "processor")):
        old, new = (statistics.median(turn[kind] for turn in turns) for turns in taken)
        print(f"| {name} | {old:.3g} | {new:.3g} | {new / old:.2f} |")


if __name__ == "__main__":
    main()
