"""What recording.yaml says of a base: unknown, rough, exact, or the dVRK's own registration."""

from __future__ import annotations

import json

import numpy as np
import pytest

from neeco.base.errors import NeecoError
from neeco.ingest.recording.base import read_dvrk_registration
from neeco.ingest.recording.model import read_recording

# rotation about x by a quarter turn, and metres
TRANSFORM = [[1.0, 0.0, 0.0, 0.05], [0.0, 0.0, -1.0, -0.02], [0.0, 1.0, 0.0, 0.17], [0.0, 0.0, 0.0, 1.0]]
MILLIMETRES = [[1, 0, 0, 50], [0, 0, -1, -20], [0, 1, 0, 170], [0, 0, 0, 1]]
METRES = [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0.2], [0, 0, 0, 1]]
FRAME = {"reference-frame": "left_frame", "transform": TRANSFORM}


def _recording(tmp_path, base=None, default=None, frame=None):
    (tmp_path / "video.mp4").touch()
    (tmp_path / "psm.csv").touch()
    poses = {"file": "psm.csv"} | ({} if frame is None else {"frame": frame})
    instrument = {"name": "psm1", "poses": poses} | ({} if base is None else {"camera_from_base": base})
    document = {"video": "video.mp4", "instruments": [instrument, {"name": "psm2", "poses": "psm.csv"}]}
    document |= {} if default is None else {"camera_from_base": default}
    (tmp_path / "recording.yaml").write_text(json.dumps(document))
    return read_recording(tmp_path / "recording.yaml").instruments


def test_a_rough_base_has_a_transform_and_how_far_it_may_be_off(tmp_path):
    rough = {"transform": MILLIMETRES, "sd_mm": 8, "sd_deg": 5}
    first, second = _recording(tmp_path, rough, "unknown")
    assert np.array_equal(first.base.matrix, MILLIMETRES)
    assert (first.base.sd_mm, first.base.sd_deg, first.base.exact) == (8, 5, False)
    assert second.base.matrix is None  # what stands at the top holds for all that say nothing


def test_a_transform_alone_is_exact(tmp_path):
    assert _recording(tmp_path, {"transform": MILLIMETRES})[0].base.exact


def test_poses_in_the_cameras_frame_need_no_base(tmp_path):
    assert _recording(tmp_path, None, "unknown", "camera")[0].base is None
    with pytest.raises(NeecoError, match=r"instruments\[0\].camera_from_base: its poses are in the camera's frame"):
        _recording(tmp_path, "unknown", None, "camera")


def test_a_registration_of_the_dvrk_is_in_metres_and_one_in_its_own_axes_is_turned(tmp_path):
    (tmp_path / "PSM1-registration-open-cv.json").write_text('{\n"base-frame": ' + json.dumps(FRAME) + "\n}\n")
    (tmp_path / "PSM1-registration-dVRK.json").write_text('"base-frame": ' + json.dumps(FRAME) + "\n")
    base = _recording(tmp_path, "PSM1-registration-open-cv.json")[0].base
    assert np.allclose(base.matrix, MILLIMETRES)
    assert (base.sd_mm, base.sd_deg) == (8.0, 5.0)
    turned = read_dvrk_registration(tmp_path / "PSM1-registration-dVRK.json").matrix
    assert np.allclose(np.diag([-1, -1, 1, 1]) @ turned, MILLIMETRES)
    whole = tmp_path / "mended" / "PSM1-registration-dVRK.json"  # made JSON by hand
    whole.parent.mkdir()
    whole.write_text('{"base-frame": ' + json.dumps(FRAME) + "}")
    assert np.array_equal(read_dvrk_registration(whole).matrix, turned)


def test_a_registration_to_the_ecm_must_say_in_which_axes(tmp_path):
    path = tmp_path / "psm1.json"
    path.write_text(json.dumps({"base-frame": FRAME | {"reference-frame": "/ECM"}}))
    with pytest.raises(NeecoError, match=r"reference-frame'\]: is '/ECM', and nothing says whether .* or OpenCV's"):
        read_dvrk_registration(path)


def test_a_trackers_frame_has_no_cameras_axes(tmp_path):
    (tmp_path / "video.mp4").touch()
    (tmp_path / "psm.csv").touch()
    document = {"video": "video.mp4", "instruments": [{"name": "psm1", "poses": "psm.csv"}]}
    document["world_from_base"] = {"transform": MILLIMETRES, "axes": "ecm"}
    (tmp_path / "recording.yaml").write_text(json.dumps(document))
    with pytest.raises(NeecoError, match=r"world_from_base\.axes: a tracker's frame has none"):
        read_recording(tmp_path / "recording.yaml")


def test_a_transform_may_lead_to_the_camera_in_other_axes(tmp_path):
    base = _recording(tmp_path, {"transform": MILLIMETRES, "axes": "ecm"})[0].base
    assert np.array_equal(base.matrix, np.diag([-1, -1, 1, 1]) @ MILLIMETRES)
    with pytest.raises(NeecoError, match=r"axes: 'left' is not known here; write one of camera, opencv, .*ecm"):
        _recording(tmp_path, {"transform": MILLIMETRES, "axes": "left"})


@pytest.mark.parametrize(
    ("base", "message"),
    [
        ("nowhere.json", "no such file"),
        ([1, 2], "expected `unknown`, a file"),
        ({"sd_mm": 8, "sd_deg": 5}, "camera_from_base.transform: is missing"),
        ({"transform": MILLIMETRES, "sd_mm": 8}, "camera_from_base.sd_deg: is missing; give both"),
        ({"transform": TRANSFORM[:2]}, "transform: "),
        ({"transform": METRES}, "transform: is within 10 mm of the origin: in metres?; give it in mm"),
        ({"transform": MILLIMETRES, "sd": 8}, "camera_from_base.sd: it has no such field"),
    ],
)
def test_a_wrong_base_ends_in_one_line(tmp_path, base, message):
    with pytest.raises(NeecoError) as raised:
        _recording(tmp_path, base)
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("key", ["matrix", "transform"])
@pytest.mark.parametrize("deviations", [{}, {"sd_mm": 3.0, "sd_deg": 2.0}])
def test_a_file_may_state_what_recording_yaml_states(tmp_path, key, deviations):
    (tmp_path / "reg.json").write_text(json.dumps({key: MILLIMETRES} | deviations))
    base = read_dvrk_registration(tmp_path / "reg.json")
    np.testing.assert_allclose(base.matrix, MILLIMETRES)
    assert (base.sd_mm, base.sd_deg) == (deviations.get("sd_mm", 8.0), deviations.get("sd_deg", 5.0))


QUATERNION = {"qx": -(0.5**0.5), "qy": 0.0, "qz": 0.0, "qw": 0.5**0.5}  # base_from_camera of MILLIMETRES
PLACE = {"x": -0.05, "y": -0.17, "z": -0.02}


@pytest.mark.parametrize("second", [False, True])
def test_the_yaml_of_easy_handeye_is_inverted(tmp_path, second):
    stated = {"parameters": {"eye_on_hand": False}, "transformation": PLACE | QUATERNION}
    if second:
        rotation = {name[1]: value for name, value in QUATERNION.items()}
        stated = {"parameters": {"calibration_type": "eye_on_base"}}
        stated |= {"transform": {"translation": PLACE, "rotation": rotation}}
    (tmp_path / "eye.yaml").write_text(json.dumps(stated))
    assert np.allclose(_recording(tmp_path, "eye.yaml")[0].base.matrix, MILLIMETRES)


ON_BASE = {"parameters": {"eye_on_hand": False}}
TRACKER = {"parameters": {"eye_on_hand": False, "tracking_base_frame": "camera_link"}}


@pytest.mark.parametrize(
    ("name", "document", "message"),
    [
        ("reg.json", {"name": "PSM1", "measured_cp": []}, "base-frame.*: is missing"),
        ("reg.json", {"x": 1}, r"base-frame.*: is missing; .* or write \{transform: 4 rows, mm, sd_mm: 8, sd_deg: 5\}"),
        ("reg.json", {"matrix": METRES}, "matrix.*: in metres"),
        ("reg.json", {"matrix": METRES[:1]}, "matrix"),
        ("reg.json", {"matrix": MILLIMETRES, "unit": "m"}, "unit: it has no"),
        ("reg.json", "transform", "is not a camera registration"),
        ("eye.yaml", {"parameters": {"eye_on_hand": True}, "transformation": PLACE | QUATERNION}, "eye_on_hand: false"),
        ("eye.yaml", {"transformation": PLACE | QUATERNION}, "eye_on_hand: false"),
        ("eye.yaml", ON_BASE | {"transformation": PLACE}, "qx"),
        ("eye.yaml", ON_BASE | {"transformation": None}, "is missing"),
        ("eye.yaml", TRACKER | {"transformation": PLACE | QUATERNION}, "_frame: is 'camera_link', and nothing says"),
        ("eye.yaml", None, "expected an object"),
        ("eye.yaml", 3, "expected an object"),
    ],
)
def test_another_file_than_a_registration_ends_in_one_line(tmp_path, name, document, message):
    (tmp_path / name).write_text(json.dumps(document))
    with pytest.raises(NeecoError, match=message) as raised:
        read_dvrk_registration(tmp_path / name)
    assert "\n" not in str(raised.value)


def test_text_is_no_registration(tmp_path):
    (tmp_path / "reg.json").write_text("transform")
    with pytest.raises(NeecoError, match="is not a camera registration"):
        read_dvrk_registration(tmp_path / "reg.json")
