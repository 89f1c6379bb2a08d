"""Random worlds: a seed is a world, all that is drawn occurs, and a table counts what users would see."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

from rendered.draws import BACKGROUNDS, FINISHES, JAWS, KINDS, LINKS, SCOPES, SIZES, STATES, TRAIN_FRAMES, draw_world
from rendered.world_capture import write_world
from world_runs import WITHOUT
from world_table import ablations_of, interval, summary_of, table_of

from neeco.base.errors import NeecoError
from neeco.capture import read_capture
from neeco.capture.checks import check_capture

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
SMALL_WORLD = "9026"  # its seed


def test_a_seed_is_a_world() -> None:
    assert draw_world(5) == draw_world(5)
    assert draw_world(5) != draw_world(6)


def test_all_that_can_be_drawn_is_drawn() -> None:
    worlds = [draw_world(seed) for seed in range(400)]
    for name, values in (
        ("background", BACKGROUNDS), ("finish", FINISHES), ("jaws", JAWS), ("kind", KINDS), ("links", LINKS),
        ("scope", SCOPES), ("size", SIZES), ("states", STATES), ("frames", TRAIN_FRAMES),
    ):  # fmt: skip
        assert {getattr(world, name) for world in worlds} == set(values), name
    assert {world.scale for world in worlds} == {1.0, 0.75, 0.5}
    assert {world.frame_off for world in worlds if world.links == "off"} == {0.0, -8.0, 8.0}
    assert {world.base for world in worlds if world.states == "encoders"} == {1.0, 4.0}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 9])  # of a still scope, of a stereo scope
def test_a_world_is_written_as_a_capture_with_truth(seed: int, tmp_path: Path) -> None:
    torch.set_num_threads(1)
    world = replace(draw_world(seed), wrong=0.1)
    write_world(world, tmp_path)
    capture = read_capture(tmp_path)
    eyes = 2 if world.scope == "stereo" else 1
    assert len(capture.split("train")) == world.frames * eyes
    assert not [problem for problem in check_capture(tmp_path) if problem.severity == "error"]
    wrong = json.loads((tmp_path / "truth" / "outliers.json").read_text())
    assert wrong.keys() <= {frame.name for frame in capture.split("train")}
    instants = {frame.state.time for frame in capture.split("train") if frame.name in wrong}
    assert len(wrong) == eyes * len(instants) > 0  # a state is wrong for all cameras
    for frame in capture.split("test"):
        assert (tmp_path / "truth" / "masks" / f"{frame.name}.png").is_file()
    with pytest.raises(NeecoError, match="already holds a capture"):
        write_world(world, tmp_path)


def worlds(*words: str) -> str:
    """What a command of worlds.py prints."""
    command = [sys.executable, str(BENCHMARKS / "worlds.py"), *words]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


@pytest.mark.slow
def test_builds_and_mechanisms_are_compared_to_the_end(tmp_path: Path) -> None:
    common = ("--seed", SMALL_WORLD, "--worlds", "1", "--work", str(tmp_path))
    said = worlds("run", "--commits", ".", ".:without-shadow", "--quick", *common)
    assert said.count("IoU 0.") == 2
    assert "1 worlds from seed" in (tmp_path / "table.md").read_text()
    assert (tmp_path / f"worst-{SMALL_WORLD}.png").is_file()
    said = worlds("ablate", "--commits", ".", "--without", "shadow", *common)  # both runs are there
    assert "IoU 0." not in said
    assert "| shadow |" in (tmp_path / "ablations.md").read_text()
    bins = subprocess.run(
        [sys.executable, str(BENCHMARKS / "foreground_bins.py"), str(tmp_path / "runs" / "here" / SMALL_WORLD)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert "| instrument |" in bins.stdout


def result(seed: int, iou: float | None, *, doubts: tuple[str, ...] = (), recall: float | None = 1.0) -> dict[str, Any]:
    told = {"doubts": list(doubts), "said": [], "status": int(iou is None)}
    return {"seed": seed, "iou": iou, "recall": recall, "train_seconds": 1.0, "gib": 1.0, **told}


def test_a_table_counts_failures_silence_and_false_alarms() -> None:
    results = [
        result(0, 0.95), result(1, 0.96, doubts=("few",)), result(2, 0.5), result(3, 0.6, doubts=("few",)),
        result(4, None), result(5, 0.97, recall=0.8),
    ]  # fmt: skip
    own = summary_of(results)
    assert (own.failures, own.silent, own.refused, own.alarms, own.right) == (4, 2, 1, 1, 2)
    assert own.worst_tenth == 0.0  # one that was refused gives no labels
    other = [{**entry, "iou": (entry["iou"] or 0) + 0.01} for entry in results]
    assert "+0.010 [+0.010, +0.010]" in table_of({"a": results, "b": other})


def test_an_interval_holds_the_mean() -> None:
    low, high = interval(np.random.default_rng(0).normal(0.1, 0.05, 40))
    assert low < 0.1 < high


def test_an_ablation_says_what_a_mechanism_gains() -> None:
    whole = {seed: result(seed, 0.9) for seed in range(12)}
    helped = {seed: result(seed, 0.8 if seed == 3 else 0.9) for seed in range(12)}
    idle = {seed: result(seed, 0.9) for seed in range(5)}
    rows = ablations_of(whole, {"idle": idle, "useful": helped, "unused": {}}).splitlines()[2:]
    assert [row.split("|")[1:3] for row in rows] == [[" useful ", " 1 of 12 "], [" idle ", " 0 of 5 "]]
    assert "+0.000, +0.100 | +0.000, - | 0.900, 0.800" in rows[0]


def test_a_mechanism_is_left_out_where_it_applies() -> None:
    worlds = [draw_world(seed) for seed in range(60)]
    for name, mechanism in WITHOUT.items():
        assert any(mechanism.applies_to(world) for world in worlds), name
    assert not any(WITHOUT["frame-joints"].applies_to(world) for world in worlds if not world.joints)


BINDS = """
import importlib, inspect, re, sys
for statement in sys.argv[1:]:
    modules = [importlib.import_module(name) for name in re.findall(r"(neeco[\\w.]+) as", statement)]
    before = [dict(vars(module)) for module in modules]
    exec(statement, {})
    for module, names in zip(modules, before):
        for name, old in names.items():
            new = vars(module)[name]
            if new is not old:
                parameters = inspect.signature(old).parameters.values()
                inspect.signature(new).bind(*[None for p in parameters if p.kind is not p.KEYWORD_ONLY])
                setattr(module, name, old)
                print(name)
"""


def test_what_takes_a_mechanisms_place_takes_what_the_mechanism_takes() -> None:
    statements = [mechanism.left_out for mechanism in WITHOUT.values() if isinstance(mechanism.left_out, str)]
    said = subprocess.run([sys.executable, "-c", BINDS, *statements], capture_output=True, text=True)
    assert said.returncode == 0, said.stderr
    assert {"drop_refuted", "drop_detached", "distinct_frames", "fit_states"} <= set(said.stdout.split())
