"""What `neeco ingest --init` writes on the scope: what its images and lenses show, and the reason where it is open."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from bag_world import BagWriter
from ingest.still_world import BASELINE, FOCAL, HEIGHT, WIDTH, Theatre

from neeco.base.errors import NeecoError
from neeco.cli import main
from neeco.ingest.cameras.still_scene import video_stands_still
from neeco.ingest.recording.model import Recording, read_recording
from neeco.ingest.recording.template import write_template
from neeco.ingest.timing.reading import read_episodes

INTRINSICS = (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
BASE = "{transform: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 100], [0, 0, 0, 1]], sd_mm: 8, sd_deg: 5}"
LEFT, RIGHT = "/stereo/left/image_raw", "/stereo/right/image_raw"


def write_bag(folder: Path, kind: str = "recording.bag", baseline: float = BASELINE, drift: int = 0) -> Path:
    """The theatre as a bag: baseline mm; drift px a frame of both cameras."""
    theatre = Theatre(folder)
    with BagWriter(folder, kind) as bag:
        for number in range(24):
            time = number / 25
            for topic, right in ((LEFT, False), (RIGHT, True)):
                bag.image(topic, time, np.roll(theatre.image(number, right), drift * number, axis=1), "rgb8", topic)
            bag.pose("/PSM1/measured_cp", time, [0.01 * time, 0, 0.1], [1, 0, 0, 0], "PSM1_base")
            bag.pose("/ECM/measured_cp", time, [0, 0, 0.1], [1, 0, 0, 0], "PSM1_base")
            bag.joints("/PSM1/measured_js", time, outer_wrist_pitch=time - 0.5, outer_wrist_yaw=0.2 * time)
            bag.joints("/PSM1/jaw/measured_js", time, jaw=time)
        bag.camera_info("/stereo/left/camera_info", 0.0, (WIDTH, HEIGHT), INTRINSICS)
        bag.camera_info("/stereo/right/camera_info", 0.0, (WIDTH, HEIGHT), INTRINSICS, baseline=baseline / 1000)
    return bag.path


def drafted(path: Path) -> tuple[Recording, str]:
    assert main(["ingest", "--init", str(path)]) == 0
    written = path.with_name("recording.yaml")
    return read_recording(written), written.read_text()


def test_a_still_stereo_scope_is_stated_with_what_shows_it(tmp_path: Path) -> None:
    kind = "recording-mcap"
    recording, text = drafted(write_bag(tmp_path, kind))
    assert recording.camera == "still"
    assert recording.stereo is not None
    left, right, right_from_left, _ = recording.read_stereo()
    np.testing.assert_allclose(right_from_left[:3, 3], [-BASELINE, 0, 0], atol=1e-9)
    assert left.intrinsics == right.intrinsics == INTRINSICS
    assert len(recording.stereo.source.open().times) == 24
    assert "camera: still   # in frames spread over the recording, the background keeps its place" in text
    assert f"# {tmp_path.joinpath(kind).name} states both lenses, 8.00 mm apart" in text
    assert f"# intrinsics: left out, {tmp_path.joinpath(kind).name} states the lens" in text
    assert text.count(RIGHT) == 1  # it is not listed as another video, too


def test_what_the_images_contradict_is_not_stated(tmp_path: Path) -> None:
    recording, text = drafted(write_bag(tmp_path, drift=2))
    assert recording.camera is None
    assert recording.stereo is None
    assert "# camera: still   # or moving; in frames spread over the recording, the back" in text
    assert re.search(r"# stereo: \{video: .*right/image_raw.*\}   # .*; for a scope that stands still", text)


def test_cameras_calibrated_one_by_one_are_no_stereo_scope_and_the_draft_says_why(tmp_path: Path) -> None:
    recording, text = drafted(write_bag(tmp_path, baseline=0.0))
    assert recording.camera == "still"
    assert recording.stereo is None
    [line] = [line for line in text.splitlines() if line.startswith("# stereo:")]
    assert RIGHT in line
    assert "# /stereo/right/camera_info: projection_matrix: has no baseline (its 4th number is 0)" in line


def test_a_folder_with_a_stereo_calibration_gives_both_videos(tmp_path: Path) -> None:
    Theatre(tmp_path).write(stereo={})
    (tmp_path / "recording.yaml").unlink()
    text = write_template(tmp_path, stands_still=video_stands_still)
    document = yaml.safe_load(text)
    assert document["images"]["folder"] == "left"
    assert document["camera"] == "still"
    assert document["stereo"] == {"images": {"folder": "right", "fps": 25}, "calibration": "stereo.yaml"}


def test_what_is_still_open_is_asked_by_line_and_refused_at_once(tmp_path, capsys):
    _, text = drafted(write_bag(tmp_path))
    asked = re.findall(r"^(\d)\. .*recording\.yaml:(\d+): ", capsys.readouterr().out, re.MULTILINE)
    assert [number for number, _ in asked] == ["1", "2", "3"]
    for (_, line), start in zip(asked, ("- name:", "# kinematics:", "# camera_from_base:"), strict=True):
        assert text.splitlines()[int(line) - 1].strip().startswith(start)
    unknown = text.replace("    # camera_from_base: unknown", "    camera_from_base: unknown")
    for content, missing in ((text, "camera_from_base: missing"), (unknown, "kinematics: missing")):
        (tmp_path / "recording.yaml").write_text(content)
        with pytest.raises(NeecoError, match=missing):
            read_episodes([read_recording(tmp_path / "recording.yaml")])


def test_a_calibration_of_another_scope_than_the_bags_own_is_doubted(tmp_path: Path) -> None:
    path = write_bag(tmp_path)
    text = drafted(path)[1].replace("    # camera_from_base: unknown", f"    camera_from_base: {BASE}")
    for focal, doubted in ((FOCAL, False), (1.1 * FOCAL, True)):
        with BagWriter(tmp_path, "other.bag") as bag:
            for side, baseline in (("left", 0.0), ("right", 0.008)):
                lens = (focal, focal, *INTRINSICS[2:])
                bag.camera_info(f"/stereo/{side}/camera_info", 0.0, (WIDTH, HEIGHT), lens, baseline=baseline)
        stated = re.sub(r"^(stereo: \{.*\})\}", r"\1, calibration: other.bag}", text, flags=re.MULTILINE)
        (tmp_path / "recording.yaml").write_text(stated)
        recording = read_recording(tmp_path / "recording.yaml")
        assert recording.read_stereo()[0].fl_x == pytest.approx(focal)
        doubts = [item.sentence for item in read_episodes([recording]).notes.contradictions]
        assert any("stereo.calibration: other.bag states a focal length of 165 px" in it for it in doubts) is doubted
        (tmp_path / "other.bag").unlink()
