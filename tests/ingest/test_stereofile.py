"""A stereo rig is the same from whichever file; what could be read in two ways is refused in one line."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import yaml
from damaged_files import refusals
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.ingest.calibration.stereo import read_stereo

SIZE = (640, 480)
LEFT = np.array([[701.5, 0, 321.25], [0, 702.5, 243.5], [0, 0, 1]])
RIGHT = np.array([[698.0, 0, 310.0], [0, 699.0, 238.75], [0, 0, 1]])
LEFT_BENDS = np.array([-0.21, 0.09, 0.001, -0.002, 0.01])
RIGHT_BENDS = np.array([-0.2, 0.08, -0.001, 0.002, 0.02])
TURN = Rotation.from_rotvec([0.01, -0.03, 0.02])
SHIFT = np.array([-4.3, 0.06, 0.11])  # mm


def as_rows(matrix):
    return np.asarray(matrix, dtype=float).tolist()


def opencv_yaml(folder, scale=1.0, name="stereo.yaml"):
    """As OpenCV's own writer puts it."""
    path = folder / name
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", SIZE[0])
    storage.write("image_height", SIZE[1])
    pairs = {"M1": LEFT, "D1": LEFT_BENDS, "M2": RIGHT, "D2": RIGHT_BENDS, "R": TURN.as_matrix(), "T": scale * SHIFT}
    for name, value in pairs.items():
        storage.write(name, value)
    storage.release()
    return path


def opencv_two_files(folder):
    """As OpenCV's sample of stereo calibration saves them."""
    whole = opencv_yaml(folder).read_text(encoding="utf-8")
    head, tail = whole.split("R: ")
    (folder / "intrinsics.yml").write_text(head, encoding="utf-8")
    (folder / "extrinsics.yml").write_text("%YAML:1.0\n---\nR: " + tail, encoding="utf-8")
    return folder / "intrinsics.yml"


def ini(folder, **changes):
    lines = []
    for side, matrix, bends, turn, shift in (
        ("StereoLeft", LEFT, LEFT_BENDS, np.eye(3), np.zeros(3)),
        ("StereoRight", RIGHT, RIGHT_BENDS, TURN.as_matrix(), SHIFT),
    ):
        values = {"res_x": SIZE[0], "res_y": SIZE[1], "fc_x": matrix[0, 0], "fc_y": matrix[1, 1]}
        values |= {"cc_x": matrix[0, 2], "cc_y": matrix[1, 2]}
        values |= {f"kc_{i}": value for i, value in enumerate([*bends, 0, 0, 0])}
        values |= {f"R_{i}": value for i, value in enumerate(turn.ravel())}
        values |= {f"T_{i}": value for i, value in enumerate(shift)}
        values |= changes if side == "StereoRight" else {}
        lines += [f"[{side}]", *(f"{name}={value}" for name, value in values.items())]
    path = folder / "StereoCalibrationDVRK.ini"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def scared_json(folder):
    values = {"KL": LEFT, "KR": RIGHT, "DL": [LEFT_BENDS], "DR": [RIGHT_BENDS], "R": TURN.as_matrix()}
    calibration = {name: as_rows(value) for name, value in values.items()} | {"T": as_rows(SHIFT[:, None])}
    calibration |= {"width": SIZE[0], "height": SIZE[1]}
    path = folder / "frame_data000000.json"
    path.write_text(json.dumps({"camera-calibration": calibration, "timestamp": 1}), encoding="utf-8")
    return path


def ros_pair(folder):
    """As ROS's stereo calibrator saves it, in metres; rectified by OpenCV."""
    rectified = cv2.stereoRectify(
        LEFT,
        LEFT_BENDS,
        RIGHT,
        RIGHT_BENDS,
        SIZE,
        TURN.as_matrix(),
        SHIFT[:, None] / 1000,
        flags=cv2.CALIB_ZERO_DISPARITY,
    )
    for side, matrix, bends, turn, projection in (
        ("left", LEFT, LEFT_BENDS, rectified[0], rectified[2]),
        ("right", RIGHT, RIGHT_BENDS, rectified[1], rectified[3]),
    ):
        document = {"image_width": SIZE[0], "image_height": SIZE[1], "distortion_model": "plumb_bob"}
        for name, value in (
            ("camera_matrix", matrix),
            ("distortion_coefficients", bends[None]),
            ("rectification_matrix", turn),
            ("projection_matrix", projection),
        ):
            document[name] = dict(rows=len(value), cols=len(value[0]), data=np.ravel(value).tolist())
        (folder / f"{side}.yaml").write_text(yaml.safe_dump(document), encoding="utf-8")
    return folder


def ros_left_file(folder):
    return ros_pair(folder) / "left.yaml"


def opencv_xml(folder):
    return opencv_yaml(folder, name="stereo.xml")


def kalibr(folder):
    """A camchain, in metres; two decimals of its rotation would not do."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = TURN.as_matrix(), SHIFT / 1000
    chain = {}
    for name, matrix, bends in (("cam0", LEFT, LEFT_BENDS), ("cam1", RIGHT, RIGHT_BENDS)):
        intrinsics = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]
        chain[name] = {"camera_model": "pinhole", "distortion_model": "radtan", "resolution": list(SIZE)}
        chain[name] |= {"intrinsics": list(map(float, intrinsics)), "distortion_coeffs": bends.tolist()}
    chain["cam1"]["T_cn_cnm1"] = pose.tolist()
    path = folder / "camchain.yaml"
    path.write_text(yaml.safe_dump(chain), encoding="utf-8")
    return path


def orb_slam(folder):
    """Its settings of a pair that it rectifies: what ROS's two files say, under LEFT and RIGHT."""
    document = {"Camera.fx": 700.0, "Camera.bf": 3.0}
    names = {
        "camera_matrix": "K",
        "distortion_coefficients": "D",
        "rectification_matrix": "R",
        "projection_matrix": "P",
    }
    for side in ("left", "right"):
        held = yaml.safe_load((ros_pair(folder) / f"{side}.yaml").read_text(encoding="utf-8"))
        document |= {f"{side.upper()}.{short}": held[name] for name, short in names.items()}
        document |= {f"{side.upper()}.width": SIZE[0], f"{side.upper()}.height": SIZE[1]}
    path = folder / "settings.yaml"
    path.write_text("%YAML:1.0\n" + yaml.safe_dump(document), encoding="utf-8")
    return path


def orb_slam_3(folder):
    """Stereo.T_c1_c2 maps points of the second camera to the first."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = TURN.as_matrix(), SHIFT / 1000
    document = {"Camera.type": "PinHole", "Camera.width": SIZE[0], "Camera.height": SIZE[1]}
    for number, matrix, bends in ((1, LEFT, LEFT_BENDS), (2, RIGHT, RIGHT_BENDS)):
        values = dict(fx=matrix[0, 0], fy=matrix[1, 1], cx=matrix[0, 2], cy=matrix[1, 2])
        values |= dict(zip(("k1", "k2", "p1", "p2", "k3"), bends, strict=True))
        document |= {f"Camera{number}.{name}": float(value) for name, value in values.items()}
    document["Stereo.T_c1_c2"] = {"rows": 4, "cols": 4, "dt": "f", "data": np.linalg.inv(pose).ravel().tolist()}
    path = folder / "settings.yaml"
    path.write_text("%YAML:1.0\n" + yaml.safe_dump(document), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "write",
    [
        *(opencv_yaml, opencv_two_files, opencv_xml, ini, scared_json),
        *(ros_pair, ros_left_file, kalibr, orb_slam, orb_slam_3),
    ],
)
def test_the_same_rig_from_every_file(tmp_path, write):
    left, right, right_from_left = read_stereo(write(tmp_path))
    for lens, matrix, bends in ((left, LEFT, LEFT_BENDS), (right, RIGHT, RIGHT_BENDS)):
        wanted = (matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5)
        np.testing.assert_allclose(lens.intrinsics, wanted, rtol=1e-9)
        np.testing.assert_allclose(lens.distortion[:5], bends, rtol=1e-9)
        assert not any(lens.distortion[5:])
        assert lens.size == SIZE
    np.testing.assert_allclose(right_from_left[:3, :3], TURN.as_matrix(), atol=1e-8)
    np.testing.assert_allclose(right_from_left[:3, 3], SHIFT, atol=1e-6)
    np.testing.assert_array_equal(right_from_left[3], [0, 0, 0, 1])


def test_metres_become_millimetres(tmp_path):
    _, _, right_from_left = read_stereo(opencv_yaml(tmp_path, scale=1e-3))
    np.testing.assert_allclose(right_from_left[:3, 3], SHIFT, rtol=1e-9)


@pytest.mark.parametrize("scale", [0.1, 100.0, 0.0, 1e-6])
def test_a_baseline_of_no_known_unit_is_refused(tmp_path, scale):
    with pytest.raises(NeecoError, match=r"stereo.yaml: T: .* give T in mm"):
        read_stereo(opencv_yaml(tmp_path, scale=scale))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"T_0": 4.3}, "T: puts the right camera to the left"),
        ({"R_0": 0.5}, "R: is no rotation"),
        ({"fc_x": "wide"}, r"fc_: 'wide, .*' are not all numbers"),
        ({"fc_x": -3}, "positive focal lengths"),
        ({"T_2": "nan"}, "are not all numbers"),
    ],
)
def test_wrong_numbers_end_in_one_line(tmp_path, changes, message):
    with pytest.raises(NeecoError, match=message) as caught:
        read_stereo(ini(tmp_path, **changes))
    assert len(str(caught.value).splitlines()) == 1
    assert str(caught.value).startswith(str(tmp_path))


def test_an_inis_coefficients_end_at_the_first_gap_and_its_left_camera_stands_at_the_origin_but_for_rounding(tmp_path):
    path = ini(tmp_path)
    whole = path.read_text(encoding="utf-8")
    path.write_text(whole.replace("kc_2=", "kd_2="), encoding="utf-8")
    assert np.count_nonzero(read_stereo(path)[0].distortion) == 2
    path.write_text(whole.replace("R_1=0.0\n", "R_1=5e-7\n", 1), encoding="utf-8")
    assert len(read_stereo(path)) == 3
    path.write_text(whole.replace("R_1=0.0\n", "R_1=5e-5\n", 1), encoding="utf-8")
    with pytest.raises(NeecoError, match="the left camera must be the origin"):
        read_stereo(path)


def test_exchanged_files_are_named(tmp_path):
    ros_pair(tmp_path)
    left, right = (tmp_path / name for name in ("left.yaml", "right.yaml"))
    first, second = left.read_bytes(), right.read_bytes()
    left.write_bytes(second)
    right.write_bytes(first)
    with pytest.raises(NeecoError, match=r"left.yaml: projection_matrix: .*exchange"):
        read_stereo(tmp_path)


def test_one_camera_is_no_rig(tmp_path):
    ros_pair(tmp_path)
    (tmp_path / "right.yaml").unlink()
    with pytest.raises(NeecoError, match=r"left.yaml: is one camera's; put the right"):
        read_stereo(tmp_path / "left.yaml")
    with pytest.raises(NeecoError, match="holds no one left and one right"):
        read_stereo(tmp_path)


@pytest.mark.parametrize("write", [opencv_yaml, ini, scared_json, ros_left_file])
def test_no_bytes_make_reading_raise(tmp_path, write):
    path = write(tmp_path)
    refusals([path], [lambda: np.testing.assert_array_equal(np.isfinite(read_stereo(path)[2]), True)], 25)


def test_the_right_camera_sees_a_point_where_opencv_projects_it(tmp_path):
    _, right, right_from_left = read_stereo(opencv_yaml(tmp_path))
    point = np.array([5.0, -3.0, 80.0])
    image, _ = cv2.projectPoints(point[None], TURN.as_rotvec(), SHIFT, RIGHT, RIGHT_BENDS)
    there = right_from_left[:3, :3] @ point + right_from_left[:3, 3]
    matrix = np.array([[right.fl_x, 0, right.cx - 0.5], [0, right.fl_y, right.cy - 0.5], [0, 0, 1]])
    drawn, _ = cv2.projectPoints(there[None], np.zeros(3), np.zeros(3), matrix, np.array(right.distortion))
    np.testing.assert_allclose(drawn, image, atol=1e-6)
