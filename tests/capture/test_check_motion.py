"""`neeco check` tells by the images that states are wrong, and names a mistake only if the images confirm it."""

from __future__ import annotations

import copy
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neeco.capture import check_capture
from neeco.capture.checks import read_checked
from neeco.capture.checks.evidence import Candidate, read_pictures
from neeco.capture.checks.verdicts import ImageVerdicts, instrument_candidates, likeliest
from neeco.capture.documents import ProblemReport
from neeco.capture.kinematics import KinematicTree, Link
from neeco.capture.readers import parse_capture

SAMPLE = Path(__file__).parents[2] / "samples" / "liver-mini"
Document = dict[str, Any]


@pytest.fixture(scope="module")
def sample(tmp_path_factory) -> Path:
    """A copy of the sample capture, whose transforms.json tests replace."""
    return Path(shutil.copytree(SAMPLE, tmp_path_factory.mktemp("motion") / "sample"))


def told(sample: Path, change: Callable[[Document], object]) -> list[str]:
    """What the images tell of the sample, changed: place and message."""
    document = json.loads((SAMPLE / "transforms.json").read_text())
    change(document)
    (sample / "transforms.json").write_text(json.dumps(document))
    report = ProblemReport()
    parsed = parse_capture(sample, report)
    assert report.problems == []
    ImageVerdicts(parsed, read_pictures(parsed)).report()
    assert all(problem.severity == "warning" for problem in report.problems)
    return [f"{problem.field}: {problem.message}" for problem in report.problems]


def states(document: Document) -> list[Document]:
    return [frame["instruments"][0] for frame in document["frames"]]


def transpose(document: Document) -> None:
    for state in states(document):
        pose = np.array(state["pose"])
        pose[:3, :3] = pose[:3, :3].T.copy()
        state["pose"] = pose.tolist()


def shift(frames: int) -> Callable[[Document], None]:
    """Every frame gets the state of so many frames later; at the end the last one stays."""

    def change(document: Document) -> None:
        given = copy.deepcopy(states(document))
        last = len(given) - 1
        for index, frame in enumerate(document["frames"]):
            frame["instruments"] = [given[min(max(index + frames, 0), last)]]

    return change


def keep(rows: slice) -> Callable[[Document], None]:
    return lambda document: document.update(frames=document["frames"][rows])


def test_a_part_of_a_good_capture_is_silent(sample):
    assert told(sample, keep(slice(50, 90))) == []


@pytest.mark.slow
@pytest.mark.parametrize("rows", [slice(0, 30), slice(None, None, 3), slice(20, 60)])
def test_parts_of_a_good_capture_are_silent(sample, rows):
    assert told(sample, keep(rows)) == []


def test_transposed_rotations_are_told_and_nothing_else(sample):
    (line,) = told(sample, transpose)
    assert line.startswith("frames[*].instruments[*].pose: rotations of 'maryland' are transposed")


def test_nothing_is_said_of_rotations_where_the_instrument_hardly_turns(sample):
    """There transposed rotations explain right poses nearly as well, and sometimes better."""

    def part(document: Document) -> None:
        keep(slice(20, 60))(document)  # turns by 24 degrees, root mean square; the whole by 34
        transpose(document)

    assert told(sample, part) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("frames", "words"), [(7, "7 frames later"), (-3, "3 frames earlier"), (15, "15 frames later")]
)
def test_states_of_other_frames_are_told_with_their_number(sample, frames, words):
    (line,) = told(sample, shift(frames))
    assert line == f"frames[*].instruments[*]: states of 'maryland' fit the images better {words}"


def with_a_second(change: Callable[[Document], object]) -> Callable[[Document], None]:
    """A second instrument, whose states are those of the only one, changed."""

    def added(document: Document) -> None:
        other = copy.deepcopy(document)
        change(other)
        for frame, state in zip(document["frames"], states(other), strict=True):
            frame["instruments"].append(state | {"name": "second"})

    return added


def test_what_one_instrument_explains_is_no_evidence_against_another(sample):
    assert told(sample, with_a_second(shift(7))) == []


def test_a_capture_says_the_mistake_as_a_strong_warning_that_training_is_given_and_does_not_refuse(sample):
    document = json.loads((SAMPLE / "transforms.json").read_text())
    shift(7)(document)
    (sample / "transforms.json").write_text(json.dumps(document))
    given: list[str] = []
    assert read_checked(sample, report=given.append).instruments
    (problem,) = check_capture(sample)
    assert given == [str(problem)]
    assert problem.severity == "warning"
    assert problem.contradicted
    assert problem.message == "states of 'maryland' fit the images better 7 frames later"
    assert problem.remedy.startswith("correct their times")


@pytest.mark.parametrize("field", ["instrument_frame", "ply_file_path"])
def test_nothing_is_said_where_nothing_can_be_known(sample, field):
    def change(document: Document) -> None:
        shift(7)(document)
        if field == "instrument_frame":
            document[field] = "unregistered"
        else:
            document.pop(field)

    document = json.loads((SAMPLE / "transforms.json").read_text())
    change(document)
    (sample / "transforms.json").write_text(json.dumps(document))
    assert not any("fit the images" in problem.message for problem in check_capture(sample))


@pytest.mark.slow
def test_poses_of_a_link_that_turns_against_the_shaft_confuse_nothing(sample):
    """The pose of a wrist that turns by up to 57 degrees: right as it is, transposed when it is transposed."""
    wrist = Link("wrist", "shaft", "revolute", np.eye(4), np.array([1.0, 0, 0]), {"bend": 1.0})
    tree = KinematicTree((Link("shaft"), wrist), pose_of="wrist")

    def bent(document: Document) -> None:
        document["instruments"] = [
            {"name": "maryland", "joints": {"jaw_angle": {}, "bend": {}}, "kinematics": tree.to_json()}
        ]
        for row, state in enumerate(states(document)):
            state["joints"]["bend"] = float(np.sin(0.9 * row))
            state["pose"] = (np.array(state["pose"]) @ tree.poses(state["joints"])["wrist"]).tolist()

    assert told(sample, bent) == []
    (line,) = told(sample, lambda document: (bent(document), transpose(document)))
    assert "are transposed" in line


def edited(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Document], None]:
    """Every pose, changed."""

    def edit(document: Document) -> None:
        for state in states(document):
            state["pose"] = change(np.array(state["pose"])).tolist()

    return edit


def in_ecm_axes(document: Document) -> None:
    """Poses as if x were left and y up in the camera's frame."""
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    for frame, state in zip(document["frames"], states(document), strict=True):
        camera = np.array(frame["transform_matrix"])
        state["pose"] = (camera @ half_turn @ np.linalg.inv(camera) @ np.array(state["pose"])).tolist()


def wxyz_read_as_xyzw(pose: np.ndarray) -> np.ndarray:
    pose[:3, :3] = Rotation.from_quat(np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1)).as_matrix()
    return pose


def shuffle(document: Document) -> None:
    given = copy.deepcopy(states(document))
    for frame, row in zip(document["frames"], np.random.default_rng(0).permutation(len(given)), strict=True):
        frame["instruments"] = [given[row]]


def test_poses_in_the_axes_of_a_robots_endoscope_are_named(sample):
    (line,) = told(sample, in_ecm_axes)
    assert line.startswith("frames[*].instruments[*].pose: poses of 'maryland' were converted to the world with the")


class AgreesWith:
    """Images that agree with instruments at some places, and not with those recorded elsewhere."""

    def __init__(self, places: np.ndarray) -> None:
        self.places = places

    def quick(self, candidate: Candidate) -> float:
        return self.compare(candidate)[2]

    def compare(self, candidate: Candidate) -> tuple[float, float, float]:
        agrees = np.allclose(np.asarray(candidate.poses)[:, :3, 3], self.places)
        return (5.0, 16.0, 0.5) if agrees else (1.0, 0.0, 0.1)


def test_one_mistake_that_has_two_descriptions_is_told():
    """In a still camera's world, a half turn of the world's axes and an endoscope's own axes give the same poses."""
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.linspace([0.1, 0.2, 0.3], [0.6, -0.4, 0.9], 6)).as_matrix()
    poses[:, :3, 3] = np.random.default_rng(0).uniform([-20, -15, 60], [20, 15, 90], (6, 3))
    cameras = np.tile(np.eye(4), (6, 1, 1))
    candidates = list(instrument_candidates(poses, cameras, "psm1"))
    turned = np.diag([-1.0, -1.0, 1.0, 1.0]) @ poses
    told = likeliest(candidates, AgreesWith(turned[:, :3, 3]))
    assert told is not None
    assert np.allclose(told.poses, turned)
    other = replace(told, message="another mistake", poses=turned @ np.diag([-1.0, -1.0, 1.0, 1.0]))
    assert likeliest([other, *candidates], AgreesWith(turned[:, :3, 3])) is None


def test_states_that_nothing_explains_contradict_the_images_and_no_cause_is_named(sample):
    (line,) = told(sample, shuffle)
    assert line.startswith("frames[*].instruments[*].pose: the images contradict the poses of 'maryland'")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (edited(wxyz_read_as_xyzw), "quaternions of 'maryland' were written w x y z and read as x y z w"),
        (edited(lambda pose: np.diag([1, 1, -1, 1]) @ pose @ np.diag([1, 1, -1, 1])), "(x, y, z) should be (x, y, -z)"),
        (edited(lambda pose: pose * ([[1, 1, 1, 1.1]] * 3 + [[1] * 4])), "about 1.1 times as large"),
        (shift(20), "states of 'maryland' fit the images better 20 frames later"),
    ],
)
def test_other_mistakes_are_named(sample, change, words):
    (line,) = told(sample, change)
    assert words in line
