"""The commands that README and docs/ name: those of code blocks, and those inside a line."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted(ROOT.glob("docs/*.md"))]
PROGRAMS = ("neeco", "python", "python3", "make", "pip", "uvx", "pipx", "git", "cd", "zip", "yolo")
PROGRAMS += ("label-studio-converter",)
START = re.compile(rf"(?:\$ )?(?:{'|'.join(PROGRAMS)})(?= )")


@dataclass(frozen=True)
class Command:
    """page: its file's name without the ending; words: as a shell gives them to the program, the program first."""

    page: str
    words: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.page}: {shlex.join(self.words)}"


def _lines(text: str) -> list[str]:
    """Lines of indented blocks and of fenced ones without a language, and code inside paragraphs."""
    text = re.sub(r" *\\\n +", " ", text)
    fenced = re.findall(r"^```\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    text = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    blocks = re.findall(r"^ {4}(.*)$", text, re.MULTILINE)
    prose = re.sub(r"^ {4}.*$", "", text, flags=re.MULTILINE)
    inline = [re.sub(r"\s+", " ", code) for code in re.findall(r"`([^`]+)`", prose)]
    return [*blocks, *(line for block in fenced for line in block.splitlines()), *inline]


def commands_of(page: Path) -> list[Command]:
    """Every command of a page, in its order; names of verbs alone (`neeco train`) are none."""
    found = []
    for line in _lines(page.read_text(encoding="utf-8")):
        if not START.match(line):
            continue
        words = shlex.split(line.removeprefix("$ "), comments=True)
        parts: list[list[str]] = [[]]
        for word in words:
            if word == "&&":
                parts.append([])
            else:
                parts[-1].append(word)
        found += [Command(page.stem, tuple(part)) for part in parts if part[0] != "." and len(part) > 1]
    return found


def all_commands() -> list[Command]:
    return [command for page in PAGES for command in commands_of(page)]
