"""Every input is opened by `neeco.base.files`, which refuses what is no regular file or too large to read whole."""

from __future__ import annotations

import ast
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from source_trees import module_trees

from neeco.base.errors import NeecoError
from neeco.base.files import MAX_BYTES, open_file, read_bytes, read_json, read_text
from neeco.base.placeholders import placeholder, read_head
from neeco.cli import main
from neeco.ingest.readers import format_of, read_table, recording_formats

HELPERS = {"open_file", "read_bytes", "read_text", "read_head", "require_file", "require_content", "placeholder"}
GUARDS = HELPERS | {"is_file"}  # a function that calls one of these may hand the file to a library
READERS = {"load", "fromfile", "loadtxt", "genfromtxt", "memmap", "imread", "safe_open", "load_file"}
READERS |= {"make_fragment", "Ros1Reader", "McapReader", "Sqlite3Reader", "DirectoryReader", "VideoCapture", "parse"}
LIBRARIES = {
    "np",
    "numpy",
    "torch",
    "cv2",
    "av",
    "Image",
    "io",
    "os",
    "codecs",
    "gzip",
    "bz2",
    "lzma",
    "pq",
    "ElementTree",
}
OPENED = {
    "source",
    "frames",
    "_spec",
    "spec",
    "reader",
    "pycolmap.Database",
    "webbrowser",
    "VideoFile",
}  # no files of the user's
ALLOWED = {
    "neeco.base.files": "holds the helpers",
    "neeco.base.locks": "opens files of neeco's own",
    "neeco.base.placeholders": "holds the helpers",
    "neeco.ingest.cameras._sfm_worker": "a program of its own, which reads the job that its parent wrote",
    "neeco.ingest.cameras.sfm": "reads what its own worker wrote into a temporary folder",
    "neeco.studies.study": "reads /proc, and nothing else",
    "neeco.viewer.export": "reads the package's own files",
    "neeco.viewer.posing": "reads the package's own files",
    "neeco.cli": "opens the null device in place of a closed stream",
    "neeco.synthesis.card": "asks a README.md whether it is the user's, and reads back what it wrote",
    "neeco.synthesis.writers.bop": "reads back what it wrote",
    "neeco.report.page": "reads back what it wrote",
}


def opens(tree: ast.AST) -> Iterator[str]:
    """Calls in a module that open a file past the helpers, as text."""
    nodes = list(ast.walk(tree))
    functions = [node for node in nodes if isinstance(node, ast.FunctionDef)]
    guarded = {call for function in functions if _calls(function) & GUARDS for call in ast.walk(function)}
    for call in (node for node in nodes if isinstance(node, ast.Call)):
        name = _name(call.func)
        if name not in READERS | {"open", "read_text", "read_bytes"}:
            continue
        owner = ast.unparse(call.func).rpartition(".")[0]
        arguments = [*call.args, *(keyword.value for keyword in call.keywords if keyword.arg == "mode")]
        modes = {item.value for item in arguments if isinstance(item, ast.Constant) and isinstance(item.value, str)}
        writes = any(mode[:1] in ("w", "a", "x") for mode in modes if len(mode) < 4)
        in_memory = bool(call.args) and _name(getattr(call.args[0], "func", call.func)) == "BytesIO"
        by_library = (name in READERS and owner in (LIBRARIES if name in ("load", "parse") else ("", *LIBRARIES))) or (
            name == "open" and owner in ("av", "Image")
        )
        whole = name in ("read_text", "read_bytes") and owner
        bare = (
            name == "open" and owner not in ("av", "Image") and owner.partition("(")[0].rpartition(".")[2] not in OPENED
        )
        if writes or in_memory or owner in OPENED or (by_library and call in guarded):
            continue
        if by_library or whole or bare:
            yield ast.unparse(call)


def _calls(tree: ast.AST) -> set[str]:
    return {_name(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}


def _name(function: ast.expr) -> str:
    return getattr(function, "attr", getattr(function, "id", ""))


def test_no_module_opens_a_file_past_the_helpers() -> None:
    found = {name: list(opens(tree)) for name, tree in module_trees().items() if name not in ALLOWED}
    assert {name: calls for name, calls in found.items() if calls} == {}


@pytest.mark.parametrize(
    ("source", "count"),
    [
        ("open(path)", 1),
        ("path.open('rb')", 1),
        ("path.open()", 1),
        ("path.read_text()", 1),
        ("np.load(path)", 1),
        ("Image.open(path)", 1),
        ("def f():\n    av.open(str(path))", 1),
        ("def f():\n    require_file(path, 'a video')\n    av.open(str(path))", 0),
        ("Image.open(BytesIO(data))", 0),
        ("path.open('w')", 0),
        ("recording.source.open()", 0),
        ("read_text(path, 'JSON')", 0),
    ],
)
def test_what_opens_a_file_is_found(source: str, count: int) -> None:
    assert len(list(opens(ast.parse(source)))) == count


@contextmanager
def at_most(seconds: int) -> Iterator[None]:
    """Fail where the block waits, as for a pipe into which nobody writes."""

    def late(number: int, frame: object) -> None:
        raise AssertionError("waits for a pipe")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def sparse(path: Path, size: int) -> Path:
    """A file of this size that takes no room on the disk."""
    with path.open("wb") as stream:
        stream.truncate(size)
    return path


@pytest.mark.parametrize("read", [read_json, lambda path: read_bytes(path, "it"), lambda path: open_file(path, "it")])
def test_a_pipe_is_refused_by_name(tmp_path: Path, read: Callable[[Path], object]) -> None:
    os.mkfifo(tmp_path / "pipe")
    with at_most(5), pytest.raises(NeecoError, match=r"pipe: is not a file"):
        read(tmp_path / "pipe")
    assert read_head(tmp_path / "pipe", 9) == b""
    assert "pipe, socket or device" in str(placeholder(tmp_path / "pipe"))


def test_a_link_to_a_pipe_is_refused_and_one_to_a_file_is_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "text").write_text("content")
    for name in ("pipe", "text"):
        (tmp_path / f"to-{name}").symlink_to(tmp_path / name)
    with at_most(5), pytest.raises(NeecoError, match="to-pipe: is not a file"):
        read_text(tmp_path / "to-pipe", "text")
    assert read_text(tmp_path / "to-text", "text") == "content"


def test_what_is_too_large_is_refused_unread(tmp_path: Path) -> None:
    file = sparse(tmp_path / "large.json", 20 * MAX_BYTES)
    with at_most(5), pytest.raises(NeecoError, match=r"large.json: has over 1 GiB; expected JSON"):
        read_json(file)


@pytest.mark.parametrize("name", ["a.csv", "a.txt", "a.yaml", "a.json", "a.tsv"])
def test_no_log_is_too_large_to_be_refused(tmp_path: Path, name: str) -> None:
    with at_most(5), pytest.raises(NeecoError, match=f"{name}: has over "):
        read_table(sparse(tmp_path / name, 20 * MAX_BYTES))


SUFFIXES = (".bag", ".mcap", ".db3", ".mha", ".mhd", ".nrrd", ".nhdr", ".seq.nrrd", ".csv", ".txt", ".tsv", ".mp4", ".")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_no_log_may_be_a_pipe(tmp_path: Path, suffix: str) -> None:
    pipe = tmp_path / f"log{suffix}"
    os.mkfifo(pipe)
    with at_most(10), pytest.raises(NeecoError, match=r"is not a file|neither poses nor readings|needs "):
        read_table(pipe)


@pytest.mark.parametrize("inner", ["meta/info.json", "metadata.yaml", "index.json", "log.csv", "poses.txt", "a.mcap"])
def test_folders_that_hold_a_pipe_are_looked_at(tmp_path: Path, inner: str) -> None:
    (tmp_path / inner).parent.mkdir(exist_ok=True)
    os.mkfifo(tmp_path / inner)
    with at_most(10):
        assert format_of(tmp_path) is None
        assert not any(kind.claims(tmp_path) for kind in recording_formats())


INIT = [f"log{suffix}" for suffix in SUFFIXES[:-1]] + ["sync.json", "lens.yaml", "calibration.xml", "meta/info.json"]


@pytest.mark.parametrize("name", INIT)
def test_init_names_a_pipe_and_goes_on(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """A folder whose images can be read is drafted; the pipe is left out."""
    from PIL import Image

    (tmp_path / "images").mkdir()
    for index in range(6):
        pixels = np.full((8, 8, 3), 20 * index, np.uint8)
        Image.fromarray(pixels).save(tmp_path / "images" / f"{index}.png")
    (tmp_path / name).parent.mkdir(exist_ok=True)
    os.mkfifo(tmp_path / name)
    with at_most(20):
        status = main(["ingest", "--init", str(tmp_path)])
    told = capsys.readouterr()
    assert "Traceback" not in told.err
    assert status == 0 or ("error" in told.err and Path(name).name in told.err)
    if status == 0:
        assert name in told.err


@pytest.mark.parametrize(
    "words",
    [
        ["check", "PIPE"],
        ["ingest", "PIPE", "--output", "out"],
        ["ingest", "--init", "PIPE"],
        ["ingest", "--video", "PIPE", "--instrument", "PIPE", "--output", "out"],
        ["train", "PIPE", "--output", "out"],
        ["evaluate", "PIPE"],
        ["render", "PIPE", "--output", "out"],
        ["synthesize", "PIPE", "--count", "1", "--output", "out"],
        ["annotate", "PIPE", "--output", "out"],
        ["view", "PIPE", "--export", "out.html"],
        ["export", "PIPE", "--output", "out.ply"],
        ["score-masks", "PIPE", "PIPE"],
        ["compare", "PIPE", "--methods", "3dgs", "--iterations", "3", "--output", "out"],
        ["sweep", "PIPE", "PIPE", "--output", "out"],
        ["track", "PIPE", "PIPE", "--output", "out"],
        ["adapt", "PIPE", "PIPE", "--output", "out"],
        ["refine", "PIPE", "PIPE", "--output", "out"],
    ],
    ids=lambda words: "-".join(words[:2]),
)
def test_no_verb_waits_for_a_pipe(inside, words, capsys):
    os.mkfifo("pipe.mcap")
    with at_most(20):
        try:
            status: object = main(["pipe.mcap" if word == "PIPE" else word for word in words])
        except SystemExit as end:
            status = end.code
    told = "".join(capsys.readouterr())
    assert status in (1, 2), told
    assert "pipe" in told
    assert "Traceback" not in told
    assert sorted(path.name for path in inside.iterdir()) == ["pipe.mcap"]
