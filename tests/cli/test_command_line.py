"""What the command line promises whatever the verb: help, exit statuses, one line per error."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from neeco import __version__, cli
from neeco.base.errors import NeecoError

MISSING = "/nowhere/at/all"
WITH_BAD_PATH = {
    "check": [MISSING],
    "ingest": [MISSING, "--output", "capture"],
    "train": [MISSING, "--output", "run"],
    "evaluate": [MISSING],
    "compare": [MISSING, "--methods", "3dgs", "--iterations", "5", "--output", "compared"],
    "render": [MISSING, "--output", "drawn"],
    "annotate": [MISSING, "--output", "out"],
    "track": [MISSING, MISSING, "--output", "out"],
    "adapt": [MISSING, MISSING, "--output", "out"],
    "refine": [MISSING, MISSING, "--output", "out"],
    "synthesize": [MISSING, "--output", "dataset", "--count", "1"],
    "score-masks": [MISSING, MISSING],
    "downstream": [MISSING, "--output", "taught"],
    "ablate": [MISSING, "--output", "ablated"],
    "sweep": [MISSING, MISSING, "--output", "swept"],
    "view": [MISSING, "--export", "page.html"],
    "export": [MISSING],
    "demo": ["--output", "taken"],
}


def neeco(*words: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run the program as a user does."""
    command = [sys.executable, "-m", "neeco", *words]
    return subprocess.run(
        command, capture_output=True, text=True, cwd=cwd, check=False, env=os.environ | {"COLUMNS": "120"}
    )


def test_help_names_every_verb_with_a_line() -> None:
    shown = neeco("--help")
    assert shown.returncode == 0
    assert "--version" in shown.stdout
    assert "--tyro-print-completion" in shown.stdout
    for verb, line in cli.VERBS.items():
        assert verb in shown.stdout
        assert line.split()[0] in shown.stdout


def test_help_waits_for_no_large_library() -> None:
    program = (
        "import sys; from neeco.cli import main\n"
        "LARGE = {'cv2', 'jinja2', 'matplotlib', 'numpy', 'scipy', 'torch'}\n"
        "try: main(['--help'])\n"
        "except SystemExit: print('imported:', *sorted(LARGE & set(sys.modules)))"
    )
    shown = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert shown.stdout.splitlines()[-1].strip() == "imported:"


@pytest.mark.parametrize("verb", cli.VERBS)
def test_every_verb_has_help_with_hyphenated_options_and_what_holds_where_one_is_left_out(verb, capsys):
    with pytest.raises(SystemExit) as left:
        cli.main([verb, "--help"])
    shown = capsys.readouterr().out
    assert left.value.code == 0
    assert f"neeco {verb}" in shown
    assert not [word for word in shown.split() if word.startswith("--") and "_" in word]
    options = shown.partition("settings of method")[0]
    assert "None" not in options
    assert "(default: )" not in options


def test_help_of_train_ends_with_a_table_of_the_chosen_method(capsys: pytest.CaptureFixture[str]) -> None:
    for words, setting, default in (([], "shaft_roll_start", "600"), (["--method", "nerfies"], "rays", "128")):
        with pytest.raises(SystemExit) as left:
            cli.main(["train", *words, "--help"])
        options, _, table = capsys.readouterr().out.partition("settings of method ")
        assert left.value.code == 0
        assert "--output" in options
        assert [setting, default] in [line.replace("│", " ").split()[:2] for line in table.splitlines()]
        assert len(table) < 7000


def test_options_next_to_a_misspelt_one_are_left_alone(capsys: pytest.CaptureFixture[str]) -> None:
    for words in (
        ["ablate", "it", "--set", "seed=1", "--ouptut", "o"],
        ["synthesize", "run", "--no-tissue-check", "-"],
    ):
        with pytest.raises(SystemExit):
            cli.main(words)
        printed = capsys.readouterr().err
        assert "--set: no such option" not in printed
        assert "--no-tissue-check: no such option" not in printed


def test_completion_knows_the_options_of_every_verb(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        cli.main(["--tyro-print-completion", "bash"])
    assert not left.value.code
    script = capsys.readouterr().out
    for option in ("--max-tissue-gaussians", "--shaft-diameter", "--min-trust", "--export"):
        assert option in script


def test_version_is_the_package_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"neeco {__version__}\n"


MEANT = r"neeco: error: {}: no such option of .*; did you mean {}\?"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], ""),
        (["--bogus"], ""),
        (["train"], "missing"),
        (["train", "capture"], "missing --output PATH: Run folder to write"),
        (["synthesize", "run"], ""),
        (["train", "one", "two", "--output", "run"], ""),
        (["view", "run", "--export"], "--export page.html"),
        (["ingest", "--intrinsics", "1", "2"], "FX FY CX CY"),
        (["synthesize", "run", "--output", "set", "--count", "4", "--views", "orb"], ""),
        *(([verb, "--no-such-option"], f"neeco {verb} --help|did you mean") for verb in cli.VERBS),
        *(
            ([wrong, "somewhere"], rf"{wrong}: no such verb; did you mean {right}\?")
            for wrong, right in [("trian", "train"), ("synthesise", "synthesize"), ("veiw", "view")]
        ),
        (["train", "somewhere", "--ouptut", "run"], MEANT.format("--ouptut", "--output")),
        (["synthesize", "run", "--output", "set", "--cuont=4"], MEANT.format("--cuont", "--count")),
        (
            ["synthesize", "run", "--output", "set", "--count", "4", "--vews", "orbit"],
            MEANT.format("--vews", "--views"),
        ),
        (
            ["train", "x", "--output", "y", "--minutes", "abc"],
            "--minutes: expected FLOAT, got 'abc': Time limit.*; see `neeco train --help`",
        ),
        (
            ["synthesize", "x", "--output", "y", "--count", "1.5"],
            "--count: expected INT, got '1.5'.*; see `neeco synthesize --help`",
        ),
        (
            ["ingest", "--intrinsics", "1", "2", "a", "3"],
            "--intrinsics: expected FLOAT FLOAT FLOAT FLOAT, got '1', '2', 'a', '3'",
        ),
        (["train", "x", "--output", "y", "--bogus"], "neeco train --help"),
    ],
)
def test_wrong_usage_is_one_line_about_the_word_and_exits_2(words, told, capsys):
    with pytest.raises(SystemExit) as left:
        cli.main(words)
    assert left.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("neeco: error: ")
    assert re.search(r"`neeco( [a-z-]+)? --help`|did you mean", line)
    assert re.search(told, line)
    assert not [word for word in ("│", "(required)", "{None}", "NoneType") if word in line]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], "no source; give recording.yaml (`neeco ingest --init` drafts it) or --video FILE"),
        (["left.mp4"], "--video left.mp4"),
        (["my left.AVI", "--output", "made"], "--video 'my left.AVI'"),
        (["--init", "nope.bag"], "nope.bag: no such file"),
        (["--init", "nope"], "nope: no such file"),
        (["--video", "left.mp4"], "--output: "),
    ],
)
def test_ingest_asks_for_the_source_that_it_lacks(words, told, inside, capsys):
    assert cli.main(["ingest", *words]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert told in line
    assert not list(inside.iterdir())


@pytest.mark.parametrize("verb", cli.VERBS)
def test_bad_path_is_one_line_and_exit_1(verb, inside, capsys):
    (inside / "taken").write_text("a file, not a folder")
    assert cli.main([verb, *WITH_BAD_PATH[verb]]) == 1
    told = capsys.readouterr()
    assert "Traceback" not in told.err + told.out
    if verb != "check":  # check lists problems on stdout; that is its result
        assert len(told.err.strip().splitlines()) == 1
        assert told.err.startswith("neeco: error: ")
        assert (MISSING if verb != "demo" else "taken") in told.err


@pytest.mark.parametrize(
    ("error", "status", "told"),
    [
        (NeecoError("file: field:\n  wrong;\n  mend it"), 1, "neeco: error: file: field: wrong; mend it"),
        (NeecoError("a\x1b[31mb\nc: \r is wrong"), 1, r"a\x1b["),  # names in damaged files command no terminal
        (OSError(2, "gone", "a\x1b[2Jb"), 1, r"a\x1b["),
        (KeyboardInterrupt(), 130, "neeco: interrupted: "),
        (MemoryError(), 1, "neeco: error: memory: too little ("),
    ],
)
def test_an_error_is_told_in_one_printable_line(error, status, told, monkeypatch, capsys):
    def fail(words: list[str]) -> int:
        raise error

    monkeypatch.setattr(cli, "_dispatch", fail)
    assert cli.main([]) == status
    line = capsys.readouterr().err.strip()  # Ctrl-C ends the terminal's own line first
    assert told in line
    assert line.isprintable()


def test_a_reader_that_goes_away_makes_no_noise() -> None:
    program = (
        "import sys; from neeco import cli\n"
        "def flood(words):\n"
        "    while True: print('x' * 10000)\n"
        "cli._dispatch = flood\n"
        "sys.exit(cli.main([]))"
    )
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.read(10)
    process.stdout.close()
    assert process.stderr.read() == b""
    process.stderr.close()
    assert process.wait(timeout=60) == cli.PIPE_CLOSED


def test_help_is_a_verb_and_a_file_is_no_capture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["help"], ["help", "train"]):
        with pytest.raises(SystemExit) as left:
            cli.main(words)
        assert left.value.code == 0
    capsys.readouterr()
    (tmp_path / "README.md").write_text("# read me")
    assert cli.main(["check", str(tmp_path / "README.md")]) == 1
    assert "is not a capture" in capsys.readouterr().out


@pytest.mark.parametrize("verb", ["evaluate", "check"])
@pytest.mark.parametrize(
    ("holds", "told"),
    [
        ("recording.yaml", "is a recording, not {}; `neeco ingest` makes a capture of it"),
        ("config.yaml", "is a run, not {}; its config.yaml names its capture"),
        ("transforms.json", "is a capture, not {}; `neeco train` makes a run of it"),
        ("jaw.csv", "is not {}; one holds "),
        ("a pipe", "is a device, pipe or socket; give {}"),
        ("nothing", "no such "),
    ],
)
def test_a_folder_of_another_kind_is_called_what_it_is(verb, holds, told, tmp_path, capsys):
    if (verb, holds) in (("evaluate", "config.yaml"), ("check", "transforms.json")):
        return  # what is asked for
    given = tmp_path / "raw"
    if holds == "a pipe":
        os.mkfifo(given)
    elif holds != "nothing":
        given.mkdir()
        (given / holds).write_text("{}")
    assert cli.main([verb, str(given)]) == 1
    printed = capsys.readouterr()
    wanted = "a run folder" if verb == "evaluate" else "the folder of a capture"
    assert f"{given}: {told.format(wanted)}" in (printed.err if verb == "evaluate" else printed.out)


@pytest.mark.parametrize(
    "words",
    [
        ["synthesize", "run", "--output", "set", "--count", "3", "--class-names"],
        ["annotate", "run", "--formats", "--output", "set"],
        ["evaluate", "run", "--splits", "--align"],
        ["train", "capture", "--joints", "--output", "run"],
    ],
)
def test_an_option_of_several_values_without_one_is_refused(words, capsys):
    option = next(word for word in words if word in ("--class-names", "--formats", "--splits", "--joints"))
    assert cli.main(words) == 1
    message = f"neeco: error: {option}: needs at least one value; give one, or remove the option\n"
    assert capsys.readouterr().err == message


@pytest.mark.parametrize("words", [["evaluate", "run"], ["score-masks", "drawn", "true"], ["check", "capture"]])
def test_numbers_go_to_no_folder(words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*words, "--json", str(tmp_path)]) == 1
    told = f"--json: {tmp_path}: is a folder; give a file, or no value to print to standard output"
    assert capsys.readouterr().err == f"neeco: error: {told}\n"
