"""Joints whose axes nobody stated are found in images one after the other, and those that explain nothing are named."""

from __future__ import annotations

import math
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from evidence_world import make_evidence
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from wristed_world import shifted

from neeco.capture.kinematics import PRISMATIC, REVOLUTE, KinematicTree, Link
from neeco.capture.model import Instrument
from neeco.raster.rotations import rigid_from_vector
from neeco.scene.articulation.stated import StatedLinks
from neeco.scene.training_views import TrainingViews
from neeco.training.config import SearchConfig
from neeco.training.instruments import chain_search, chains
from neeco.training.instruments.chains import find_trees
from neeco.training.instruments.color_evidence import clear_by_color
from neeco.training.instruments.evidence import Evidence
from neeco.training.instruments.trocar import trocar_line

SENSOR = rigid_from_vector(torch.tensor([0.3, -0.2, 0.1, 4.0, -3.0, 5.0], dtype=torch.float64))  # shaft_from_sensor
WRIST_AT, JAWS_AT, TIP, RADIUS = 4.0, 13.0, 28.0, 3.0  # mm along the shaft
PITCH_AXIS, JAW_AXIS = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])


def wristed_tree() -> KinematicTree:
    """Pitch, then yaw with two jaws about the same axis."""
    jaws = (("jaw_left", 0.5), ("jaw_right", -0.5))
    wrist = Link("wrist", "shaft", REVOLUTE, shifted(0, 0, WRIST_AT), PITCH_AXIS, {"pitch": 1.0})
    at = shifted(0, 0, JAWS_AT - WRIST_AT)
    values = [(name, {"yaw": 1.0, "jaw": gain}) for name, gain in jaws]
    return KinematicTree(
        (Link("shaft"), wrist, *(Link(name, "wrist", REVOLUTE, at, JAW_AXIS, value) for name, value in values))
    )


def sliding_tree() -> KinematicTree:
    """A rod that slides out of the shaft, with two jaws at its end."""
    rod = Link("rod", "shaft", PRISMATIC, shifted(0, 0, WRIST_AT), np.array([0, 0, 1.0]), {"rod_mm": 1.0})
    at = shifted(0, 0, JAWS_AT - WRIST_AT)
    jaws = [Link(f"jaw_{k}", "rod", REVOLUTE, at, JAW_AXIS, {"jaw": gain}) for k, gain in enumerate((0.5, -0.5))]
    return KinematicTree((Link("shaft"), rod, *jaws))


def resting(link: int, count: int = 2500) -> Tensor:
    """[P, 3] mm, of the shaft, the wrist or a jaw at rest."""
    generator = torch.Generator().manual_seed(link)
    ends = [(-40, WRIST_AT, RADIUS), (WRIST_AT, JAWS_AT, 2.6), (JAWS_AT, TIP, 1.0), (JAWS_AT, TIP, 1.0)]
    near, far, radius = ends[link]
    turn, along, out = torch.rand(3, count, generator=generator)
    out, turn = radius * out.sqrt(), 2 * torch.pi * turn
    return torch.stack([out * turn.cos(), out * turn.sin(), near + (far - near) * along], -1)


def world_of(tree: KinematicTree, ranges: dict[str, tuple[float, float]], frames: int = 40) -> Evidence:
    """Silhouettes of the tree's links at random readings; `noise`: a reading that moves nothing."""
    links = StatedLinks(tree).requires_grad_(False)

    def state(rng: np.random.Generator) -> tuple[dict[str, float], Tensor]:
        readings = {name: float(rng.uniform(*limits)) for name, limits in ranges.items()}
        return readings, torch.cat([links.place(resting(k), k, readings) for k in range(links.link_count)])

    return make_evidence(SENSOR, frames, instrument=state)


def search_in(
    evidence: Evidence, names: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> tuple[Instrument, list[str]]:
    """What is found of an instrument with these joints, and what is said of it."""
    monkeypatch.setattr(chain_search, "EVALUATIONS", 12)  # coarser, for speed
    monkeypatch.setattr(chain_search, "ANGLES", 12)
    monkeypatch.setattr(chain_search, "GRID_POINTS", 250)
    monkeypatch.setattr(chains, "tissue_evidence", lambda scene, views, config: evidence)
    monkeypatch.setattr(chains, "_fitted_again", lambda session, known: known)
    monkeypatch.setattr(chains, "clear_by_color", lambda known, views: known)
    told: list[str] = []
    session = SimpleNamespace(
        config=SimpleNamespace(search=SearchConfig(seeds=300), seed=0),
        report=told.append,
        searching=nullcontext,
        scene=SimpleNamespace(instruments=(Instrument("tool", dict.fromkeys(names)),), diagnostics={}),
        views=SimpleNamespace(frames=evidence.frames),
    )
    found = find_trees(cast(Any, session))
    assert found is not None
    return found[0], told


def apart(found: Link, at: float, axis: np.ndarray, tree: KinematicTree) -> tuple[float, float]:
    """Degrees and mm by which a found link's axis, at rest, is off one at `at` mm along the true shaft."""
    place = tree.joints.index(found)
    point, direction = (part[place] for part in tree.axes_at_rest)
    shaft_from_sensor = SENSOR.numpy()
    direction = shaft_from_sensor[:3, :3] @ direction
    point = shaft_from_sensor[:3, :3] @ point + shaft_from_sensor[:3, 3]
    between = point - np.array([0, 0, at])
    angle = math.degrees(math.acos(min(1.0, abs(float(direction @ axis)))))
    return angle, float(np.linalg.norm(between - (between @ axis) * axis))


def test_a_wrist_with_two_jaws_is_found_and_a_reading_that_moves_nothing_named(monkeypatch: pytest.MonkeyPatch) -> None:
    ranges = {"noise": (-0.6, 0.6), "jaw": (0.2, 1.2), "pitch": (-0.7, 0.7), "yaw": (-0.6, 0.6)}
    found, told = search_in(world_of(wristed_tree(), ranges), tuple(ranges), monkeypatch)
    tree = found.kinematics
    assert tree is not None
    assert set(tree.readings) == set(found.joints) == {"pitch", "yaw", "jaw"}
    wrist, left, right = tree.links[1:]
    assert (left.parent, right.parent, wrist.parent) == (wrist.name, wrist.name, "shaft")
    assert dict(left.value) == {"yaw": 1.0, "jaw": 0.5}
    assert dict(right.value) == {"yaw": 1.0, "jaw": -0.5}
    for link, at, axis in ((wrist, WRIST_AT, PITCH_AXIS), (left, JAWS_AT, JAW_AXIS)):
        degrees, millimetres = apart(link, at, axis, tree)
        assert degrees < 15  # from which training finds the rest
        assert millimetres < 2
    assert any("joint noise was NOT found" in line for line in told)


def test_a_rod_that_slides_is_found_before_its_jaws(monkeypatch: pytest.MonkeyPatch) -> None:
    ranges = {"jaw": (0.2, 1.2), "rod_mm": (-5.0, 5.0)}
    found, _ = search_in(world_of(sliding_tree(), ranges), tuple(ranges), monkeypatch)
    tree = found.kinematics
    assert tree is not None
    rod, *jaws = tree.links[1:]
    assert (rod.type, dict(rod.value)) == (PRISMATIC, {"rod_mm": 1.0})
    assert SENSOR.numpy()[:3, :3] @ rod.axis @ np.array([0, 0, 1.0]) > math.cos(math.radians(15))
    assert [dict(jaw.value) for jaw in jaws] == [{"jaw": 0.5}, {"jaw": -0.5}]


def test_an_instrument_with_one_joint_is_left_to_the_search_for_hinges() -> None:
    session = SimpleNamespace(scene=SimpleNamespace(instruments=(Instrument("tool", {"jaw": None}),)))
    assert find_trees(cast(Any, session)) is None


def test_stated_kinematics_are_not_searched_for() -> None:
    tree = wristed_tree()
    session = SimpleNamespace(
        scene=SimpleNamespace(instruments=(Instrument("tool", dict.fromkeys(tree.readings), tree),))
    )
    assert find_trees(cast(Any, session)) is None


def poses_through_a_trocar(
    rng: np.random.Generator, slide: float, noise: float, count: int = 60
) -> tuple[np.ndarray, ...]:
    """(world_from_instrument [F, 4, 4], the shaft's point [3] and direction [3] in the instrument's frame)."""
    trocar = rng.normal(size=3) * 50
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    point = rng.normal(size=3) * 5
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose in poses:
        turn = rigid_from_vector(torch.from_numpy(np.concatenate([rng.normal(size=3) * 0.5, np.zeros(3)])))[
            :3, :3
        ].numpy()
        depth = -100 + slide * rng.uniform(-0.5, 0.5)
        pose[:3, :3] = turn
        pose[:3, 3] = trocar - turn @ (point + depth * direction) + noise * rng.normal(size=3)
    return poses, point, direction


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6), st.floats(15, 60))
def test_the_shaft_goes_through_the_point_that_all_poses_have_in_common(seed: int, slide: float) -> None:
    poses, point, direction = poses_through_a_trocar(np.random.default_rng(seed), slide, 0.2)
    line = trocar_line(poses)
    assert line is not None
    assert line.clear
    assert abs(float(line.direction @ direction)) > math.cos(math.radians(2))
    assert np.linalg.norm(np.cross(point - line.point, line.direction)) < 4  # 100 mm from the trocar
    assert line.slide == pytest.approx(slide, abs=0.2 * slide + 1.5)


def test_poses_that_do_not_slide_show_no_line() -> None:
    poses, *_ = poses_through_a_trocar(np.random.default_rng(1), 0.0, 0.3)
    line = trocar_line(poses)
    assert line is not None
    assert not line.clear


def test_poses_anywhere_show_no_trocar() -> None:
    rng = np.random.default_rng(2)
    poses = np.stack(
        [rigid_from_vector(torch.from_numpy(rng.normal(size=6) * [1, 1, 1, 20, 20, 20])).numpy() for _ in range(60)]
    )
    line = trocar_line(poses)
    assert line is not None
    assert not line.clear


def test_a_dark_shaft_that_the_tissue_took_in_is_evidence_by_its_colour() -> None:
    evidence = make_evidence(torch.eye(4, dtype=torch.float64), 12)
    rng = np.random.default_rng(0)
    tissue, steel = torch.tensor([180, 70, 60]), torch.tensor([70, 75, 80])
    images = []
    for hits in evidence.hits:
        grain = torch.from_numpy(rng.integers(-8, 9, (*hits.shape, 3)))
        images.append((torch.where(hits[..., None] > 0.5, steel, tissue) + grain).to(torch.uint8))
    views = TrainingViews(evidence.frames, tuple(images), (None,) * len(images))
    holes = torch.from_numpy(rng.uniform(size=evidence.hits.shape) < 0.5)  # of the instrument, and fog beside it
    beside = torch.nn.functional.max_pool2d(evidence.hits[:, None], 9, 1, 4)[:, 0] - evidence.hits
    poor = Evidence(
        torch.where(holes, 0.6 * beside, evidence.hits),
        evidence.depths,
        evidence.camera_from_world,
        evidence.intrinsics,
        evidence.frames,
    )

    def overlap(hits: Tensor) -> float:
        known, true = hits > 0.5, evidence.hits > 0.5
        return float((known & true).sum() / (known | true).sum())

    assert overlap(poor.hits) < 0.5
    assert overlap(clear_by_color(poor, views).hits) > 0.85
