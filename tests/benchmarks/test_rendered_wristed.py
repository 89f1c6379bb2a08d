"""A rendered wristed instrument stands where its stated links say, in its depth and its masks."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from rendered_truth import frames_with_depth, seen_points, truth_of

from neeco.capture import check_capture, errors_only, read_capture
from neeco.capture.readers import kinematics_of

FOCAL, WIDTH, HEIGHT = 54.0, 64, 48
WRIST = 2


@pytest.fixture(scope="module", params=["bowel-wristed", "cloth-wristed"])
def capture(request: pytest.FixtureRequest, benchmarks: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eleven frames of a scene."""
    from rendered.frames import Settings
    from rendered.render import Lens
    from rendered.scenes import SCENES
    from rendered.writing import write_recording

    path = tmp_path_factory.mktemp(request.param)
    settings = Settings(Lens(WIDTH, HEIGHT, FOCAL), resolution=240, every=25)
    write_recording(SCENES[request.param], path, settings)
    return path


def test_the_capture_records_every_reading(capture: Path) -> None:
    recorded = read_capture(capture)
    assert set(recorded.instruments[0].joints) == {"jaw_angle", "wrist_pitch", "wrist_yaw"}
    assert errors_only(check_capture(capture)) == []


def test_what_is_seen_lies_on_the_link_that_it_is_labelled_as(capture: Path) -> None:
    """Surface points from the stored depth, carried to their link's frame by forward kinematics, lie on its solid."""
    from rendered.kinematics import JAW_NAMES, truth_ids
    from rendered.scenes import SCENES

    stated = json.loads((capture / "truth" / "kinematics.json").read_text())
    tree = kinematics_of(stated["kinematics"], "truth/kinematics.json")
    spec = SCENES[capture.name.rstrip("0123456789")]
    rotation = spec.mount.mechanical_from_sensor()[:3, :3]
    first, second = (JAW_NAMES[part] for part in truth_ids(spec))
    start = spec.design.pitch_at
    solids = {
        "wrist": lambda points: spec.design._wrist(points + torch.tensor([0.0, 0.0, start])),
        first: spec.design.jaws[0].distance,
        second: spec.design.jaws[1].distance,
    }
    parts = {"wrist": WRIST} | {name: part for part, name in JAW_NAMES.items()}
    seen = dict.fromkeys(parts, 0)
    for frame in frames_with_depth(capture):
        points, ids = seen_points(capture, frame)
        joints = dict(frame["instruments"][0]["joints"])
        for name, offset in zip(spec.design.wrist_joints, spec.encoders.offsets, strict=True):
            joints[name] += offset  # as the encoders read without play and noise
        poses = tree.poses(joints)
        for link, part in parts.items():
            back = np.linalg.inv(poses[link])
            local = (points[ids == part] @ back[:3, :3].T + back[:3, 3]) @ rotation.T
            gaps = solids[link](torch.from_numpy(local).float())
            assert gaps.abs().numpy().max(initial=0.0) < 0.12, (frame["file_path"], link)
            seen[link] += len(local)
    assert min(seen.values()) > 2, seen


def test_axes_and_pivots_are_stated_as_wrongly_as_said(capture: Path) -> None:
    from rendered.kinematics import AXIS_ERROR, PIVOT_ERROR

    exact = kinematics_of(json.loads((capture / "truth" / "kinematics.json").read_text())["kinematics"], "truth")
    stated = read_capture(capture).instruments[0].kinematics
    assert stated is not None
    assert [link.name for link in stated.links] == [link.name for link in exact.links]
    for ours, theirs in zip(stated.links[1:], exact.links[1:], strict=True):
        assert np.degrees(np.arccos(ours.axis @ theirs.axis)) == pytest.approx(np.degrees(AXIS_ERROR), abs=1e-4)
        assert np.linalg.norm((ours.origin - theirs.origin)[:3, 3]) == pytest.approx(PIVOT_ERROR, abs=1e-3)
    assert np.array_equal(stated.links[2].axis, stated.links[3].axis)  # the jaws share theirs


def test_readings_err_by_their_offsets_play_and_noise(capture: Path) -> None:
    from rendered.scenes import SCENES

    spec = SCENES[capture.name.rstrip("0123456789")]
    truth = truth_of(capture)
    recorded = json.loads((capture / "transforms.json").read_text())
    for name, offset in zip(spec.design.wrist_joints, spec.encoders.offsets, strict=True):
        errors = np.array(
            [
                ours["instruments"][0]["joints"][name] - theirs["instruments"][0]["joints"][name]
                for ours, theirs in zip(recorded["frames"], truth["frames"], strict=True)
            ]
        )
        limit = spec.encoders.play + 4 * spec.encoders.noise + 0.02  # states are read 2 ms late
        assert np.abs(errors - offset).max() < limit
        assert errors.std() > 0


@pytest.mark.parametrize("scene", ["bowel-wristed", "stomach-wristed", "cloth-wristed"])
def test_the_wrist_goes_beyond_its_training_range_in_unseen_frames_only(benchmarks: ModuleType, scene: str) -> None:
    from rendered.motion import plan
    from rendered.scenes import SCENES
    from rendered.writing import SEEN, UNSEEN

    spec = SCENES[scene]
    trajectory = plan(spec.path, spec.design.hinge, SEEN, UNSEEN, spec.seed)
    reached = {"seen": 0.0, "unseen": 0.0}
    for time, split in zip(trajectory.times, trajectory.splits, strict=True):
        most = np.abs(np.array(trajectory.at(time).wrist) / spec.path.wrist_train).max()
        kind = "unseen" if split == "unseen" else "seen"
        reached[kind] = max(reached[kind], most)
    assert 0.5 < reached["seen"] <= 1.02  # a spline passes its knots by a little
    assert reached["unseen"] > 1.1


def test_all_that_casts_a_shadow_lies_within_reach(benchmarks: ModuleType) -> None:
    from rendered.motion import Bend
    from rendered.scenes import SCENES

    bends = [Bend(1.3, pitch, yaw) for pitch, yaw in ((0.0, 0.0), (1.0, 0.9), (-1.0, 0.9), (1.0, -0.9))]
    design = SCENES["bowel-wristed"].design
    for each in bends:
        centers, _ = design.balls(each)
        away = (centers - torch.tensor([0.0, 0.0, design.hinge])).norm(dim=1)
        assert float(away.max()) < design.reach
