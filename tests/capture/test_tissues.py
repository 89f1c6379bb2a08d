"""Several tissues in one capture: written, read back, and refused in a line where names do not fit."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from capture_folders import Folder

from neeco.capture import read_capture
from neeco.capture.checks import check_capture, inspect_capture
from neeco.capture.model import Capture, PointCloud, Tissue
from neeco.capture.readers import read_states
from neeco.capture.writer import fingerprint, state_to_json, write_capture
from neeco.errors import NeecoError


def two_tissues(folder: Folder, root: Path) -> Capture:
    """The folder's frames, the first half over a, the rest over b, whose world lies elsewhere."""
    capture = read_capture(folder.root)
    frames = []
    for index, frame in enumerate(capture.frames):
        tissue, away = ("a", 0.0) if index < 4 else ("b", 9000.0)
        pose, camera = (
            given.clone() for given in (frame.state.instruments["grasper"].pose, frame.camera.world_from_camera)
        )
        pose[0, 3] += away
        camera[0, 3] += away
        given = {"grasper": replace(frame.state.instruments["grasper"], pose=pose)}
        state = replace(frame.state, instruments=given, tissue=tissue)
        frames.append(replace(frame, state=state, camera=replace(frame.camera, world_from_camera=camera)))
    elsewhere = PointCloud(capture.points.positions + np.float32([9000.0, 0, 0]), capture.points.colors)
    tissues = (Tissue("a", capture.points), Tissue("b", elsewhere))
    made = replace(capture, frames=tuple(frames), points=PointCloud(measured=False), tissues=tissues)
    write_capture(made, root)
    return made


def test_tissues_read_back_as_they_were_written(folder: Folder, tmp_path: Path) -> None:
    made = two_tissues(folder, tmp_path / "two")
    read = read_capture(tmp_path / "two")
    assert [frame.state.tissue for frame in read.frames] == ["a"] * 4 + ["b"] * 4
    for tissue, wanted in zip(read.tissues, made.tissues, strict=True):
        assert tissue.name == wanted.name
        assert abs(tissue.points.positions - wanted.points.positions).max() < 1e-2
        assert len(read.over(tissue.name).frames) == 4
    assert not read.points.measured
    write_capture(read, tmp_path / "again")
    again = read_capture(tmp_path / "again")
    assert fingerprint(again) == fingerprint(read)
    other = replace(again, tissues=(replace(again.tissues[0], name="c"), again.tissues[1]))
    assert fingerprint(other) != fingerprint(read)


def test_a_capture_of_one_tissue_is_written_as_it_was(folder: Folder, tmp_path: Path) -> None:
    write_capture(read_capture(folder.root), tmp_path / "one")
    assert "tissue" not in (tmp_path / "one" / "transforms.json").read_text()


def test_every_tissue_is_checked_in_its_own_world(folder: Folder, tmp_path: Path) -> None:
    two_tissues(folder, tmp_path / "two")  # 9 m apart: in one world, every camera and pose of b would be far off
    checked = inspect_capture(tmp_path / "two")
    assert [str(problem) for problem in checked.problems if problem.severity == "error"] == []
    assert checked.summary.tissues == {"a": 4, "b": 4}
    assert checked.summary.travel_mm["grasper"] < 100


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d["frames"][2].pop("tissue"), "frames[2].tissue: is missing; name one of the file's tissues: a, b"),
        (lambda d: d["frames"][2].update(tissue="c"), "frames[2].tissue: 'c' is unknown: the file's tissues are a, b"),
        (lambda d: d["frames"][2].update(tissue=7), "frames[2].tissue: expected text, found 7"),
        (lambda d: d.pop("tissues"), "frames[0].tissue: 'a' is unknown: the file lists no tissues"),
        (lambda d: d["tissues"].append({"name": "a"}), "tissues[2].name: 'a' comes twice"),
        (lambda d: d["tissues"].append({"name": "c"}), "tissues: no frame of split 'train' shows 'c'"),
        (lambda d: d["tissues"].append(3), "tissues[2]: expected an object, found 3"),
        (lambda d: d["tissues"][1].update(ply_file_path="no.ply"), "tissues[1].ply_file_path: no such file: 'no.ply'"),
        (lambda d: d.update(ply_file_path="sparse_1.ply"), "ply_file_path: is of no tissue"),
        (lambda d: d.update(tissues=[]), "tissues: is empty"),
    ],
)  # fmt: skip
def test_names_that_do_not_fit_are_refused(change: Any, message: str, folder: Folder, tmp_path: Path) -> None:
    two_tissues(folder, tmp_path / "two")
    damaged = Folder(tmp_path / "two")
    damaged.edit(change)
    assert any(message in str(problem) for problem in check_capture(tmp_path / "two"))


def test_states_name_their_tissue(folder: Folder, tmp_path: Path) -> None:
    made = two_tissues(folder, tmp_path / "two")
    file = tmp_path / "states.jsonl"
    file.write_text(json.dumps(state_to_json(made.frames[5].state)))
    state = read_states(file, made.instruments, ("a", "b"))[0].state
    assert state.tissue == "b"
    assert torch.equal(state.instruments["grasper"].pose, made.frames[5].state.instruments["grasper"].pose)
    for tissue, words in (("c", "'c' is not in the scene"), (None, "missing")):
        file.write_text(json.dumps(state_to_json(replace(made.frames[5].state, tissue=tissue))))
        with pytest.raises(NeecoError, match=rf"line 1: tissue: {words}; name one of its tissues: a, b"):
            read_states(file, made.instruments, ("a", "b"))
