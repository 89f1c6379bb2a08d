"""Camera effects: the file that asks for them, what each does to an image, and that labels stay right."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from rod_world import CAMERA, FakeRun, rod_state

from neeco.base.errors import NeecoError
from neeco.capture.model import State
from neeco.geometry.rotations import rigid
from neeco.labels.drawing import draw_layers
from neeco.labels.labellers import CompositedLabels
from neeco.scene import GaussianScene
from neeco.synthesis import camera_effects
from neeco.synthesis.camera_effects import (
    EFFECTS,
    CameraEffects,
    Motion,
    Range,
    RecordedMotion,
    apply_effects,
    average_exposure,
    image_circle,
    linear_to_srgb,
    read_effects,
    srgb_to_linear,
    subframes,
)
from neeco.synthesis.dataset import synthesize
from neeco.synthesis.generator import SampleGenerator
from neeco.synthesis.samplers import moved_camera
from neeco.synthesis.settings import Settings
from neeco.synthesis.tissue_replacement import Appearance

SETTINGS = Settings(count=4, seed=3, tissue_tolerance_mm=2.0)


def effects_file(folder: Path, text: str) -> str:
    path = folder / "effects.yaml"
    path.write_text(text)
    return str(path)


def grey(value: float = 0.5) -> np.ndarray:
    return np.full((48, 64, 3), value, np.float32)


def through_effects(image: np.ndarray, depth: float = 100.0, seed: int = 0, **values: float) -> np.ndarray:
    return apply_effects(image, np.full(image.shape[:2], depth), values, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def moving(scene: GaussianScene) -> GaussianScene:
    """The rod recorded at 25 frames a second, sliding sideways by 30 mm/s, its jaw opening."""
    states = tuple(replace(rod_state(x=1.2 * k - 6, jaw=0.02 * k), time=k / 25) for k in range(12))
    recorded = replace(scene.recorded, states=states)
    copied = GaussianScene("rod", scene.canonical, scene.deformation, scene.instruments, recorded, scene.center)
    copied.load_state_dict(scene.state_dict())
    return copied


def test_a_file_may_say_a_number_a_range_or_for_which_share(tmp_path: Path) -> None:
    text = "gamma: 1.1\nlens_blur_px: [0, 2]\nsmoke: {range: [0.1, 0.4], share: 0.5}\nsoft_masks: mean\n"
    effects = read_effects(Path(effects_file(tmp_path, text)))
    assert effects.ranges == {"gamma": Range(1.1, 1.1), "lens_blur_px": Range(0, 2), "smoke": Range(0.1, 0.4, 0.5)}
    assert effects.soft_masks == "mean"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "has no effects; choose one or more of shutter_s"),
        ("- gamma", "has no effects"),
        ("gamma: [1, 2", r"line 1: not valid YAML \(expected"),
        ("gamma: " + "9" * 400, r"gamma: 9+ is out of range"),
        ("gamma: [1, 2, &a [*a]]", "its aliases expand to too many values"),
        ("gama: 1", "gama: no such effect; there are shutter_s"),
        ("gamma: often", "gamma: 'often' is no range"),
        ("gamma: [1]", r"gamma: \[1\] is no range"),
        ("gamma: true", "gamma: True is no range"),
        ("gamma: [2, 1]", r"gamma: \[2, 1\] is out of range; give LOW <= HIGH within 0.3 to 3"),
        ("shutter_s: 2", "shutter_s: 2 is out of range; give LOW <= HIGH within 0 to 0.2"),
        ("gamma: .nan", "gamma: nan is out of range"),
        ("smoke: {range: [0, 1], shares: 2}", "smoke: give a number"),
        ("smoke: {range: 0.5, share: 2}", "smoke: share: 2 is not a share"),
        ("soft_masks: sharp\ngamma: 1", "soft_masks: 'sharp' is neither mid nor mean"),
    ],
)
def test_a_bad_file_is_told_in_a_line(text: str, told: str, tmp_path: Path) -> None:
    with pytest.raises(NeecoError, match=f"effects.yaml: {told}") as error:
        read_effects(Path(effects_file(tmp_path, text)))
    assert "\n" not in str(error.value)


def test_a_missing_file_leaves_nothing(run: FakeRun, tmp_path: Path) -> None:
    with pytest.raises(NeecoError, match=r"nowhere.yaml: no such file"):
        synthesize(run, tmp_path / "out", replace(SETTINGS, camera_effects=str(tmp_path / "nowhere.yaml")))  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()


@given(st.sets(st.sampled_from(sorted(EFFECTS))), st.integers(0, 2**32))
def test_a_value_depends_on_no_other_effects_range(names: set[str], seed: int) -> None:
    every = {name: Range(effect.lowest, effect.highest) for name, effect in EFFECTS.items()}
    whole = CameraEffects(every).draw(np.random.default_rng(seed))
    some = CameraEffects({name: every[name] for name in names}).draw(np.random.default_rng(seed))
    assert some == {name: whole[name] for name in some}
    assert set(some) == names
    assert all(EFFECTS[name].lowest <= value <= EFFECTS[name].highest for name, value in whole.items())


def test_an_effect_takes_its_share_of_the_images() -> None:
    effects = CameraEffects({"smoke": Range(0.1, 0.2, 0.25)})
    taken = sum("smoke" in effects.draw(np.random.default_rng(seed)) for seed in range(2000))
    assert 430 < taken < 570  # 3.6 standard deviations


def test_light_and_stored_image_are_inverse() -> None:
    image = np.linspace(0, 1, 300, dtype=np.float32).reshape(10, 10, 3)
    assert np.abs(linear_to_srgb(srgb_to_linear(image)) - image).max() < 16 * np.finfo(np.float32).eps  # two powers
    assert srgb_to_linear(np.float32([0.5]))[0] == pytest.approx(0.2140, abs=1e-4)  # IEC 61966-2-1


def test_without_effects_an_image_keeps_its_bits() -> None:
    image = np.random.default_rng(0).random((8, 8, 3), np.float32)
    assert apply_effects(image, np.zeros((8, 8)), {"shutter_s": 0.01}, np.random.default_rng(0)) is image


def test_exposure_and_white_balance_scale_light() -> None:
    brighter = through_effects(grey(0.3), exposure_stops=1.0, red_gain=1.5)
    assert srgb_to_linear(brighter)[0, 0] == pytest.approx(srgb_to_linear(grey(0.3))[0, 0] * [3.0, 2.0, 2.0], rel=1e-4)


def test_gamma_is_an_exponent_on_the_stored_image() -> None:
    assert through_effects(grey(0.25), gamma=2.0) == pytest.approx(0.0625, abs=1e-5)


def test_noise_has_the_deviation_asked_for() -> None:
    noisy = srgb_to_linear(through_effects(grey(0.5), read_noise=0.02)) - srgb_to_linear(grey(0.5))
    assert noisy.std() == pytest.approx(0.02, rel=0.05)
    bright = srgb_to_linear(through_effects(grey(0.9), shot_noise=0.02)) - srgb_to_linear(grey(0.9))
    assert bright.std() == pytest.approx(0.02 * np.sqrt(srgb_to_linear(grey(0.9))[0, 0, 0]), rel=0.05)
    assert np.array_equal(through_effects(grey(), read_noise=0.02), through_effects(grey(), read_noise=0.02))
    assert not np.array_equal(
        through_effects(grey(), read_noise=0.02), through_effects(grey(), seed=1, read_noise=0.02)
    )


def test_smoke_hides_what_is_far_more_than_what_is_near() -> None:
    near, far = (through_effects(grey(0.1), depth, smoke=0.4, smoke_grey=0.8) for depth in (30.0, 150.0))
    assert 0.1 < near.mean() < far.mean() < 0.8
    passes = 0.6**1.5
    expected = srgb_to_linear(grey(0.1)) * passes + srgb_to_linear(grey(0.8)) * (1 - passes)
    assert srgb_to_linear(far) == pytest.approx(expected, abs=1e-5)


def test_lens_blur_keeps_the_light_and_spreads_it() -> None:
    image = grey(0.0)
    image[24, 32] = 1.0
    light = srgb_to_linear(through_effects(image, lens_blur_px=1.5))[..., 0]
    assert light.sum() == pytest.approx(1.0, rel=0.02)
    rows = np.arange(48) - 24
    assert (light.sum(1) * rows**2).sum() / light.sum() == pytest.approx(1.5**2, rel=0.05)


def test_vignette_and_image_circle_darken_the_corners() -> None:
    assert srgb_to_linear(through_effects(grey(), vignette=0.5))[0, 0, 0] == pytest.approx(
        0.5 * srgb_to_linear(grey())[0, 0, 0], rel=0.05
    )
    shown = through_effects(grey(), field_of_view=0.6)
    assert shown[0, 0].max() == 0
    assert shown[24, 32, 0] == pytest.approx(0.5, abs=1e-4)
    assert image_circle(48, 64, 0.6).sum() == pytest.approx(np.pi * (0.6 * 40) ** 2, rel=0.02)


def test_jpeg_leaves_its_marks() -> None:
    image = grey() * np.linspace(0, 2, 64, dtype=np.float32)[None, :, None]
    good, bad = (np.abs(through_effects(image, jpeg_quality=quality) - image).mean() for quality in (100, 10))
    assert good < 0.005 < bad


def test_labels_are_cut_at_the_image_circle(run: FakeRun, tmp_path: Path) -> None:
    path = effects_file(tmp_path, "field_of_view: 0.5\n")
    synthesize(run, tmp_path / "set", replace(SETTINGS, camera_effects=path))  # type: ignore[arg-type]
    outside = image_circle(48, 64, 0.5) <= 0.5
    for index in range(4):
        for folder in ("masks", "parts", "soft"):
            with Image.open(tmp_path / f"set/{folder}/{index:06d}.png") as image:
                assert not np.array(image)[outside].any()
    record = json.loads((tmp_path / "set/states.jsonl").read_text().splitlines()[0])
    assert record["camera_effects"] == {"field_of_view": 0.5}


def test_labels_and_states_are_those_without_effects(run: FakeRun, tmp_path: Path) -> None:
    path = effects_file(tmp_path, "read_noise: 0.05\nlens_blur_px: [0.5, 2]\n")
    plain, changed = tmp_path / "plain", tmp_path / "changed"
    synthesize(run, plain, SETTINGS)  # type: ignore[arg-type]
    synthesize(run, changed, replace(SETTINGS, camera_effects=path))  # type: ignore[arg-type]
    for index in range(4):
        for folder, same in (("images", False), ("masks", True), ("soft", True), ("parts", True), ("depth", True)):
            name = f"{folder}/{index:06d}.png"
            assert ((plain / name).read_bytes() == (changed / name).read_bytes()) is same


def test_another_range_is_another_data_set(run: FakeRun, tmp_path: Path) -> None:
    path = effects_file(tmp_path, "gamma: 1.2\n")
    settings = replace(SETTINGS, count=1, camera_effects=path)
    synthesize(run, tmp_path / "set", settings)  # type: ignore[arg-type]
    effects_file(tmp_path, "gamma: 1.3\n")
    with pytest.raises(NeecoError, match=r"settings.camera_effects: begun with .*1\.2.*now .*1\.3"):
        synthesize(run, tmp_path / "set", settings, resume=True)  # type: ignore[arg-type]


def test_motion_goes_on_as_recorded(moving: GaussianScene) -> None:
    motion = RecordedMotion(moving.recorded)(rod_state(), np.random.default_rng(0))
    assert motion.instruments["rod"][3:] == pytest.approx([30.0, 0, 0], abs=1e-6)
    assert motion.joints["rod"]["jaw_angle"] == pytest.approx(0.5)
    assert motion.camera == pytest.approx(np.zeros(6), abs=1e-9)
    state, camera = motion.advanced(rod_state(x=2.0), CAMERA, 0.1)
    assert state.instruments["rod"].pose[0, 3].item() == pytest.approx(5.0)
    assert torch.equal(camera.world_from_camera, CAMERA.world_from_camera)


def test_a_recording_without_times_tells_of_no_motion(run: FakeRun, tmp_path: Path) -> None:
    path = effects_file(tmp_path, "shutter_s: 0.02\n")
    with pytest.raises(NeecoError, match=r"effects.yaml: shutter_s: no two recorded frames are close enough in time"):
        SampleGenerator.of(run.scene, replace(SETTINGS, camera_effects=path))


def test_mixed_instruments_and_camera_move_each_as_recorded(moving: GaussianScene) -> None:
    other = replace(
        moving.recorded,
        cameras=tuple(moved_camera(CAMERA, rigid(np.eye(3), np.array([0, 2.0 * k, 0]))) for k in range(12)),
        states=tuple(State({}, k / 25) for k in range(12)),
    )
    motion = RecordedMotion(other, [moving.recorded])
    assert motion.known
    drawn = motion(rod_state(), np.random.default_rng(0))
    assert drawn.instruments["rod"][3:] == pytest.approx([30.0, 0, 0], abs=1e-6)
    assert drawn.camera[3:] == pytest.approx([0, 50.0, 0], abs=1e-6)
    assert not RecordedMotion(other, [replace(moving.recorded, states=moving.recorded.states[:1])]).known


def test_an_exposure_is_drawn_as_often_as_its_motion_needs(moving: GaussianScene) -> None:
    drawing = draw_layers(moving, CompositedLabels(moving), rod_state(), CAMERA, 0.0)
    still = Motion({"rod": np.zeros(6)}, {"rod": {"jaw_angle": 0.0}}, np.zeros(6))
    fast = Motion({"rod": np.array([0, 0, 0, 5e5, 0, 0.0])}, {"rod": {"jaw_angle": 0.0}}, np.zeros(6))
    slow = Motion({"rod": np.array([0, 0, 0, 400.0, 0, 0])}, {"rod": {"jaw_angle": 0.0}}, np.zeros(6))
    counts = [len(subframes(moving, drawing, motion, 0.02)) for motion in (still, slow, fast)]
    assert counts[0] == 1
    assert counts[1] in (7, 9)  # 8 mm at 70 mm and 60 px: 6.9 px
    assert counts[2] <= camera_effects.CameraEffects.max_subframes


def blurred(scene: GaussianScene, state: State, motion: Motion, shutter_s: float, count: int) -> torch.Tensor:
    """The exposure drawn `count` times."""
    labeller = CompositedLabels(scene)
    times = ((np.arange(count) + 0.5) / count - 0.5) * shutter_s
    drawings = [draw_layers(scene, labeller, *motion.advanced(state, CAMERA, float(t)), 0.0) for t in times]
    return torch.from_numpy(average_exposure([drawing.image.numpy() for drawing in drawings]))


@pytest.mark.parametrize(("speed", "seen"), [(60.0, 0.06), (250.0, 0.2)])
def test_motion_blur_is_the_integral_over_the_exposure(speed, seen, moving, tmp_path):
    path = effects_file(tmp_path, "shutter_s: 0.05\nsoft_masks: mean\n")
    generator = SampleGenerator.of(moving, replace(SETTINGS, camera_effects=path))
    motion = Motion({"rod": np.array([0, 0, 0.5, speed, 0, 0])}, {"rod": {"jaw_angle": 2.0}}, np.zeros(6))
    generator = replace(generator, motion=lambda state, rng: motion)  # type: ignore[arg-type]
    sharp = draw_layers(moving, generator.labeller, rod_state(), CAMERA, 0.0)
    made = generator._through_camera(sharp, {"shutter_s": 0.05}, np.random.default_rng(0), Appearance())
    exact = blurred(moving, rod_state(), motion, 0.05, 64)
    assert float((made.image - exact).abs().max()) < 0.03
    assert float((sharp.image - exact).abs().max()) > seen
    assert torch.equal(made.parts, sharp.parts)  # of the middle of the exposure
    assert float((made.share - sharp.share).abs().max()) > seen
    assert float(made.share.sum()) == pytest.approx(float(sharp.share.sum()), rel=0.05)
    cut = generator._through_camera(
        sharp, {"shutter_s": 0.05, "field_of_view": 0.3}, np.random.default_rng(0), Appearance()
    )
    assert not bool(cut.share[torch.from_numpy(image_circle(48, 64, 0.3) <= 0.5)].any())
