"""What the machine may do to a command: close its streams, stop reading, spell letters otherwise, run out of memory."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import subprocess
import sys
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from neeco import cli
from neeco.base.errors import NeecoError, memory_failure
from neeco.base.files import new_folder
from neeco.capture import read_capture
from neeco.capture.images import read_image_bytes
from neeco.raster.devices import readable_failures
from neeco.training.run import load_run

NOT_UTF8 = b"caf\xe9".decode("utf-8", "surrogateescape")
TORCH = (
    "[enforce fail at alloc_cpu.cpp:124] err == 0. DefaultCPUAllocator: can't allocate memory: you tried to allocate "
    "400000000000 bytes. Error code 12 (Cannot allocate memory)"
)
PROGRAM = """\
import os, sys
from rich.console import Console
from neeco import cli
cli._dispatch = lambda words: Console().print("done") or 0
status = cli.main(["--version"])
sys.exit(status or (os.open(os.devnull, os.O_RDONLY) < 3 and "a file has a standard stream's number"))
"""


def run(redirected: str) -> tuple[int, str]:
    """Exit status and error stream of a command that prints by rich, as a shell redirects it."""
    command = ["bash", "-c", f'"$@" {redirected}; exit ${{PIPESTATUS[0]}}', "bash", sys.executable, "-c", PROGRAM]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.returncode, done.stderr


def test_closed_streams_are_no_error_and_no_file_takes_their_place() -> None:
    assert run("<&- >&- 2>&-") == (0, "")


def test_a_reader_that_is_gone_ends_a_command_by_141() -> None:
    assert run("| true") == (cli.PIPE_CLOSED, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device is always full here")
def test_a_full_disk_behind_stdout_is_one_line() -> None:
    assert run("> /dev/full") == (1, "neeco: error: output: No space left on device; check that path and the disk\n")


def test_letters_that_a_terminal_cannot_show_are_escaped(monkeypatch: pytest.MonkeyPatch) -> None:
    shown, told = (io.TextIOWrapper(io.BytesIO(), encoding="ascii") for _ in range(2))

    def speak(words: list[str]) -> int:
        Console().print("für rich")
        print("für print")
        raise NeecoError("für/transforms.json: is wrong")

    monkeypatch.setattr(cli, "_dispatch", speak)
    with redirect_stdout(shown), redirect_stderr(told):
        assert cli.main([]) == 1
    assert shown.buffer.getvalue() == rb"f\xfcr rich" + b"\n" + rb"f\xfcr print" + b"\n"  # type: ignore[attr-defined]
    assert told.buffer.getvalue().startswith(rb"neeco: error: f\xfcr/transforms.json")  # type: ignore[attr-defined]


def test_a_name_that_is_not_utf8_is_refused_before_anything_is_written(tmp_path, capsys):
    folder = tmp_path / NOT_UTF8
    for words in (["check", str(folder)], ["train", str(tmp_path), "--output", str(folder / "run")]):
        assert cli.main(words) == 1
        assert r"caf\xe9" in (told := capsys.readouterr().err)
        assert "the name is not in UTF-8; rename" in told
    for use in (read_capture, load_run, lambda path: new_folder(path).__enter__()):
        with pytest.raises(NeecoError, match="not in UTF-8"):
            use(folder)
    assert list(tmp_path.iterdir()) == []
    folder.mkdir()
    with contextlib.chdir(folder):  # a run would note its capture's absolute path
        assert cli.main(["train", "capture", "--output", "run"]) == 1
    assert r"caf\xe9': the name is not in UTF-8" in capsys.readouterr().err


def too_large() -> MemoryError:
    with pytest.raises(MemoryError) as caught:
        np.empty((1 << 45,), np.float64)
    return caught.value


@pytest.mark.parametrize(
    ("error", "asked"),
    [
        (too_large(), "256 TiB more were asked for"),
        (RuntimeError(TORCH), "373 GiB more were asked for"),
        (RuntimeError("OpenCV: (-4:Insufficient memory) Failed to allocate 3145728 bytes"), "3 MiB more"),
        (RuntimeError("can't start new thread"), ""),
        (ImportError("libtorch_cpu.so: failed to map segment from shared object"), ""),
        (OSError(12, "Cannot allocate memory"), ""),
        (MemoryError(), ""),
    ],
)
def test_too_little_memory_is_one_line_that_says_how_much_and_what_to_do(error, asked):
    told = str(memory_failure(error))
    assert told.startswith("memory: too little (")
    assert "\n" not in told
    assert asked in told
    assert "--scale" in told


def test_memory_is_named_where_a_reader_took_it_for_a_damaged_file(monkeypatch: pytest.MonkeyPatch) -> None:
    def read() -> None:
        try:
            raise RuntimeError(TORCH)
        except RuntimeError:
            raise NeecoError("scene.safetensors: damaged scene; train again") from None

    with pytest.raises(NeecoError, match=r"memory: too little .*--scale"), readable_failures():
        read()
    assert memory_failure(NeecoError("scene.safetensors: damaged scene; train again")) is None
    assert memory_failure(RuntimeError("shapes differ")) is None

    def full(path: Path, **options: object) -> None:
        raise MemoryError

    monkeypatch.setattr(Image, "open", full)
    with pytest.raises(MemoryError):
        read_image_bytes(Path(__file__), (4, 3), 1.0)


def switched_on(kind: Any) -> Iterator[str]:
    """Names of the settings that a flag --no-NAME switches off."""
    for field in dataclasses.fields(kind):
        hint = get_type_hints(kind)[field.name]
        if dataclasses.is_dataclass(hint):
            yield from switched_on(hint)
        elif hint is bool and field.default is True:
            yield field.name


def test_the_help_of_a_flag_that_switches_off_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    found = 0
    for verb in cli.VERBS:
        for name in switched_on(cli._verb([verb])[1]):
            with pytest.raises(SystemExit):
                cli.main([verb, "--help"])
            flag = f"--no-{name.replace('_', '-')}"
            assert capsys.readouterr().out.count(flag) == 2  # the flag, and a sentence on what is done without it
            found += 1
    assert found
