"""Size, lens and format of drawn images: everything in a data set agrees with them."""

from __future__ import annotations

import json
from copy import copy
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from image_files import read_image
from PIL import Image

import neeco
from neeco.base.errors import NeecoError
from neeco.capture.images import read_labels
from neeco.geometry.lens import Lens
from neeco.labels.annotation import annotate, draw_labelled
from neeco.labels.drawing import draw, draw_layers
from neeco.labels.labellers import CompositedLabels
from neeco.synthesis.dataset import synthesize
from neeco.synthesis.rendered_views import View, render
from neeco.synthesis.settings import ImageSettings, Settings, SizeSettings

SETTINGS = Settings(count=2, seed=3, tissue_tolerance_mm=2.0)
LENS = Lens(52.0, 52.0, 32.5, 23.5, (-0.3, 0.1, 0.001, -0.002), (64, 48), border=(32.0, 24.0, 30.0))
FORMATS = ("coco", "yolo", "webdataset", "imagefolder")


@pytest.fixture
def lens_scene(scene):
    """Its frames are what the lens's images are once they are undistorted."""
    pinhole = LENS.pinhole((64, 48))
    camera = pinhole.camera(np.eye(4))
    cameras = (camera,) * len(scene.recorded.cameras)
    scene = copy(scene)
    scene.recorded = replace(scene.recorded, lens=LENS, cameras=cameras)
    return scene


@pytest.mark.parametrize(
    ("size", "words"),
    [
        (SizeSettings(size="1280"), "--size: '1280' is not WIDTHxHEIGHT"),
        (SizeSettings(size="0x10"), "--size: '0x10'"),
        (SizeSettings(size="64x48", scale=2), "--size: given with --scale"),
        (SizeSettings(scale=0.0), "--scale must be a number above 0.*got 0.0"),
        (SizeSettings(scale=float("nan")), "--scale must be a number above 0.*got nan"),
        (SizeSettings(size="128x128"), "recorded 64x48; give 128x96 or 171x128"),
        (SizeSettings(size="64000x48000"), "--size: 64000x48000 is more than"),
        (SizeSettings(scale=1e30), "--scale: .* is more than"),
        (ImageSettings(quality=0), "--quality must be 1 to 100 .got 0."),
        (ImageSettings(quality=50), "--quality: applies to JPEG only, and images would be PNG"),
        (Settings(count=0), "--count: 0 is out of range"),
        (Settings(count=1, seed=-1), "--seed: -1 is out of range"),
        (Settings(count=1, max_attempts=0), "--max-attempts: 0 is out of range"),
    ],
)
def test_settings_that_make_no_sense_are_refused_by_name(size, words):
    with pytest.raises(NeecoError, match=words):
        (size.check(), size.of(64, 48))


def test_a_value_that_is_no_number_is_refused_by_the_name_of_its_option():
    with pytest.raises(NeecoError, match=r"--min-share: inf is not a finite number"):
        Settings.from_values("synthesize", count=1, min_share=float("inf"))


def test_a_size_keeps_the_shape_of_the_recorded_images():
    assert SizeSettings().of(64, 48) == (64, 48)
    assert SizeSettings(scale=0.5).of(64, 48) == (32, 24)
    assert SizeSettings(size="1920X1440").of(64, 48) == (1920, 1440)
    assert SizeSettings(size="101x76").of(64, 48) == (101, 76)  # to the pixel


def test_everything_in_a_data_set_agrees_with_its_size_and_format(run, tmp_path):
    output = tmp_path / "dataset"
    settings = replace(SETTINGS, scale=2.0, image_format="jpg")
    synthesize(run, output, settings, FORMATS)
    for folder in ("masks", "soft", "ignore", "parts", "depth", "silhouettes"):
        with Image.open(output / folder / "000001.png") as image:
            assert image.size == (128, 96)
    records = [json.loads(line) for line in (output / "states.jsonl").read_text().splitlines()]
    assert [record["image"] for record in records] == ["images/000000.jpg", "images/000001.jpg"]
    assert records[0]["intrinsics"]["fl_x"] == 2 * run.scene.recorded.cameras[0].fx
    parts = cv2.imread(str(output / "parts/000000.png"), cv2.IMREAD_UNCHANGED)
    assert parts is not None
    x, y, width, height = cv2.boundingRect((parts > 0).astype(np.uint8))
    assert records[0]["labels"][0]["box"] == [x, y, width, height]
    coco = json.loads((output / "coco/instances.json").read_text())["images"][0]
    assert (coco["file_name"], coco["width"], coco["height"]) == ("000000.jpg", 128, 96)
    assert (output / "yolo/images/train/000000.jpg").is_file()
    line = (output / "yolo/labels/train/000000.txt").read_text().split()
    assert float(line[3]) == pytest.approx(width / 128, abs=1e-5)
    assert (
        json.loads((output / "imagefolder/train/metadata.jsonl").read_text().splitlines()[0])["file_name"]
        == "000000.jpg"
    )
    assert "--size 128x96 --image-format jpg" in (output / "README.md").read_text()
    assert "images/*.jpg" not in (output / "README.md").read_text()  # imagefolder comes first
    drawn = neeco.LabelledImages(run.scene, 2, seed=3, scale=2.0, tissue_tolerance_mm=2.0)[0]
    stored = read_image(output / "images/000000.jpg")
    assert stored.shape == (96, 128, 3)
    assert float((stored.permute(2, 0, 1) - drawn["image"]).abs().mean()) < 0.02
    assert torch.equal(read_labels(output / "parts/000000.png"), drawn["parts"])
    for other in ({"scale": None}, {"scale": 3.0}, {"image_format": "png"}, {"quality": 50}):
        with pytest.raises(NeecoError, match=r"settings\.(size|quality): begun with"):
            synthesize(run, output, replace(settings, **other), FORMATS, resume=True)
    same = replace(settings, scale=None, size="128x96", count=3)
    assert synthesize(run, output, same, FORMATS, resume=True).made_now == 1


def test_what_is_drawn_through_the_lens_is_the_undistorted_drawing_once_it_is_undistorted(lens_scene, state):
    """At four times the size, so that edges are no more than a few pixels of many."""
    pinhole = lens_scene.recorded.cameras[0].resized(256, 192)
    bent = LENS.distorted_camera(lens_scene.recorded.cameras[0]).resized(256, 192)
    lens = Lens.of(bent)
    labeller = CompositedLabels(lens_scene)
    straight, drawn = (draw_layers(lens_scene, labeller, state(y=8.0), camera, 0.01) for camera in (pinhole, bent))
    shown = lens.undistort_mask(drawn.depth > 0)
    shown = cv2.erode(shown.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert shown.mean() > 0.5
    pixels = lens.undistort((drawn.image.numpy() * 255).round().astype(np.uint8)) / 255.0
    error = np.square(pixels - straight.image.numpy())[shown].mean()
    assert -10 * np.log10(error) > 38
    parts = cv2.remap(drawn.parts.numpy(), *_maps_of(lens), cv2.INTER_NEAREST)
    assert (parts != straight.parts.numpy())[shown].mean() < 0.01
    assert np.abs(cv2.remap(drawn.depth, *_maps_of(lens), cv2.INTER_NEAREST) - straight.depth)[shown].mean() < 0.5
    (label,), (bent_label,) = (annotate(lens_scene, item, labeller.names) for item in (straight, drawn))
    assert bent_label.shape.area == int((drawn.parts > 0).sum())
    for name, point in bent_label.keypoints.items():
        if point.visibility:
            ray = (np.array(label.keypoints[name][:2]) - [pinhole.cx, pinhole.cy]) / [pinhole.fx, pinhole.fy]
            matrix = np.array([[bent.fx, 0, bent.cx], [0, bent.fy, bent.cy], [0, 0, 1]])
            expected = cv2.projectPoints(
                np.append(ray, 1.0)[None], np.zeros(3), np.zeros(3), matrix, np.array(LENS.distortion)
            )
            assert np.allclose(expected[0].ravel(), point[:2], atol=0.1)


def _maps_of(lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = np.indices(lens.size[::-1], np.float32)
    return lens.undistort(columns), lens.undistort(rows)


def test_a_data_set_drawn_through_the_lens_says_so(lens_scene, run, tmp_path):
    output, run = tmp_path / "dataset", replace(run, scene=lens_scene)
    synthesize(run, output, replace(SETTINGS, lens=True), ("coco",))
    assert json.loads((output / "states.jsonl").read_text().splitlines()[0])["intrinsics"] == LENS.intrinsics_json()
    planes = {name: read_labels(output / name / "000000.png") for name in ("parts", "masks")}
    rows, columns = np.mgrid[0:48, 0:64] + 0.5
    outside = torch.from_numpy(np.hypot(columns - 32, rows - 24) > 30)
    assert (read_image(output / "images/000000.png")[outside] == 0).all()
    assert all((plane[outside] == 0).all() for plane in planes.values())
    assert (np.asarray(Image.open(output / "depth/000000.png"))[outside] == 0).all()
    assert "--lens" in (output / "README.md").read_text()
    with pytest.raises(NeecoError, match=r"--formats: bop cannot store distorted images"):
        synthesize(run, tmp_path / "bop", replace(SETTINGS, lens=True), ("bop",))


def test_a_recording_without_a_lens_is_drawn_through_none(run, tmp_path):
    with pytest.raises(NeecoError, match="--lens: the scene's capture states no lens"):
        synthesize(run, tmp_path / "dataset", replace(SETTINGS, lens=True))


def test_render_draws_at_any_size_and_format(scene, state, camera, tmp_path):
    render(scene, [View("a", state(), camera)], tmp_path, images=ImageSettings(scale=0.5, image_format="jpg"))
    assert {path.name for path in tmp_path.iterdir()} == {"a.jpg", "a_parts.png", "a_mask.png", "parts.json"}
    with Image.open(tmp_path / "a.jpg") as image:
        assert image.size == (32, 24)


def test_a_scene_draws_any_size_from_python(scene, state, camera):
    large = draw_labelled(scene, state(), camera.resized(128, 96))
    assert large.image.shape == (96, 128, 3)
    box, larger = draw_labelled(scene, state(), camera).boxes[0], large.boxes[0]
    assert torch.allclose(larger, 2 * box, atol=2.0)
    assert torch.equal(large.image, draw(scene, state(), camera.resized(128, 96)).image)
