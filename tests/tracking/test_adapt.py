"""Frames of another operation, labelled by proposals that the image and the scene verify."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from folder_contents import contents
from grasper_world import CAMERA, RecordedRun, grasper_state, make_scene

from neeco.base.errors import NeecoError
from neeco.capture.images import read_image_bytes, read_labels, write_image, write_labels
from neeco.capture.model import Frame, State
from neeco.cli import main
from neeco.evaluation.masks import iou
from neeco.evidence.image_cut import cut_out
from neeco.scene import GaussianScene
from neeco.scene.io import save_scene
from neeco.states.crop_rendering import InstrumentRenderer
from neeco.studies.adaptation import AdaptRequest, verification
from neeco.studies.adaptation.adapt import Adapted, adapt_footage
from neeco.studies.adaptation.verification import Verifier, state_of
from neeco.tracking.from_labels import LabelFitter

COUNT = 4
LARGE = CAMERA.scaled(2)


def silent(what: str, done: int, total: int) -> None:
    """No progress."""


def large_scene() -> GaussianScene:
    """The grasper, recorded by a camera of twice the size."""
    scene = make_scene()
    scene.recorded = replace(scene.recorded, cameras=(LARGE,) * len(scene.recorded.states))
    return scene


def other_wall() -> GaussianScene:
    """The grasper before a wall of another colour."""
    scene = large_scene()
    tissue = scene.canonical.counts[0]
    colors = np.random.default_rng(5).uniform((0.05, 0.05, 0.4), (0.11, 0.11, 0.46), (tissue, 3))
    dc = scene.canonical.sh_dc.clone()
    dc[:tissue, 0] = (torch.from_numpy(colors).float() - 0.5) / 0.28209479177387814
    scene.canonical = replace(scene.canonical, sh_dc=dc)
    return scene


def states() -> list[State]:
    """Of the frames: between and beyond the recorded ones, turned by a third of a circle before the camera."""
    turned = [grasper_state(-4 + 3 * k, 2 * k - 3, 64 + 3 * k, 2.0 + 0.1 * k, 0.3, 0.5 + 0.1 * k) for k in range(COUNT)]
    return [replace(state, time=k / 25) for k, state in enumerate(turned)]


def silhouette(state: State) -> np.ndarray:
    return InstrumentRenderer(large_scene()).render(state, LARGE)[1].numpy() > 0.5


@pytest.fixture(scope="module")
def operation(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """images/: the frames; masks/: what a network might propose, thinner than the instrument and torn."""
    root = tmp_path_factory.mktemp("operation")
    for k, state in enumerate(states()):
        write_image(root / "images" / f"{k:06d}.png", other_wall().render(state, LARGE).color.clamp(0, 1))
        mask = cv2.erode(silhouette(state).astype(np.uint8), np.ones((5, 5), np.uint8))
        mask[:, ::7] = 0
        write_labels(root / "masks" / f"{k:06d}.png", torch.from_numpy(mask))
    return root


@pytest.fixture(scope="module")
def run(tracked_run: RecordedRun) -> RecordedRun:
    return replace(tracked_run, scene=large_scene())


def request_of(operation: Path, output: Path, **options) -> AdaptRequest:
    given = {"masks": operation / "masks", "min_overlap": 0.8} | options
    return AdaptRequest(run=Path("run"), footage=operation / "images", output=output, **given)


@pytest.fixture(scope="module")
def adapted(run: RecordedRun, operation: Path, tmp_path_factory: pytest.TempPathFactory) -> Adapted:
    return adapt_footage(run, request_of(operation, tmp_path_factory.mktemp("set") / "out"), silent)


def test_poor_proposals_become_labels_of_the_whole_instrument(adapted: Adapted, operation: Path) -> None:
    assert adapted.accepted == COUNT
    for k, state in enumerate(states()):
        true, proposed = silhouette(state), read_labels(operation / "masks" / f"{k:06d}.png").numpy() > 0
        mask = read_labels(adapted.output / "masks" / f"{k:06d}.png").numpy() > 0
        assert iou(mask, true) > max(0.85, iou(proposed, true) + 0.2)
        parts = read_labels(adapted.output / "parts" / f"{k:06d}.png").numpy()
        assert (parts[mask] > 0).all()
        assert not parts[~mask].any()
        image = operation / "images" / f"{k:06d}.png"
        assert (read_image_bytes(adapted.output / "images" / image.name) == read_image_bytes(image)).all()


def test_few_accepted_frames_are_doubtful(adapted: Adapted) -> None:
    """Another instrument's shaft may fit where little else is in view."""
    assert adapted.verdict.startswith("usable, if it shows the run's instrument, which is not checked: 100% of the 4")
    some = [entry | {"accepted": index == 0} for index, entry in enumerate(adapted.records)]
    assert replace(adapted, records=some).verdict.startswith("DOUBTFUL: 25% of the 4 frames with a proposal accepted")


def test_frames_without_an_instrument_do_not_make_labels_doubtful(
    run: RecordedRun, operation: Path, tmp_path: Path
) -> None:
    for k in (1, 2):
        write_labels(tmp_path / "masks" / f"{k:06d}.png", read_labels(operation / "masks" / f"{k:06d}.png"))
    done = adapt_footage(run, request_of(operation, tmp_path / "out", masks=tmp_path / "masks"), silent)
    assert ": 100% of the 2 frames with a proposal accepted" in done.verdict


def test_the_card_says_where_images_and_masks_are_from(adapted: Adapted, operation: Path) -> None:
    card = (adapted.output / "README.md").read_text()
    assert "recorded in another operation" in card
    assert f"{operation / 'images'} --masks {operation / 'masks'} --model unet" in card


def test_the_hinge_is_found_wherever_it_is_in_the_image(adapted: Adapted) -> None:
    """A shaft's tilt towards the camera is hardly visible in silhouettes."""
    for state, entry in zip(states(), adapted.records, strict=True):
        found, true = (each.instruments["grasper"].pose[:3, 3].numpy() for each in (state_of(entry), state))
        apart = LARGE.fx * (found[:2] / found[2] - true[:2] / true[2])
        assert np.linalg.norm(apart) < 4  # px
        assert abs(found[2] / true[2] - 1) < 0.2


def test_frames_of_another_instrument_are_refused_in_one_line(
    run: RecordedRun, operation: Path, tmp_path: Path
) -> None:
    masks = tmp_path / "masks"
    for k in range(COUNT):
        disc = cv2.circle(np.zeros((128, 192), np.uint8), (120, 60), 18, 1, -1)
        write_labels(masks / f"{k:06d}.png", torch.from_numpy(disc))
    with pytest.raises(
        NeecoError, match=r"0 of 4 frames accepted, 4 have a proposal, the best overlap is .*; check that it shows"
    ):
        adapt_footage(run, request_of(operation, tmp_path / "out", masks=masks, min_overlap=0.9), silent)
    records = json.loads((tmp_path / "out" / "adapt.json").read_text())["frames"]
    assert all(entry["reason"] and not entry["accepted"] for entry in records)


def test_interrupted_work_continues_to_the_same_bytes(run: RecordedRun, operation: Path, adapted, tmp_path) -> None:
    def stop(what: str, done: int, total: int) -> None:
        if what == "verification" and done == 2:
            raise KeyboardInterrupt

    output = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        adapt_footage(run, request_of(operation, output), stop)
    with pytest.raises(NeecoError, match="--resume"):
        adapt_footage(run, request_of(operation, output), silent)
    with pytest.raises(NeecoError, match=r"adapt\.json: .*min_overlap"):
        adapt_footage(run, request_of(operation, output, min_overlap=0.7, resume=True), silent)
    adapt_footage(run, request_of(operation, output, resume=True), silent)
    assert contents(output) == contents(adapted.output)


def test_pixels_that_a_mask_leaves_out_do_not_count(run: RecordedRun, operation: Path, tmp_path: Path) -> None:
    """A bright text lies over the frames, and the proposals take it for an instrument."""
    text = np.zeros((LARGE.height, LARGE.width), bool)
    text[:, :40] = True
    frames = []
    for k in range(2):
        name = f"{k:06d}.png"
        image = read_image_bytes(operation / "images" / name)
        image[text] = 250
        write_image(tmp_path / "images" / name, torch.from_numpy(image).float() / 255)
        write_labels(tmp_path / "counted" / name, torch.from_numpy((~text).astype(np.uint8) * 255))
        mask = read_labels(operation / "masks" / name).numpy() | text
        write_labels(tmp_path / "1" / "proposals" / name, torch.from_numpy(mask.astype(np.uint8)))
        files = {"image_path": tmp_path / "images" / name, "mask_path": tmp_path / "counted" / name}
        frames.append(Frame(**files, camera=LARGE, state=State({}, 0.0), split="footage"))
    channels = run.scene.label_channels().sum(1, keepdim=True)
    verifier = Verifier(LabelFitter.of(run.scene, ("instrument",), channels), frames, 0.8)
    fits = tmp_path / "1" / "fits"
    for index in verifier.chunk(tmp_path / "1", (0, 1)):
        assert json.loads((fits / f"{index:06d}.json").read_text())["accepted"]
        mask = read_labels(fits / f"{index:06d}.png").numpy() > 0
        assert not mask[text].any()
        assert iou(mask, silhouette(states()[index]) & ~text) > 0.85


def test_any_number_of_workers_writes_the_same_bytes(
    run: RecordedRun, operation: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(verification, "ADAPT", replace(verification.ADAPT, chunk=1))
    save_scene(run.scene, tmp_path / "scene.safetensors")
    told: list[tuple[int, int]] = []
    for workers in (1, 2):
        output = tmp_path / str(workers)
        request = request_of(operation, output, workers=workers)
        done = adapt_footage(
            replace(run, path=tmp_path),
            request,
            lambda what, done, total: told.append((done, total)) if what == "verification" else None,
        )
        assert done.accepted == COUNT
    assert told == 2 * [(k + 1, COUNT) for k in range(COUNT)]
    assert contents(tmp_path / "1") == contents(tmp_path / "2")


def test_a_segmenter_learns_from_renderings_and_proposes(run: RecordedRun, operation: Path, tmp_path: Path) -> None:
    """Hardly trained, its proposals are poor; the rounds, their files and the refusal are those of a long one."""
    output = tmp_path / "out"
    options = {"masks": None, "steps": 12, "count": 6, "rounds": 2, "min_overlap": 0.0}
    done = adapt_footage(run, request_of(operation, output, **options), silent)
    assert 0 < done.accepted <= COUNT
    for number in (1, 2):
        assert len(list((output / "rounds" / str(number) / "proposals").iterdir())) == COUNT
    assert (output / "coco" / "instances.json").exists()


def test_a_frame_accepted_before_is_fitted_as_well_from_its_state_there(
    run: RecordedRun, operation: Path, adapted: Adapted, tmp_path: Path
) -> None:
    rounds = tmp_path / "rounds"
    shutil.copytree(adapted.output / "rounds" / "1", rounds / "1")
    shutil.copytree(rounds / "1" / "proposals", rounds / "2" / "proposals")
    frames = [Frame(path, LARGE, State({}, 0.0), "footage") for path in sorted((operation / "images").iterdir())]
    channels = run.scene.label_channels().sum(1, keepdim=True)
    verifier = Verifier(LabelFitter.of(run.scene, ("instrument",), channels), frames, 0.8)
    assert list(verifier.chunk(rounds / "2", range(COUNT))) == list(range(COUNT))
    for before in adapted.records:
        after = json.loads((rounds / "2" / "fits" / f"{before['frame']}.json").read_text())
        assert after["accepted"]
        assert after["misfit"] < 1.05 * before["misfit"]


def test_rounds_end_where_another_would_learn_the_same(run: RecordedRun, operation: Path, tmp_path: Path) -> None:
    options = {"masks": None, "steps": 2, "count": 4, "rounds": 3, "min_overlap": 0.99}
    with pytest.raises(NeecoError, match="0 of 4 frames accepted"):
        adapt_footage(run, request_of(operation, tmp_path / "out", **options), silent)
    assert not (tmp_path / "out" / "rounds" / "2").exists()


def test_a_cut_follows_the_image_beyond_a_proposal() -> None:
    image = np.full((60, 80, 3), (170, 90, 80), np.uint8)
    image[20:40] = (60, 60, 70)
    image = (image + np.random.default_rng(0).normal(0, 4, image.shape)).clip(0, 255).astype(np.uint8)
    proposed = np.zeros((60, 80), bool)
    proposed[27:33, 10:70] = True
    true = np.zeros((60, 80), bool)
    true[20:40] = True
    cut = cut_out(image, proposed, 0.15)
    assert cut is not None
    assert iou(cut, true) > 0.95
    assert cut_out(image, np.zeros((60, 80), bool), 0.15) is None


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--workers", "0"], "--workers must be at least 1 (got 0)"),
        (["--rounds", "0"], "--rounds must be at least 1 (got 0)"),
        (["--min-overlap", "1.5"], "--min-overlap: 1.5 is not a share"),
        (["--intrinsics", "0", "90", "48", "32"], "--intrinsics: FX and FY must be positive"),
    ],
)
def test_options_that_nothing_can_be_made_of_are_named(run, operation, tmp_path, words, message) -> None:
    name = words[0][2:].replace("-", "_")
    value = tuple(map(float, words[1:])) if len(words) > 2 else float(words[1]) if "." in words[1] else int(words[1])
    with pytest.raises(NeecoError) as error:
        adapt_footage(run, request_of(operation, tmp_path / "out", **{name: value}), silent)
    assert str(error.value).startswith(message)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"backgrounds": Path("nowhere")}, "--backgrounds: nowhere: no such folder"),
        ({"model": "dfine"}, "--model: dfine"),
    ],
)
def test_what_a_segmenter_cannot_learn_with_is_refused_at_once(run, operation, tmp_path, options, message) -> None:
    with pytest.raises(NeecoError, match=message):
        adapt_footage(run, request_of(operation, tmp_path / "out", masks=None, **options), silent)
    assert not (tmp_path / "out").exists()


def test_frames_of_another_shape_need_intrinsics(run: RecordedRun, operation: Path, tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for file in (operation / "images").iterdir():
        image = cv2.imread(str(file))
        assert cv2.imwrite(str(folder / file.name), image[:, :128])
    request = replace(request_of(operation, tmp_path / "out"), footage=folder)
    with pytest.raises(NeecoError, match=r"images of another shape .*; state --intrinsics FX FY CX CY"):
        adapt_footage(run, request, silent)
    assert not (tmp_path / "out").exists()


def test_a_run_that_is_none_ends_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["adapt", str(tmp_path / "none"), str(tmp_path), "--output", str(tmp_path / "out")]) == 1
    assert "no such run folder" in capsys.readouterr().err
