"""States with errors: of the sizes asked for, and mirrored ones that look alike from afar."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from capture_folders import write_folder
from kinematic_trees import turned
from scipy.spatial.transform import Rotation

from neeco.capture import Capture, Frame, Instrument, InstrumentState, KinematicTree, Link, PointCloud, State
from neeco.capture.kinematics import REVOLUTE
from neeco.geometry.camera import Camera
from neeco.geometry.trocar import ShaftLine

NAME = "needle_driver"
BESIDE = np.array([3.0, -2.0, 0.0])  # mm from the frame's origin to the shaft


def wrist() -> KinematicTree:
    """Pitch, then yaw of two jaws, on a shaft along z beside the frame's origin."""
    pitch = turned("z", 0.0, *BESIDE[:2], 26.0)
    x, y = np.eye(3)[:2]
    jaws = [
        Link(f"jaw_{side}", "wrist", REVOLUTE, turned("z", 0.0, 0, 0, 9), x, {"wrist_yaw": 1.0, "jaw_angle": gain})
        for side, gain in (("left", 0.5), ("right", -0.5))
    ]
    return KinematicTree((Link("shaft"), Link("wrist", "shaft", REVOLUTE, pitch, y, {"wrist_pitch": 1.0}), *jaws))


def recorded(count: int) -> Capture:
    """Frames of one camera, with random poses and joints 100 mm in front of it."""
    rng = np.random.default_rng(0)
    camera = Camera(torch.eye(4), 1.0, 1.0, 0.5, 0.5, 1, 1)
    frames = []
    for number in range(count):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.random(random_state=rng).as_matrix()
        pose[:3, 3] = [*rng.uniform(-20, 20, 2), 100.0]
        joints = {name: float(rng.uniform(-0.5, 0.5)) for name in ("wrist_pitch", "wrist_yaw", "jaw_angle")}
        frames.append(
            Frame(Path(f"{number}.png"), camera, State({NAME: InstrumentState(pose, joints)}, number / 25), "train")
        )
    points = PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))
    joints = dict.fromkeys(("wrist_pitch", "wrist_yaw", "jaw_angle"))
    return Capture(Path(), tuple(frames), (Instrument(NAME, joints, wrist()),), points)


@pytest.fixture(scope="module")
def state_errors(benchmarks: ModuleType) -> ModuleType:
    import state_errors

    return state_errors


@pytest.mark.parametrize("smooth_s", [0.0, 0.4])
def test_errors_have_the_sizes_asked_for(state_errors: ModuleType, smooth_s: float) -> None:
    exact = recorded(1200)
    sizes = (2.0, 6.0, 0.3, 1.5, 4.0)
    given = state_errors.with_errors(exact, sizes, smooth_s, True, np.random.default_rng(1))
    turns, shifts, joints = [], [], []
    for before, after in zip(exact.frames, given.frames, strict=True):
        old, new = before.state.instruments[NAME], after.state.instruments[NAME]
        turns.append(
            Rotation.from_matrix(old.pose[:3, :3].T.numpy() @ new.pose[:3, :3].numpy()).as_rotvec(degrees=True)
        )
        shifts.append((new.pose - old.pose)[:3, 3].numpy())
        joints.append([np.degrees(new.joints[name] - old.joints[name]) for name in old.joints])
        assert new.uncertainty is not None
        assert new.uncertainty.rotation_deg == pytest.approx((2.0, 2.0, 6.0))
    found = [np.std(errors, axis=0) for errors in (turns, shifts, joints)]
    expected = [2, 2, 6, 0.3, 0.3, 1.5, 4, 4, 4]
    np.testing.assert_allclose(np.concatenate(found), expected, rtol=0.1)
    neighbours = np.mean(np.abs(np.diff(shifts, axis=0)), axis=0) / np.std(shifts, axis=0)
    assert (neighbours < 0.3).all() == (smooth_s > 0)


def test_readings_stay_within_the_joints_limits(state_errors: ModuleType) -> None:
    exact = recorded(50)
    (instrument,) = exact.instruments
    limited = replace(exact, instruments=(replace(instrument, joints=dict.fromkeys(instrument.joints, (-0.5, 0.5))),))
    given = state_errors.with_errors(limited, (2.0, 6.0, 0.3, 1.5, 20.0), 0.0, False, np.random.default_rng(1))
    readings = [value for frame in given.frames for value in frame.state.instruments[NAME].joints.values()]
    assert min(readings) == -0.5
    assert max(readings) == 0.5


def test_a_mirrored_state_looks_alike_from_afar(state_errors: ModuleType) -> None:
    """Orthographic, without their names, points on the links' middle lines are where they were."""
    capture, tree = recorded(5), wrist()
    shaft = ShaftLine(BESIDE, np.array([0.0, 0.0, 1.0]))
    for frame in capture.frames:
        before = frame.state.instruments[NAME]
        after = state_errors.mirrored(frame, NAME, tree, shaft)
        seen = []
        for state in (before, after):
            links = tree.poses(state.joints)
            local = [np.array([*BESIDE[:2], 5.0, 1.0])]
            local += [links[name] @ [0.0, 0.0, 8.0, 1.0] for name in ("wrist", "jaw_left", "jaw_right")]
            seen.append(np.stack(local) @ state.pose.numpy().T)
        shaft_and_wrist, jaws = seen[1][:2], seen[1][2:][::-1]
        np.testing.assert_allclose(np.concatenate([shaft_and_wrist, jaws])[:, :2], seen[0][:, :2], atol=1e-9)
        depths = [points[2:, 2] - points[0, 2] for points in seen]
        assert np.abs(depths[0] - depths[1]).max() > 1  # mm: it is another state


def test_outliers_are_named_and_nothing_else_changes(state_errors, tmp_path, monkeypatch):
    folder = write_folder(tmp_path / "capture")
    document = folder.document
    (folder.root / "truth").mkdir()
    (folder.root / "truth" / "transforms.json").write_text(json.dumps(document))
    words = ["state_errors.py", str(folder.root), str(tmp_path / "out"), "--outliers", "0.4"]
    monkeypatch.setattr(sys, "argv", words)
    assert state_errors.main() == 0
    wrong = json.loads((tmp_path / "out" / "truth" / "outliers.json").read_text())
    train = [frame for frame in document["frames"] if frame["split"] == "train"]
    assert len(wrong) == round(0.4 * len(train))
    assert {text.split()[0] for text in wrong.values()} == {"mirrored", "exchanged"}
    written = json.loads((tmp_path / "out" / "transforms.json").read_text())
    for before, after in zip(document["frames"], written["frames"], strict=True):
        same = np.allclose(before["instruments"][0]["pose"], after["instruments"][0]["pose"], atol=1e-6)
        assert same != (Path(before["file_path"]).stem in wrong)
