"""A lens is the same from whichever file, and straight lines are straight once it is taken out."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from neeco.base.errors import NeecoError
from neeco.geometry.lens import Lens
from neeco.ingest.calibration.lens import read_lens

OPENCV = """%YAML:1.0
---
image_width: 320
image_height: 240
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 300.5, 0., 159.5, 0., 301.5, 119.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -0.3, 0.1, 0.001, -0.002, 0. ]
"""
FISHEYE = {
    "camera_model": "OPENCV_FISHEYE", "w": 640, "h": 480, "fl_x": 330, "fl_y": 335, "cx": 322, "cy": 241,
    "k1": -0.02, "k2": 0.01, "k3": -0.004, "k4": 0.0007,
}  # fmt: skip
ROS = """image_width: 320
image_height: 240
distortion_model: plumb_bob
camera_matrix: {rows: 3, cols: 3, data: [300.5, 0, 159.5, 0, 301.5, 119.5, 0, 0, 1]}
distortion_coefficients: {rows: 1, cols: 5, data: [-0.3, 0.1, 0.001, -0.002, 0.0]}
"""
LENS = Lens(300.5, 301.5, 160.0, 120.0, (-0.3, 0.1, 0.001, -0.002, 0.0), (320, 240))


def test_the_same_lens_from_opencv_ros_and_nerfstudio(world):
    nerfstudio = {"fl_x": 300.5, "fl_y": 301.5, "cx": 160, "cy": 120, "w": 320, "h": 240}
    nerfstudio |= {"k1": -0.3, "k2": 0.1, "p1": 0.001, "p2": -0.002}
    assert read_lens(world.text(OPENCV, "opencv.yaml")) == LENS
    assert read_lens(world.text(ROS, "ros.yaml")) == LENS
    assert read_lens(world.text(json.dumps(nerfstudio), "transforms.json")) == LENS


XML = """<opencv_storage>
<image_width>320</image_width><image_height>240</image_height>
<camera_matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
<data>300.5 0. 159.5 0. 301.5 119.5 0. 0. 1.</data></camera_matrix>
<distortion_coefficients type_id="opencv-matrix"><rows>1</rows><cols>5</cols><dt>d</dt>
<data>-0.3 0.1 1e-3 -2e-3 0.</data></distortion_coefficients>
</opencv_storage>
"""
ORB = "\n".join(
    f"Camera.{name}: {value}"
    for name, value in zip(
        ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "width", "height"),
        ("300.5", "301.5", "159.5", "119.5", "-.3", ".1", "1e-3", "-2e-3", "0", "320", "240"),
        strict=True,
    )
)
KALIBR = """cam0:
  camera_model: pinhole
  distortion_coeffs: [-.3, .1, 1e-3, -2.0e-3, 0]
  distortion_model: radtan
  intrinsics: [300.5, 301.5, 159.5, 119.5]
  resolution: [320, 240]
  rostopic: /left
"""
EUROC = """sensor_type: camera
resolution: [320, 240]
camera_model: pinhole
intrinsics: [300.5, 301.5, 159.5, 119.5] # fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.3, 0.1, 0.001, -0.002, 0.0]
"""
CAMODOCAL = """%YAML:1.0
---
model_type: PINHOLE
image_width: 320
image_height: 240
distortion_parameters:
   {k1: -0.3, k2: 0.1, p1: 0.001, p2: -0.002, k3: 0.}
projection_parameters: {fx: 300.5, fy: 301.5, cx: 159.5, cy: 119.5}
"""
DIALECT = OPENCV.replace("data: [", "data:[") + "File.outputdir: %PATH\nViewer.PointSize:2\n"  # which only OpenCV reads
SIDES = "".join(
    f"{side}.{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data:[{numbers}]\n"
    for side, shift in (("LEFT", 0), ("RIGHT", 60))
    for name, rows, columns, numbers in (
        ("K", 3, 3, f"300.5, 0., {159.5 + shift}, 0., 301.5, 119.5, 0., 0., 1."),
        ("D", 1, 5, "-0.3, 0.1, 0.001, -0.002, 0."),
    )
)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("dialect.yaml", DIALECT),
        ("opencv.xml", XML),
        ("opencv.xml", f'<?xml version="1.0"?>\n{XML}'),
        ("orb.yaml", ORB),
        ("orb.yaml", "%YAML:1.0\nViewer.PointSize:2\n" + ORB),
        ("orb3.yaml", ORB.replace("ra.", "ra1.").replace("ra1.w", "ra.w").replace("ra1.h", "ra.h")),
        ("stella.yaml", "Camera:\n" + ORB.replace("Camera.", "  ").replace("width", "cols").replace("height", "rows")),
        ("camchain.yaml", KALIBR),
        ("sensor.yaml", EUROC),
        ("camodocal.yaml", CAMODOCAL),
        ("both.yaml", "%YAML:1.0\nCamera.fx: 1.0\nLEFT.width: 320\nLEFT.height: 240\n" + SIDES),
        ("message.yaml", ROS + "---\n"),
        ("hand.yaml", "mtx: [[300.5, 0, 159.5], [0, 301.5, 119.5], [0, 0, 1]]\ndist: [[-.3, .1, 1e-3, -2e-3, 0]]\n"
         "image_size: [320, 240]"),
        ("opencv.json", json.dumps({"camera_matrix": {"type_id": "opencv-matrix", "rows": 3, "cols": 3, "data":
         [300.5, 0, 159.5, 0, 301.5, 119.5, 0, 0, 1]}, "image_width": 320, "image_height": 240,
         "distortion_coefficients": {"data": [-0.3, 0.1, 0.001, -0.002, 0]}})),
    ],
)  # fmt: skip
def test_the_same_lens_from_every_calibrator(world, name, text):
    assert read_lens(world.text(text, name)) == LENS


def test_a_fisheye_lens_of_kalibr_and_of_camodocal(world):
    kalibr = KALIBR.replace("radtan", "equidistant").replace("[-.3, .1, 1e-3, -2.0e-3, 0]", "[-.02, .01, -4e-3, 7e-4]")
    camodocal = """%YAML:1.0
model_type: KANNALA_BRANDT
image_width: 320
image_height: 240
projection_parameters: {k2: -0.02, k3: 0.01, k4: -0.004, k5: 0.0007, mu: 300.5, mv: 301.5, u0: 159.5, v0: 119.5}
"""
    lens = read_lens(world.text(kalibr, "kalibr.yaml"))
    assert len(lens.distortion) == 8
    assert read_lens(world.text(camodocal, "camodocal.yaml")) == lens


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("K.txt", "300.5 0 159.5\n0 301.5 119.5\n0 0 1\n"),
        ("K.csv", "300.5,0,159.5\n0,301.5,119.5\n0,0,1"),
        ("K.json", "[[300.5, 0, 159.5], [0, 301.5, 119.5], [0, 0, 1]]"),
        ("K.yaml", "[300.5, 0, 159.5, 0, 301.5, 119.5, 0, 0, 1]"),
        ("K.txt", "3.005e2 0.0e0 1.595e2\n0.0e0 3.015e2 1.195e2\n0 0 1.0e0"),
    ],
)
def test_nine_numbers_are_a_camera_matrix(world, name, text):
    assert read_lens(world.text(text, name)) == Lens(300.5, 301.5, 160.0, 120.0)


SCARAMUZZA = '{"width": 640, "height": 480, "cx": 320, "cy": 240, "a0": 300, "a1": 0, "a2": -0.001, "c": 1, "d": 0}'


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.yaml", "x: [1, 2", "line 1: not valid YAML"),
        ("a.yaml", "%YAML:1.0\n---\nCamera.fx: 1\nCamera.fx: 300\n", "Camera.fx"),
        ("a.yaml", "<?xml version='1.0'?>", "is XML"),
        ("a.yaml", "video: a.mp4\nintrinsics: [300, 300, 160, 120]", "camera_matrix: missing"),
        ("a.xml", "<opencv_storage><camera_matrix></opencv_storage>", "is XML that OpenCV cannot read"),
        ("a.yaml", "%YAML:1.0\na:" + "[" * 100_000, "no keys; expected camera_matrix"),
        ("a.xml", "<?xml version='1.0'?><opencv_storage>" + "<a>" * 100_000, "is XML that OpenCV cannot read"),
        ("a.yaml", KALIBR.replace("pinhole", "omni"), "omni: this lens model is not supported"),
        *((name, SCARAMUZZA, "omnidirectional .*; undistort the images first") for name in ("a.json", "a.yaml")),
        ("a.yaml", "K: [300, 0, 0, 0, 300, 0, 160, 120, 1]", "camera_matrix: stands column by column"),
        ("a.yaml", OPENCV.replace("300.5", "-300.5"), "two positive focal lengths"),
        ("a.yaml", OPENCV.replace("0.1, 0.001, ", ""), "has 3 coefficients"),
        ("a.yaml", OPENCV.replace("-0.3", ".nan"), "nan is not a usable number"),
        ("a.yaml", OPENCV.replace("300.5", "wide"), "'wide' is not a usable number"),
        ("a.yaml", ROS.replace("plumb_bob", "equidistant"), "a fisheye lens has 4 coefficients, not 5"),
        ("a.json", "{}", "fl_x: missing"),
        *(("a.json", text, "expected an object with fl_x") for text in ("null", "[null]")),
        *(("a.yaml", text, "no keys; expected") for text in ("3", "[]")),
        ("a.txt", "300 0 160\n0 300 120\n0 0 2", "no keys; expected camera_matrix"),
        ("a.json", '{"fl_x": "x", "cx": 1, "cy": 1}', "'x' is not a usable number"),
        ("a.json", json.dumps(FISHEYE | {"fl_x": 90, "fl_y": 90}), "covers more than 80 degrees from its axis"),
        ("a.json", json.dumps(FISHEYE | {"k1": -0.9}), "or is not monotonic"),
        ("a.yaml", "!!python/object/apply:os.system [ls]", "not valid YAML"),
    ],
)
def test_calibrations_that_are_none(world, name, text, message):
    with pytest.raises(NeecoError, match=rf"{name}: .*{message}") as caught:
        read_lens(world.text(text, name))
    assert "\n" not in str(caught.value)


def test_a_fisheye_lens_bends_as_opencv_says(world):
    lens = read_lens(world.text(json.dumps(FISHEYE), "fisheye.json"))
    rays = np.random.default_rng(0).uniform((-1.4, -0.9), (1.4, 0.9), (200, 2))  # to 59 degrees off the axis
    coefficients = np.array([FISHEYE[key] for key in ("k1", "k2", "k3", "k4")])
    true = cv2.fisheye.distortPoints(rays[:, None], lens._matrix(), coefficients)[:, 0]
    points = np.column_stack([rays, np.ones(200)])
    bent, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens._matrix(), np.array(lens.distortion))
    assert np.abs(bent[:, 0] - true).max() < 0.01  # px
    lens.pinhole((640, 480))  # and nothing folds


def test_a_lens_of_another_video_is_refused():
    with pytest.raises(NeecoError, match=r"lens\.yaml: calibrated on 320x240 images, the video is 640x480"):
        LENS.check_size((640, 480), "lens.yaml")
    with pytest.raises(NeecoError, match="principal point"):
        Lens(300, 300, 900, 100).check_size((320, 240), "--intrinsics")


def test_undistorting_moves_points_to_where_the_pinhole_sees_them():
    points = np.array([[-40.0, -30, 100], [35, 25, 100], [0, 20, 100], [30, -28, 100]])
    camera = LENS._matrix()
    seen, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera, np.array(LENS.distortion))
    image = np.zeros((240, 320, 3), dtype=np.uint8)
    for x, y in seen.reshape(-1, 2):
        cv2.circle(image, (round(float(x) * 16), round(float(y) * 16)), 4 * 16, (255, 255, 255), -1, cv2.LINE_AA, 4)
    straight = LENS.undistort(image)
    pinhole = LENS.pinhole((320, 240))
    assert pinhole.distortion == ()
    rows, columns = np.indices((240, 320)) + 0.5
    for x, y, z in points:
        u, v = pinhole.fl_x * x / z + pinhole.cx, pinhole.fl_y * y / z + pinhole.cy
        near = straight[..., 0] * (np.hypot(columns - u, rows - v) < 8.0)
        found = np.array([(columns * near).sum(), (rows * near).sum()]) / near.sum()
        np.testing.assert_allclose(found, [u, v], atol=0.3)


def test_distortion_that_folds_the_image_is_refused():
    with pytest.raises(NeecoError, match="folds the image over"):
        Lens(300, 300, 160, 120, (-9.0, -40.0, 0.0, 0.0)).pinhole((320, 240))
