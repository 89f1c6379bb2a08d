"""What the rendered captures' switches say of themselves is so: sizes, exposure, frames and errors."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from neeco.capture import read_capture

WIDTH, HEIGHT, RESOLUTION = 64, 48, 240


@pytest.fixture(scope="module")
def world(benchmarks: ModuleType) -> dict:
    """A small stomach and its motion."""
    from rendered.frames import Settings
    from rendered.motion import plan
    from rendered.render import Lens
    from rendered.scenes import SCENES

    spec = SCENES["stomach"]
    place = Settings(Lens(WIDTH, HEIGHT, 54.0), RESOLUTION).place(spec)
    trajectory = plan(spec.path, spec.design.hinge, 230, 45, spec.seed)
    return {"spec": spec, "place": place, "trajectory": trajectory}


def test_other_sizes_keep_the_vertical_field_of_view(benchmarks: ModuleType) -> None:
    usual, large = (benchmarks.parse(["bowel", "OUT", "--size", size])[2] for size in ("320x256", "1920x1080"))
    assert large.lens.height / large.lens.focal == pytest.approx(usual.lens.height / usual.lens.focal)


@pytest.mark.parametrize("size", ["320", "0x0", "321x256", "-320x256", "320x256x3"])
def test_sizes_that_are_none_are_refused(benchmarks: ModuleType, size: str) -> None:
    with pytest.raises(SystemExit):
        benchmarks.parse(["bowel", "OUT", f"--size={size}"])


def test_exposure_multiplies_light_by_what_it_says(world: dict) -> None:
    from rendered.exposure import meter
    from rendered.render import draw, view_of

    recording = world["trajectory"]
    exposure = meter(world["place"], replace(recording, times=recording.times[::10][:6]))
    assert np.abs(np.diff(np.log(exposure.gain))).max() < 0.05  # it changes smoothly
    assert np.ptp(exposure.gain) > 0.002
    for number in (1, 5):
        view = view_of(recording.at(recording.times[10 * number]))
        fixed, exposed = (draw(world["place"], view, gain).color.numpy() for gain in (None, exposure.of(number)))
        dim = (fixed.max(-1) < 0.8) & (exposed.max(-1) < 0.8) & (fixed.min(-1) > 0.05)  # below the shoulder
        ratio = np.median((linear(exposed) / linear(fixed))[dim], 0)
        assert ratio == pytest.approx(np.array(exposure.of(number)), rel=1e-3)


def linear(color: np.ndarray) -> np.ndarray:
    return ((color + 0.055) / 1.055) ** 2.4


def test_slowed_recordings_share_the_states_of_what_they_are_multiples_of(world: dict) -> None:
    from rendered.frames import take_shots
    from rendered.motion import slowed

    few, many = (take_shots(slowed(world["trajectory"], frames), world["spec"]) for frames in (54, 108))
    train = [[shot.moment for shot in shots if shot.split == "train"] for shots in (few, many)]
    assert [len(moments) for moments in train] == [54, 108]
    for one, same in zip(train[0], train[1][::2], strict=True):
        assert np.allclose(one.scene_from_mechanical, same.scene_from_mechanical, rtol=0, atol=1e-9)
        assert np.allclose(one.scene_from_camera, same.scene_from_camera, rtol=0, atol=1e-9)
        assert one.opening == pytest.approx(same.opening, abs=1e-9)
    seen, planned = (
        [shot.moment.hinge for shot in shots if shot.split == "unseen"]
        for shots in (few, take_shots(world["trajectory"], world["spec"]))
    )
    assert np.allclose(seen, planned, rtol=0, atol=1e-9)


def test_a_slowed_recording_ends_where_the_planned_one_does(world: dict) -> None:
    from rendered.motion import slowed

    planned, slow = world["trajectory"], slowed(world["trajectory"], 108)
    last, slow_last = (path.times[path.splits.index("unseen") - 1] for path in (planned, slow))
    assert slow_last / slow.slower == pytest.approx(last * 107 / 108)
    assert slow.at(slow_last).opening == pytest.approx(planned.at(last * 107 / 108).opening)


def test_test_frames_lie_midway_between_training_frames_of_every_thinned_list(world, benchmarks, tmp_path):
    from rendered.motion import slowed
    from rendered.writing import write_thinned

    slow = slowed(world["trajectory"], 108)
    frames = [
        {"file_path": f"images/{number:06d}.jpg", "split": split, "time": float(time)}
        for number, (time, split) in enumerate(zip(slow.times, slow.splits, strict=True))
    ]
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    write_thinned(tmp_path)
    for kept in (108, 36, 12, 4):
        name = "transforms.json" if kept == 108 else f"transforms-{kept}.json"
        listed = json.loads((tmp_path / name).read_text())["frames"]
        times = {split: [frame["time"] for frame in listed if frame["split"] == split] for split in slow.splits}
        assert [len(times[split]) for split in ("train", "test", "unseen")] == [kept, 3, 45]
        train = np.array(times["train"])
        for time in times["test"]:
            after = np.searchsorted(train, time)
            assert (train[after - 1] + train[after]) / 2 == pytest.approx(time)


def test_an_exact_capture_has_no_errors(benchmarks: ModuleType, tmp_path: Path) -> None:
    from rendered.render import Lens
    from rendered.writing import write_recording

    spec, _, settings = benchmarks.parse(["bowel", "OUT", "--exact", "--every", "90"])
    settings = replace(settings, lens=Lens(WIDTH, HEIGHT, 54.0), resolution=RESOLUTION)
    write_recording(spec, tmp_path, settings)
    given, true = read_capture(tmp_path), json.loads((tmp_path / "truth" / "transforms.json").read_text())
    for frame, exact in zip(given.frames, true["frames"], strict=True):
        state = frame.state.instruments["scissors"]
        assert np.allclose(state.pose, exact["instruments"][0]["pose"], rtol=0, atol=1e-6)
        assert state.joints["jaw_angle"] == pytest.approx(exact["instruments"][0]["joints"]["jaw_angle"], abs=2e-6)
        camera = np.array(exact["transform_matrix"]) @ np.diag([1, -1, -1, 1])
        assert np.allclose(frame.camera.world_from_camera, camera, rtol=0, atol=1e-3)


@pytest.mark.parametrize("options", ["--frames 100", "--frames 27", "--frames 54 --video", "--frames 54 --every 2"])
def test_what_cannot_be_slowed_is_refused(benchmarks: ModuleType, options: str) -> None:
    with pytest.raises(SystemExit):
        benchmarks.parse(["bowel", "OUT", *options.split()])
    with pytest.raises(SystemExit):
        benchmarks.parse(["bowel-wristed", "OUT", "--exact"])
