"""Touched worlds: the instrument goes below the resting surface, which gives way there and returns; all else stays."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

from rendered import draws, world_capture
from rendered.displaced import TOUCHING
from rendered.draws import World, draw_world
from rendered.touch import KINDS
from rendered.world_capture import write_world
from world_runs import capture_path, world_of

from neeco.capture import read_capture

SEED = 7  # a hinged instrument before a still scope


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> tuple[World, Path, Path]:
    """A small touched world that pulls, its capture, and that of the same world without contact."""
    torch.set_num_threads(1)
    world = draw_world(SEED, touched=True)
    assert world.touch is not None
    touch = replace(world.touch, kind="pull", radius=5.0, return_s=0.2, depth=3.0)
    small = replace(world, size=(64, 48), frames=12, coverage=1.0, automatic=False, touch=touch)
    folder = tmp_path_factory.mktemp("worlds")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(draws, "RESOLUTION", 90)
        patch.setattr(world_capture, "TEST", 4)
        patch.setattr(world_capture, "BEYOND", 4)
        write_world(small, folder / "touched")
        write_world(replace(small, touch=None), folder / "free")
    return small, folder / "touched", folder / "free"


def read(path: Path) -> Any:
    return json.loads(path.read_text())


def image(capture: Path, name: str) -> np.ndarray:
    return np.array(Image.open(capture / "images" / name)).astype(int)


def test_frames_with_and_without_contact_are_in_every_split(captures: tuple[World, Path, Path]) -> None:
    _, touched, free = captures
    contact = read(touched / "truth" / "contact.json")
    assert {entry["contact"] for entry in contact.values()} == {"none", "touching", "grasping"}
    capture = read_capture(touched)
    for split in ("train", "test", "unseen"):
        share = np.mean([contact[frame.image_path.name]["contact"] != "none" for frame in capture.split(split)])
        assert 0.2 < share < 0.8, split
    other = read_capture(free)
    assert [(f.name, f.split, f.state.time) for f in capture.frames] == [
        (f.name, f.split, f.state.time) for f in other.frames
    ]


def test_the_tips_are_below_the_resting_surface_where_they_touch(captures: tuple[World, Path, Path]) -> None:
    world, touched, _ = captures
    contact = read(touched / "truth" / "contact.json")
    depths = [entry["depth_mm"] for entry in contact.values() if entry["contact"] == "touching"]
    assert min(depths) > 0
    assert 0.5 * world.touch.depth < max(depths) < world.touch.depth + 2
    assert all(entry["depth_mm"] <= TOUCHING for entry in contact.values() if entry["contact"] == "none")


def test_the_surface_moves_near_the_instrument_and_comes_back(captures: tuple[World, Path, Path]) -> None:
    world, touched, _ = captures
    points, contact = read(touched / "truth" / "points.json"), read(touched / "truth" / "contact.json")
    rest, moved = np.array(points["rest"]), np.array(points["displacement"])
    assert moved.shape == (len(contact), len(rest), 3)
    assert list(contact) == points["file_names"]
    size = np.linalg.norm(moved, axis=-1)
    held = np.array([entry["contact"] == "grasping" for entry in contact.values()])
    assert size[held].max() > 1.5
    time = {
        Path(frame["file_path"]).name: frame["time"] for frame in read(touched / "truth" / "transforms.json")["frames"]
    }
    when = np.array([time[name] for name in contact])
    busy = np.array([entry["contact"] != "none" for entry in contact.values()])
    since = np.array([min([t - s for s in when[busy] if s <= t], default=np.inf) for t in when])
    assert (since > 8 * world.touch.return_s).any()
    assert size[since > 8 * world.touch.return_s].max() < 0.05
    for row, one in zip(size, rest[size.argmax(1)], strict=True):  # far from the point that moves most
        far = np.linalg.norm(rest - one, axis=1) > 5 * world.touch.radius + 20
        assert row[far].max(initial=0) < 0.05


def test_images_differ_only_near_the_instrument(captures: tuple[World, Path, Path]) -> None:
    _, touched, free = captures
    contact = read(touched / "truth" / "contact.json")
    masks = [np.array(Image.open(c / "truth" / "masks" / "000000.png")) for c in (touched, free)]
    assert masks[0].shape == masks[1].shape
    still = [name for name, entry in contact.items() if entry["displacement_mm"] < 0.02]
    equal = [np.array_equal(image(touched, name), image(free, name)) for name in still]
    assert any(equal)
    grasped = [name for name, entry in contact.items() if entry["contact"] == "grasping"]
    changes = np.mean([np.abs(image(touched, name) - image(free, name)).max(-1) > 24 for name in grasped])
    assert 0.005 < changes < 0.5


def test_what_is_not_touched_says_nothing_of_touch(captures: tuple[World, Path, Path]) -> None:
    _, touched, free = captures
    own, other = read(touched / "world.json"), read(free / "world.json")
    assert own.pop("touch")["kind"] == "pull"
    assert "touch" not in other
    assert own | {"share": 0} == other | {"share": 0}
    assert not (free / "truth" / "contact.json").exists()


def test_kinds_are_drawn_and_names_tell_touched_worlds_apart() -> None:
    worlds = [draw_world(seed, touched=True) for seed in range(80)]
    assert {world.touch.kind for world in worlds} == set(KINDS)
    assert not any(world.touch.grasps for world in worlds if world.kind == "straight")
    assert replace(worlds[5], touch=None) == draw_world(5) == world_of(5)
    assert world_of("5-touched") == worlds[5]
    assert capture_path(Path(), "5-touched") != capture_path(Path(), 5)
