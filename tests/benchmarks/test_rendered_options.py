"""What the rendered captures' switches say of themselves is so: sizes, detail, breathing, exposure, lens and video."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from neeco.capture import check_capture, errors_only, read_capture
from neeco.ingest.calibration.lens import read_lens
from neeco.ingest.readers.logs import read_pose_log
from neeco.ingest.recording.file import read_recording

WIDTH, HEIGHT, RESOLUTION = 64, 48, 240


@pytest.fixture(scope="module")
def world(benchmarks: ModuleType) -> dict:
    """A small stomach with its fine detail, and its motion."""
    from rendered.detail import make_detail
    from rendered.frames import Settings
    from rendered.motion import plan
    from rendered.render import Lens
    from rendered.scenes import SCENES

    spec = SCENES["stomach"]
    place = Settings(Lens(WIDTH, HEIGHT, 54.0), RESOLUTION).place(spec)
    trajectory = plan(spec.path, spec.design.hinge, 230, 45, spec.seed)
    return {
        "spec": spec,
        "place": place,
        "detail": make_detail("stomach", place.tissue, 1),
        "trajectory": trajectory,
        "moment": trajectory.at(0.5),
    }


@pytest.fixture(scope="module")
def capture(benchmarks: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six frames of breathing tissue behind a lens, with the recording."""
    from rendered.frames import Settings
    from rendered.render import Lens
    from rendered.scenes import SCENES
    from rendered.writing import write_recording

    path = tmp_path_factory.mktemp("options")
    settings = Settings(Lens(WIDTH, HEIGHT, 54.0), RESOLUTION, every=50, breathing_mm=3.0, optics=True, video=True)
    write_recording(SCENES["stomach"], path, settings, lambda line: None)
    return path


def pixels(path: Path) -> np.ndarray:
    return np.array(Image.open(path)).astype(float)


def test_the_usual_size_is_drawn_as_without_the_option(benchmarks: ModuleType) -> None:
    plain = benchmarks.parse(["stomach", "OUT"])
    assert benchmarks.parse(["stomach", "OUT", "--size", "320x256"]) == plain
    assert not plain[2].detail


def test_other_sizes_keep_the_vertical_field_of_view_and_have_detail(benchmarks: ModuleType) -> None:
    usual, large = (benchmarks.parse(["bowel", "OUT", "--size", size])[2] for size in ("320x256", "1920x1080"))
    assert large.detail
    assert large.lens.height / large.lens.focal == pytest.approx(usual.lens.height / usual.lens.focal)


@pytest.mark.parametrize("size", ["320", "0x0", "321x256", "-320x256", "320x256x3"])
def test_sizes_that_are_none_are_refused(benchmarks: ModuleType, size: str) -> None:
    with pytest.raises(SystemExit):
        benchmarks.parse(["bowel", "OUT", f"--size={size}"])


def test_the_detailed_renderer_sees_what_the_plain_one_sees(world: dict) -> None:
    from rendered.adaptive import draw_detailed
    from rendered.render import draw, view_of

    view = view_of(world["moment"])
    plain, detailed = draw(world["place"], view), draw_detailed(world["place"], world["detail"], view)
    same = plain.parts == detailed.parts
    assert same.float().mean() > 0.995
    assert (plain.depth - detailed.depth).abs()[same].quantile(0.99) < 0.05
    assert (plain.color.mean((0, 1)) - detailed.color.mean((0, 1))).abs().max() < 0.03


def test_a_part_covers_the_same_place_at_twice_the_size(world: dict) -> None:
    from rendered.adaptive import draw_detailed
    from rendered.render import Lens, view_of

    view = view_of(world["moment"])
    twice = replace(world["place"], lens=Lens(2 * WIDTH, 2 * HEIGHT, 108.0))
    small, large = (draw_detailed(place, world["detail"], view).parts for place in (world["place"], twice))
    tool = small > 0
    share = (large > 0).float().reshape(HEIGHT, 2, WIDTH, 2).mean((1, 3))
    assert tool.sum() > 100
    assert (tool & (share > 0.5)).sum() / (tool | (share > 0.5)).sum() > 0.9  # edges are many where pixels are few
    assert (tool == (share > 0.5))[(share == 0) | (share == 1)].float().mean() > 0.995


def test_detail_that_a_pixel_does_not_resolve_is_averaged(world: dict) -> None:
    fine = torch.linspace(0, 20, 4000)
    values = [
        world["detail"].tissue(world["place"].tissue, fine, fine, torch.full_like(fine, size)) for size in (0.02, 2)
    ]
    rough = [(value.normal[1:] - value.normal[:-1]).abs().mean() for value in values]
    assert rough[0] > 5 * rough[1]
    assert values[1].spread.mean() > 2 * values[0].spread.mean()  # what is lost widens highlights
    assert float(values[0].albedo.mean()) == pytest.approx(float(values[1].albedo.mean()), rel=0.05)


def test_tissue_breathes_as_the_truth_says(capture: Path, world: dict) -> None:
    truth = json.loads((capture / "truth" / "breathing.json").read_text())
    (mode,) = truth["modes"]
    assert mode["amplitude_mm"] == 3
    scene_from_world = np.linalg.inv(truth["world_from_scene"])
    y, x = (plane.ravel() for plane in np.mgrid[-40:40:40j, -40:40:40j])
    xy = (torch.from_numpy(axis).float() for axis in (x, y))
    rest = np.stack([x, y, world["place"].tissue.height_at(*xy).numpy()], -1)
    off = (rest[:, :2] - mode["center_mm"]) / mode["reach_mm"]
    weight = mode["still"] + (1 - mode["still"]) * np.exp(-(off**2).sum(-1))
    errors = {amplitude: [] for amplitude in (0.0, 2.0, 3.0, 4.0)}
    for frame in json.loads((capture / "truth" / "transforms.json").read_text())["frames"]:
        if "depth_file_path" not in frame:
            continue
        depth = pixels(capture / "truth" / frame["depth_file_path"]) * 0.05
        tissue = pixels(capture / "truth" / frame["part_mask_path"])[::2, ::2] == 0
        camera = np.linalg.inv(scene_from_world @ np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1]))
        share = np.sin(2 * np.pi * frame["time"] / mode["period_s"] + mode["phase_rad"])
        for amplitude, found in errors.items():
            moved = rest + amplitude * share * weight[:, None] * mode["direction"]
            u, v, z = (camera[:3, :3] @ moved.T + camera[:3, 3:]) * [[54], [54], [1]]
            # every second pixel's centre is stored, from the first
            column, row = (u / z + WIDTH / 2 - 0.5) / 2, (v / z + HEIGHT / 2 - 0.5) / 2
            inside = (column > 1) & (row > 1) & (column < WIDTH / 2 - 2) & (row < HEIGHT / 2 - 2)
            maps = (axis[inside].astype(np.float32)[None] for axis in (column, row))
            seen, free = (
                cv2.remap(plane.astype(np.float32), column_, row_, cv2.INTER_LINEAR)[0]
                for (column_, row_) in [tuple(maps)]
                for plane in (depth, tissue)
            )
            found.append(np.abs(seen - z[inside])[free == 1])
    means = {amplitude: np.median(np.concatenate(found)) for amplitude, found in errors.items()}
    assert min(means, key=means.__getitem__) == 3
    assert means[3.0] < 0.25 * means[0.0]


def test_exposure_states_what_it_multiplied_light_by(world: dict) -> None:
    from rendered.exposure import meter
    from rendered.render import draw, view_of

    recording = world["trajectory"]
    exposure = meter(world["place"], replace(recording, times=recording.times[::10][:6]))
    stated = exposure.describe([1, 5])
    assert np.abs(np.diff(np.log(exposure.gain))).max() < 0.05  # it changes smoothly
    assert np.ptp(exposure.gain) > 0.002
    for index, number in enumerate((1, 5)):
        view = view_of(recording.at(recording.times[10 * number]))
        fixed, exposed = (draw(world["place"], view, gain).color.numpy() for gain in (None, exposure.of(number)))
        dim = (fixed.max(-1) < 0.8) & (exposed.max(-1) < 0.8) & (fixed.min(-1) > 0.05)  # below the shoulder
        ratio = np.median((linear(exposed) / linear(fixed))[dim], 0)
        assert ratio == pytest.approx(stated["gain"][index] * np.array(stated["color_gain"][index]), rel=1e-3)


def linear(color: np.ndarray) -> np.ndarray:
    return ((color + 0.055) / 1.055) ** 2.4


def test_undistorted_raw_images_are_the_images(capture: Path) -> None:
    lens = read_lens(capture / "optics" / "calibration.yaml")
    assert lens is not None
    matrix = np.array([[54.0, 0, WIDTH / 2 - 0.5], [0, 54.0, HEIGHT / 2 - 0.5], [0, 0, 1]])
    maps = cv2.initUndistortRectifyMap(matrix, np.array(lens.distortion), None, matrix, (WIDTH, HEIGHT), cv2.CV_32FC1)
    frame = read_capture(capture).frames[2]
    assert frame.mask_path is not None
    visible = pixels(frame.mask_path) > 0
    assert 0.7 < visible.mean() < 0.99
    raw, image = pixels(capture / "raw" / frame.image_path.name), pixels(frame.image_path)
    off = np.abs(cv2.remap(raw, *maps, cv2.INTER_LINEAR) - image)[visible].mean()
    assert off < 0.5 * np.abs(raw - image)[visible].mean()
    assert raw[0, 0].mean() < 8  # the border is dark
    assert errors_only(check_capture(capture)) == []


def test_the_recording_holds_the_same_frames_and_states(capture: Path) -> None:
    recording = read_recording(capture / "recording" / "recording.yaml")
    truth = json.loads((capture / "truth" / "transforms.json").read_text())["frames"]
    unknown = json.loads((capture / "truth" / "recording.json").read_text())
    source = recording.source.open()
    assert len(source.times) == len(truth)
    log = read_pose_log(recording.instruments[0].poses)
    offset = unknown["clocks_s"]["em"]
    assert recording.sync["em"] == pytest.approx(offset, abs=0.01)
    for frame in truth:
        nearest = np.abs(log.times - frame["time"] - offset).argmin()
        shift = log.positions[nearest] - np.array(frame["instruments"][0]["pose"])[:3, 3]
        assert np.linalg.norm(shift) < 4


@pytest.mark.slow
def test_workers_write_the_same_bytes(benchmarks: ModuleType, tmp_path: Path) -> None:
    from rendered.frames import Settings
    from rendered.render import Lens
    from rendered.scenes import SCENES
    from rendered.writing import write_recording

    for workers in (1, 2):
        settings = Settings(Lens(WIDTH, HEIGHT, 54.0), RESOLUTION, every=50, detail=True, workers=workers)
        write_recording(SCENES["bowel"], tmp_path / str(workers), settings, lambda line: None)
    files = sorted(path.relative_to(tmp_path / "1") for path in (tmp_path / "1").rglob("*") if path.is_file())
    assert len(files) > 15
    assert all((tmp_path / "1" / file).read_bytes() == (tmp_path / "2" / file).read_bytes() for file in files)


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


def test_test_frames_lie_midway_between_training_frames_of_every_thinned_list(
    world: dict, benchmarks: ModuleType, tmp_path: Path
) -> None:
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
    write_recording(spec, tmp_path, settings, lambda line: None)
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


def test_another_processor_gives_other_pixels_of_the_same_frames_and_plates_lack_the_instrument(
    benchmarks: ModuleType, tmp_path: Path
) -> None:
    from rendered.frames import Settings
    from rendered.scenes import SCENES
    from rendered.writing import write_recording

    settings = benchmarks.parse(["stomach", "OUT", "--processor", "bright", "--plates"])[2]
    assert settings.lens.focal < Settings().lens.focal
    small = Settings(replace(settings.lens, width=WIDTH, height=HEIGHT, focal=54.0), RESOLUTION, every=100, plates=True)
    for name, processor in (("own", None), ("other", "bright")):
        write_recording(SCENES["stomach"], tmp_path / name, replace(small, processor=processor), lambda line: None)
    own, other = (pixels(tmp_path / name / "images/000000.jpg") for name in ("own", "other"))
    assert other.mean() > 1.15 * own.mean()
    masks = [(tmp_path / name / "truth/masks/000000.png").read_bytes() for name in ("own", "other")]
    assert masks[0] == masks[1]
    instrument = pixels(tmp_path / "own/truth/masks/000000.png") > 0
    change = np.abs(own - pixels(tmp_path / "own/plates/000000.jpg")).mean(2)
    assert change[instrument].mean() > 30
    assert np.median(change[~instrument]) < 4
