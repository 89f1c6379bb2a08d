"""Footage over another tissue, which a run of method 3dgs learned from the footage."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from grasper_world import CAMERA, RecordedRun, grasper_state, make_scene, moving, record
from scipy.spatial.transform import Rotation
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.capture.images import write_image
from neeco.capture.model import Capture, PointCloud, State
from neeco.capture.writer import write_capture
from neeco.cli import main
from neeco.geometry.camera import Camera
from neeco.scene import GaussianScene
from neeco.states.crop_rendering import InstrumentRenderer, TissueRenderer
from neeco.states.parameters import DEG
from neeco.tracking.track import over_tissue, state_of, track_footage
from neeco.training.run import GaussianRun, load_run

COUNT = 6


def other_wall() -> GaussianScene:
    """The grasper before a wall of other colours, 8 mm nearer."""
    scene = make_scene()
    tissue = scene.canonical.counts[0]
    shift = torch.zeros(len(scene.canonical), 3)
    shift[:tissue, 2] = -8.0
    colors = np.random.default_rng(5).uniform((0.57, 0.6, 0.37), (0.63, 0.65, 0.43), (tissue, 3))
    dc = scene.canonical.sh_dc.clone()
    dc[:tissue, 0] = (torch.from_numpy(colors).float() - 0.5) / 0.28209479177387814
    scene.canonical = replace(scene.canonical, means=scene.canonical.means + shift, sh_dc=dc)
    return scene


def elsewhere(pose: Tensor) -> Tensor:
    """A pose [4, 4] of the wall's world in the footage's."""
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = torch.from_numpy(Rotation.from_rotvec([0.7, -1.1, 2.0]).as_matrix())
    turn[:3, 3] = torch.tensor([40.0, -200.0, 90.0])
    return turn @ pose.double()


@pytest.fixture(scope="module")
def other_footage(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """The grasper's frames before the other wall, in a world of its own; no states."""
    root = tmp_path_factory.mktemp("other")
    recorded = record(other_wall(), root, [moving(1.2 * k) for k in range(COUNT)], "train")
    camera = replace(CAMERA, world_from_camera=elsewhere(CAMERA.world_from_camera))
    frames = [replace(f, camera=camera, state=State({}, k / 25)) for k, f in enumerate(recorded.frames)]
    wall = recorded.points.positions - np.array([0, 0, 8.0])
    turn = elsewhere(torch.eye(4)).numpy()
    points = PointCloud((wall @ turn[:3, :3].T + turn[:3, 3]).astype(np.float32), recorded.points.colors)
    return Capture(root, tuple(frames), (), points)


@pytest.fixture(scope="module")
def other_tissue(other_footage: Capture, tmp_path_factory: pytest.TempPathFactory) -> GaussianRun:
    """What `neeco train --method 3dgs` learns of that footage, and of as many frames before the instrument came."""
    root = tmp_path_factory.mktemp("tissue")
    capture, run, wall = root / "capture", root / "run", TissueRenderer(other_wall()).render(CAMERA, None)
    before = [replace(frame, image_path=root / f"before-{frame.name}.png") for frame in other_footage.frames]
    for frame in before:
        write_image(frame.image_path, wall)
    write_capture(replace(other_footage, frames=(*before, *other_footage.frames)), capture)
    assert main(["train", str(capture), "--method", "3dgs", "--iterations", "350", "--output", str(run)]) == 0
    return load_run(run).gaussians("track")


def in_camera(state: State, camera: Camera) -> Tensor:
    return torch.linalg.inv(camera.world_from_camera.double()) @ state.instruments["grasper"].pose.double()


def test_instruments_stand_before_the_tissue_of_another_scene() -> None:
    own, other = make_scene(), other_wall()
    joined = over_tissue(own, other)
    state = grasper_state()
    (color, alpha), (expected, opacity) = (InstrumentRenderer(scene).render(state, CAMERA) for scene in (joined, own))
    assert torch.equal(color, expected)
    assert torch.equal(alpha, opacity)
    rows = ~joined.canonical.of_instruments
    assert torch.equal(joined.canonical.means[rows], other.canonical.means[~other.canonical.of_instruments])


def test_footage_over_another_tissue_in_another_world_is_tracked(tracked_run, other_footage, other_tissue, tmp_path):
    tracked = track_footage(tracked_run, other_footage, tmp_path / "out", tissue=other_tissue, min_trust=0.2)
    assert tracked.written == COUNT
    for k, rec in enumerate(tracked.records):
        found, true = in_camera(state_of(rec), other_footage.frames[k].camera), in_camera(moving(1.2 * k), CAMERA)
        turned = Rotation.from_matrix((true[:3, :3].T @ found[:3, :3]).numpy()).magnitude() / DEG
        assert turned < 3
        assert float((found[:3, 3] - true[:3, 3]).norm()) < 2  # 3 % of the distance
    run = load_run(tmp_path / "out" / "run")
    assert run.scene.recorded.names == tuple(frame.name for frame in other_footage.frames)
    assert len(run.capture().frames) == COUNT
    trusts = sorted(rec["trust"]["value"] for rec in tracked.records)
    output, stricter = tmp_path / "out", trusts[1]  # which leaves out the least trusted frame
    again = track_footage(tracked_run, other_footage, output, tissue=other_tissue, min_trust=stricter, resume=True)
    run = load_run(output / "run")
    assert 0 < again.written < COUNT
    assert run.scene.recorded.names == tuple(frame.name for frame in run.capture().frames)


def test_tissue_that_a_run_does_not_learn_by_itself_is_refused(tracked_run: RecordedRun) -> None:
    scene = make_scene()
    scene.deformation.motion = lambda canonical: None
    with pytest.raises(NeecoError, match=r"--tissue: .* learns no tissue by itself; use a run of method 3dgs"):
        over_tissue(tracked_run.scene, scene)


def test_users_of_what_went_are_told_what_to_type(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    video, output = tmp_path / "film.mp4", str(tmp_path / "out")
    video.write_bytes(b"a video")
    assert main(["track", "run", str(tmp_path), "--tissue", "footage", "--output", output]) == 1
    assert "neeco train --method 3dgs FOOTAGE --output RUN2" in capsys.readouterr().err
    assert main(["track", "run", str(video), "--output", output]) == 1
    assert f"neeco ingest --video {video} --output FOOTAGE" in capsys.readouterr().err


@pytest.mark.parametrize("what", ["no instrument", "black"])
def test_footage_without_the_instrument_is_trusted_nowhere(tracked_run, other_footage, other_tissue, tmp_path, what):
    wall = TissueRenderer(other_wall()).render(CAMERA, None)
    frames = []
    for frame in other_footage.frames[:2]:
        path = tmp_path / f"{frame.name}.png"
        write_image(path, wall if what == "no instrument" else torch.zeros_like(wall))
        frames.append(replace(frame, image_path=path))
    footage = replace(other_footage, frames=tuple(frames))
    tracked = track_footage(tracked_run, footage, tmp_path / "out", tissue=other_tissue)
    assert tracked.written == 0
    assert max(rec["trust"]["value"] for rec in tracked.records) < 0.5
    with pytest.raises(NeecoError, match=r"no frame has a trust of"):
        tracked.require_trusted()
