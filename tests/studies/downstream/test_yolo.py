"""The user's own program: what it is given, what is read back, and what is told when it fails."""

from __future__ import annotations

import json
import os
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from downstream_world import Held, square, squares, task_of

from neeco.errors import NeecoError, install_hint
from neeco.studies.downstream.batches import BatchSampler
from neeco.studies.downstream.models.yolo import NO_AUGMENTATION, Yolo
from neeco.studies.downstream.scores import Detections

PROGRAM = f"""#!{sys.executable}
import json, os, sys
from pathlib import Path

words, settings = sys.argv[1:3], dict(word.split("=", 1) for word in sys.argv[3:])
here = Path(settings["project"]) / settings["name"]
assert not here.exists(), "it would have gone elsewhere"
here.mkdir()
with open(os.environ["TOLD"], "a") as stream:
    stream.write(json.dumps([*words, settings, os.environ["YOLO_CONFIG_DIR"]]) + "\\n")
if words == ["detect", "train"]:
    assert settings["model"] == "yolo11n.yaml", "not from scratch"
    (here / "weights").mkdir()
    (here / "weights" / "last.pt").write_text("weights")
    lists = Path(settings["data"]).read_text()
    (here / "data.yaml").write_text(lists)
    for name in ("train", "val"):
        for image in Path(settings["data"]).with_name(name + ".txt").read_text().split("\\n")[:-1]:
            assert Path(image).is_file(), image
            label = Path(image.replace("/images/", "/labels/")).with_suffix(".txt")
            with (here / (name + ".txt")).open("a") as stream:
                stream.write(Path(image).stem + ": " + label.read_text().replace("\\n", ";") + "\\n")
elif words == ["detect", "predict"]:
    assert Path(settings["model"]).read_text() == "weights"
    (here / "labels").mkdir()
    for image in sorted(Path(settings["source"]).iterdir()):
        if image.stem == "000000":  # nothing is found in the others
            (here / "labels" / (image.stem + ".txt")).write_text(os.environ["ANSWER"])
"""
ANSWER = "0 0.5 0.25 0.5 0.25 0.3\n0 0.25 0.5 0.1 0.2 0.9\n"


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Puts a program named yolo on the PATH, and gives what it is told."""

    def put(text: str = PROGRAM) -> Path:
        folder = tmp_path / "bin"
        folder.mkdir()
        (folder / "yolo").write_text(text)
        (folder / "yolo").chmod(0o755)
        monkeypatch.setenv("PATH", str(folder), prepend=os.pathsep)
        monkeypatch.setenv("TOLD", str(tmp_path / "told"))
        monkeypatch.setenv("ANSWER", ANSWER)
        return tmp_path / "told"

    return put


def told_to(file: Path) -> list[tuple[str, dict[str, str]]]:
    return [(verb, settings) for _, verb, settings, _ in map(json.loads, file.read_text().splitlines())]


def test_it_is_given_a_folder_in_its_own_format(install, tmp_path: Path) -> None:
    told = install()
    example = square(0)
    task = task_of(
        tmp_path / "a job: #1",
        batches=BatchSampler([Held(example)], [squares(3, 1)], seed=0),
        steps=30,
        batch=4,
        seed=2,
        size=(192, 160),
    )
    Yolo().fit(task)
    work = tmp_path / "a job: #1" / "yolo"
    ((verb, settings),) = told_to(told)
    assert verb == "train"
    asked = {key: settings[key] for key in ("epochs", "batch", "imgsz", "seed", "device", "plots")}
    assert asked == {"epochs": "20", "batch": "4", "imgsz": "192", "seed": "2", "device": "cpu", "plots": "False"}
    described = yaml.safe_load((work / "train" / "data.yaml").read_text())
    assert described == {"train": str(work / "train.txt"), "val": str(work / "val.txt"), "names": {0: "instrument"}}
    lines = (work / "train" / "train.txt").read_text().splitlines()
    assert len(lines) == 6  # the single frame as often as the three of the set
    assert [line.split(":")[0] for line in lines].count("train0_000000") == 3
    (x0, y0, x1, y1), *_ = example.boxes()[0] / 64
    number, *shares = lines[0].split(": ")[1].rstrip(";").split()
    assert number == "0"
    assert [float(share) for share in shares] == pytest.approx(
        [(x0 + x1) / 2, (y0 + y1) / 2, x1 - x0, y1 - y0], abs=1e-6
    )
    assert len((work / "train" / "val.txt").read_text().splitlines()) == 1  # it wants some
    assert not (work / "data").exists()
    assert json.loads(told.read_text().splitlines()[0])[3] == str(work / "settings")  # nothing in the user's home


@pytest.mark.parametrize("augmented", [False, True])
def test_its_own_augmentation_is_on_only_where_asked_for(augmented: bool, install, tmp_path: Path) -> None:
    told = install()
    feed = BatchSampler(squares(2), seed=0, augmented=augmented)
    Yolo().fit(task_of(tmp_path / "job", batches=feed))
    settings = told_to(told)[0][1]
    for word in NO_AUGMENTATION:
        name, _, value = word.partition("=")
        assert settings.get(name) == (None if augmented else value)
    assert {"hsv_v", "mosaic", "fliplr", "scale", "translate"} <= {word.split("=")[0] for word in NO_AUGMENTATION}


def test_its_answers_are_read_best_first_in_pixels(install, tmp_path: Path) -> None:
    install()
    fitted = Yolo().fit(task_of(tmp_path / "job"))
    images = [np.zeros((40, 80, 3), np.uint8)] * 2
    for _ in range(2):  # asked twice it answers twice
        first, second = fitted.predict(images)
        assert isinstance(first, Detections)
        assert isinstance(second, Detections)
        assert first.scores.tolist() == [0.9, 0.3]
        assert first.boxes == pytest.approx(np.array([[16, 16, 24, 24], [20, 5, 60, 15]]))
        assert first.classes.tolist() == [1, 1]
        assert second.boxes.shape == (0, 4)


@pytest.mark.parametrize("line", ["0 0.5 0.5 0.1 0.2", "0 a b c d e", "0 0.5 0.5 0.1 0.2 0.9 7"])
@pytest.mark.parametrize("times", [1, 6, 7])
def test_answers_in_another_format_are_refused(line: str, times: int, install, tmp_path: Path, monkeypatch) -> None:
    install()
    fitted = Yolo().fit(task_of(tmp_path / "job"))
    monkeypatch.setenv("ANSWER", f"{line}\n" * times)
    with pytest.raises(NeecoError, match=r"000000.txt: not `class x y width height score` lines"):
        fitted.predict([np.zeros((40, 80, 3), np.uint8)])


def test_without_the_program_one_line_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    told = Yolo.missing_requirement()
    assert told is not None
    assert "`yolo`" in told
    assert "\n" not in told


def test_with_the_program_what_scores_its_boxes_must_be_there(install, monkeypatch: pytest.MonkeyPatch) -> None:
    from neeco.studies.downstream import model

    install()
    assert Yolo.missing_requirement() is None
    monkeypatch.setattr(model.importlib.util, "find_spec", lambda name: None)
    assert Yolo.missing_requirement() == f"needs pycocotools; {install_hint('downstream')}"


def test_a_failing_program_is_told_in_one_line_with_its_last_words(install, tmp_path: Path) -> None:
    install(
        f"#!{sys.executable}\nimport sys\nprint('a banner')\nsys.exit('a long\\nstory of\\nmany lines\\nended badly')\n"
    )
    with pytest.raises(
        NeecoError, match=r"yolo train failed: story of many lines ended badly; see .*train\.log"
    ) as told:
        Yolo().fit(task_of(tmp_path / "job"))
    assert "\n" not in str(told.value)
    assert "a banner" in (tmp_path / "job" / "yolo" / "train.log").read_text()


def test_a_program_that_writes_no_weights_is_told(install, tmp_path: Path) -> None:
    install(f"#!{sys.executable}\n")
    with pytest.raises(NeecoError, match=re.escape("last.pt: yolo wrote no weights")):
        Yolo().fit(task_of(tmp_path / "job"))


def test_what_a_stopped_training_left_is_no_hindrance(install, tmp_path: Path) -> None:
    install()
    (tmp_path / "job" / "yolo" / "train").mkdir(parents=True)
    Yolo().fit(task_of(tmp_path / "job"))
