"""Random worlds: small captures whose every property is drawn, to decide what a change is worth.

    python benchmarks/worlds.py draw SEED OUT [--touched]                     # one world, a capture with truth
    python benchmarks/worlds.py run --commits OLD . --worlds 40 --seed S --work DIR [--workers 2]
    python benchmarks/worlds.py run --commits . .:without-silhouettes … --quick --worlds 40 --seed S --work DIR
    python benchmarks/worlds.py ablate --commits . --worlds 16 --seed S --work DIR # all mechanisms, one left out each
    python benchmarks/worlds.py table --commits OLD . --worlds 40 --seed S --work DIR   # what is there so far

`draw` renders a capture of 192x144 to 320x256, 12 to 120 training frames, with truth/ and world.json; what is drawn
from which distribution is in `rendered/draws.py`. 6 to 25 s of CPU time; touched worlds of 120 frames take minutes.

With --touched the instrument presses, slides on, grasps or pulls the tissue (`rendered/touch.py`), which gives way;
the world is that of the seed otherwise, but for the noise of trackers and structure from motion, which is drawn anew.
It lies in DIR/worlds/SEED-touched, has truth/contact.json and truth/points.json, and goes to DIR/table-touched.md.

`run` trains and evaluates each build on the same worlds (S, S + 1, …) in turns and can be stopped and called again. A
build is a commit, "." (this checkout), the folder of another, or any with ":without-NAME" (a mechanism left out;
`--help` lists them). It
writes DIR/table.md: per build the label IoU with aligned poses (mean of the splits test and unseen; median, and mean of
the worst tenth of the worlds; a refused run counts 0), failures (IoU below .80 or recall on shafts below .90), silent
ones (neither refused nor called doubtful), false alarms (doubts about runs of IoU above .90), paired differences of IoU
against the first build (95 % intervals, worlds resampled), errors of right states over their stated standard deviations
(rms; near 1 is right), CPU seconds of training, peak memory; the same by strata; the worst worlds, each with a picture
(outline of the truth green, of the label magenta). --quick trains 1,000 iterations of worlds at 192x144.

`ablate` runs --quick: a build as it is, and less each mechanism (or those of `--without`), each on the first --worlds
worlds from S on that have what it works on; DIR/ablations.md has a row for each: in how many worlds anything changes,
what it gains, aligned, as given and of parts, and the worst tenth with and without it.

A change of an estimator is decided on 40 worlds of one seed, and reported on 40 others, `--seed fresh`: a seed from the
hash of the last commit.
"""

from __future__ import annotations

import argparse
import subprocess
from collections.abc import Iterable
from pathlib import Path

import cv2
import torch
from rendered.draws import draw_world
from rendered.world_capture import write_world
from world_runs import (
    ROOT,
    TOUCHED,
    WITHOUT,
    Name,
    builds_of,
    capture_path,
    result_path,
    run_all,
    run_path,
    worlds_of,
)
from world_table import Result, ablations_of, pictures_of, strata_of, table_of, worst_of

from neeco.base.errors import NeecoError
from neeco.base.files import read_json, write_text

QUICK = ("--iterations", "1000")
WORST = 5


def main() -> int:
    """Draw a world, or run builds on many."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=f"mechanisms that can be left out: {', '.join(WITHOUT)}",
    )  # fmt: skip
    verbs = parser.add_subparsers(dest="verb", required=True)
    drawn = verbs.add_parser("draw", help="render one world")
    drawn.add_argument("seed", type=int)
    drawn.add_argument("output", type=Path)
    drawn.add_argument("--touched", action="store_true", help="the instrument touches the tissue")
    for name, words in (
        ("run", "train builds on worlds, and write the table"), ("table", "write the table"),
        ("ablate", "train a build less each of its mechanisms, and write what each gains"),
    ):  # fmt: skip
        runs = verbs.add_parser(name, help=words)
        runs.add_argument("--commits", nargs="+", required=True, metavar="COMMIT[:without-NAME]")
        runs.add_argument("--worlds", type=int, default=40)
        runs.add_argument("--seed", default="fresh", help="of the first world, or `fresh`")
        runs.add_argument("--work", type=Path, required=True, help="folder for worlds, runs and results")
        runs.add_argument("--workers", type=int, default=2)
        runs.add_argument("--quick", action="store_true", help="small images, 1,000 iterations")
        runs.add_argument("--touched", action="store_true", help="worlds whose instrument touches the tissue")
        if name == "ablate":
            runs.add_argument("--without", nargs="+", default=list(WITHOUT), choices=WITHOUT, metavar="NAME")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    if arguments.verb == "draw":
        capture = write_world(draw_world(arguments.seed, touched=arguments.touched), arguments.output)
        print(f"{arguments.output}: {len(capture.frames)} frames")
        return 0
    first = fresh_seed() if arguments.seed == "fresh" else int(arguments.seed)
    ending = TOUCHED if arguments.touched else ""

    def name_of(seed: int) -> Name:
        return f"{seed}{ending}" if ending else seed

    seeds = [name_of(seed) for seed in range(first, first + arguments.worlds)]
    if arguments.verb == "ablate":
        commit, *others = arguments.commits
        if others or ":" in commit:
            raise NeecoError("--commits: ablate leaves mechanisms out of one build itself; give one commit or checkout")
        suited = {
            name: [name_of(seed) for seed in worlds_of(name, first, arguments.worlds)] for name in arguments.without
        }
        whole, *lacking = builds_of([commit, *(f"{commit}:without-{name}" for name in suited)], arguments.work)
        worlds = {
            seed: [whole, *(build for build in lacking if seed in suited[build.without])]
            for seed in sorted({seed for seeds in suited.values() for seed in seeds})
        }
        run_all(worlds, arguments.work, QUICK, arguments.workers, quick=True)
        results = {build.without: results_of(arguments.work, build.title, suited[build.without]) for build in lacking}
        text = ablations_of(results_of(arguments.work, commit, worlds), results)
        write_text(arguments.work / f"ablations{ending}.md", f"worlds from seed {first}\n\n{text}\n")
        print(text)
        return 0
    if arguments.verb == "run":
        builds = builds_of(arguments.commits, arguments.work)
        options = QUICK if arguments.quick else ()
        worlds = dict.fromkeys(seeds, builds)
        run_all(worlds, arguments.work, options, arguments.workers, quick=arguments.quick)
    write_table(arguments.commits, seeds, arguments.work, ending)
    return 0


def fresh_seed() -> int:
    """A seed that nobody chose: of the hash of the last commit."""
    said = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True)
    return int(said.stdout[:8], 16)


def results_of(work: Path, title: str, seeds: Iterable[Name]) -> dict[Name, Result]:
    """Results of a build that are there, by seed."""
    paths = {seed: result_path(work, title, seed) for seed in seeds}
    return {seed: read_json(path) for seed, path in paths.items() if path.exists()}


def write_table(titles: list[str], seeds: list[Name], work: Path, ending: str) -> None:
    """Write table.md and pictures of the worlds that all builds have a result for."""
    done = [seed for seed in seeds if all(result_path(work, title, seed).exists() for title in titles)]
    if not done:
        raise NeecoError(f"{work}: no world has a result of every build yet; call `run` first")
    by_build = {title: [read_json(result_path(work, title, seed)) for seed in done] for title in titles}
    text = [f"{len(done)} worlds from seed {seeds[0]}", table_of(by_build), strata_of(by_build)]
    for title, results in by_build.items():
        text.append(f"Worst worlds of {title}:\n\n{worst_of(results, WORST)}")
    write_text(work / f"table{ending}.md", "\n\n".join(text) + "\n")
    print("\n\n".join(text[:2]))
    last = list(by_build.values())[-1]
    for result in sorted(last, key=lambda result: result["iou"] or 0.0)[:WORST]:
        seed = result["seed"]
        runs = {title: run_path(work, title, seed) for title in titles}
        pictures_of(seed, capture_path(work, seed), runs, work / f"worst-{seed}.png")


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except NeecoError as error:
        raise SystemExit(f"worlds: {error}") from None
