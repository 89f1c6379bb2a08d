"""Package metadata that name the repository's address: `urls`, and README with absolute links, as an index shows it.

scikit-build-core asks this module for them (pyproject.toml). The address comes from the environment, where GitHub's
workflows have it: GITHUB_SERVER_URL and GITHUB_REPOSITORY ("owner/name"). Without it, links stay as README has them.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

RELATIVE_LINK = re.compile(r"\]\((?![a-z]+:|#)([^)\s]+)\)")
IMAGE = re.compile(r"\.(jpg|png|svg|gif)$")
FIELDS = ("readme", "urls")


def repository() -> str | None:
    """Return the address of the repository that this is built from; None where the environment lacks it."""
    name = os.environ.get("GITHUB_REPOSITORY")
    return f"{os.environ.get('GITHUB_SERVER_URL', 'https://github.com')}/{name}" if name else None


def absolute_links(text: str, address: str, tag: str) -> str:
    """Return Markdown whose relative links and images point to the files of `tag` in the repository at `address`."""

    def absolute(link: re.Match[str]) -> str:
        kind = "raw" if IMAGE.search(link[1]) else "blob"
        return f"]({address}/{kind}/{tag}/{link[1]})"

    return RELATIVE_LINK.sub(absolute, text)


def dynamic_metadata(settings: Mapping[str, Any], project: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of pyproject.toml's `project` that depend on the address (a hook of scikit-build-core)."""
    address, tag, text = repository(), f"v{project['version']}", Path("README.md").read_text(encoding="utf-8")
    if address is None:
        return {"readme": {"text": text, "content-type": "text/markdown"}, "urls": {}}
    return {
        "readme": {"text": absolute_links(text, address, tag), "content-type": "text/markdown"},
        "urls": {
            "Repository": address,
            "Documentation": f"{address}/blob/{tag}/docs/index.md",
            "Changelog": f"{address}/blob/{tag}/CHANGELOG.md",
            "Issues": f"{address}/issues",
        },
    }


def dynamic_wheel(settings: Mapping[str, Any]) -> dict[str, bool]:
    """Return that a wheel built from an sdist may have other values (a hook of scikit-build-core)."""
    return dict.fromkeys(FIELDS, True)
