"""Write requirements/*.txt and constraints.txt: which versions are installed, and the hashes that they must have.

    python tools/lock.py                        # after a change of pyproject.toml: what is locked keeps its version
    python tools/lock.py --upgrade ruff mypy    # these to their newest; without names, all
    python tools/lock.py --torch-cpu FILE.whl   # PyTorch's builds for the CPU, which PyPI does not have for Linux

Needs uv (`pip install uv`), which resolves for every Python and platform at once.
"""

from __future__ import annotations

import argparse
import hashlib
import re
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "requirements"
CONSTRAINTS = ROOT / "constraints.txt"
PYTHON = "3.11"  # the oldest
TORCH_CPU = "torch-cpu"  # the one file that is no group's: of PyTorch, and nothing else


@dataclass(frozen=True)
class Group:
    """A file in requirements/: all that its extra and roots need, by itself or by the files that it includes."""

    purpose: str
    extras: tuple[str, ...] | None = ()  # None: without neeco itself
    roots: tuple[str, ...] = ()
    includes: tuple[str, ...] = ("neeco",)


def groups() -> dict[str, Group]:
    """All of them, by name; each after those that it includes."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    # scikit-build-core asks for the last two where the machine has none
    build = (*project["build-system"]["requires"], "cmake>=3.18", "ninja>=1.5")
    extras = [extra for extra in project["project"]["optional-dependencies"] if extra != "dev"]
    return {
        "neeco": Group("what neeco needs to run", includes=()),
        "build": Group("what neeco is built with", None, build, ()),
        **{extra: Group(f"the extra {extra}", (extra,)) for extra in extras},
        "dev": Group(
            "the extra dev",
            ("dev",),
            includes=("neeco", "build", "docs", "downstream", "hub", "ingest", "lerobot", "ros", "urdf", "usd", "view"),
        ),
        "nvidia": Group("PyTorch's CUDA build, which PyPI has for Linux", ("triton",), includes=("triton",)),
        "wasm": Group("make viewer", None, ("ziglang",), ()),
    }


def belongs(name: str, group: str) -> bool:
    """May a group's file list it? What only PyTorch's CUDA build needs has files of its own."""
    if re.match("nvidia-|cuda-", name):
        return group == "nvidia"
    return name != "triton" or group == "triton"


@dataclass(frozen=True)
class Locked:
    """A requirement as a lock file has it."""

    name: str
    version: str
    marker: str | None  # on which Pythons and platforms
    hashes: tuple[str, ...]  # of all its files, "sha256:…"

    @property
    def pin(self) -> str:
        return f"{self.name}=={self.version}" + (f" ; {self.marker}" if self.marker else "")

    @property
    def text(self) -> str:
        return " \\\n".join([self.pin, *(f"    --hash={digest}" for digest in self.hashes)]) + "\n"


def read(text: str) -> list[Locked]:
    """What a file lists that uv or this script wrote. Raises ValueError for a line that neither writes."""
    found: list[Locked] = []
    for line in text.splitlines():
        entry = re.fullmatch(r"([a-z0-9-]+)==([^ ;]+)(?: ; (.+?))?(?: \\)?", line)
        digest = re.fullmatch(r" +--hash=(sha256:[0-9a-f]{64})(?: \\)?", line)
        if entry:
            found.append(Locked(entry[1], entry[2], entry[3], ()))
        elif digest:
            found[-1] = replace(found[-1], hashes=(*found[-1].hashes, digest[1]))
        elif line.strip() and not line.lstrip().startswith(("#", "-r ")):
            raise ValueError(f"not understood: {line}")
    return found


def locked(group: str) -> list[Locked]:
    """What requirements/GROUP.txt lists; nothing where there is no such file."""
    file = FOLDER / f"{group}.txt"
    return read(file.read_text()) if file.exists() else []


def resolve(
    extras: Iterable[str] | None, roots: Iterable[str], known: Iterable[Locked], options: Sequence[str]
) -> list[Locked]:
    """What neeco with `extras` and the `roots` need: in the `known` versions, unless `options` of uv say otherwise."""
    with tempfile.TemporaryDirectory() as folder:
        wanted, output = Path(folder) / "wanted.in", Path(folder) / "locked.txt"
        wanted.write_text("".join(f"{root}\n" for root in roots))
        output.write_text("".join(entry.text for entry in known))
        command = ["uv", "pip", "compile", "--quiet", "--universal", "--generate-hashes", "--python-version", PYTHON]
        if extras is not None:
            command += ["pyproject.toml", *(f"--extra={extra}" for extra in extras)]
        command += [*options, str(wanted), "-o", str(output)]
        subprocess.run(command, check=True, cwd=ROOT, stdout=subprocess.DEVNULL)
        return [entry for entry in read(output.read_text()) if "== 'emscripten'" not in (entry.marker or "")]


def lock(options: Sequence[str]) -> dict[str, list[Locked]]:
    """Each group's requirements. options: uv's."""
    named = groups()
    before = [entry for group in named for entry in locked(group)]
    roots = [root for group in named.values() for root in group.roots]
    every = resolve((extra for group in named.values() for extra in group.extras or ()), roots, before, options)
    full = {entry.name: entry for entry in every}
    if newer := sorted(entry.name for entry in every if "python_full_version >=" in (entry.marker or "")):
        raise SystemExit(f"tools/lock.py: {', '.join(newer)}: not for every Python that neeco runs on; bound it")
    result: dict[str, list[Locked]] = {}
    for name, group in named.items():
        needed = {entry.name for entry in resolve(group.extras, group.roots, every, ())}
        listed = needed.difference(*({each.name for each in result[other]} for other in included(name)))
        result[name] = [full[each] for each in sorted(listed) if belongs(each, name)]
    return result


def torch_cpu(wheels: Iterable[Path], torch: Locked) -> list[Locked]:
    """PyTorch's builds for the CPU, of the version that is locked: what is known of them, and these `wheels`."""
    local = {entry.version: set(entry.hashes) for entry in locked(TORCH_CPU)}
    for wheel in wheels:
        digest = hashlib.sha256(wheel.read_bytes()).hexdigest()
        local.setdefault(wheel.name.split("-")[1], set()).add(f"sha256:{digest}")
    return [
        Locked("torch", version, None, tuple(sorted(hashes)))
        for version, hashes in local.items()
        if version == f"{torch.version}+cpu"
    ]


def included(name: str) -> set[str]:
    """The groups whose files pip reads with that of this one."""
    direct = groups()[name].includes
    return set(direct).union(*map(included, direct))


def write(result: dict[str, list[Locked]]) -> None:
    """The groups' files in requirements/, and constraints.txt."""
    for name, group in groups().items():
        write_file(name, group.purpose, result[name], group.includes)
    CONSTRAINTS.write_text(constraints(entry for entries in result.values() for entry in entries))


def write_file(name: str, purpose: str, entries: Iterable[Locked], includes: Iterable[str] = ()) -> None:
    """requirements/NAME.txt."""
    FOLDER.mkdir(exist_ok=True)
    text = [f"# Written by tools/lock.py: {purpose}.\n", *(f"-r {other}.txt\n" for other in includes)]
    (FOLDER / f"{name}.txt").write_text("".join([*text, *(entry.text for entry in entries)]))


def constraints(entries: Iterable[Locked]) -> str:
    """The text of constraints.txt: the locked versions, for whoever lets pip choose what to install."""
    head = "# Written by tools/lock.py. The versions everything is tested with: pip install -c constraints.txt ...\n"
    return head + "".join(sorted({f"{entry.pin}\n" for entry in entries}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--upgrade", nargs="*", metavar="NAME")
    parser.add_argument("--torch-cpu", nargs="+", type=Path, metavar="FILE.whl", default=[])
    given = parser.parse_args()
    options = [f"--upgrade-package={name}" for name in given.upgrade or ()]
    try:
        result = lock(["--upgrade"] if given.upgrade == [] else options)
        [torch] = [entry for entry in result["neeco"] if entry.name == "torch"]
        write_file(TORCH_CPU, "PyTorch's builds for the CPU", torch_cpu(given.torch_cpu, torch))
        write(result)
    except FileNotFoundError as error:
        sys.exit(f"tools/lock.py: {error.filename}: not found; pip install uv, or name a wheel that is there")
    except subprocess.CalledProcessError as error:
        sys.exit(error.returncode)


if __name__ == "__main__":
    main()
