"""README's links are absolute on the page that an index shows of it, and relative in the repository."""

from __future__ import annotations

import contextlib
import importlib
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tools"))


@pytest.fixture
def package_metadata() -> Iterator[ModuleType]:
    with contextlib.chdir(ROOT):
        yield importlib.import_module("package_metadata")


def test_links_of_the_page_on_an_index_lead_to_the_files_of_the_version(package_metadata, environment):
    environment.update(GITHUB_SERVER_URL="https://forge.example", GITHUB_REPOSITORY="surgery/neeco")
    fields = package_metadata.dynamic_metadata({}, {"version": "9.1"})
    links = re.findall(r"(!?)\[[^]]*\]\(([^)]+)\)", fields["readme"]["text"])
    prefix = re.compile("https://forge.example/surgery/neeco/(blob|raw)/v9.1/([^#]+)")
    leading = [(image, prefix.match(link)) for image, link in links if link.startswith("https://forge.example/")]
    assert len(leading) > 10
    for image, found in leading:
        assert found
        assert (ROOT / found[2]).exists()
        assert (found[1] == "raw") == bool(image)
    assert all("://" in link or link.startswith("#") for _, link in links)
    assert fields["urls"]["Repository"] == "https://forge.example/surgery/neeco"


def test_without_an_address_nothing_is_invented(package_metadata, environment):
    environment.pop("GITHUB_REPOSITORY", None)
    fields = package_metadata.dynamic_metadata({}, {"version": "9.1"})
    assert fields["readme"]["text"] == (ROOT / "README.md").read_text()
    assert fields["urls"] == {}


def test_the_version_is_the_same_wherever_it_is_stated() -> None:
    stated = {
        "pyproject.toml": r'^version = "(.+)"$',
        "CITATION.cff": "^version: (.+)$",
        "src/neeco/__init__.py": r'^__version__ = "(.+)"$',
    }
    found = {re.findall(pattern, (ROOT / file).read_text(), re.MULTILINE)[0] for file, pattern in stated.items()}
    assert len(found) == 1
