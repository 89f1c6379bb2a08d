"""Files appear whole or not at all, one process at a time; what others wrote is read with measure."""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from neeco.base.errors import NeecoError
from neeco.base.files import (
    LOCK,
    MAX_VALUES,
    TEMPORARY,
    FastYamlLoader,
    YamlDumper,
    YamlLoader,
    is_vacant,
    new_folder,
    own_folder,
    parse_yaml,
    placeholder,
    read_json,
    require_inside,
    require_like,
    visible_entries,
    write_atomically,
    write_text,
    write_unsynced,
)
from neeco.capture.images import open_image
from neeco.capture.points import read_ply
from neeco.capture.readers import read_urdf
from neeco.ingest.calibration.lens import read_lens
from neeco.ingest.readers import read_table
from neeco.ingest.readers.plus import PlusSequence
from neeco.ingest.readers.video import open_video
from neeco.scene.io import load_scene, save_tensors
from neeco.synthesis.writers import link

HOLD = """\
import sys, time
from neeco.base.files import own_folder
with own_folder(sys.argv[1]):
    print(flush=True)
    time.sleep(60)
"""


def test_a_folder_is_one_process_at_a_time(tmp_path: Path) -> None:
    place = tmp_path / "deep" / "out"
    with own_folder(place):
        with pytest.raises(NeecoError, match="out: another neeco process is writing there; wait for its end"):
            own_folder(place).__enter__()
        (place / "file").touch()
    assert [path.name for path in place.iterdir()] == ["file"]
    with own_folder(place):
        pass


def test_a_killed_process_holds_no_folder_and_what_it_left_is_swept(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        with pytest.raises(NeecoError, match="another neeco process"):
            own_folder(tmp_path).__enter__()
        process.send_signal(signal.SIGKILL)
    of_another = f"{TEMPORARY}folder"  # say, an ingest's
    (tmp_path / "deep" / of_another).mkdir(parents=True)
    half = (f"{TEMPORARY}a.png", f"deep/{TEMPORARY}b.json")
    whole = (f"deep/{of_another}/{TEMPORARY}c", "deep/whole", ".own")
    for name in (*half, *whole):
        (tmp_path / name).write_text("x")
    assert (tmp_path / LOCK).exists()
    with own_folder(tmp_path):
        left = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
        assert left == {*whole, LOCK}
    assert not (tmp_path / LOCK).exists()


WRITE = """\
import sys, time
from pathlib import Path
from neeco.base.files import write_atomically
def write(temporary):
    temporary.write_text("whole")
    print(flush=True)
    sys.stdin.readline()
write_atomically(Path(sys.argv[1]), write)
"""


def test_a_file_that_a_living_process_writes_is_not_swept_and_that_of_a_killed_one_is(tmp_path: Path) -> None:
    command = [sys.executable, "-c", WRITE, str(tmp_path / "file.txt")]
    for killed in (False, True):
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            process.stdout.readline()
            if killed:
                process.kill()
                process.wait()
            with own_folder(tmp_path):
                assert any(path.name.startswith(TEMPORARY) for path in tmp_path.iterdir()) is not killed
            if not killed:
                process.communicate("\n")
                assert (process.returncode, (tmp_path / "file.txt").read_text()) == (0, "whole")


def test_a_folder_of_another_process_is_waited_for(tmp_path: Path) -> None:
    hold = HOLD.replace("sleep(60)", "sleep(0.3)")
    with subprocess.Popen([sys.executable, "-c", hold, str(tmp_path)], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        with own_folder(tmp_path, wait_s=20):
            assert process.wait(20) == 0


def test_half_a_character_is_no_json_and_a_pair_of_halves_is_one_letter(tmp_path: Path) -> None:
    file = tmp_path / "file.json"
    file.write_text(r'{"name": "\ud83d\ude00"}')
    assert read_json(file) == {"name": "\N{GRINNING FACE}"}
    for text in (r'{"name": ["\udcff.jpg"]}', r'{"\uD83D": 1}'):
        file.write_text(text)
        with pytest.raises(NeecoError, match="an incomplete character; write its names"):
            read_json(file)


@pytest.mark.parametrize(("umask", "file", "folder"), [(0o077, 0o600, 0o700), (0o002, 0o664, 0o775)])
def test_the_umask_decides_who_may_read(tmp_path: Path, umask: int, file: int, folder: int) -> None:
    path, tensors = tmp_path / "made" / "file.txt", tmp_path / "made" / "file.safetensors"
    before = os.umask(umask)
    try:
        write_atomically(path, lambda temporary: temporary.write_text("x"))
        save_tensors({"a": torch.zeros(2)}, {}, tensors)  # by a library that may replace the file
        assert os.umask(umask) == umask  # it is the process's own, which other threads share
    finally:
        os.umask(before)
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE(tensors.stat().st_mode) == file
    assert stat.S_IMODE(path.parent.stat().st_mode) == folder


def test_a_file_and_then_the_folders_that_name_it_are_synced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, synced = tmp_path / "made" / "file.txt", []

    def sync(descriptor: int) -> None:
        place = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        synced.append((place.name, path.exists()) if place.is_dir() else ("file", path.exists()))

    monkeypatch.setattr(os, "fsync", sync)
    write_atomically(path, lambda temporary: temporary.write_text("x"))
    assert synced == [(tmp_path.name, False), ("file", False), ("made", True)]


def test_a_link_out_of_a_folder_is_refused_and_one_within_it_is_not(tmp_path: Path) -> None:
    folder, outside = tmp_path / "folder", tmp_path / "outside"
    folder.mkdir()
    outside.mkdir()
    (folder / "file").touch()
    (folder / "same").symlink_to("file")
    with own_folder(folder):
        assert require_inside(folder / "same", folder) == folder / "same"
    (folder / "deep").symlink_to(outside)
    with pytest.raises(NeecoError, match=r"any.png: a symbolic link leads out of .*folder; replace it by its target"):
        require_inside(folder / "deep" / "any.png", folder)
    with pytest.raises(NeecoError, match=r"deep: a symbolic link leads out of"):
        own_folder(folder).__enter__()
    (folder / "deep").unlink()
    (folder / "round").symlink_to("round")
    with pytest.raises(NeecoError, match=r"round: a symbolic link that leads to itself; remove it"):
        own_folder(folder).__enter__()


def test_a_folder_may_be_reached_by_a_link(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "disk" / "file").touch()
    (tmp_path / "run").symlink_to("disk")
    with own_folder(tmp_path / "run"):
        require_inside(tmp_path / "run" / "file", tmp_path / "run")


def test_a_folder_with_nothing_whole_in_it_is_vacant(tmp_path: Path) -> None:
    assert is_vacant(tmp_path / "absent")
    (tmp_path / LOCK).touch()
    (tmp_path / f"{TEMPORARY}abc.yaml").touch()
    assert is_vacant(tmp_path)
    (tmp_path / "whole").touch()
    assert not is_vacant(tmp_path)


def test_a_refused_folder_that_was_made_for_it_goes_again(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), own_folder(tmp_path / "a" / "b"):
        raise ZeroDivisionError
    assert not (tmp_path / "a").exists()


def test_half_a_file_is_known_by_its_name(tmp_path: Path) -> None:
    def look(temporary: Path) -> None:
        assert temporary.name.startswith(TEMPORARY)
        assert temporary.suffix == ".png"
        temporary.write_text("x")

    write_atomically(tmp_path / "image.png", look)
    assert os.listdir(tmp_path) == ["image.png"]


BOMB = "a: &a [x,x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{after}: &{after} [{','.join([f'*{before}'] * 10)}]\n"
    for before, after in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (BOMB, "its aliases expand to too many values"),
        ("&a [*a]", "its aliases expand to too many values"),
        ("[" * 1200, "its nesting is too deep"),
        ("a: 2020-13-45", "not valid YAML"),
        ("a: !!float x", "not valid YAML"),
        ("a: !!timestamp x", "not valid YAML"),
        ("!!python/object/apply:os.system ['true']", "line 1: not valid YAML"),
    ],
)
def test_yaml_without_measure_is_refused_in_one_line(text: str, told: str, tmp_path: Path) -> None:
    began = time.process_time()
    with pytest.raises(NeecoError, match=rf"^file.yaml: .*{told}") as error:
        parse_yaml(Path("file.yaml"), text, "repair it")
    assert "\n" not in str(error.value)
    assert time.process_time() - began < 5


@pytest.mark.parametrize("loader", [YamlLoader, FastYamlLoader])
def test_numbers_are_those_of_yaml_1_2(loader: type[yaml.SafeLoader]) -> None:
    texts = ["-.5", "+.5", ".5", "1e-3", "-2E3", "1.5e3", "5.", "7", "-.inf"]
    values = parse_yaml(Path("x"), f"[{', '.join(texts)}]", "", loader)
    assert values == [float(text.replace(".inf", "inf")) for text in texts]
    words = ["e3", "1e", "1e3x", "-", ".", "1.2.3", "v1.5", "0x02"]
    assert parse_yaml(Path("x"), f"[{', '.join(words)}]", "", loader) == [*words[:-1], 2]
    assert parse_yaml(Path("x"), yaml.dump({"1e5": ".5"}, Dumper=YamlDumper), "", loader) == {"1e5": ".5"}


def test_aliases_within_measure_are_read() -> None:
    assert parse_yaml(Path("x"), "a: &a [1, 2]\nb: *a", "") == {"a": [1, 2], "b": [1, 2]}
    assert MAX_VALUES > 100_000


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a": ' + "9" * 10_000 + "}"])
def test_json_without_measure_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(NeecoError, match=r"a.json: not usable JSON: a number or the nesting is too large"):
        read_json(tmp_path / "a.json")


LIKE = {"name": str, "splits": {str: {"psnr": (float, None)}}, "rows": [int]}
GOOD = {"name": "x", "splits": {"test": {"psnr": None}, "seen": {"psnr": 3}}, "rows": [1], "more": []}


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"name": 3}, "f: name: is not in neeco's format; mend it"),
        ({"name": "\ud800"}, "f: name: is not in neeco's format"),
        ({"splits": {"\ud800": {}}}, "f: splits: holds a name that is no text"),
        ({"splits": {"test": {}}}, "f: splits: test: psnr is missing; mend it"),
        ({"splits": {"test": {"psnr": float("nan")}}}, "f: splits: test: psnr: is not in neeco's"),
        ({"splits": []}, "f: splits: is not in neeco's"),
        ({"rows": [1, True]}, r"f: rows\[1\]: is not in neeco's"),
        ({"rows": None}, "f: rows: is not in neeco's"),
    ],
)
def test_what_is_built_otherwise_is_told_by_its_place(change: dict[str, object], told: str) -> None:
    assert require_like(GOOD, LIKE, "f", "mend it") is GOOD
    with pytest.raises(NeecoError, match=told):
        require_like(GOOD | change, LIKE, "f", "mend it")


LFS = "version https://git-lfs.github.com/spec/v1\noid sha256:0123456789abcdef\nsize 990\n"
READERS = {  # of files that neeco opens itself and of those that a library opens, by ending
    ".json": read_json,
    ".csv": read_table,
    ".yaml": read_lens,
    ".urdf": read_urdf,
    ".ply": read_ply,
    ".png": open_image,
    ".mp4": open_video,
    ".mha": PlusSequence().streams,
    ".safetensors": load_scene,
}


@pytest.mark.parametrize("ending", READERS)
def test_a_git_lfs_pointer_in_place_of_a_file_is_named_by_every_reader(ending: str, tmp_path: Path) -> None:
    file = tmp_path / f"file{ending}"
    file.write_text(LFS, encoding="utf-8")
    with pytest.raises(NeecoError, match=r"file.*: is a Git LFS pointer, not the file; run `git lfs pull`$"):
        READERS[ending](file)


def test_files_that_only_mention_a_pointer_are_content(tmp_path: Path) -> None:
    for content in (f"# {LFS}", ""):
        (tmp_path / "file").write_text(content)
        assert placeholder(tmp_path / "file") is None
    assert placeholder(tmp_path) is placeholder(tmp_path / "missing") is None


def test_hidden_files_are_no_part_of_a_folder(tmp_path: Path) -> None:
    for name in ("b.png", "a.png", "._a.png", ".DS_Store"):
        (tmp_path / name).touch()
    assert [entry.name for entry in visible_entries(tmp_path)] == ["a.png", "b.png"]


def test_unsynced_files_are_whole_and_so_is_what_they_replace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "made" / "file.bin"
    write_unsynced(path, b"first")
    assert path.read_bytes() == b"first"

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(NeecoError, match="cannot write: No space left"):
        write_unsynced(path, b"second")
    assert [entry.name for entry in path.parent.iterdir()] == ["file.bin"]
    assert path.read_bytes() == b"first"


@pytest.mark.parametrize("write", [lambda path: write_text(path, "x"), lambda path: write_unsynced(path, b"x")])
def test_whoever_cannot_write_learns_what_to_do(tmp_path: Path, write: Callable[[Path], None]) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    for path, remedy in (
        (tmp_path / ("x" * 300), "give a shorter name"),
        (tmp_path / "file" / "a.png", "a file has "),  # errno depends on what is tried first
        (tmp_path / "folder", "a folder has the file's name"),
    ):
        with pytest.raises(NeecoError) as refused:
            write(path)
        message = str(refused.value)
        assert message.startswith(f"{path}: cannot write: "), message
        assert f"; {remedy}" in message
    assert {entry.name for entry in tmp_path.iterdir()} == {"file", "folder"}


WRITERS: list[Callable[[Path], object]] = [
    lambda path: write_text(path, "x"),
    lambda path: write_unsynced(path, b"x"),
    lambda path: link(Path(__file__), path),
]


@pytest.mark.parametrize("write", WRITERS)
def test_links_pipes_sockets_and_devices_are_not_replaced(tmp_path: Path, write: Callable[[Path], object]) -> None:
    (tmp_path / "file").write_text("kept")
    (tmp_path / "link").symlink_to("file")
    (tmp_path / "dangling").symlink_to("absent")
    os.mkfifo(tmp_path / "pipe")
    names = ["link", "dangling", "pipe"]
    with socket.socket(socket.AF_UNIX) as server:
        handle = os.open(tmp_path, os.O_RDONLY)
        server.bind(f"/proc/self/fd/{handle}/socket")  # whose names are short
        os.close(handle)
        names.append("socket")
    with contextlib.suppress(PermissionError):  # root's alone
        os.mknod(tmp_path / "null", stat.S_IFCHR | 0o666, os.makedev(1, 3))
        names.append("null")
    before = {name: os.lstat(tmp_path / name) for name in names}
    for name in names:
        with pytest.raises(NeecoError, match=rf"{name}: is a .*, not a file, and is not replaced; give another path"):
            write(tmp_path / name)
        after = os.lstat(tmp_path / name)
        assert (after.st_ino, after.st_mode) == (before[name].st_ino, before[name].st_mode)
    assert (tmp_path / "file").read_text() == "kept"
    assert {entry.name for entry in tmp_path.iterdir()} == {"file", *names}


@pytest.mark.parametrize("open_folder", [new_folder, own_folder])
def test_a_pipe_is_no_folder_and_none_is_within_a_folder_of_ours(tmp_path: Path, open_folder: Any) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(NeecoError, match="pipe"), open_folder(tmp_path / "pipe"):
        raise AssertionError
    (tmp_path / "dangling").symlink_to("absent")
    with pytest.raises(NeecoError, match="dangling"), open_folder(tmp_path / "dangling"):
        raise AssertionError
    assert stat.S_ISFIFO(os.lstat(tmp_path / "pipe").st_mode)
    with pytest.raises(NeecoError, match="pipe: is a device, pipe or socket, not a file"), own_folder(tmp_path):
        raise AssertionError


def test_a_key_given_twice_is_refused_in_json_and_yaml(tmp_path):
    file = tmp_path / "a.json"
    file.write_text('{"frames": [], "lens": {"fl_x": 1, "fl_x": 2}}')
    with pytest.raises(NeecoError, match="'fl_x' is given twice"):
        read_json(file)
    with pytest.raises(NeecoError, match="'fl_x' is given twice"):
        parse_yaml(file, "lens: {fl_x: 1, fl_x: 2}", "repair it")


def test_what_a_file_holds_moves_no_terminals_cursor():
    assert str(NeecoError("a\x1b[2Jb\nc")) == "a\\x1b[2Jb c"
