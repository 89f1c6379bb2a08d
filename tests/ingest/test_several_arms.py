"""Bases of several arms in one view, posed about trocars: each is found from the pieces that are nearest to it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from ingest.base_world import episodes, silent, views_of
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.geometry.lens import Lens
from neeco.geometry.trocar import line_through_trocar
from neeco.ingest.readers.logs import PoseLog
from neeco.ingest.recording.base import StatedBase
from neeco.ingest.recording.model import InstrumentLogs
from neeco.ingest.registration.base import BaseRegistration
from neeco.ingest.registration.find_bases import find_bases
from neeco.ingest.timing.clock_search import GIVEN, ClockOffset
from neeco.ingest.timing.episodes import Episodes

WIDTH, HEIGHT, FOCAL = 160, 128, 200.0
RADIUS = 4.0  # mm
TIMES = np.arange(16) / 2.5


@dataclass(frozen=True)
class Arm:
    """An arm whose base is at its trocar, and whose shaft ends where it logs."""

    camera_from_base: np.ndarray
    pace: float

    def poses_at(self, times: np.ndarray) -> np.ndarray:
        """base_from_instrument [F, 4, 4]; the shaft along z."""
        turns = Rotation.from_euler(
            "XYZ", np.stack([0.09 * np.sin(self.pace * times), 0.07 * np.cos(1.3 * self.pace * times), 0.5 * times], -1)
        )
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        poses[:, :3, :3] = turns.as_matrix()
        depth = 90 + 9 * np.sin(0.8 * self.pace * times + 1)
        poses[:, :3, 3] = poses[:, :3, 2] * depth[:, None]
        return poses

    def wrong(self, mm: float, degrees: float) -> np.ndarray:
        turned = self.camera_from_base.copy()
        middle = turned[:3, :3] @ (0, 0, 90) + turned[:3, 3]
        turn = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.0, 0.8])).as_matrix()
        turned[:3, :3] = turn @ turned[:3, :3]
        turned[:3, 3] = turn @ (turned[:3, 3] - middle) + middle + mm * np.array([0.6, -0.6, 0.53])
        return turned

    def beside(self, found: np.ndarray) -> float:
        """mm, the root mean square distance across the view at which a base puts the shaft beside itself, at all times.
        Along it nothing tells where the logged frame is: where the shaft ends is not known."""
        poses = self.camera_from_base @ self.poses_at(TIMES)
        worst = 0.0
        for behind in (0.0, 40.0):
            places = self.poses_at(TIMES) @ (0.0, 0.0, -behind, 1.0)
            right = places @ self.camera_from_base.T
            sides = np.cross(poses[:, :3, 2], right[:, :3])
            sides /= np.linalg.norm(sides, axis=1)[:, None]
            off = (((places @ found.T) - right)[:, :3] * sides).sum(1)
            worst = max(worst, float(np.sqrt(np.square(off).mean())))
        return worst


def _towards(start: tuple[float, float, float], end: tuple[float, float, float]) -> np.ndarray:
    """camera_from_base [4, 4] at `start`, its z towards `end`."""
    z = np.subtract(end, start) / np.linalg.norm(np.subtract(end, start))
    x = np.cross((0.0, 1.0, 0.2), z)
    x /= np.linalg.norm(x)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.stack([x, np.cross(z, x), z], -1), start
    return matrix


LEFT = Arm(_towards((-85.0, -40.0, 85.0), (0.0, -5.0, 115.0)), 1.1)
RIGHT = Arm(_towards((80.0, 45.0, 90.0), (15.0, 20.0, 130.0)), 0.6)


def _masks(*arms: Arm) -> np.ndarray:
    """bool [F, h, w]: tubes that end where they are logged."""
    masks = np.zeros((len(TIMES), HEIGHT, WIDTH), np.uint8)
    for arm in arms:
        for mask, pose in zip(masks, arm.camera_from_base @ arm.poses_at(TIMES), strict=True):
            ends = np.stack([pose[:3, 3], pose[:3, 3] - 88 * pose[:3, 2]])
            pixels = FOCAL * ends[:, :2] / ends[:, 2:] + (WIDTH / 2, HEIGHT / 2)
            way = np.diff(pixels, axis=0)[0] / np.linalg.norm(np.diff(pixels, axis=0))
            side = FOCAL * RADIUS / ends[:, 2:] * (-way[1], way[0])
            corners = np.concatenate([pixels + side, (pixels - side)[::-1]]) - 0.5
            cv2.fillPoly(mask, [np.rint(corners * 8).astype(np.int32)], 1, cv2.LINE_8, 3)
    return masks.astype(bool)


def test_a_log_about_a_trocar_tells_where_the_shaft_lies():
    moved = np.eye(4)
    moved[:3, :3] = Rotation.from_rotvec((0.3, -0.2, 0.1)).as_matrix()
    moved[:3, 3] = 3.0, -2.0, 5.0
    line = line_through_trocar(LEFT.poses_at(TIMES) @ moved)
    assert line is not None
    axis = moved[:3, :3].T @ (0, 0, 1)
    point = -moved[:3, :3].T @ moved[:3, 3]
    assert np.allclose(line.axis, axis, atol=1e-6)
    assert np.allclose(line.point, point - (point @ axis) * axis, atol=1e-5)


def test_a_wrist_that_bends_behind_what_is_logged_leaves_no_line():
    bend = np.tile(np.eye(4), (len(TIMES), 1, 1))
    bend[:, :3, :3] = Rotation.from_rotvec(np.outer(0.6 * np.sin(2.1 * TIMES), (0.0, 1.0, 0.0))).as_matrix()
    tip = np.eye(4)
    tip[2, 3] = 9.0
    assert line_through_trocar(LEFT.poses_at(TIMES) @ bend @ tip) is None


def _log(arm: Arm) -> PoseLog:
    times = np.arange(-0.4, TIMES[-1] + 0.4, 0.02)
    poses = arm.poses_at(times)
    quats = Rotation.from_matrix(poses[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    return PoseLog(path=None, clock="ros", times=times, positions=poses[:, :3, 3], quats=quats, gaps=(), notes=())


def _data(arms: dict[str, Arm], bases: dict[str, StatedBase]) -> Episodes:
    instruments = [InstrumentLogs(name=name, camera_from_base=base) for name, base in bases.items()]
    logs = {name: _log(arm) for name, arm in arms.items()}
    return episodes(instruments, logs, {"ros": ClockOffset(0.0, 0.0, GIVEN)})


def _found(data: Episodes, masks: np.ndarray) -> tuple[Episodes, dict[str, BaseRegistration]]:
    lens = Lens(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, (), (WIDTH, HEIGHT))
    cameras = np.tile(np.eye(4), (len(TIMES), 1, 1))
    views = views_of(TIMES, cameras, lens, lambda row: np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    return find_bases(data, views, lambda rows: masks[rows], silent)


@pytest.mark.slow
def test_the_bases_of_two_arms_in_one_view_are_found():
    arms = {"psm1": LEFT, "psm2": RIGHT}
    data = _data(arms, {name: StatedBase(arm.wrong(6, 4), 5.0, 3.0) for name, arm in arms.items()})
    placed, found = _found(data, _masks(LEFT, RIGHT))
    for name, arm in arms.items():
        assert arm.beside(arm.wrong(6, 4)) > 3
        assert arm.beside(placed.world_from_base[name]) < 1.0
        assert found[name].overlap > 0.8


def test_of_several_arms_one_that_hardly_moves_keeps_what_is_given():
    resting = Arm(RIGHT.camera_from_base, 0.0)
    arms = {"psm1": resting, "psm2": resting}
    data = _data(arms, {name: StatedBase(RIGHT.wrong(6, 4), 5.0, 3.0) for name in arms})
    placed, found = _found(data, np.zeros((len(TIMES), HEIGHT, WIDTH), bool))
    assert np.array_equal(placed.world_from_base["psm1"], RIGHT.wrong(6, 4))
    assert found["psm1"].frames == 0
    stated = found["psm1"].uncertainty(np.eye(4), np.eye(4)[None])  # for the capture, and the verdict
    assert np.array(stated.covariance).diagonal() == pytest.approx([np.radians(3.0) ** 2] * 3 + [25.0] * 3)
    assert (
        "too little to find its base, which stays as given, with standard deviations 5.0 mm and 3.0 deg"
        in data.notes.sentences[0]
    )


def test_one_that_moves_and_is_not_seen_is_refused():
    data = _data({"psm1": RIGHT, "psm2": RIGHT}, {"psm1": StatedBase(), "psm2": StatedBase()})
    with pytest.raises(
        NeecoError, match=r"recording\.yaml: instrument 'psm1': camera_from_base: what moves looks like"
    ):
        _found(data, np.zeros((len(TIMES), HEIGHT, WIDTH), bool))
