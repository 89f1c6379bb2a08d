"""A data set that comes to nothing leaves nothing; what was drawn before a failure is kept and can be gone on from."""

import errno
import json
import os
import shutil
import signal
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from folder_contents import contents
from viewer_world import grasper_scene, write_recorded_images, write_run

import neeco.base.files
from neeco.base.errors import NeecoError
from neeco.capture.writer import state_to_json
from neeco.cli import main
from neeco.synthesis.dataset import synthesize
from neeco.synthesis.settings import Settings

# the first state that is drawn for image 2 shows too little of the instrument
SETTINGS = Settings(count=4, seed=7, tissue_tolerance_mm=2.0, max_attempts=3, min_share=0.08)


@pytest.fixture(scope="module")
def whole(run, tmp_path_factory):
    """The data set of SETTINGS."""
    output = tmp_path_factory.mktemp("whole") / "dataset"
    synthesize(run, output, SETTINGS)
    return output


def behind_the_camera(state, path) -> str:
    path.write_text(json.dumps(state_to_json(state(z=-50.0))) + "\n")
    return str(path)


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize(
    ("states", "told"),
    [
        ("nowhere.jsonl", "nowhere.jsonl: no such file; --states takes"),
        ("bad.jsonl", "bad.jsonl: line 1: not valid JSON"),
        ("behind.jsonl", "behind.jsonl: every state was refused .*leaves the image.*; correct its poses"),
        ("interpolate", r"image 0: no acceptable state in 3 attempts \(leaves the image: 3\)"),
    ],
)
def test_a_refused_data_set_leaves_the_disk_as_it_was(there, states, told, run, tmp_path, state):
    (tmp_path / "bad.jsonl").write_text("{\n")
    behind_the_camera(state, tmp_path / "behind.jsonl")
    output = tmp_path / "new" / "dataset"
    if there:
        output.mkdir(parents=True)
    asked = {"min_share": 0.9} if states == "interpolate" else {"states": str(tmp_path / states)}
    with pytest.raises(NeecoError, match=told):
        synthesize(run, output, replace(SETTINGS, **asked))
    if there:
        assert list(output.iterdir()) == []
    else:
        assert not output.parent.exists()


def test_images_drawn_before_a_refusal_are_kept_indexed_and_gone_on_from(run, whole, tmp_path):
    cut = tmp_path / "cut"
    with pytest.raises(NeecoError, match=r"image 2: no acceptable state"):
        synthesize(run, cut, replace(SETTINGS, max_attempts=1))
    info = json.loads((cut / "dataset.json").read_text())
    assert (info["complete"], info["images"]) == (False, 2)
    assert len((cut / "states.jsonl").read_text().splitlines()) == 2
    resumed = synthesize(run, cut, SETTINGS, resume=True)
    assert (resumed.made_now, resumed.refused) == (2, {"leaves the image": 2})
    assert contents(cut / "images") == contents(whole / "images")


def test_ctrl_c_is_told_with_the_way_to_go_on(tmp_path, capsys):
    scene = grasper_scene()
    run = write_run(scene, tmp_path / "run", write_recorded_images(scene, tmp_path / "capture", masks=False))

    def interrupt() -> None:
        while not (tmp_path / "dataset" / "images" / "000001.png").exists():
            time.sleep(0.001)
        os.kill(os.getpid(), signal.SIGINT)

    words = ["synthesize", str(run), "--output", str(tmp_path / "dataset"), "--count", "12", "--force"]
    threading.Thread(target=interrupt, daemon=True).start()
    assert main(words) == 130
    assert capsys.readouterr().err.splitlines()[-1].endswith("run the same command with --resume")
    assert main([*words, "--resume"]) == 0
    assert "12 images" in capsys.readouterr().out


def test_a_refused_resume_changes_nothing(run, whole, tmp_path):
    output = shutil.copytree(whole, tmp_path / "dataset")
    before = contents(output)
    for settings, told in (
        (replace(SETTINGS, seed=4), "settings.seed: begun with 7, now 4"),
        (replace(SETTINGS, states="nowhere.jsonl"), "nowhere.jsonl: no such file; --states takes"),
        (replace(SETTINGS, count=2), "--count: .* holds more than 2 images already"),
    ):
        with pytest.raises(NeecoError, match=told):
            synthesize(run, output, settings, resume=True)
        assert contents(output) == before


def test_an_interrupted_resume_forgets_no_image(run, whole, tmp_path):
    def interrupt(done):
        raise KeyboardInterrupt

    output = shutil.copytree(whole, tmp_path / "dataset")
    with pytest.raises(KeyboardInterrupt):
        synthesize(run, output, replace(SETTINGS, count=6), resume=True, on_progress=interrupt)
    assert json.loads((output / "dataset.json").read_text())["images"] == 4
    assert len((output / "states.jsonl").read_text().splitlines()) == 4


def test_a_full_disk_is_told_with_the_file_and_gone_on_from(run, whole, tmp_path, monkeypatch):
    cut = tmp_path / "cut"
    with monkeypatch.context() as patched:
        real = os.replace
        left = iter(range(11))  # dataset.json, one image's seven files and record, and two of the next's

        def full(source: object, target: object) -> None:
            if next(left, None) is None:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            real(source, target)

        patched.setattr(neeco.base.files.os, "replace", full)
        with pytest.raises(NeecoError, match=r"000001.*: cannot write: No space left on device"):
            synthesize(run, cut, SETTINGS)
    assert not [path for path in cut.rglob(".*") if path.is_file()]  # no half-written file
    assert synthesize(run, cut, SETTINGS, resume=True).made_now == 3
    assert contents(cut) == contents(whole)


def test_a_given_state_with_its_own_camera_is_tried_once_and_not_counted_as_drawn(run, tmp_path, state):
    camera = np.diag([1.0, -1.0, -1.0, 1.0]).tolist()  # OpenGL axes of an OpenCV camera at the world's origin
    lines = [state_to_json(given) | {"camera": camera} for given in (state(z=-50.0), state())]
    path = tmp_path / "states.jsonl"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    made = synthesize(run, tmp_path / "dataset", replace(SETTINGS, count=2, states=str(path)))
    assert (made.images, made.made_now, made.skipped) == (1, 1, [0])
    assert made.refused == {"leaves the image": 1}


def test_more_images_than_names_have_digits_for_are_refused_at_once(run, tmp_path, capsys):
    words = ["synthesize", str(run.path), "--output", str(tmp_path / "dataset"), "--count", "9999999999999"]
    assert main(words) == 1
    assert "--count: 9999999999999 is out of range; give 1 to 1,000,000" in capsys.readouterr().err
    words = ["render", str(run.path), "--video", str(tmp_path / "a.mp4"), "--frames", "9999999999999"]
    assert main(words) == 1
    assert "--frames must be 2 to 1,000,000 (got 9999999999999)" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
