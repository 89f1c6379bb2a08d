"""What a file leaves open is shown in every way to read it; what tells the ways apart is measured."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from neeco.cli.ingest import Ingest, run
from neeco.ingest.readers.choices import axis_directions, find_rotations, largest_step, open_poses, shaft_of
from neeco.report.choice_picture import CHOICES, write_choice_picture

pytest.importorskip("av")
pytest.importorskip("pyarrow")

from lerobot_world import BODY, write_data_set

TROCAR = np.array([0.03, -0.05, 0.02])
STATE = "observation.state"


def pivoting(frames: int = 40) -> tuple[np.ndarray, Rotation]:
    """Tips [T, 3] m and turns of a tool whose z axis goes through the trocar, turning about it and going in and out."""
    times = np.arange(frames) / 10
    turns = Rotation.from_euler("ZYX", np.stack([0.9 * times, 0.5 * np.sin(times), 0.4 * np.cos(1.7 * times)], 1))
    depth = 0.1 + 0.02 * np.sin(2 * times)
    return TROCAR + depth[:, None] * turns.as_matrix()[:, :, 2], turns


def test_a_shafts_lines_meet_in_the_trocar_under_the_right_order_only():
    places, turns = pivoting()
    right = shaft_of(places, turns.as_quat(scalar_first=True))
    assert right.axis == 2
    np.testing.assert_allclose(right.point, TROCAR, atol=1e-9)
    assert right.rms < 1e-9
    assert shaft_of(places, turns.as_quat()).rms > 0.005  # xyzw read as wxyz


def test_axes_are_the_columns_of_the_rotation():
    _, turns = pivoting()
    quats = turns.as_quat(scalar_first=True)
    for axis in range(3):
        np.testing.assert_allclose(axis_directions(quats, axis), turns.as_matrix()[:, :, axis], atol=1e-12)


def test_the_turn_between_frames_is_the_same_in_both_orders():
    _, turns = pivoting()
    steps = (turns[1:] * turns[:-1].inv()).magnitude()
    assert largest_step(turns.as_quat(scalar_first=True)) == pytest.approx(steps.max())
    assert largest_step(turns.as_quat()) == pytest.approx(steps.max())


def test_rotations_are_found_by_their_numbers():
    places, turns = pivoting()
    quats, matrices = turns.as_quat().astype(np.float32), turns.as_matrix().reshape(-1, 9).astype(np.float32)
    assert find_rotations(np.column_stack([places, quats, places])) == [(3, "quaternion")]
    assert find_rotations(np.column_stack([places, matrices, quats])) == [(3, "rotation_matrix"), (12, "quaternion")]
    assert find_rotations(np.column_stack([places, places])) == []
    assert find_rotations(np.tile([1.0, 0, 0, 0], (9, 1))) == []  # four numbers that stand still
    mirrored = matrices * np.array([1, 1, -1] * 3)
    assert find_rotations(mirrored.astype(np.float32)) == []


@pytest.mark.parametrize(
    ("names", "titles"),
    [
        (None, ["quaternion_wxyz", "quaternion_xyzw"]),
        (list(BODY), ["quaternion_wxyz, as named"]),
        (
            ["x", "y", "z", "roll", "pitch", "yaw", "jaw"],
            [f"euler_convention: {way}" for way in ("XYZ", "ZYX", "xyz", "zyx")] + ["rotation_vector"],
        ),
    ],
)
def test_every_way_to_read_poses_is_drawn(tmp_path, names, titles):
    places, turns = pivoting()
    angles = np.column_stack([turns.as_euler("XYZ"), np.zeros(len(places))])
    rotation = angles if names and "yaw" in names else turns.as_quat()
    states = [{STATE: np.column_stack([places, rotation])}]
    path = write_data_set(tmp_path / "set", "v2.1", states, names={STATE: names})
    (found,) = open_poses(path)
    assert [way.title for way in found.readings] == titles
    np.testing.assert_allclose(found.positions, places, atol=1e-7)
    best = min(found.readings, key=lambda way: shaft_of(found.positions, way.quats).rms)
    off = (Rotation.from_quat(best.quats, scalar_first=True).inv() * turns).magnitude()
    assert off.max() < 1e-5
    picture = tmp_path / "choices.png"
    assert write_choice_picture(path, picture)
    with Image.open(picture) as image:
        assert image.size[1] > 200 * len(titles)
        assert len(np.unique(np.asarray(image.convert("L")))) > 30


def test_a_dvrks_poses_are_shown_in_either_axes(tmp_path):
    places, turns = pivoting()
    names = [f"psm1_{part}" for part in BODY]
    states = [{STATE: np.column_stack([places, turns.as_quat()])}]
    path = write_data_set(tmp_path / "set", "v2.1", states, names={STATE: names})
    found = {poses.frame: poses for poses in open_poses(path)}
    assert list(found) == ["camera", "ecm"]
    np.testing.assert_allclose(found["ecm"].positions, found["camera"].positions * [-1, -1, 1], atol=1e-12)
    for axis in range(3):  # of the tool, as the camera sees it
        ways = [axis_directions(found[frame].readings[0].quats, axis) for frame in ("camera", "ecm")]
        np.testing.assert_allclose(ways[1], ways[0] * [-1, -1, 1], atol=1e-12)


def test_init_writes_the_picture_beside_the_recording(tmp_path, capsys):
    places, turns = pivoting()
    states = [{STATE: np.column_stack([places, turns.as_quat()])}]
    path = write_data_set(tmp_path / "set", "v3.0", states)
    assert run(Ingest(source=(path,), init=True)) == 0
    assert (tmp_path / CHOICES).is_file()
    assert str(tmp_path / CHOICES) in capsys.readouterr().out
    assert (tmp_path / "recording.yaml").is_file()


def test_nothing_open_is_nothing_to_draw(tmp_path):
    path = write_data_set(tmp_path / "set", "v2.1", [{"action": np.zeros((12, 3))}])
    assert open_poses(path) == []
    assert not write_choice_picture(path, tmp_path / "choices.png")
    assert not (tmp_path / "choices.png").exists()
