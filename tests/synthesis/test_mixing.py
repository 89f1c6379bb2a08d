"""One run's tissue under other runs' instruments: where they stand, who hides whom, and whose label a pixel is."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from ball_world import RADIUS, at, ball_scene, ball_state, run_of
from PIL import Image
from rod_world import CAMERA

from neeco.base.errors import NeecoError
from neeco.capture.model import InstrumentState, State
from neeco.cli import main
from neeco.geometry.camera import Camera
from neeco.labels.drawing import draw_layers
from neeco.labels.labellers import CompositedLabels
from neeco.raster.native import torch_threads
from neeco.scene import GaussianScene
from neeco.synthesis.dataset import synthesize
from neeco.synthesis.generator import ENTERS_ANOTHER, Acceptance
from neeco.synthesis.settings import Settings
from neeco.synthesis.tissue_replacement import Mixture, tissue_depth, tissue_gaussians

FINE = Camera(torch.eye(4, dtype=torch.float64), 240.0, 240.0, 128.0, 96.0, 256, 192, learned_fx=240.0)
SETTINGS = Settings(count=4, seed=1, tissue_tolerance_mm=2.0)


def disc(x: float, y: float, z: float) -> np.ndarray:
    """[H, W] bool: the pixels whose line of sight meets a ball there."""
    row, column = np.mgrid[0 : FINE.height, 0 : FINE.width] + 0.5
    ray = np.stack([(column - FINE.cx) / FINE.fx, (row - FINE.cy) / FINE.fy, np.ones_like(row)], -1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    middle = np.array([x, y, z])
    return np.linalg.norm(middle - (ray @ middle)[..., None] * ray, axis=-1) < RADIUS


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


@pytest.fixture(scope="module")
def near() -> GaussianScene:
    return ball_scene("near", [(-8, 0, 55), (-4, 2, 60), (-9, 4, 58)])


@pytest.fixture(scope="module")
def far() -> GaussianScene:
    return ball_scene("far", [(8, 0, 75), (10, -2, 78), (6, 3, 72)])


def test_labels_and_occlusion_of_two_balls_are_those_of_geometry(near: GaussianScene, far: GaussianScene) -> None:
    mixed = Mixture.of(ball_scene("own", [(0, 0, 50)]), [near, far]).scene
    labeller = CompositedLabels(mixed)
    assert labeller.names == (("near", "instrument"), ("far", "instrument"))
    state = State({"near": InstrumentState(at(-3, 0, 55), {}), "far": InstrumentState(at(4, 0, 75), {})}, 0.0)
    drawing = draw_layers(mixed, labeller, state, FINE, 0.01)
    parts = drawing.parts.numpy()
    front, behind = disc(-3, 0, 55), disc(4, 0, 75)
    assert bool((front & behind).any())
    assert overlap(parts == 1, front) > 0.93
    assert overlap(parts == 2, behind & ~front) > 0.9
    assert overlap(drawing.layers["far"].mask, behind) > 0.93


def test_an_instrument_stands_as_far_before_the_tissue_as_before_its_own(near: GaussianScene) -> None:
    camera = Camera(at(500, 40, -30), 60.0, 60.0, 32.0, 24.0, 64, 48)
    tissue = ball_scene("own", [(0, 0, 50)], wall=130.0)
    mixture = Mixture.of(tissue, [near])
    assert tissue_depth(tissue_gaussians(tissue), CAMERA, np.array([0.0, 0, 60])) == pytest.approx(130.0, rel=0.02)
    placed = mixture.place(near, ball_state("near", -8, 0, 60), CAMERA, CAMERA)["near"].pose
    assert placed[2, 3].item() == pytest.approx(90.0, abs=2.0)  # 40 mm before the wall
    assert placed[0, 3].item() / placed[2, 3].item() == pytest.approx(-8 / 60)  # on the same line of sight
    deep = Mixture.of(ball_scene("own", [(0, 0, 50)], wall=70.0), [near])
    close = deep.place(near, ball_state("near", -8, 0, 60), CAMERA, CAMERA)["near"].pose
    assert close[2, 3].item() == pytest.approx(55.0, abs=0.1)  # not 30: it was recorded no nearer
    beside = mixture.place(near, ball_state("near", -8, 0, 60), CAMERA, camera)["near"].pose
    local = torch.linalg.inv(camera.world_from_camera) @ beside
    assert local[0, 3].item() / local[2, 3].item() == pytest.approx(-8 / 60)


def test_the_light_is_that_of_the_tissue_and_shafts_are_matched(near: GaussianScene) -> None:
    tissue = ball_scene("own", [(0, 0, 50)], color=0.6)
    with torch.no_grad():
        tissue.falloff.copy_(torch.tensor([1.0, 2.0]))
        tissue.vignette.copy_(torch.tensor([-0.5, 0.1]))
        tissue.shadow_offsets[1] = torch.tensor([5.0, 1.0, 0.0])
        tissue.shadow_strengths[1] = 0.3
    mixture = Mixture.of(tissue, [near])
    mixed = mixture.scene
    for name in ("falloff", "vignette", "shadow_offsets", "shadow_strengths"):
        assert torch.equal(getattr(mixed, name), getattr(tissue, name))
    assert mixture.gains[0] == pytest.approx((1.2, 1.2, 1.2), rel=1e-3)
    color = mixed.canonical.sh_dc[mixed.canonical.body(1)][:, 0] * 0.28209479177387814 + 0.5
    assert color.mean().item() == pytest.approx(0.6, rel=1e-3)
    assert Mixture.of(tissue, [tissue]).gains == ((1.0, 1.0, 1.0),)


def test_instruments_in_each_other_are_refused_but_not_those_recorded_so(near, far):
    mixed = Mixture.of(near, [near, far]).scene
    labeller = CompositedLabels(mixed)
    groups = (frozenset({"near"}), frozenset({"far"}))
    for depth, refused in ((75.0, False), (58.0, True)):
        state = State({"near": InstrumentState(at(-2, 0, 55), {}), "far": InstrumentState(at(2, 0, depth), {})}, 0.0)
        drawing = draw_layers(mixed, labeller, state, CAMERA, 0.01)
        assert (Acceptance(0.0, None, recorded_together=groups).refusal(drawing) == ENTERS_ANOTHER) is refused
        assert Acceptance(0.0, None, recorded_together=(groups[0] | groups[1],)).refusal(drawing) is None


def test_a_mixed_data_set_is_made_by_any_number_of_workers_with_the_same_bytes(near, far, tmp_path):
    tissue, first, second = (
        run_of(scene, tmp_path / name)
        for name, scene in (("tissue", ball_scene("own", [(0, 0, 50)], wall=110.0)), ("near", near), ("far", far))
    )
    alone, shared = tmp_path / "alone", tmp_path / "shared"
    with torch_threads(1):  # as `open_run` does
        synthesize(tissue, alone, SETTINGS, instrument_runs=(first, second))  # type: ignore[arg-type]
        synthesize(tissue, shared, SETTINGS, instrument_runs=(first, second), workers=2)  # type: ignore[arg-type]
    files = {path.relative_to(alone) for path in alone.rglob("*") if path.is_file()}
    assert files == {path.relative_to(shared) for path in shared.rglob("*") if path.is_file()}
    assert all((alone / file).read_bytes() == (shared / file).read_bytes() for file in files)
    info = json.loads((alone / "dataset.json").read_text())
    assert info["instruments"] == [str(first.path), str(second.path)]
    assert len(info["settings"]["instruments_sha256"]) == len(info["color_gains"]) == 2
    with Image.open(alone / "parts/000000.png") as parts:
        assert set(np.unique(np.array(parts))) <= {0, 1, 2}
    with pytest.raises(NeecoError, match=r"settings.instruments_sha256: begun with"):
        synthesize(tissue, alone, SETTINGS, instrument_runs=(second,), resume=True)  # type: ignore[arg-type]


def test_what_cannot_be_mixed_is_told(near: GaussianScene, scene: GaussianScene) -> None:
    with pytest.raises(NeecoError, match=r"--instruments: method rod does not keep tissue and instruments apart"):
        Mixture.of(near, [scene])
    with pytest.raises(NeecoError, match=r"--instruments: 'near' is in two of the runs"):
        Mixture.of(near, [near, near])
    mixture = Mixture.of(near, [near])
    with pytest.raises(NeecoError, match=r"--states: grid: "):
        mixture.sampler(replace(SETTINGS, states="grid"))
    with pytest.raises(NeecoError, match=r"--views: orbit"):
        mixture.sampler(replace(SETTINGS, views="orbit"))


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--count", "2"], "synthesize: give either a RUN, or --tissue RUN with --instruments RUN"),
        (
            ["a", "--tissue", "b", "--instruments", "c", "--count", "2"],
            "synthesize: give either a RUN, or --tissue RUN",
        ),
        (["--tissue", "b", "--count", "2"], "--instruments: requires --tissue RUN"),
        (["a", "--instruments", "b", "--count", "2"], "--instruments: requires --tissue RUN"),
        (["--tissue", "b", "--instruments", "c", "--count", "2"], "b: no such run folder"),
    ],
)
def test_the_command_line_asks_for_one_or_the_other(words, told, tmp_path, capsys):
    assert main(["synthesize", *words, "--output", str(tmp_path / "out")]) == 1
    error = capsys.readouterr().err.strip()
    assert told in error
    assert len(error.splitlines()) == 1
    assert not (tmp_path / "out").exists()
