"""Every command that README and docs/ name runs to its end, with every option that they name."""

from __future__ import annotations

import contextlib
import functools
import io
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from documented_commands import PAGES, ROOT, all_commands
from documented_world import DocumentedWorld

from neeco.cli import VERBS, main

# What stands for "…" and for the parts of a synopsis, by the words before it.
IN_FULL = {
    "evaluate RUN [--splits": "evaluate RUN --splits test unseen --align --json FILE.json",
    "score-masks PREDICTED TRUTH [": "score-masks PREDICTED TRUTH --splits test unseen --json FILE.json",
    "compare CAPTURE …": "compare CAPTURE --methods 3dgs kinematic --iterations 40 --output cmp",
    "compare CAPTURE --methods …": "compare CAPTURE --methods 3dgs kinematic --output cmp",
    "compare CAPTURE --output C225 --transforms": (
        "compare CAPTURE --output C225 --transforms transforms.json --methods 3dgs --iterations 40 --seeds 1"
    ),
    "ingest --video VIDEO …": (
        "ingest --video VIDEO --instrument instrument.csv --laparoscope camera.csv --output CAPTURE"
    ),
    "synthesize --tissue runs/stomach --instruments runs/liver runs/bowel": (
        "synthesize --tissue runs/stomach --instruments runs/liver runs/bowel --count 4 --output mixed"
    ),
    "ingest --init FILE|FOLDER": "ingest --init FOLDER",
}
# Options that a page names outside a command, in a command for each.
OF_PROSE = """
train CAPTURE --output RUN --minutes 10
train CAPTURE --output RUN --scale 0.25
train CAPTURE --output RUN --max-instrument-gaussians 6000
train CAPTURE --output RUN --iterations 5000 --set resolution.full_size_at=0.7
train CAPTURE --output RUN --joints jaw_angle
train CAPTURE --output RUN --batch-size 2 --method 3dgs
train CAPTURE --output RUN --device auto --seed 3
train CAPTURE --output RUN --set schedule.sh_order=off
train CAPTURE --output RUN --method nps --set deformation.half=false
ingest recording.yaml --output CAPTURE --frames 30 --json ingest.json
ingest recording.yaml --output CAPTURE --strict
synthesize RUN --output SET --count 2 --views perturbed --states extrapolate --margin 0.2 --seed 4
synthesize RUN --output SET --count 2 --views rolled
synthesize RUN --output SET --count 2 --views orbit --max-unobserved 0.9 --max-attempts 20
synthesize RUN --output SET --count 2 --image-format jpg --quality 90 --scale 2
synthesize RUN --output SET --count 2 --no-tissue-check --min-share 0.001
synthesize RUN --output SET --count 2 --tissue-tolerance-mm 4 --label-threshold 0.6 --min-component 0.02
synthesize RUN --output SET --count 2 --labels threshold --delta-thresholds 0.1 0.1 0.1
synthesize RUN --output SET --count 2 --labels composited --formats webdataset bop imagefolder
synthesize RUN --output SET --count 2 --states states.jsonl
synthesize RUN --output SET --count 2 --states path:path.jsonl
synthesize RUN --output SET --count 2 --states grid
synthesize RUN --output SET --count 2 --class-names maryland=needle_driver
synthesize RUN --output dataset --count 8 --resume
annotate RUN --output LABELLED --lens
annotate RUN --capture OTHER --output LABELLED
track RUN FOOTAGE --output TRACKED --start first --min-trust 0.1
evaluate RUN --json
evaluate RUN --force
annotate RUN --output LABELLED --force
synthesize RUN --output SET --count 2 --force
check CAPTURE --json
check CAPTURE --json FILE.json
view RUN --export FILE.html --sh 1
view RUN --size 1600x1280
view RUN --scale 2
view RUN --host 127.0.0.1
export RUN --states states.jsonl --output liver.usdc
export RUN --output liver.spz
ingest --formats
score-masks PREDICTED TRUTH --classes shaft=1 wrist=2 jaws=3 jaws=4 --truth-classes shaft=1 wrist=2 jaws=3 jaws=4
adapt RUN VIDEO --output SET --model unet --intrinsics 290 290 160 128 --rounds 2 --min-overlap 0
downstream CAPTURE --sets few=dataset:2 many=dataset:4 --steps 1 --batch 2 --output OUT
downstream CAPTURE --sets few=dataset:2 --classes parts --output OUT --workers 1
downstream CAPTURE --sets few=dataset:2 --backgrounds PLATES --output OUT
sweep CAPTURE STUDY.yaml --splits unseen --output DIR
"""
# Options of `neeco` that no test can run to the end here: what they need.
ELSEWHERE = {
    "--push-to-hub": "an account of a hub; tests/synthesis/test_hub_upload.py has a hub that answers",
    "--lpips-weights": "weights of LPIPS; tests/evaluation/test_lpips.py makes some",
    "--cpu-minutes": "a budget of time, run by `compare` with --iterations instead; tests/studies/test_jobs.py",
}
# Commands that no test can run to the end here: what they need.
NOT_HERE = {
    "breathing": "the method that the page makes; tests/training/test_adding_a_method.py makes and trains it",
    "--shaft-diameter": "the video of one shaft; tests/ingest/test_from_video.py renders its frames",
}
# Programs that are not neeco, and why they are not run here.
OTHER_PROGRAMS = {
    "make": "`make demo test` and what they install are what .ci/run does; a dry run below",
    "python3": "makes an environment",
    "pip": "needs the network; .ci/run installs the same versions",
    "pipx": "needs the network",
    "uvx": "needs the network",
    "git": "needs the repository's address",
    "cd": "run together with the next command",
}
SMALLER = (
    (r"--count \d{2,}", "--count 2"),
    (r"--iterations [\dN]+", "--iterations 40"),
    (r"--cpu-minutes [\d.]+|--minutes [\d.]+", "--iterations 40"),
    (r"--seeds \d+", "--seeds 1"),
    (r"--seed N", "--seed 1"),
    (r"--workers \d+", "--workers 2"),
    (r"--num-real 0 10 all", "--num-real 0 2 all"),
    (r"--num-real 10 all", "--num-real 2 all"),
    (r"--frames (100|200|2025)\b", "--frames 3"),
    (r"--frame 100\b", "--frame 1"),
    (r"--lpips-weights \w+", ""),
    (r"deformation\.(rays|elastic_rays|background_points)=\d+", r"deformation.\1=64"),
    (r"deformation\.(coarse_samples|fine_samples|width|warp_width)=\d+", r"deformation.\1=8"),
    (r"deformation\.(depth|warp_depth)=\d+", r"deformation.\1=2"),
    (r"published_steps=20000", "published_steps=40"),
    (r"--min-trust \S+", "--min-trust 0"),  # of a run of 150 iterations
)
TRAINING = {"train": "--iterations 40", "demo": "--minutes 0.05"}  # `refine` trains as its run was
SMALL_SWEEP = ("--iterations 40", "--set max_tissue_gaussians=1500", "--set initial_points=400")
SMALL_ADAPT = {"--frames": 4, "--count": 16, "--steps": 120, "--rounds": 1, "--min-overlap": 0}
SMALL_STUDY = {"--folds": 1, "--steps": 1, "--size": 48, "--batch": 2, "--num-real": 2, "--device": "cpu"}


@functools.cache
def options_of(verb: str) -> frozenset[str]:
    """The options that a verb's help names."""
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown), contextlib.suppress(SystemExit):
        main([verb, "--help"])
    return frozenset(re.findall(r"(?<![\w-])--[a-z][a-z-]*", shown.getvalue()))


def written() -> list[str]:
    """The words after `neeco` of every command on the pages, those of synopses in full, and those for prose."""
    found = []
    for command in all_commands():
        if command.words[0] != "neeco":
            continue
        line = shlex.join(command.words[1:]).replace("'", "")
        if command.words[1:] == (line,) and line in VERBS and line != "demo":
            continue  # a verb's name in a sentence
        for begin, full in IN_FULL.items():
            if line.startswith(begin):
                extra = " ".join(re.findall(r"(?<=… )--.*", line))
                line = f"{full} {extra}".strip() if full else ""
                break
        found.append(line)
    return [*found, *OF_PROSE.strip().splitlines()]


def is_run(line: str) -> bool:
    words = line.split()
    if words[:1] in (["ingest"], ["track"]) and not {"--output", "--init", "--formats", "--help"} & {*words}:
        return False  # a sentence on what the verb does
    # a fragment that names an option of a verb, such as `neeco train --method NAME`
    return bool(words) and words[0] in VERBS and not (len(words) > 1 and words[-1] in ("--init", "--export", "NAME"))


COMMANDS = sorted({line for line in written() if is_run(line)})


def smaller(line: str) -> str:
    """The command on small numbers: few iterations, few images, small networks."""
    for pattern, less in SMALLER:
        line = re.sub(pattern, less, line)
    verb, words = line.split()[0], line.split()
    if verb in TRAINING and "--iterations" not in words and "--help" not in words:
        line += f" {TRAINING[verb]}"
    if verb == "train" and "--method" not in words and "--help" not in words:
        line += " --set deformation.carving.tissue_steps=50"
    if verb == "train" and "--max-tissue-gaussians" not in words and "--help" not in words:
        line += " --max-tissue-gaussians 1500"
    if verb in ("ablate", "sweep"):
        line += "".join(f" {option}" for option in SMALL_SWEEP if option.split("=")[0] not in line)
    if verb == "ablate":
        line += " --set deformation.width=8 --set deformation.depth=2"
    if verb == "downstream":
        line += "".join(f" {option} {value}" for option, value in SMALL_STUDY.items() if option not in words)
    if verb == "adapt":
        line += "".join(f" {option} {value}" for option, value in SMALL_ADAPT.items() if option not in words)
    if verb == "synthesize" and "--count" not in words:
        line += " --count 2"
    if verb == "synthesize" and "--min-share" not in words:
        line += " --min-share 0 --max-unobserved 1"
    if verb == "synthesize" and "--no-tissue-check" not in words and "--tissue-tolerance-mm" not in words:
        line += " --no-tissue-check"
    if verb == "track" and "--min-trust" not in words:
        line += " --min-trust 0"
    if verb in ("synthesize", "annotate", "adapt") and "--force" not in words:
        line += " --force"  # a run of 40 iterations is no good one
    return line


def test_every_option_that_a_page_names_is_in_a_command_that_is_run() -> None:
    """A page that names a new option brings a command with it, here or on the page."""
    used = {word for line in COMMANDS for word in line.split() if word.startswith("--")}
    known = {option for verb in VERBS for option in options_of(verb)}
    for page in PAGES:
        text = re.sub(r"https?://\S+", "", page.read_text(encoding="utf-8"))
        named = set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", text)) & known
        assert named - used - set(ELSEWHERE) == set(), page.name


def test_every_command_of_a_page_has_options_that_there_are() -> None:
    for line in COMMANDS:
        verb, *words = line.split()
        wrong = {word for word in words if word.startswith("--")} - options_of(verb) - {"--help"}
        assert not wrong, line


def test_every_program_that_a_page_names_is_run_or_has_a_reason() -> None:
    programs = {command.words[0] for command in all_commands()}
    run = {"neeco", "python", "zip", "yolo", "label-studio-converter"}
    assert programs - run - set(OTHER_PROGRAMS) == set()


def test_make_knows_the_targets_that_pages_name() -> None:
    if shutil.which("make") is None:
        pytest.skip("make is absent")
    targets = {command.words[1] for command in all_commands() if command.words[0] == "make"}
    assert {"demo", "test"} <= targets
    for target in targets:
        subprocess.run(["make", "--dry-run", target], cwd=ROOT, check=True, capture_output=True)


@pytest.fixture(scope="session")
def documented(tmp_path_factory: pytest.TempPathFactory) -> DocumentedWorld:
    return DocumentedWorld(tmp_path_factory.mktemp("documented"))


def prepare(documented: DocumentedWorld, words: list[str], folder: Path) -> None:
    """Make everything that a command reads; what it is to write is left out."""
    verb = "init" if "--init" in words else words[0]
    writes = {index + 1 for index, word in enumerate(words) if word in ("--output", "--export", "--video")}
    if verb in ("ingest", "init"):
        writes -= {index + 1 for index, word in enumerate(words) if word == "--video"}
    if "--resume" in words:
        writes = set()
    for index, word in enumerate(words):
        for name in re.split(r"=|path:|:\d+$", word):
            if index not in writes and name and not (folder / name).exists():
                documented.make(name, verb, folder / name)


def serves(words: list[str], folder: Path) -> None:
    """Run a server until it has said its address, then end it as Ctrl-C does."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    command = [sys.executable, "-u", "-m", "neeco", *words, "--no-browser", "--port", str(port)]
    with subprocess.Popen(command, cwd=folder, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as server:
        assert server.stdout is not None
        said = ""
        for line in server.stdout:
            said += line
            if "http://" in line:
                server.send_signal(signal.SIGINT)
                break
        said += server.stdout.read()
        assert server.wait(60) in (0, 130), said
        assert "Traceback" not in said


@pytest.mark.slow
@pytest.mark.parametrize("line", COMMANDS)
def test_a_command_of_the_pages_runs_to_its_end(line, documented, inside):
    if line.startswith("downstream"):
        pytest.importorskip("transformers")
    if "--help" in line.split():
        return
    for piece, elsewhere in NOT_HERE.items():
        if piece in line:
            pytest.skip(elsewhere)
    words = shlex.split(smaller(line))
    prepare(documented, words, inside)
    if words[0] == "view" and "--export" not in words:
        if "--annotate" in words:
            pytest.skip("posing")
        pytest.importorskip("websockets")
        return serves(words, inside)
    assert main(words) == 0
    outputs = [words[index + 1] for index, word in enumerate(words) if word in ("--output", "--export", "--video")]
    assert all(os.path.exists(path) for path in outputs)


@pytest.mark.slow
@pytest.mark.parametrize("page", ["index", "recipes"])
def test_the_python_of_a_page_runs(page, documented, inside):
    """README's and getting-started's are run by tests/test_library.py, adding-a-method's by tests/training; blocks that
    begin with packages of others need these."""
    prepare(documented, ["python", "RUN", "dataset"], inside)
    blocks = re.findall(
        r"^```python\n(.*?)^```", (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8"), re.M | re.S
    )
    own = [block for block in blocks if block.startswith("import neeco")]
    assert own
    for block in own:
        code = block.replace("count=1000", "count=2, min_share=0.0").replace("num_workers=2", "num_workers=0")
        exec(compile(code, page, "exec"), {})
