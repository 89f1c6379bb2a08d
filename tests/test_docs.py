"""Pages lead where they say, commands have the flags that pages name, and no page or name speaks the old words."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest
from source_trees import module_trees

from neeco.cli import VERBS

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])
SPOKEN = [page for page in PAGES if page.name not in ("CHANGELOG.md", "glossary.md")]
# classes, functions, arguments and variables of 0.1 that are no terms of the field; docs/glossary.md has today's words
OLD_NAMES = {
    *(
        "Artist",
        "Sitter",
        "Visitor",
        "Studio",
        "Pace",
        "Guard",
        "Keeper",
        "Crew",
        "Parcel",
        "Maker",
        "Wishes",
        "Answer",
    ),
    *("Teaching", "casts", "goes_native", "photograph", "made_up", "rim", "lost", "told", "said", "kept", "standings"),
    *("shots", "drawn"),
}
OLD_PHRASES = re.compile(r"\b(photographs?|made up|roads? not walked|processor (?:minutes?|time)|goes native)\b", re.I)


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub and the site make them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    slugs = {re.sub(r"[^\w\- ]", "", re.sub(r"[`*]", "", text)).strip().lower().replace(" ", "-") for text in headings}
    return slugs | set(re.findall(r"^::: (\S+)$", page.read_text(encoding="utf-8"), re.MULTILINE))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_of_a_page_lead_somewhere(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), f"{page.name}: {link}"
        assert not anchor or anchor in anchors(target), f"{page.name}: {link}"


def test_pages_name_only_verbs_that_there_are() -> None:
    for page in SPOKEN:
        for verb in re.findall(r"^ {4}neeco ([a-z][a-z-]+)", page.read_text(encoding="utf-8"), re.MULTILINE):
            assert verb in VERBS, f"{page.name}: neeco {verb}"


@pytest.mark.parametrize("page", SPOKEN, ids=lambda page: str(page.relative_to(ROOT)))
def test_pages_speak_no_old_words(page: Path) -> None:
    found = OLD_PHRASES.findall(page.read_text(encoding="utf-8"))
    assert found == []


def names_of(tree: ast.Module) -> set[str]:
    """Every name that a module defines or uses: classes, functions, arguments, variables, attributes."""
    found = set()
    for node in ast.walk(tree):
        found |= {getattr(node, field) for field in ("name", "id", "attr", "arg") if hasattr(node, field)}
    return found


def test_the_code_speaks_no_old_words() -> None:
    spoken = {module: sorted(names_of(tree) & OLD_NAMES) for module, tree in module_trees().items()}
    assert {module: names for module, names in spoken.items() if names} == {}


@pytest.mark.parametrize(("page", "lines"), [("README.md", 120), ("docs/results.md", 150), ("docs/findings.md", 60)])
def test_first_pages_stay_short(page: str, lines: int) -> None:
    assert len((ROOT / page).read_text(encoding="utf-8").splitlines()) <= lines, "move details to a topic page"


def test_pages_say_the_same_of_the_papers_claim() -> None:
    claim = "seen states 5.3 dB before 3DGS, 1.2 behind Deformable-3DGS, 2.5 behind 4DGS; unseen states 1.7 dB behind"
    for page in ("results.md", "reproducing-the-paper.md"):
        assert claim in (ROOT / "docs" / page).read_text(encoding="utf-8"), page
