"""A rendered wristed instrument stands where its stated links say, in its depth and its masks."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from neeco.capture import check_capture, errors_only, read_capture
from neeco.capture.kinematicsfile import kinematics_of

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
FOCAL, WIDTH, HEIGHT = 54.0, 64, 48
WRIST, JAW_LEFT, JAW_RIGHT = 2, 3, 4


@pytest.fixture(scope="module")
def benchmarks() -> Iterator[None]:
    """Makes `benchmarks/` importable."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # for images this small threads only wait for each other
    sys.path.insert(0, str(BENCHMARKS))
    try:
        yield
    finally:
        sys.path.remove(str(BENCHMARKS))
        torch.set_num_threads(threads)


@pytest.fixture(scope="module", params=["bowel-wristed", "stomach-wristed"])
def capture(request: pytest.FixtureRequest, benchmarks: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eleven frames of a scene."""
    from rendered.frames import Settings
    from rendered.render import Lens
    from rendered.scenes import SCENES
    from rendered.writing import write_recording

    path = tmp_path_factory.mktemp(request.param)
    settings = Settings(Lens(WIDTH, HEIGHT, FOCAL), resolution=240, every=25)
    write_recording(SCENES[request.param], path, settings, lambda line: None)
    return path


def test_the_capture_records_three_readings(capture: Path) -> None:
    recorded = read_capture(capture)
    assert set(recorded.instruments[0].joints) == {"jaw_angle", "wrist_pitch", "wrist_yaw"}
    assert errors_only(check_capture(capture)) == []


def test_what_is_seen_lies_on_the_link_that_it_is_labelled_as(capture: Path) -> None:
    """Surface points from the stored depth, carried to their link's frame by forward kinematics, lie on its solid."""
    from rendered.kinematics import JAW_NAMES
    from rendered.scenes import SCENES

    truth = json.loads((capture / "truth" / "transforms.json").read_text())
    stated = json.loads((capture / "truth" / "kinematics.json").read_text())
    tree = kinematics_of(stated["kinematics"], "truth/kinematics.json")
    spec = SCENES[capture.name.rstrip("0123456789")]
    rotation = spec.mount.mechanical_from_sensor()[:3, :3]
    first, second = "jaw_left", "jaw_right"
    if _gain(tree, "jaw_left") > _gain(tree, "jaw_right"):  # the first jaw turns against the opening
        first, second = second, first
    solids = {
        "wrist": lambda points: spec.design._wrist(points + torch.tensor([0.0, 0.0, spec.design.pitch_at])),
        first: spec.design.jaws[0].distance,
        second: spec.design.jaws[1].distance,
    }
    parts = {"wrist": WRIST} | {name: part for part, name in JAW_NAMES.items()}
    seen = dict.fromkeys(parts, 0)
    for frame in truth["frames"]:
        if "depth_file_path" not in frame:
            continue
        points, ids = _seen_points(capture, frame)
        joints = dict(frame["instruments"][0]["joints"])
        joints["wrist_pitch"] += spec.encoders.pitch_offset  # as the encoders read without play and noise
        joints["wrist_yaw"] += spec.encoders.yaw_offset
        poses = tree.poses(joints)
        for link, part in parts.items():
            back = np.linalg.inv(poses[link])
            local = (points[ids == part] @ back[:3, :3].T + back[:3, 3]) @ rotation.T
            gaps = solids[link](torch.from_numpy(local).float())
            assert float(gaps.abs().max()) < 0.12 if len(local) else True, (frame["file_path"], link)
            seen[link] += len(local)
    assert min(seen.values()) > 5, seen


def test_readings_err_by_their_offsets_play_and_noise(capture: Path) -> None:
    from rendered.scenes import SCENES

    spec = SCENES[capture.name.rstrip("0123456789")]
    truth = json.loads((capture / "truth" / "transforms.json").read_text())
    recorded = json.loads((capture / "transforms.json").read_text())
    for name, offset in (("wrist_pitch", spec.encoders.pitch_offset), ("wrist_yaw", spec.encoders.yaw_offset)):
        errors = np.array(
            [
                ours["instruments"][0]["joints"][name] - theirs["instruments"][0]["joints"][name]
                for ours, theirs in zip(recorded["frames"], truth["frames"], strict=True)
            ]
        )
        limit = spec.encoders.play + 4 * spec.encoders.noise + 0.02  # states are read 2 ms late
        assert np.abs(errors - offset).max() < limit
        assert errors.std() > 0


def test_the_wrist_goes_beyond_its_training_range_in_unseen_frames_only(capture: Path) -> None:
    from rendered.scenes import SCENES

    spec = SCENES[capture.name.rstrip("0123456789")]
    truth = json.loads((capture / "truth" / "transforms.json").read_text())
    reached = {"seen": 0.0, "unseen": 0.0}
    for frame in truth["frames"]:
        joints = frame["instruments"][0]["joints"]
        most = np.abs(np.array([joints["wrist_pitch"], joints["wrist_yaw"]]) / spec.path.wrist_train).max()
        kind = "unseen" if frame["split"] == "unseen" else "seen"
        reached[kind] = max(reached[kind], most)
    assert 0.5 < reached["seen"] <= 1.0
    assert reached["unseen"] > 1.1


def test_logs_of_a_wrist_are_refused(benchmarks: None, capsys: pytest.CaptureFixture[str]) -> None:
    module = importlib.import_module("rendered_captures")
    with pytest.raises(SystemExit) as exit:
        module.parse(["bowel-wristed", "out", "--video"])
    assert exit.value.code == 2
    assert "--video: the logs of a wrist are not written" in capsys.readouterr().err


def _gain(tree, link: str) -> float:
    return next(item for item in tree.links if item.name == link).value["jaw_angle"]


def _seen_points(capture: Path, frame: dict) -> tuple[np.ndarray, np.ndarray]:
    """Surface points [M, 3] in the sensor's frame from the stored depth, and their part ids [M]."""
    depth = np.array(Image.open(capture / "truth" / frame["depth_file_path"])).astype(float) * 0.05
    v, u = np.mgrid[0:HEIGHT:2, 0:WIDTH:2] + 0.5
    rays = np.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones_like(u)], -1)
    world_from_camera = np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])  # to OpenCV axes
    transform = np.linalg.inv(np.array(frame["instruments"][0]["pose"])) @ world_from_camera
    points = (rays * depth[..., None]) @ transform[:3, :3].T + transform[:3, 3]
    labels = np.array(Image.open(capture / "truth" / frame["part_mask_path"]))
    return points.reshape(-1, 3), labels[::2, ::2].ravel()
