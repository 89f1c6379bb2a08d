"""The command line: `neeco VERB …`. Parses, calls one function, prints.

Each verb is one module of this package: a frozen dataclass (its docstring and fields are the help text) and
`run(args) -> int`. Only the module of the verb that was asked for is imported, so that `neeco --help` answers at once.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import io
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from dataclasses import is_dataclass, make_dataclass
from typing import Any, get_type_hints

from neeco import __version__
from neeco.base.errors import NeecoError, memory_failure, nearest, visible
from neeco.base.files import FOLLOW_LINKS, require_utf8

VERBS = {
    "demo": "The whole main job on the bundled sample capture, in five minutes.",
    "check": "Report all problems of a capture.",
    "ingest": "Make a capture from a recording: video and tracker logs.",
    "train": "Learn a scene from a capture.",
    "evaluate": "Score a run: images, masks, parts, speed; writes a report.",
    "render": "Render frames of a capture, or states from a file, with part ids and masks.",
    "sweep": "Train and score configurations of methods, each with several seeds; tables and a report.",
    "compare": "Train and score several methods, equally long; a sweep.",
    "score-masks": "Score a folder of masks from any source against the truth.",
    "view": "Show a run interactively, in a browser or as one file.",
    "export": "Write a scene in one state for other viewers of Gaussians (PLY, SPZ, OpenUSD).",
    "synthesize": "Render a labelled data set of unrecorded instrument states.",
    "annotate": "Label recorded frames with the learned scene, with a confidence per frame.",
    "track": "Estimate instrument states in footage without states, with a learned scene.",
    "adapt": "Label frames of another operation: a segmenter proposes, the scene verifies.",
    "refine": "Train a run again, with additional frames that it tracked.",
    "downstream": "Train detectors and segmenters on synthetic images; test them on recorded frames.",
    "ablate": "Remove components of the methods one by one, for the paper's tables and ours; a sweep.",
}

DESCRIPTION = """Labelled images of surgical instruments in states nobody recorded.

neeco VERB --help, neeco help VERB: the options of a verb.
neeco VERB … --follow-links: also read files of a capture that are links to files outside of its folder.
neeco --version: the version.
neeco --tyro-print-completion bash|zsh|tcsh: completion for a shell, to be sourced (bash, tcsh) or saved as _neeco in a
folder of fpath (zsh)."""
COMPLETION = ("--tyro-print-completion", "--tyro-write-completion")

USAGE = 2
INTERRUPTED = 130  # 128 + SIGINT, what a shell reports
PIPE_CLOSED = 141  # 128 + SIGPIPE


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line (default: this process's) and return its exit status.

    0 done; 1 invalid input or insufficient memory, one line on stderr; 130 interrupted by Ctrl-C; 141 if the output
    pipe was closed. Usage errors (2) and `--help` (0) raise SystemExit. Standard streams may be closed, and may have
    any encoding.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    for at in reversed([at for at, word in enumerate(words) if word == "--json"]):
        if at + 1 == len(words) or words[at + 1].startswith("--"):  # without a file: to standard output
            words.insert(at + 1, "-")
    _prepare_streams()
    terminate, before = None, os.environ.get(FOLLOW_LINKS)
    if "--follow-links" in words[1:]:
        words.remove("--follow-links")
        os.environ[FOLLOW_LINKS] = "1"
    if threading.current_thread() is threading.main_thread():
        # SIGTERM is handled as Ctrl-C, with the same clean-up
        terminate = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _warn
            status = _dispatch(words)
        sys.stdout.flush()
        return status
    except (BrokenPipeError, SystemExit) as error:
        # rich turns a broken pipe into SystemExit
        if isinstance(error, SystemExit) and not isinstance(error.__context__, BrokenPipeError):
            raise
        return PIPE_CLOSED
    except KeyboardInterrupt as interrupt:
        message = " ".join(map(str, interrupt.args)) or "run the same command again"
        print(f"\nneeco: interrupted: {visible(message)}", file=sys.stderr)
        return INTERRUPTED
    except Exception as error:
        if failure := memory_failure(error):
            _print_error(failure)
        elif isinstance(error, NeecoError):
            _print_error(error.command_line or str(error))
        elif isinstance(error, OSError):
            where = error.filename or ("output" if error.errno == errno.ENOSPC else "system")
            _print_error(f"{where}: {error.strerror or error}; check that path and the disk")
        else:
            raise
        return 1
    finally:
        for stream in (sys.stdout, sys.stderr):  # discard unwritable output, or the interpreter fails on exit
            try:
                stream.flush()
            except OSError:
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        if before is None:
            os.environ.pop(FOLLOW_LINKS, None)
        else:
            os.environ[FOLLOW_LINKS] = before
        if terminate is not None:
            signal.signal(signal.SIGTERM, terminate)


def _prepare_streams() -> None:
    """Replace closed standard streams, as under cron, by the null device, so that no file gets their descriptors, and
    escape characters that their encoding lacks."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        stream = getattr(sys, name)
        if stream is None:
            null = os.open(os.devnull, os.O_RDWR)  # the lowest free number: that of the stream
            os.set_inheritable(null, True)
            setattr(sys, name, os.fdopen(null, "w" if number else "r", encoding="utf-8"))
        elif number and isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _print_error(message: str) -> None:
    print(f"neeco: error: {visible(message)}", file=sys.stderr)


def _dispatch(words: list[str]) -> int:
    if words == ["--version"]:
        print(f"neeco {__version__}")
        return 0
    if words[:1] == ["help"]:
        words = [*words[1:2], "--help"]
    import tyro

    config = (tyro.conf.FlagCreatePairsOff,)
    if words and words[0] in ("-h", "--help", *COMPLETION):
        choices = {  # placeholders in the overview, without importing the verbs
            name: _verb([name])[1]
            if words[0] in COMPLETION
            else make_dataclass(name.replace("-", "_"), [], namespace={"__doc__": line})
            for name, line in VERBS.items()
        }
        tyro.extras.subcommand_cli_from_dict(choices, prog="neeco", description=DESCRIPTION, args=words, config=config)
        raise SystemExit(USAGE)
    if not words or words[0] not in VERBS:
        meant = nearest(words[0], [*VERBS, "help"]) if words else None
        hint = "" if meant is None else f"did you mean {meant}? "
        problem = f"{words[0]}: no such verb" if words else "no verb given"
        _print_error(f"{problem}; {hint}`neeco --help` lists all")
        raise SystemExit(USAGE)
    run, arguments = _verb(words)
    from neeco.cli._output import usage_error

    box = io.StringIO()  # tyro prints usage errors in a frame
    try:
        with contextlib.redirect_stderr(box):
            parsed = tyro.cli(arguments, prog=f"neeco {words[0]}", args=words[1:], config=config)
    except SystemExit as end:
        if end.code:
            _print_error(usage_error(box.getvalue(), words, arguments))
        elif words[0] == "train":
            importlib.import_module(f"{__name__}.train").explain(words)
        raise
    with contextlib.suppress(FileNotFoundError):  # the current folder was removed: absolute paths may still work
        for word in (os.getcwd(), *words):
            require_utf8(word)
    from neeco.raster.devices import readable_failures
    from neeco.raster.native import keep_freed_memory

    keep_freed_memory()
    groups = (parsed, *filter(is_dataclass, vars(parsed).values()))
    for word in (word for word in words if word.startswith("--")):
        if any(vars(group).get(word[2:].replace("-", "_")) == () for group in groups):
            raise NeecoError(f"{word}: needs at least one value; give one, or remove the option")
    with readable_failures():
        return run(parsed)


def _warn(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    """Print a warning as one line on the error stream."""
    print(f"neeco: warning: {visible(str(message))}", file=sys.stderr)


def _verb(words: Sequence[str]) -> tuple[Callable[[Any], int], Callable[..., Any]]:
    """Return the `run` of the first word's module, and the dataclass of its arguments."""
    module = importlib.import_module(f"{__name__}.{words[0].replace('-', '_')}")
    arguments = next(iter(get_type_hints(module.run).values()))
    from neeco.cli._output import state_defaults

    state_defaults(arguments)
    return module.run, arguments
