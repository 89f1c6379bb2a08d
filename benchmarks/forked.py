"""`neeco` in a child of this process, which has imported everything already: what it did, said and took."""

from __future__ import annotations

import importlib
import importlib.util
import os
import pkgutil
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from neeco.cli import VERBS

ROOT = Path(__file__).resolve().parents[1]
TESTS, SOURCE = ROOT / "tests", ROOT / "src" / "neeco"
DRAW = ("--no-tissue-check", "--min-share", "0", "--max-unobserved", "1", "--force")  # of a run of 20 iterations
NO_PROGRESS = ("Traceback", "Warning", "neeco: error")  # words of lines that tell of no progress


@dataclass(frozen=True)
class Ended:
    """How a command ended. `status` is the exit status, or minus the signal that killed it."""

    status: int
    said: str  # on stdout
    told: str  # on stderr
    seconds: float
    processor: float  # s
    peak_mb: float

    def in_one_line(self, status: int = 1) -> str:
        """What is wrong with it as a refusal in one line, after what it told of its progress; empty where it is one."""
        if self.status != status:
            return f"exit status {self.status}: {self.told[-1500:]}"
        *before, last = self.told.strip().splitlines() or [""]
        if not last.startswith("neeco: error: ") or any(word in line for line in before for word in NO_PROGRESS):
            return f"not one line: {self.told[-1500:]}"
        return ""


class Child:
    """A command under way in a process group of its own."""

    def __init__(self, words: Sequence[str], desk: Path, prepare: Callable[[], None] = lambda: None) -> None:
        """words: of the command line. desk: folder for what it says. prepare: called in the child before it starts."""
        self.texts = desk / f"{time.monotonic_ns()}.out", desk / f"{time.monotonic_ns()}.err"
        self.began = time.monotonic()
        sys.stdout.flush()
        sys.stderr.flush()
        self.pid = os.fork()
        if self.pid == 0:
            self._be_the_child(words, prepare)

    def _be_the_child(self, words: Sequence[str], prepare: Callable[[], None]) -> None:
        status = 70
        try:
            os.setsid()
            for number, text in enumerate(self.texts, 1):
                os.dup2(os.open(text, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            prepare()
            from neeco.cli import main

            status = main(list(words))
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else 2
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)

    def running(self) -> bool:
        """Whether it has not ended yet."""
        return os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None

    def kill(self, group: bool = True) -> None:
        """SIGKILL, to it alone or with all that it started."""
        os.killpg(self.pid, signal.SIGKILL) if group else os.kill(self.pid, signal.SIGKILL)

    def wait(self, limit: float = 600.0) -> Ended:
        """How it ended; killed after `limit` s."""
        while self.running():
            if time.monotonic() - self.began > limit:
                self.kill()
                break
            time.sleep(0.005)
        seconds = time.monotonic() - self.began
        _, status, usage = os.wait4(self.pid, 0)
        said, told = (
            text.read_text(encoding="utf-8", errors="replace") if text.exists() else "" for text in self.texts
        )
        for text in self.texts:
            text.unlink(missing_ok=True)
        return Ended(
            os.waitstatus_to_exitcode(status),
            said,
            told,
            seconds,
            usage.ru_utime + usage.ru_stime,
            usage.ru_maxrss / 1024,
        )


def limit_memory(gib: float) -> None:
    """From here on this process may have `gib` GiB more than it has."""
    status = Path("/proc/self/status").read_text()
    now = 1024 * int(next(line for line in status.splitlines() if line.startswith("VmData")).split()[1])
    resource.setrlimit(resource.RLIMIT_DATA, (now + int(gib * 2**30),) * 2)


def module_at(path: Path, name: str = "") -> ModuleType:
    """A file of the tests as a module: its worlds."""
    name = name or path.stem
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def import_modules() -> None:
    """Import what the verbs use, most of which they import only when they run, once for all children."""
    for verb in VERBS:
        importlib.import_module(f"neeco.cli.{verb.replace('-', '_')}")
    for package in ("ingest", "report", "studies", "synthesis"):
        for module in pkgutil.walk_packages([str(SOURCE / package)], f"neeco.{package}."):
            with suppress(ImportError):  # of extras that are not installed
                importlib.import_module(module.name)


def hasten_ingest() -> None:
    """Let structure from motion be answered from known cameras (as in tests/ingest)."""
    from neeco.ingest.cameras.sfm import Attempt, StructureFromMotion, strategies

    world = module_at(TESTS / "ingest" / "conftest.py", "ingest_world")
    known = world.Recorded(world.World(Path(os.devnull)))
    StructureFromMotion._search = lambda self, progress: Attempt(strategies(None)[0], 1)  # type: ignore[method-assign]
    StructureFromMotion._run = lambda self, job, progress: known.reconstruct(  # type: ignore[method-assign]
        self.names, self.job["camera_params"]
    )
