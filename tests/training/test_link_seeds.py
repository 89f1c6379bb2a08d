"""Seeds lie on the links with which they must move to stay on evidence."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from evidence_world import make_evidence
from torch import Tensor
from wristed_world import shifted

from neeco.capture.kinematics import REVOLUTE, KinematicTree, Link
from neeco.capture.model import Instrument, InstrumentState, State
from neeco.evidence.carving import CarvedShape, CarvingSettings, Evidence, carve
from neeco.geometry.rotations import rigid_from_vector, rotate_about
from neeco.methods.kinematic.articulation import Articulation
from neeco.methods.kinematic.link_search import align_to_links, correct_poses, readings_of, start_links
from neeco.methods.kinematic.wrist_search import search_wrist
from neeco.scene.drawable import Recorded
from neeco.states.refinement import RefineConfig, Refinement

SEARCH = CarvingSettings(seeds=600)
PITCH_AT, YAW_AT, TIP, RADIUS = 4.0, 14.0, 30.0, 3.0  # mm along the shaft


def driver_tree() -> KinematicTree:
    jaws = (("jaw_left", 0.5), ("jaw_right", -0.5))
    return KinematicTree(
        (
            Link("shaft"),
            Link("wrist", "shaft", REVOLUTE, shifted(0, 0, PITCH_AT), np.array([0, 1.0, 0]), {"pitch": 1.0}),
            *(
                Link(name, "wrist", REVOLUTE, shifted(0, 0, YAW_AT - PITCH_AT), np.array([1.0, 0, 0]), {"jaw": gain})
                for name, gain in jaws
            ),
        )
    )


def resting(link: str, count: int = 2500) -> Tensor:
    """[P, 3] mm, of one link at rest."""
    generator = torch.Generator().manual_seed(len(link))
    near, far, radius = {"shaft": (-40, PITCH_AT, RADIUS), "wrist": (PITCH_AT, YAW_AT, 2.5)}.get(
        link, (YAW_AT, TIP, 0.9)
    )
    turn, along, out = torch.rand(3, count, generator=generator)
    out, turn = radius * out.sqrt(), 2 * torch.pi * turn
    return torch.stack([out * turn.cos(), out * turn.sin(), near + (far - near) * along], -1)


def driver(rng: np.random.Generator, pitch_sign: float = 1.0) -> tuple[dict[str, float], Tensor]:
    readings = {"pitch": float(rng.uniform(-0.7, 0.7)), "jaw": float(rng.uniform(0.3, 1.4))}
    links, true = (
        Articulation(driver_tree()).requires_grad_(False),
        {**readings, "pitch": pitch_sign * readings["pitch"]},
    )
    return readings, torch.cat([links.place(resting(name), k, true) for k, name in enumerate(links.part_names)])


@pytest.fixture(scope="module")
def carved() -> tuple[Evidence, CarvedShape]:
    evidence = make_evidence(torch.eye(4, dtype=torch.float64), 60, instrument=driver)
    shape = carve(evidence, "tool", torch.Generator().manual_seed(0), SEARCH)
    assert shape is not None
    return evidence, shape


def session(evidence: Evidence, unrecorded: tuple[str, ...] = ()) -> Any:
    """What the search asks of a training session."""
    said: list[str] = []
    instrument = Instrument("tool", {"pitch": (-1.0, 1.0), "jaw": (0.0, 1.6)}, driver_tree(), unrecorded)
    frames = evidence.frames
    if unrecorded:
        frames = tuple(replace(frame, state=halfway(frame.state, instrument)) for frame in frames)
    return cast(
        Any,
        SimpleNamespace(
            config=SimpleNamespace(deformation=SimpleNamespace(carving=SEARCH), seed=0),
            report=said.append,
            said=said,
            scene=SimpleNamespace(
                instruments=(instrument,),
                recorded=Recorded.of(frames, (instrument,)),
                diagnostics={},
                base_corrections=torch.zeros(1, 6),
                center=torch.tensor([0.0, 0.0, 130.0]),
            ),
            refinement=Refinement(RefineConfig(frame_joints=True), frames, (instrument,), torch.device("cpu")),
            full_views=SimpleNamespace(frames=frames),
        ),
    )


def halfway(state: State, instrument: Instrument) -> State:
    given = state.instruments["tool"]
    return State({"tool": InstrumentState(given.pose, {**given.joints, "jaw": instrument.halfway("jaw")})}, state.time)


def started(carved: tuple[Evidence, CarvedShape]) -> Articulation:
    links = Articulation(driver_tree()).requires_grad_(False)
    links.base.copy_(carved[1].instrument_from_shaft)
    links.radius.fill_(carved[1].radius)
    return links


def test_every_link_is_seeded_where_it_is(carved: tuple[Evidence, CarvedShape]) -> None:
    links, generator = started(carved), torch.Generator().manual_seed(0)
    seeds, logits = start_links(session(carved[0]), links, carved[0], "tool", carved[1], columns=4, generator=generator)
    assert logits.shape == (len(seeds), 4)
    owners = logits.argmax(1)
    for k, (near, far) in enumerate(((-45, PITCH_AT), (PITCH_AT, YAW_AT), (YAW_AT, TIP), (YAW_AT, TIP))):
        own = seeds[owners == k]
        assert len(own) > 80
        along, away = own[:, 2], own[:, :2].norm(dim=1)
        inside = (along > near - 4) & (along < far + 4) & (away < 2 * RADIUS)
        assert float(inside.float().mean()) > (0.7 if k < 2 else 0.45), links.part_names[k]  # jaws are thin
        assert near - 4 < float(along.median()) < far + 4


def test_a_carved_line_is_kept_where_the_links_agree_and_else_theirs_is_taken(carved):
    evidence, shape = carved
    links, kept, told = started(carved), session(evidence), session(evidence)
    assert align_to_links(kept, links, evidence, "tool", shape, torch.Generator().manual_seed(0)).seeds is shape.seeds
    astray = CarvedShape(**vars(shape) | {"instrument_from_shaft": torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))})
    again = align_to_links(told, links, evidence, "tool", astray, torch.Generator().manual_seed(0))
    assert told.said
    assert not kept.said
    assert float(again.instrument_from_shaft[2, 2]) > 0.99
    assert again.near < -20 < PITCH_AT < again.tip
    assert float(again.seeds[:, :2].norm(dim=1).median()) < 2 * RADIUS


def test_a_shaft_that_leaves_no_evidence_is_seeded_about_the_stated_line(carved: tuple[Evidence, CarvedShape]) -> None:
    """As where the tissue's fit absorbed a dark shaft that hardly moves."""
    evidence, shape = replace(carved[0], hits=torch.zeros_like(carved[0].hits)), carved[1]
    links, told = started(carved), session(evidence)
    far = torch.eye(4)
    far[0, 3] = 30.0
    astray = replace(shape, instrument_from_shaft=far, radius=20.0)
    again = align_to_links(told, links, evidence, "tool", astray, torch.Generator().manual_seed(0))
    assert told.said
    along, away = again.seeds[:, 2], again.seeds[:, :2].norm(dim=1)
    assert float(along.max()) <= PITCH_AT
    assert float(along.min()) < PITCH_AT - 20
    assert float(away.max()) < 2 * RADIUS
    assert again.radius < 2 * RADIUS


def test_links_of_a_joint_that_nobody_recorded_are_seeded_on_their_sides(carved: tuple[Evidence, CarvedShape]) -> None:
    """Mirrored, with the jaws exchanged, they would explain the images as well."""
    evidence = carved[0]
    asked = session(evidence, ("jaw",))
    seeds, logits = start_links(
        asked,
        started(carved),
        evidence,
        "tool",
        carved[1],
        columns=4,
        generator=torch.Generator().manual_seed(0),
    )
    owners = logits.argmax(1)
    for link, sense in ((2, 1.0), (3, -1.0)):  # jaw_left turns by half of the reading about x, which takes z to -y
        own = seeds[owners == link]
        assert len(own) > 80
        assert float((-sense * own[:, 1]).quantile(0.02)) > -0.5 * carved[1].radius


HEADING = 0.8  # rad


def closed_driver(rng: np.random.Generator) -> tuple[dict[str, float], Tensor]:
    """A driver that stays closed, its jaws not where the tree has them at rest: the zero of the yaw is another."""
    readings = {"pitch": float(rng.uniform(-0.7, 0.7)), "jaw": 0.0}
    links = Articulation(driver_tree()).requires_grad_(False)
    pivot, axis = torch.tensor([0, 0, YAW_AT]), torch.tensor([1.0, 0, 0])
    shapes = [resting(name) for name in links.part_names]
    shapes[2:] = [rotate_about(shape, axis, pivot, torch.full((len(shape),), HEADING)) for shape in shapes[2:]]
    return readings, torch.cat([links.place(shape, k, readings) for k, shape in enumerate(shapes)])


def test_links_that_nobody_recorded_open_from_where_they_are_closed() -> None:
    evidence = make_evidence(torch.eye(4, dtype=torch.float64), 60, instrument=closed_driver)
    shape = carve(evidence, "tool", torch.Generator().manual_seed(0), SEARCH)
    assert shape is not None
    asked, links = session(evidence, ("jaw",)), started((evidence, shape))
    seeds, logits = start_links(
        asked, links, evidence, "tool", shape, columns=4, generator=torch.Generator().manual_seed(0)
    )
    found = readings_of(asked, evidence, "tool")[0]["jaw"]
    assert found < 0.3  # of 1.6; half way is 0.8
    ahead = torch.tensor([0, -np.sin(HEADING), np.cos(HEADING)]).float()
    across = torch.tensor([0, np.cos(HEADING), np.sin(HEADING)]).float()
    for link, sense in ((2, -1.0), (3, 1.0)):
        own = seeds[logits.argmax(1) == link] - torch.tensor([0, 0, YAW_AT])
        assert float((own @ ahead).quantile(0.02)) > -0.5 * RADIUS  # the wrist, which moves alike, is behind
        assert float((own @ ahead).quantile(0.75)) > 6  # mm, of 16
        assert float((sense * own @ across).quantile(0.02)) > -0.5 * RADIUS


@pytest.mark.parametrize(
    ("change", "doubted", "words"),
    [
        (lambda given: given, set(), ""),
        (
            lambda given: {"pitch": given["jaw"], "jaw": given["pitch"]},
            {"tool.pitch", "tool.jaw"},
            "with the readings of pitch and jaw exchanged",
        ),
        (lambda given: {**given, "pitch": -given["pitch"]}, {"tool.pitch"}, "with the sign of pitch reversed"),
    ],
)
def test_readings_that_drive_other_joints_than_they_say_are_doubted(carved, change, doubted, words):
    carved = few_frames(carved)
    asked = session(carved[0])
    readings = [change(given) for given in readings_of(asked, carved[0], "tool")]
    assert not correct_poses(asked, started(carved), *carved_for(asked, carved), readings)
    assert set(asked.scene.diagnostics.get("doubted_readings", {})) == doubted
    assert all(words in line for line in asked.said)
    assert len(asked.said) == bool(doubted)


def test_frames_that_contradict_each_other_make_no_reading_doubtful(carved: tuple[Evidence, CarvedShape]) -> None:
    """In seven of twelve frames the links bend the other way, which is no evidence that a sign is reversed."""
    other = make_evidence(STILL, 60, instrument=partial(driver, pitch_sign=-1.0))
    recorded, shape = few_frames(carved, step=5)
    hits = torch.cat([other.subset(torch.arange(0, 35, 5)).hits, recorded.hits[7:]])
    mixed = (replace(recorded, hits=hits), shape)
    asked = session(mixed[0])
    correct_poses(asked, started(mixed), *carved_for(asked, mixed), readings_of(asked, mixed[0], "tool"))
    assert not asked.scene.diagnostics.get("doubted_readings")


STILL = torch.eye(4, dtype=torch.float64)


def few_frames(carved: tuple[Evidence, CarvedShape], step: int = 4) -> tuple[Evidence, CarvedShape]:
    return carved[0].subset(torch.arange(0, 60, step)), carved[1]


def carved_for(asked: Any, carved: tuple[Evidence, CarvedShape]) -> tuple[Evidence, Instrument, CarvedShape]:
    return carved[0], asked.scene.instruments[0], carved[1]


def moved(carved: tuple[Evidence, CarvedShape], base: Tensor, frame: Tensor) -> tuple[Evidence, CarvedShape]:
    """The evidence with all poses moved by `base` [4, 4] in the world and by `frame` [4, 4] in the instrument."""
    evidence, shape = carved
    frames = []
    for one in evidence.frames:
        given = one.state.instruments["tool"]
        frames.append(
            replace(
                one, state=State({"tool": InstrumentState(base @ given.pose @ frame, given.joints)}, one.state.time)
            )
        )
    back = torch.linalg.inv(frame).float()
    return replace(evidence, frames=tuple(frames)), replace(
        shape, instrument_from_shaft=back @ shape.instrument_from_shaft
    )


def pivots_off_mm(asked: Any, links: Articulation, evidence: Evidence, true: Evidence) -> float:
    """Rms distance of the last pivot from where it is, with what was learned of bases and links."""
    correction = rigid_from_vector(asked.scene.base_corrections[0]).double()
    center, off = asked.scene.center.double(), []
    rest = Articulation(driver_tree()).requires_grad_(False)
    for one, other in zip(evidence.frames, true.frames, strict=True):
        given, right = one.state.instruments["tool"], other.state.instruments["tool"]
        found, wanted = (item.place(item.axes()[0][:1], 1, right.joints)[0].double() for item in (links, rest))
        here = given.pose[:3, :3] @ found + given.pose[:3, 3] - center
        here = correction[:3, :3] @ here + center + correction[:3, 3]
        off.append(here - right.pose[:3, :3] @ wanted - right.pose[:3, 3])
    return float(torch.stack(off).square().sum(1).mean().sqrt())


@pytest.mark.slow
@pytest.mark.parametrize("along_mm", [-5.0, 8.0])
def test_a_frame_that_is_off_along_the_shaft_is_found_and_no_joint_is_called_reversed(carved, along_mm):
    true = few_frames(carved)
    off = moved(true, STILL, torch.from_numpy(shifted(0, 0, along_mm)))
    asked, links = session(off[0]), started(off)
    correct_poses(asked, links, *carved_for(asked, off), readings_of(asked, off[0], "tool"))
    assert len(asked.said) == 1
    assert "the pose's frame is off along the shaft" in asked.said[0]
    found = asked.scene.diagnostics["registration_of_links"]["tool"]
    assert abs(found["frame_off_along_shaft_mm"] - along_mm) < 1.5
    assert not asked.scene.diagnostics.get("doubted_readings")
    assert pivots_off_mm(asked, links, off[0], true[0]) < 2.6  # mm


def test_a_base_that_is_off_is_corrected(carved: tuple[Evidence, CarvedShape]) -> None:
    true = few_frames(carved)
    base = rigid_from_vector(torch.tensor([0.02, -0.03, 0.02, 5.0, -4.0, 3.0], dtype=torch.float64))
    off = moved(true, base, STILL)
    asked, links = session(off[0]), started(off)
    before = pivots_off_mm(asked, links, off[0], true[0])
    assert correct_poses(asked, links, *carved_for(asked, off), readings_of(asked, off[0], "tool"))
    assert pivots_off_mm(asked, links, off[0], true[0]) < 0.4 * before


def exchanged(readings: list[dict[str, float]]) -> list[dict[str, float]]:
    return [{"pitch": given["jaw"], "jaw": given["pitch"]} for given in readings]


@pytest.mark.parametrize("named", [list, exchanged])
def test_links_that_nobody_stated_are_found_whatever_their_readings_are_called(carved, named) -> None:
    evidence, shape = few_frames(carved, step=3)
    readings = named([dict(frame.state.instruments["tool"].joints) for frame in evidence.frames])
    tree = search_wrist(evidence, "tool", shape, readings, ("pitch", "jaw"))
    assert tree is not None
    _, wrist, left, right = tree.links
    first, second = ("pitch", "jaw") if named is list else ("jaw", "pitch")
    assert set(wrist.value) == {first}
    assert set(left.value) == set(right.value) == {second}
    assert right.value[second] - left.value[second] == pytest.approx(1.0)
    points, directions = tree.axes_at_rest
    np.testing.assert_allclose(np.abs(directions), [[1, 0, 0], [1, 0, 0], [0, 1, 0]], atol=0.2)
    np.testing.assert_allclose(points[:, 2], [YAW_AT, YAW_AT, PITCH_AT], atol=4.0)
    # turned as the true one is, but for its errors
    true, found = (part.poses({"pitch": 0.5, "jaw": 0.0})["wrist"] for part in (driver_tree(), tree))
    if named is list:
        np.testing.assert_allclose(found[:3, :3], true[:3, :3], atol=0.2)


def test_readings_of_other_moments_show_no_wrist(carved) -> None:
    evidence, shape = carved  # with 20 of its frames, one is found by chance
    readings = [dict(frame.state.instruments["tool"].joints) for frame in evidence.frames]
    exchanged_in_time = [*readings[17:], *readings[:17]]
    assert search_wrist(evidence, "tool", shape, exchanged_in_time, ("pitch", "jaw")) is None
