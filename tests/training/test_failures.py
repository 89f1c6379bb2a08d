"""What goes wrong while training is told in one line, and what was done is kept."""

from __future__ import annotations

import errno
import json
import os
import shutil
import stat
from pathlib import Path

import numpy as np
import pytest
import torch
from capture_files import write_capture
from PIL import Image
from safetensors import safe_open
from safetensors.torch import save_file

import neeco.base.files
from neeco.base.errors import NeecoError
from neeco.base.files import LOCK, TEMPORARY
from neeco.capture.checks import read_checked
from neeco.cli import main
from neeco.training.config import TrainConfig, training_config
from neeco.training.run import checkpoint_path, load_run, read_checkpoint
from neeco.training.session import GaussianSession
from neeco.training.train import ProgressRow, train

SHORT = ["density_start=10", "density_stop=0.9", "log_interval=5", "checkpoint_interval=20"]
CONFIG = training_config("3dgs", {"iterations": 60}, SHORT)
SIZES = {"rays": 32, "coarse_samples": 6, "width": 8, "depth": 2, "warp_width": 8, "warp_depth": 2}
RAYS = training_config("nerfies", {"iterations": 10}, [f"deformation.{name}={size}" for name, size in SIZES.items()])


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A capture, and a whole run on it; not to be changed."""
    folder = tmp_path_factory.mktemp("whole")
    capture = write_capture(folder / "capture")
    return capture, train(capture, folder / "run", CONFIG)


@pytest.fixture(scope="module")
def whole(finished: tuple[Path, Path]) -> bytes:
    """The scene that `CONFIG` learns from the fixture `capture`, whatever folder that is in."""
    return (finished[1] / "scene.safetensors").read_bytes()


@pytest.fixture(scope="module")
def unfinished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A capture, and a run on it that stopped with a checkpoint; not to be changed."""
    folder = tmp_path_factory.mktemp("unfinished")
    capture = write_capture(folder / "capture")
    with pytest.raises(KeyboardInterrupt):
        train(capture, folder / "run", CONFIG, progress=interrupt)
    return capture, folder / "run"


def interrupt(row: ProgressRow) -> None:
    if row.iteration == 30 and not row.note:
        raise KeyboardInterrupt


def hidden_files(folder: Path) -> list[Path]:
    return [path for path in folder.rglob(".*") if path.is_file()]


@pytest.mark.parametrize(("whole_files", "named"), [(0, "config.yaml"), (2, "session.safetensors")])
def test_a_full_disk_is_one_line_and_leaves_no_half_file(
    whole_files, named, whole, capture, tmp_path, monkeypatch, capsys
):
    words = ["train", str(capture), "--output", str(tmp_path / "cut"), "--method", "3dgs", "--iterations", "60"]
    words += [word for setting in SHORT for word in ("--set", setting)]
    with monkeypatch.context() as patched:
        real, left = os.fsync, iter(range(whole_files))

        def full(descriptor: int) -> None:
            if stat.S_ISREG(os.fstat(descriptor).st_mode) and next(left, None) is None:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            real(descriptor)

        patched.setattr(neeco.base.files.os, "fsync", full)
        assert main(words) == 1
    told = capsys.readouterr().err.strip().splitlines()[-1]
    assert told.startswith("neeco: error: ")
    assert named in told
    assert "No space left on device" in told
    if whole_files == 0:
        assert not (tmp_path / "cut").exists()
        return
    assert hidden_files(tmp_path / "cut") == []
    assert read_checkpoint(tmp_path / "cut")[1]["iteration"] == 20  # the one before
    assert main([*words, "--resume"]) == 0
    assert (tmp_path / "cut" / "scene.safetensors").read_bytes() == whole


def test_metrics_that_cannot_be_written_are_told_with_their_file(capture: Path, tmp_path: Path) -> None:
    def block(row: ProgressRow) -> None:
        if row.iteration == 5:
            (tmp_path / "run" / "metrics.jsonl").unlink()
            (tmp_path / "run" / "metrics.jsonl").mkdir()

    with pytest.raises(NeecoError, match=r"metrics.jsonl: cannot write: Is a directory"):
        train(capture, tmp_path / "run", CONFIG, progress=block)


@pytest.mark.parametrize(("after", "kept"), [(49, 40), (1, None)])
def test_a_loss_that_becomes_no_number_keeps_the_last_checkpoint(after, kept, capture, tmp_path):
    def diverge(session: GaussianSession) -> None:
        if session.iteration == after:
            session.scene.canonical.sh_dc.data.fill_(1e30)

    with pytest.raises(NeecoError, match=rf"loss became nan at iteration {after + 1}, frame 0000.*another --seed"):
        train(capture, tmp_path / "run", CONFIG, watch=diverge)
    assert checkpoint_path(tmp_path / "run").exists() is (kept is not None)
    assert kept is None or read_checkpoint(tmp_path / "run")[1]["iteration"] == kept
    assert not (tmp_path / "run" / "scene.safetensors").exists()
    assert hidden_files(tmp_path / "run") == []


def test_a_run_of_another_version_is_refused_by_file_and_field(finished, tmp_path):
    capture, run = finished[0], shutil.copytree(finished[1], tmp_path / "run")
    config = (run / "config.yaml").read_text()

    (run / "config.yaml").write_text(config.replace("neeco-run/1", "neeco-run/9"))
    for opened in (lambda: load_run(run), lambda: train(capture, run, CONFIG, resume=True)):
        with pytest.raises(NeecoError, match=r"config.yaml: schema is 'neeco-run/9', this version reads 'neeco-run/1'"):
            opened()

    def with_line(line: str) -> str:
        """The settings with this line in place of that of its key."""
        key = line.partition(":")[0]
        kept = [other for other in config.splitlines() if other.partition(":")[0] != key]
        return "\n".join([*kept, line, ""])

    for line in ("capture: [1]", "seed: x", "transforms: {}"):
        (run / "config.yaml").write_text(with_line(line))
        with pytest.raises(NeecoError, match=rf"config.yaml: {line.partition(':')[0]}: is not in neeco's format"):
            load_run(run)

    for line in ("minutes: -0.0", "iterations: 0", "batch_size: 0", "seed: -1"):
        (run / "config.yaml").write_text(with_line(line))
        with pytest.raises(
            NeecoError, match=rf"config.yaml: --{line.partition(':')[0].replace('_', '-')}: .*; train again"
        ):
            train(capture, run, CONFIG, resume=True)

    (run / "config.yaml").write_text(config + "warp_drive: true\n")
    with pytest.raises(NeecoError, match=r"config.yaml: .*warp_drive"):
        train(capture, run, CONFIG, resume=True)

    (run / "config.yaml").write_text(config)
    scene = (run / "scene.safetensors").read_bytes()
    (run / "scene.safetensors").write_bytes(scene.replace(b"neeco-scene/2", b"neeco-scene/9"))
    with pytest.raises(NeecoError, match=r"scene.safetensors: schema 'neeco-scene/9', this version reads"):
        load_run(run)

    (run / "scene.safetensors").unlink()
    stored = checkpoint_path(run).read_bytes()
    checkpoint_path(run).write_bytes(stored.replace(b"neeco-checkpoint/1", b"neeco-checkpoint/9"))
    with pytest.raises(
        NeecoError, match=r"session.safetensors: cannot resume from this checkpoint .*neeco-checkpoint/9"
    ):
        train(capture, run, CONFIG, resume=True)
    checkpoint_path(run).write_bytes(stored[: len(stored) // 2])
    with pytest.raises(NeecoError, match=r"session.safetensors: cannot resume from this checkpoint"):
        train(capture, run, CONFIG, resume=True)


def test_a_run_is_read_from_its_own_folder_alone(finished, tmp_path):
    run = shutil.copytree(finished[1], tmp_path / "run")
    (tmp_path / "large").mkdir()
    (run / "renders").symlink_to(tmp_path / "large")  # its owner's
    load_run(run)
    for name in ("config.yaml", "scene.safetensors", "metrics.jsonl"):
        (run / name).rename(tmp_path / name)
        (run / name).symlink_to(tmp_path / name)
        with pytest.raises(NeecoError, match=rf"{name}: a symbolic link leads out of .*run; replace it by its target"):
            load_run(run)
        (tmp_path / name).rename(run / name)


def test_a_frame_that_becomes_unreadable_after_the_check_is_named(capture, tmp_path):
    checked = read_checked(capture)
    (capture / "images/000003.png").write_bytes(b"a disk gone bad")
    with pytest.raises(NeecoError, match=r"^[^\n]*000003.png[^\n]*$"):
        train(capture, tmp_path / "run", CONFIG, capture=checked)
    assert not (tmp_path / "run").exists()


def test_a_frame_that_becomes_unreadable_mid_run_does_no_harm(whole: bytes, capture: Path, tmp_path: Path) -> None:
    def remove(row: ProgressRow) -> None:
        (capture / "images/000003.png").unlink(missing_ok=True)

    run = train(capture, tmp_path / "run", CONFIG, progress=remove)
    assert (run / "scene.safetensors").read_bytes() == whole


@pytest.mark.parametrize(("seen", "config"), [(False, CONFIG), (True, CONFIG), (False, RAYS)])
def test_what_a_loss_mask_hides_teaches_nothing(seen: bool, config: TrainConfig, tmp_path: Path) -> None:
    """Pixels under the mask are repainted: the scene stays the same. Repainted beside the mask: it changes."""
    scenes = []
    for name in ("a", "b"):
        capture = write_capture(tmp_path / name)
        document = json.loads((capture / "transforms.json").read_text())
        mask = np.full((24, 32), 255, np.uint8)
        mask[:8, :8] = 0
        for frame in document["frames"]:
            path = capture / frame["file_path"]
            frame["mask_path"] = f"masks/{path.name}"
            (capture / "masks").mkdir(exist_ok=True)
            Image.fromarray(mask).save(capture / frame["mask_path"])
            if name == "b":
                pixels = np.array(Image.open(path))
                pixels[:8, :8] = 255 - pixels[:8, :8]
                if seen:
                    pixels[10:14, 10:14] = 255 - pixels[10:14, 10:14]
                Image.fromarray(pixels).save(path)
        (capture / "transforms.json").write_text(json.dumps(document))
        run = train(capture, tmp_path / f"run-{name}", config)
        scenes.append((run / "scene.safetensors").read_bytes())
    assert (scenes[0] != scenes[1]) is seen


def test_a_run_whose_capture_is_gone_says_where_to_write_its_new_place(finished, tmp_path, capsys):
    capture, run = tmp_path / "capture", shutil.copytree(finished[1], tmp_path / "run")
    config = run / "config.yaml"
    config.write_text(config.read_text().replace(str(finished[0]), str(capture)))
    moved = shutil.copytree(finished[0], tmp_path / "moved")
    for words in (["evaluate", str(run)], ["render", str(run), "--output", str(tmp_path / "drawn")]):
        capsys.readouterr()
        assert main(words) == 1
        told = capsys.readouterr().err
        assert told.strip().splitlines() == [told.strip()]
        assert f"{run / 'config.yaml'}: capture: {capture} no longer exists; put it back, or write its" in told
    config.write_text(config.read_text().replace(str(capture), str(moved)))
    assert main(["render", str(run), "--output", str(tmp_path / "drawn"), "--split", "train"]) == 0


def test_a_run_killed_before_its_first_whole_file_begins_again(capture: Path, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    for name in (LOCK, f"{TEMPORARY}abc.yaml"):
        (tmp_path / "run" / name).touch()
    with pytest.raises(NeecoError, match="run: nothing was begun there; leave out --resume, or correct the path"):
        train(capture, tmp_path / "run", CONFIG, resume=True)
    run = train(capture, tmp_path / "run", CONFIG)
    assert hidden_files(run) == []


def test_where_nothing_was_begun_nothing_is_resumed(capture, tmp_path, capsys):
    output = tmp_path / "runs" / "none"
    assert main(["train", str(capture), "--output", str(output), "--resume"]) == 1
    remedy = "leave out --resume, or correct the path"
    assert capsys.readouterr().err == f"neeco: error: {output}: nothing was begun there; {remedy}\n"
    assert not output.parent.exists()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("window", "[1.5]"),
        ("window", "[[1, 2, 3]]"),
        ("window", "3"),
        ("window", '[["a", {}]]'),
        ("window", "[[NaN, 1]]"),
        ("window", '[[1, "nan"]]'),
        ("scene", '{"a": 1}'),
    ],
)
def test_a_checkpoint_whose_fields_do_not_fit_is_refused(field, value, unfinished, tmp_path):
    capture, run = unfinished[0], shutil.copytree(unfinished[1], tmp_path / "run")
    path = checkpoint_path(run)
    with safe_open(path, framework="pt") as stream:
        header = json.loads(stream.metadata()["neeco"])
        tensors = {name: stream.get_tensor(name) for name in stream.keys()}  # noqa: SIM118
    header[field] = json.loads(value)
    save_file(tensors, path, {"neeco": json.dumps(header)})
    with pytest.raises(NeecoError, match=r"session.safetensors: cannot resume from this checkpoint"):
        train(capture, tmp_path / "run", CONFIG, resume=True)


@pytest.mark.parametrize("number", [1e30, float("inf"), float("nan")])
def test_a_checkpoint_of_impossible_numbers_is_refused(number, unfinished, tmp_path):
    path = checkpoint_path(shutil.copytree(unfinished[1], tmp_path / "run"))
    with safe_open(path, framework="pt") as stream:
        header, tensors = stream.metadata(), {name: stream.get_tensor(name) for name in stream.keys()}  # noqa: SIM118
    changed = next(name for name in tensors if name.startswith("adam/") and tensors[name].is_floating_point())
    for name in ("statistics/total", changed):
        save_file(tensors | {name: torch.full_like(tensors[name], number)}, path, header)
        with pytest.raises(NeecoError, match=f"session.safetensors: cannot resume .*{name} contains NaN"):
            read_checkpoint(tmp_path / "run")


def test_rows_that_a_full_disk_cut_off_are_written_again(unfinished, tmp_path):
    capture, _ = unfinished[0], shutil.copytree(unfinished[1], tmp_path / "cut")
    with (tmp_path / "cut" / "metrics.jsonl").open("a") as stream:
        stream.write('{"iteration": 35, "loss": {}')
    train(capture, tmp_path / "cut", CONFIG, resume=True)
    rows = [json.loads(line) for line in (tmp_path / "cut" / "metrics.jsonl").read_text().splitlines()]
    assert [row["iteration"] for row in rows] == list(range(5, 61, 5))


def test_a_capture_that_changed_is_not_trained_on(capture, tmp_path, capsys):
    words = ["train", str(capture), "--output", str(tmp_path / "run"), "--method", "3dgs", "--iterations", "60"]
    with pytest.raises(KeyboardInterrupt):
        train(
            capture,
            tmp_path / "run",
            training_config("3dgs", {"iterations": 60}, ["log_interval=5"]),
            progress=interrupt,
        )
    image = capture / "images" / "000003.png"
    content = image.read_bytes()
    Image.new("RGB", (32, 24)).save(image)
    assert main([*words, "--resume"]) == 1
    told = capsys.readouterr().err.strip().splitlines()[-1]
    assert f"config.yaml: capture: {capture} has changed since this run was begun; put its files back" in told
    assert not (tmp_path / "run" / "scene.safetensors").exists()
    image.write_bytes(content)
    assert main([*words, "--resume"]) == 0
