"""Footage over another tissue, or whose cameras nobody knows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from grasper_world import CAMERA, RecordedRun, grasper_state, make_scene, moving, record
from scipy.spatial.transform import Rotation
from torch import Tensor

from neeco.capture.images import write_image
from neeco.capture.model import Capture, PointCloud, State
from neeco.cli import main
from neeco.errors import NeecoError
from neeco.fitting.crop_rendering import InstrumentRenderer, TissueRenderer
from neeco.fitting.parameters import DEG
from neeco.geometry.camera import Camera
from neeco.ingest.footage_video import read_footage
from neeco.scene import GaussianScene
from neeco.tracking import footage_scene, footage_tissue
from neeco.tracking.follow import Step
from neeco.tracking.footage_scene import Colors, over_tissue
from neeco.tracking.footage_tissue import foreground
from neeco.tracking.motion import MotionModel
from neeco.tracking.parameters import TrackedParameters
from neeco.tracking.track import state_of, track_footage
from neeco.tracking.trust import TrackTrust
from neeco.training.run import load_run

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
    """The grasper's frames before the other wall, in a world of its own and darker light; no states."""
    root = tmp_path_factory.mktemp("other")
    lit = Colors((0.8, 0.75, 0.7), 1.15).of(other_wall())
    recorded = record(lit, root, [moving(1.2 * k) for k in range(COUNT)], "train")
    camera = replace(CAMERA, world_from_camera=elsewhere(CAMERA.world_from_camera))
    frames = [replace(f, camera=camera, state=State({}, k / 25)) for k, f in enumerate(recorded.frames)]
    wall = recorded.points.positions - np.array([0, 0, 8.0])
    turn = elsewhere(torch.eye(4)).numpy()
    points = PointCloud((wall @ turn[:3, :3].T + turn[:3, 3]).astype(np.float32), recorded.points.colors)
    return Capture(root, tuple(frames), (), points)


@pytest.fixture
def short_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(footage_tissue, "ROUND_ITERATIONS", (100, 250))
    monkeypatch.setattr(footage_scene, "N_FRAMES", 2)
    monkeypatch.setattr(footage_tissue, "AGAIN_ITERATIONS", 60)


def in_camera(state: State, camera: Camera) -> Tensor:
    return torch.linalg.inv(camera.world_from_camera.double()) @ state.instruments["grasper"].pose.double()


def test_gain_and_gamma_are_found_in_what_they_made_of_colours() -> None:
    drawn = torch.rand(500, 3, generator=torch.Generator().manual_seed(1)) * 0.7 + 0.1
    seen = torch.tensor([0.8, 0.9, 1.1]) * drawn**1.3
    seen[::20] = 0.5  # something else is there
    found = Colors.fitted(drawn, seen)
    assert found.gain == pytest.approx((0.8, 0.9, 1.1), rel=0.03)
    assert found.gamma == pytest.approx(1.3, rel=0.03)


def test_no_colours_to_compare_change_nothing() -> None:
    assert Colors.fitted(torch.zeros(0, 3), torch.zeros(0, 3)) == Colors()


def test_recoloured_instruments_look_so_and_tissue_stays() -> None:
    scene, colors = make_scene(), Colors((0.8, 0.9, 1.1), 1.2)
    before = InstrumentRenderer(scene).render(grasper_state(), CAMERA)
    after = InstrumentRenderer(colors.of(scene)).render(grasper_state(), CAMERA)
    solid = before[1] > 0.99
    expected = torch.tensor(colors.gain) * (before[0] / before[1][..., None])[solid] ** colors.gamma
    seen = (after[0] / after[1][..., None])[solid]
    # between two Gaussians of other colours the power of a mean is not the mean of powers
    assert float((seen - expected).abs().mean()) < 0.01
    tissue = scene.canonical.counts[0]
    assert torch.equal(colors.of(scene).canonical.sh_dc[:tissue], scene.canonical.sh_dc[:tissue])


def test_instruments_stand_before_the_tissue_of_another_scene() -> None:
    own, other = make_scene(), other_wall()
    joined = over_tissue(own, other)
    state = grasper_state()
    (color, alpha), (expected, opacity) = (InstrumentRenderer(scene).render(state, CAMERA) for scene in (joined, own))
    assert torch.equal(color, expected)
    assert torch.equal(alpha, opacity)
    rows = ~joined.canonical.of_instruments
    assert torch.equal(joined.canonical.means[rows], other.canonical.means[~other.canonical.of_instruments])


def test_what_passes_before_the_tissue_is_masked_with_a_rim(tmp_path: Path) -> None:
    scene = make_scene()
    frame = record(scene, tmp_path, [grasper_state()], "train").frames[0]
    mask = foreground(frame, TissueRenderer(scene))
    label = InstrumentRenderer(scene).render(grasper_state(), CAMERA)[1].numpy() > 0.5
    assert mask[label].mean() > 0.95
    assert mask.mean() < 0.5


def test_footage_over_another_tissue_in_another_world_is_tracked(
    tracked_run: RecordedRun, other_footage: Capture, tmp_path: Path, short_rounds: None
) -> None:
    tracked = track_footage(tracked_run, other_footage, tmp_path / "out", tissue="footage", min_trust=0.2)
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
    again = track_footage(tracked_run, other_footage, output, tissue="footage", min_trust=stricter, resume=True)
    run = load_run(output / "run")
    assert 0 < again.written < COUNT
    assert run.scene.recorded.names == tuple(frame.name for frame in run.capture().frames)


@pytest.mark.slow
def test_another_tissue_broken_off_goes_on_to_the_same_bytes(
    tracked_run: RecordedRun, other_footage: Capture, tmp_path: Path, short_rounds: None
) -> None:
    footage = replace(other_footage, frames=other_footage.frames[:3])
    track_footage(tracked_run, footage, tmp_path / "whole", tissue="footage")

    def stop(stage: str, done: int, total: int) -> None:
        if stage == "learning the tissue, round-2" and done >= 50:
            raise KeyboardInterrupt

    def stop_tracking(done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    broken = tmp_path / "broken"
    with pytest.raises(KeyboardInterrupt):
        track_footage(tracked_run, footage, broken, tissue="footage", on_stage=stop)
    with pytest.raises(NeecoError, match="tissue: begun with 'footage'"):
        track_footage(tracked_run, footage, broken, resume=True)
    with pytest.raises(KeyboardInterrupt):
        track_footage(tracked_run, footage, broken, tissue="footage", resume=True, on_progress=stop_tracking)
    track_footage(tracked_run, footage, broken, tissue="footage", resume=True)
    files = [sorted(p for p in root.rglob("*") if p.is_file()) for root in (tmp_path / "whole", broken)]
    assert [p.relative_to(tmp_path / "whole") for p in files[0]] == [p.relative_to(broken) for p in files[1]]
    for one, other in zip(*files, strict=True):
        if one.name != "config.yaml":  # says where its capture lies
            assert one.read_bytes() == other.read_bytes(), one


def test_tissue_alone_is_learned_again(other_footage: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(footage_tissue, "AGAIN_ITERATIONS", 60)
    scene, trust = make_scene(), TrackTrust(0.9, 1.0, 1.0, 1.0)
    parameters = TrackedParameters.of(scene)
    motion = MotionModel.of(parameters, scene.recorded.states)
    frames = [replace(f, camera=CAMERA) for f in other_footage.frames]
    steps = [
        Step(
            frame=k,
            how="followed",
            motion=motion.begin(moving(1.2 * k)),
            misfit=0.2,
            gain=1.0,
            trust=trust,
            found_at=0.0,
            searched_at=0.0,
        )
        for k in range(len(frames))
    ]
    before = {name: tensor.clone() for name, tensor in scene.canonical.tensors().items()}
    footage_tissue.learn_again(scene, frames, steps, lambda what, done, total: None)
    rows, after = scene.canonical.of_instruments, scene.canonical.tensors()
    assert all(torch.equal(after[name][rows], tensor[rows]) for name, tensor in before.items())
    assert not torch.equal(after["sh_dc"][~rows], before["sh_dc"][~rows])
    lost = [replace(step, how="lost") for step in steps]
    assert footage_tissue.usable(lost) == []


@pytest.mark.parametrize("what", ["no instrument", "black"])
def test_footage_without_the_instrument_is_trusted_nowhere(
    tracked_run: RecordedRun, other_footage: Capture, tmp_path: Path, short_rounds: None, what: str
) -> None:
    wall = TissueRenderer(other_wall()).render(CAMERA, None)
    frames = []
    for frame in other_footage.frames[:2]:
        path = tmp_path / f"{frame.name}.png"
        write_image(path, wall if what == "no instrument" else torch.zeros_like(wall))
        frames.append(replace(frame, image_path=path))
    footage = replace(other_footage, frames=tuple(frames))
    tracked = track_footage(tracked_run, footage, tmp_path / "out", tissue="footage")
    assert tracked.written == 0
    assert max(rec["trust"]["value"] for rec in tracked.records) < 0.5
    with pytest.raises(NeecoError, match=r"no frame has a trust of"):
        tracked.require_trusted()


def test_one_frame_does_not_tell_tissue_from_foreground(
    tracked_run: RecordedRun, other_footage: Capture, tmp_path: Path
) -> None:
    footage = replace(other_footage, frames=other_footage.frames[:1])
    with pytest.raises(NeecoError, match="1 frame does not tell tissue"):
        track_footage(tracked_run, footage, tmp_path / "out", tissue="footage")


def test_a_file_that_is_no_video_is_told_in_one_line(
    tracked_run: RecordedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "notes.mp4"
    file.write_text("no video")
    with pytest.raises(NeecoError, match=r"notes\.mp4"):
        read_footage(file, tmp_path / "out", tracked_run.scene, False, lambda what, done, total: None)
    with pytest.raises(NeecoError, match=r"gone\.mp4: no such file or folder; give a capture or a video"):
        read_footage(tmp_path / "gone.mp4", tmp_path / "out", tracked_run.scene, False, lambda what, done, total: None)
    assert not (tmp_path / "out").exists()
    assert main(["track", "run", str(file), "--output", str(tmp_path / "out"), "--tissue", "run"]) == 1
    assert "leave it out" in capsys.readouterr().err


def test_the_video_that_a_folder_was_begun_with_is_asked_for(
    tracked_run: RecordedRun, tmp_path: Path, other_footage: Capture
) -> None:
    file, kept = tmp_path / "film.mp4", tmp_path / "out" / "footage"
    file.write_bytes(b"one")
    kept.mkdir(parents=True)
    (kept / "source.json").write_text('{"video_sha256": "another"}')
    with pytest.raises(NeecoError, match="video_sha256: begun with 'another'"):
        read_footage(file, tmp_path / "out", tracked_run.scene, True, lambda what, done, total: None)
    with pytest.raises(NeecoError, match="not empty"):
        read_footage(file, tmp_path / "out", tracked_run.scene, False, lambda what, done, total: None)
