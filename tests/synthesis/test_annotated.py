"""Recorded frames labelled by the scene: fitted, judged by their images, written or listed."""

from __future__ import annotations

import json
import shutil
from contextlib import nullcontext
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from folder_contents import contents
from image_files import read_image
from PIL import Image
from rod_world import CAMERA, FakeRun, make_scene, rod_state

from neeco.base.errors import NeecoError
from neeco.capture.images import read_labels, write_image
from neeco.capture.model import Capture, Frame, Instrument, InstrumentState, PointCloud, State
from neeco.cli import main
from neeco.evaluation.trust import TypicalErrors, estimate_trust, typical_errors_of
from neeco.geometry.lens import Lens
from neeco.geometry.rotations import rigid_from_vector
from neeco.labels.drawing import LayeredDrawing, draw_layers
from neeco.labels.labellers import CompositedLabels
from neeco.report.run_page import write_annotated_page
from neeco.scene import GaussianScene, Recorded
from neeco.synthesis.annotated import annotate_capture
from neeco.synthesis.settings import ImageSettings

USUAL = TypicalErrors(0.05, 0.05)
HIDDEN = 5  # the frame whose instrument something is held before


@dataclass(frozen=True)
class RecordedRun(FakeRun):
    """And what annotation uses."""

    recording: Capture

    def capture(self) -> Capture:
        return self.recording


def tracked(state: State, index: int) -> State:
    """What a tracker says of `state`: half a millimetre off."""
    off = torch.tensor([0.0, 0.004, 0.0, 0.4, -0.3, 0.2], dtype=torch.float64) * (1 if index % 2 else -1)
    given = state.instruments["rod"]
    return State({"rod": InstrumentState(given.pose @ rigid_from_vector(off), given.joints)}, time=index / 10)


@pytest.fixture(scope="module")
def recorded(run, scene: GaussianScene, tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    """Eight images of the scene, one of them with a board held before the instrument."""
    root = tmp_path_factory.mktemp("recorded")
    frames = []
    for index in range(8):
        state = rod_state(x=2.0 * index - 7, y=3.0, jaw=0.1 * index)
        with torch.no_grad():
            image = scene.render(state, CAMERA).color.clamp(0, 1)
        if index == HIDDEN:
            image[5:45, 20:60] = torch.tensor([0.1, 0.3, 0.9])
        path = root / "images" / f"{index:03d}.png"
        write_image(path, image)
        frames.append(Frame(path, CAMERA, tracked(state, index), "test" if index in (2, HIDDEN) else "train"))
    points = PointCloud(np.zeros((1, 3), np.float32), np.zeros((1, 3), np.float32))
    return RecordedRun(run.path, scene, Capture(root, tuple(frames), scene.instruments, points))


@pytest.fixture(scope="module")
def made(recorded: RecordedRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("made") / "annotated"
    annotated = annotate_capture(recorded, output)
    assert annotated.written == 7
    write_annotated_page(output, annotated.records, recorded.capture(), 0.8)
    return output


def layers(scene: GaussianScene, state: State) -> LayeredDrawing:
    return draw_layers(scene, CompositedLabels(scene), state, CAMERA, 0.01, tissue_image=True)


def test_an_image_supports_a_right_label_and_not_a_wrong_one(scene: GaussianScene) -> None:
    right, wrong = layers(scene, rod_state()), layers(scene, rod_state(x=12.0))
    assert estimate_trust(right, right.image, None, USUAL).value == 1.0
    judged = estimate_trust(wrong, right.image, None, USUAL)
    assert judged.value < 0.3
    assert judged.against > 0.7


def test_what_something_hides_is_no_label(scene: GaussianScene) -> None:
    drawing = layers(scene, rod_state())
    image, label = drawing.image.clone(), drawing.parts > 0
    image[:20] = torch.tensor([0.1, 0.3, 0.9])
    hidden = float((label[:20]).sum() / label.sum())
    judged = estimate_trust(drawing, image, None, USUAL)
    assert judged.against == pytest.approx(hidden, abs=0.1)
    assert judged.value < 1 - hidden + 0.1


def test_a_label_too_small_misses_what_looks_like_no_tissue(scene: GaussianScene) -> None:
    drawing = layers(scene, rod_state())
    label = drawing.parts.clone()
    half = torch.nonzero(label.sum(0))[:, 0].float().mean().round().long()
    label[:, half:] = 0
    cut = replace(drawing, parts=label, image=torch.where((label > 0)[..., None], drawing.image, drawing.tissue_image))
    judged = estimate_trust(cut, drawing.image, None, USUAL, neighbourhood=0.2)  # a very small image
    assert judged.missed > 0.2
    assert judged.value < 0.9


def test_pixels_that_the_loss_leaves_out_do_not_vote(scene: GaussianScene) -> None:
    drawing = layers(scene, rod_state())
    image = drawing.image.clone()
    image[:20] = torch.tensor([0.1, 0.3, 0.9])
    mask = torch.ones(48, 64, dtype=torch.bool)
    mask[:23] = False  # and what the blur of the errors reaches
    assert estimate_trust(drawing, image, mask, USUAL).value == 1.0


def test_without_a_label_there_is_nothing_to_trust(scene: GaussianScene) -> None:
    drawing = layers(scene, rod_state())
    empty = replace(drawing, parts=torch.zeros_like(drawing.parts))
    assert estimate_trust(empty, drawing.image, None, USUAL).value == 0.0


def test_usual_errors_are_those_of_all_but_a_hundredth_of_the_pixels(scene: GaussianScene) -> None:
    drawing = layers(scene, rod_state())
    off = 0.04 * torch.rand(drawing.parts.shape, generator=torch.Generator().manual_seed(0))
    brighter = (drawing.image + off[..., None]).clamp(0, 1)
    usual = typical_errors_of([(drawing, brighter, None)])
    assert 0.02 < usual.inside < 0.04
    assert estimate_trust(drawing, brighter, None, usual).value > 0.95


def test_recorded_images_get_the_labels_that_the_scene_draws_at_fitted_poses(made: Path, recorded: RecordedRun) -> None:
    lines = [json.loads(line) for line in (made / "states.jsonl").read_text().splitlines()]
    assert [line["frame"] for line in lines] == ["000", "001", "002", "003", "004", "006", "007"]
    for index, line in zip((0, 1, 2, 3, 4, 6, 7), lines, strict=True):
        with (
            Image.open(made / line["image"]) as image,
            Image.open(recorded.capture().frames[index].image_path) as photo,
        ):
            assert np.array_equal(np.asarray(image), np.asarray(photo))
        with Image.open(made / line["image"].replace("images", "masks", 1)) as stored:
            mask = np.asarray(stored) > 0
        true = layers(recorded.scene, rod_state(x=2.0 * index - 7, y=3.0, jaw=0.1 * index)).parts.numpy() > 0
        assert (mask & true).sum() / (mask | true).sum() > 0.97
        assert line["trust"]["value"] > 0.9
        assert line["moved"]["rod"]["mm"] + line["moved"]["camera"]["mm"] > 0.2
    assert {line["recorded_split"] for line in lines} == {"train", "test"}


def test_a_label_without_its_shaft_is_not_trusted(tmp_path: Path) -> None:
    """The rendering explains all that it labels; that an instrument shows beside it, only the image tells."""
    camera = replace(CAMERA, fx=240.0, fy=240.0, cx=128.0, cy=96.0, width=256, height=192)
    whole, frames = make_scene(), []
    for index in range(4):
        state = rod_state(x=2.0 * index - 7, y=3.0, jaw=0.1 * index)
        with torch.no_grad():
            image = whole.render(state, camera).color
        noise = 0.02 * torch.randn(image.shape, generator=torch.Generator().manual_seed(index))
        path = tmp_path / "images" / f"{index:03d}.png"
        write_image(path, (image + noise).clamp(0, 1))
        frames.append(Frame(path, camera, state, "test" if index == 2 else "train"))
    points = PointCloud(np.zeros((1, 3), np.float32), np.zeros((1, 3), np.float32))
    (tmp_path / "scene.safetensors").write_bytes(b"the scene's bits")
    trusted = []
    for n_lost in (0, 45):  # of the 60 Gaussians of the shaft, from its rear on
        scene = make_scene()
        kept = torch.ones(len(scene.canonical), dtype=torch.bool)
        tissue, instrument = scene.canonical.counts
        kept[tissue : tissue + n_lost] = False
        scene.canonical = scene.canonical.map(lambda tensor, kept=kept: tensor[kept], (tissue, instrument - n_lost))
        run = RecordedRun(tmp_path, scene, Capture(tmp_path, tuple(frames), scene.instruments, points))
        records = annotate_capture(run, tmp_path / f"without-{n_lost}", min_trust=0.0).records
        trusted.append(min(record["trust"]["value"] for record in records))
    assert trusted[0] > 0.8 > 0.65 > trusted[1]


def test_a_frame_that_training_fitted_is_labelled_about_the_fitted_state(recorded: RecordedRun, tmp_path: Path) -> None:
    """Its recorded state may be that of another moment."""
    capture, scene, true = recorded.capture(), copy(recorded.scene), rod_state(x=-1.0, y=3.0, jaw=0.3)
    wrong = replace(capture.frames[3], state=rod_state(x=20.0, y=-9.0, jaw=0.3))
    scene.recorded = Recorded.of([replace(wrong, state=true)], scene.instruments)
    frames = tuple(wrong if frame.name == "003" else frame for frame in capture.frames)
    annotate_capture(RecordedRun(recorded.path, scene, replace(capture, frames=frames)), tmp_path / "set")
    line = next(line for line in (tmp_path / "set" / "states.jsonl").read_text().splitlines() if '"003"' in line)
    with Image.open(tmp_path / "set" / "masks" / "000003.png") as stored:
        mask = np.asarray(stored) > 0
    label = layers(scene, true).parts.numpy() > 0
    assert (mask & label).sum() / (mask | label).sum() > 0.97
    assert json.loads(line)["moved"]["rod"]["mm"] > 15  # from the recorded state


def test_a_frame_that_is_not_trusted_is_listed_and_not_written(made: Path) -> None:
    assert not (made / "images" / "000005.png").exists()
    info = json.loads((made / "dataset.json").read_text())
    assert info["complete"]
    assert info["skipped"] == [HIDDEN]
    assert info["refused"] == {"not trusted": 1}
    page = (made / "annotate.html").read_text()
    assert page.index("</b> 005") < page.index("</b> 000")  # worst first
    assert ": not written" in page
    assert "http" not in page.replace("http://www.w3.org/", "")


def test_files_are_numbered_anew_and_the_card_and_the_command_say_so(made, recorded, tmp_path, monkeypatch, capsys):
    words = " ".join((made / "README.md").read_text().split())
    assert "Files are numbered anew: the field `frame` of `states.jsonl` has the name" in words
    few = replace(
        recorded, recording=replace(recorded.recording, frames=recorded.recording.frames[HIDDEN - 1 : HIDDEN + 2])
    )
    trusted = SimpleNamespace(**vars(few), capture=few.capture, require_trusted=lambda verb: None)
    monkeypatch.setattr("neeco.training.run.open_gaussian_run", lambda *_, **__: nullcontext(trusted))
    assert main(["annotate", "run", "--output", str(tmp_path / "set")]) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"2 of 3 frames in {tmp_path / 'set'}; 1 left out with a trust below 0.8",
        "frames are renumbered; `frame` in states.jsonl is the original name; all frames, worst first: "
        f"{tmp_path / 'set' / 'annotate.html'}",
    ]


def test_the_same_again_gives_the_same_bytes_and_so_does_going_on(made, recorded, tmp_path):
    def stop(done: int, total: int) -> None:
        if done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        annotate_capture(recorded, tmp_path / "cut", on_progress=stop)
    assert not json.loads((tmp_path / "cut" / "dataset.json").read_text())["complete"]
    annotate_capture(recorded, tmp_path / "cut", resume=True)
    before = contents(made)
    del before["annotate.html"]
    assert contents(tmp_path / "cut") == before


def test_bad_input_is_told_in_one_line_and_leaves_nothing(made: Path, recorded: RecordedRun, tmp_path: Path) -> None:
    capture, output = recorded.capture(), tmp_path / "output"
    with pytest.raises(NeecoError, match=r"--min-trust: 1.5 is not a share"):
        annotate_capture(recorded, output, min_trust=1.5)
    other = replace(capture, instruments=(Instrument("hook"),))
    with pytest.raises(NeecoError, match=r"instruments: the scene learned 'rod', here are: hook"):
        annotate_capture(recorded, output, capture=other)
    still = replace(capture, instruments=(Instrument("rod"),))
    with pytest.raises(NeecoError, match=r"instruments: rod: no joint 'jaw_angle'"):
        annotate_capture(recorded, output, capture=still)
    hidden = replace(capture, frames=(capture.frames[HIDDEN],))
    with pytest.raises(NeecoError, match=r"--min-trust: no frame of .* is trusted by 0.8; the best is by 0\.\d+"):
        annotate_capture(recorded, output, capture=hidden)
    assert not output.exists()
    with pytest.raises(NeecoError, match=r"not empty"):
        annotate_capture(recorded, made)
    begun = shutil.copytree(made, tmp_path / "begun")
    with pytest.raises(NeecoError, match=r"settings.min_trust: begun with 0.8, now 0.5"):
        annotate_capture(recorded, begun, min_trust=0.5, resume=True)


def test_a_wrong_run_is_told_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["annotate", str(tmp_path / "nothing"), "--output", str(tmp_path / "output")]) == 1
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "output").exists()


def test_a_recording_that_changed_is_not_gone_on_with(made: Path, recorded: RecordedRun, tmp_path: Path) -> None:
    begun = shutil.copytree(made, tmp_path / "begun")
    frames = list(recorded.recording.frames)
    frames[2] = replace(frames[2], image_path=frames[1].image_path)
    changed = replace(recorded, recording=replace(recorded.recording, frames=tuple(frames)))
    with pytest.raises(NeecoError, match=r"dataset.json: settings.captures_sha256: begun with .*use a new folder"):
        annotate_capture(changed, begun, resume=True)


def test_recorded_images_and_labels_are_written_as_large_as_asked_and_through_the_lens(recorded, tmp_path):
    scene, recording = copy(recorded.scene), replace(recorded.recording, frames=recorded.recording.frames[2:4])
    lens = Lens(50.0, 50.0, 32.0, 24.0, (-0.3, 0.1, 0.0, 0.0), (64, 48), border=(32.0, 24.0, 31.0))
    scene.recorded = replace(scene.recorded, lens=lens)
    few = replace(recorded, scene=scene, recording=recording)
    annotate_capture(few, tmp_path / "large", images=ImageSettings(scale=2.0, image_format="jpg"), formats=())
    annotate_capture(few, tmp_path / "bent", images=ImageSettings(lens=True), formats=())
    pixels = read_image(tmp_path / "large/images/000000.jpg").permute(2, 0, 1)
    bent = read_image(tmp_path / "bent/images/000000.png").permute(2, 0, 1)
    large_parts, parts, ignore = (
        read_labels(tmp_path / name / "000000.png") for name in ("large/parts", "bent/parts", "bent/ignore")
    )
    recorded_image = few.recording.frames[0].load_image().permute(2, 0, 1)
    shrunk = torch.nn.functional.avg_pool2d(pixels, 2)
    assert float((shrunk - recorded_image).abs().mean()) < 0.02
    assert large_parts.shape == (96, 128)
    # the pinhole saw less than the lens does: what it left out, no label speaks of
    black = bent.sum(0) == 0
    assert 0.05 < float(black.float().mean()) < 0.5
    assert (parts[black] == 0).all()
    rows, columns = np.mgrid[0:48, 0:64] + 0.5
    away = torch.from_numpy(np.hypot(columns - 32, rows - 24))
    assert (ignore[black & (away < 30)] == 255).all()
    assert not ignore[away > 32].any()  # nothing is there in the recording either
    seen, straight = bent[:, parts > 0], recorded_image[:, large_parts[::2, ::2] > 0]
    assert float((seen.mean(1) - straight.mean(1)).abs().max()) < 0.1
