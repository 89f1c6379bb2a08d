"""Roll and joints of an instrument found in a video: what its images say, and what hand-posed frames add."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from posing_world import JOINT, NAME, PosingWorld, measured_world

from neeco.base.errors import NeecoError
from neeco.capture.readers import read_capture
from neeco.ingest.posing.along_shaft import (
    FILE,
    Shafts,
    crop,
    measure,
    read_measurements,
    roll_pairs,
    unrolled_textures,
    write_measurements,
)
from neeco.ingest.posing.posed_capture import HandPose, PosedCapture, read_answers, write_answers

HAND_DEG = 3.0


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> PosingWorld:
    """Read only: tests that write take a copy."""
    return measured_world(tmp_path_factory.mktemp("posing") / "capture")


@pytest.fixture
def copied(world: PosingWorld, tmp_path: Path) -> Path:
    return Path(shutil.copytree(world.root, tmp_path / "capture"))


def shafts(world: PosingWorld) -> Shafts:
    return Shafts.of(world.capture, world.capture.instruments[0])


def rolls_of(found: Shafts, x_axes: np.ndarray) -> np.ndarray:
    """Rolls [F] rad of instruments whose x axis is [F, 3] in the camera's axes."""
    towards, across = found.view_axes
    return np.arctan2((x_axes * across).sum(-1), (x_axes * towards).sum(-1))


def answers(world: PosingWorld, frames: list[int], error_deg: float = 0.0) -> list[HandPose]:
    random = np.random.default_rng(5)
    return [
        HandPose(
            world.capture.frames[frame].name,
            NAME,
            math.degrees(world.rolls[frame]) + error_deg * random.normal(),
            {JOINT: math.degrees(world.jaws[frame]) + error_deg * random.normal()},
        )
        for frame in frames
    ]


def rms_deg(errors: np.ndarray) -> float:
    return float(np.degrees(np.sqrt((errors**2).mean())))


def test_along_the_shaft_it_points_to_the_tip_and_the_jaws_lie_beyond_the_wrist(world: PosingWorld) -> None:
    along, across = np.arange(-10.0, 24.0), np.arange(-12.0, 12.5, 0.5)
    for frame in (0, 20):
        mask = world.masks[frame].astype(np.uint8) * 255
        widths = (crop(shafts(world), frame, mask, along, across) > 127).sum(1) * 0.5
        assert widths[along < 0] == pytest.approx(6.0, abs=1.0)
        assert widths[along > 20].max() > 2


def test_roll_turns_x_from_the_camera_sideways(world: PosingWorld) -> None:
    found = shafts(world)
    for roll in (-2.0, 0.0, 0.7):
        x_axes = np.stack([found.rotation(frame, roll)[:, 0] for frame in range(len(found))])  # the camera is the world
        np.testing.assert_allclose(rolls_of(found, x_axes), roll, atol=1e-9)
        assert ((x_axes * found.origins).sum(-1) < 0).all() == (roll != -2.0)  # towards the camera


def test_a_view_that_turns_is_not_taken_for_a_roll(world: PosingWorld) -> None:
    """An instrument that stands still while the camera goes round it is carried by exactly what its roll changes."""
    found = shafts(world)
    count = len(found)
    angle = np.linspace(0, 1.2, count)
    camera = np.stack([[[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]] for a in angle])
    at = np.array([0.0, 0.0, 70.0])
    places = at - 70 * camera[:, :, 2]  # always looking at it
    z, x = np.array([0.8, 0.6, 0.0]), np.array([-0.6, 0.8, 0.0])
    still = replace(
        found,
        origins=np.einsum("fji,fj->fi", camera, at - places),
        directions=np.einsum("fji,j->fi", camera, z),
        world_from_camera=camera,
    )
    rolls = np.unwrap(rolls_of(still, np.einsum("fji,j->fi", camera, x)))
    assert np.ptp(rolls) > 0.3
    np.testing.assert_allclose(np.diff(rolls), still.carried(), atol=1e-9)


def test_texture_tells_how_far_it_rolled(world: PosingWorld) -> None:
    images = [(frame.load_image_bytes().numpy()) for frame in world.capture.frames]
    textures, seen = unrolled_textures(shafts(world), lambda frame: images[frame])
    assert seen.all()
    pairs = roll_pairs(textures, seen)
    turned = world.rolls[pairs.second] - world.rolls[pairs.first]
    near = (np.abs(turned) > 0.1) & (np.abs(turned) < 0.7)
    errors = np.abs(pairs.turns[near] - turned[near, None])
    assert near.sum() > 50
    assert np.degrees(np.median(errors[:, 0])) < 4
    # of several hypotheses the right one is there more often than it is the best
    assert (errors.min(1) < 0.2).mean() > max(0.9, (errors[:, 0] < 0.2).mean() - 1e-9)


def test_a_few_hand_posed_frames_tell_all(world: PosingWorld) -> None:
    posed = PosedCapture(world.root)
    given: list[HandPose] = []
    for _ in range(5):
        asked = posed.solve(given)[NAME].suggestions(1)[0].frame
        given.append(*answers(world, [asked], HAND_DEG))
    solved = posed.solve(given)[NAME]
    assert rms_deg(solved.rolls.values - world.rolls) < 5
    assert rms_deg(solved.joints[JOINT].values - world.jaws) < 6
    before = posed.solve(given[:1])[NAME]
    assert rms_deg(before.joints[JOINT].values - world.jaws) > rms_deg(solved.joints[JOINT].values - world.jaws)
    assert solved.deviations()["roll"] < before.deviations()["roll"]


def test_no_frame_is_asked_twice_and_every_answer_changes_what_is_asked(world: PosingWorld) -> None:
    posed = PosedCapture(world.root)
    first = [item.frame for item in posed.solve([])[NAME].suggestions()]
    assert len(set(first)) == len(first) == 10
    later = [item.frame for item in posed.solve(answers(world, [first[0], 12]))[NAME].suggestions()]
    assert not {first[0], 12} & set(later)


def test_an_answer_that_its_neighbours_contradict_is_doubted(world: PosingWorld) -> None:
    posed = PosedCapture(world.root)
    good = answers(world, [0, 8, 16, 24, 32, 39])
    assert posed.solve(good)[NAME].outliers() == []
    turned = [*good[:3], replace(good[3], roll_deg=good[3].roll_deg + 180), *good[4:]]
    assert {doubt.frame for doubt in posed.solve(turned)[NAME].outliers() if abs(doubt.degrees) > 120} == {24}
    twice = [*good, replace(good[2], joints_deg={JOINT: good[2].joints_deg[JOINT] + 20})]
    said = [str(doubt) for doubt in posed.solve(twice)[NAME].outliers()]
    assert f"{JOINT} differs by 20° from an earlier answer" in said


def test_states_are_written_with_how_sure_they_are(world: PosingWorld, copied: Path) -> None:
    posed = PosedCapture(copied)
    given = answers(world, [0, 10, 20, 30, 39])
    solved = posed.solve(given)
    posed.write_states(solved)
    again = read_capture(copied)
    found = Shafts.of(again, again.instruments[0])
    before = shafts(world)
    np.testing.assert_allclose(found.origins, before.origins, atol=1e-9)
    np.testing.assert_allclose(found.directions, before.directions, atol=1e-9)
    camera = np.stack([frame.state.instruments[NAME].pose.numpy()[:3, 0] for frame in again.frames])
    np.testing.assert_allclose(np.exp(1j * rolls_of(found, camera)), np.exp(1j * solved[NAME].rolls.values), atol=1e-6)
    for index, frame in enumerate(again.frames):
        state = frame.state.instruments[NAME]
        assert state.joints[JOINT] == pytest.approx(solved[NAME].joints[JOINT].values[index])
        assert state.uncertainty is not None
        assert state.uncertainty.rotation_deg[:2] == (1.0, 1.0)
        assert 0 < state.uncertainty.rotation_deg[2] < 20
        assert state.uncertainty.translation_mm == (0.2, 0.2, 1.0)


def test_without_answers_the_roll_is_said_to_be_unknown(world: PosingWorld) -> None:
    state = read_capture(world.root).frames[3].state.instruments[NAME]
    assert state.uncertainty is not None
    assert state.uncertainty.rotation_deg[2] == 180.0


def test_answers_are_read_back_line_by_line(world: PosingWorld, copied: Path) -> None:
    given = [HandPose("000003", NAME, -12.5, {JOINT: 31.0}, "2026-03-01 14:05", "Ada"), *answers(world, [5])]
    write_answers(copied, given)
    back = read_answers(copied)
    assert back[0] == given[0]
    assert back[1].roll_deg == pytest.approx(given[1].roll_deg, abs=0.05)
    assert sum(line.startswith("- ") for line in (copied / "hand_posed.yaml").read_text().splitlines()) == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1", "answers: .* is not a list"),
        ("- 3", r"answers\[0\]: is a group of fields"),
        ("- {frame: '000001', instrument: rod}", r"answers\[0\].roll_deg: missing"),
        ("- {frame: '000001', instrument: rod, roll_deg: left}", "no angle in degrees; mend"),
        ("- {frame: '000001', instrument: rod, roll_deg: .nan}", "no angle"),
        ("- {frame: '000001', instrument: rod, roll_deg: 1, joint: 2}", r"answers\[0\].joint: it has no such field"),
        ("- {frame: '000001', instrument: rod, roll_deg: 1}", "expected jaw_angle"),
        ("- {frame: '999', instrument: rod, roll_deg: 1, joints_deg: {jaw_angle: 2}}", "no such frame"),
        ("- {frame: '000001', instrument: rope, roll_deg: 1, joints_deg: {jaw_angle: 2}}", "no instrument 'rope'"),
    ],
)
def test_a_wrong_line_is_named(copied: Path, text: str, message: str) -> None:
    (copied / "hand_posed.yaml").write_text(text + "\n")
    with pytest.raises(NeecoError, match=message) as raised:
        PosedCapture(copied).solve()
    assert "hand_posed.yaml" in str(raised.value)


def test_measurements_of_other_frames_are_refused(world: PosingWorld, copied: Path) -> None:
    measured = measure(world.capture, {NAME: lambda frame: world.masks[frame]})
    write_measurements(replace(world.capture, root=copied, frames=world.capture.frames[:-1]), measured)
    with pytest.raises(NeecoError, match="other frames"):
        read_measurements(read_capture(copied))
    (copied / FILE).write_bytes(b"no tensors")
    with pytest.raises(NeecoError, match="not readable"):
        read_measurements(read_capture(copied))
    (copied / FILE).unlink()
    with pytest.raises(NeecoError, match="no such file"):
        PosedCapture(copied)


def test_an_instrument_with_a_tracker_is_not_posed_by_hand(copied: Path) -> None:
    path = copied / "transforms.json"
    document = json.loads(path.read_text())
    for item in document["instruments"]:
        del item["from_video"]
    path.write_text(json.dumps(document))
    with pytest.raises(NeecoError, match="all poses are known"):
        PosedCapture(copied)
