"""Write the second part of NOTICE: what neeco installs, from requirements/*.txt, each with its licence.

    python tools/notice.py        # after tools/lock.py, on Linux, with pip 25 or newer; it installs nothing

Exit status 1, and NOTICE as it was, where neeco would come to import something whose licence is not in ALLOWED.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterable, Mapping

from lock import ROOT, groups, locked

NOTICE = ROOT / "NOTICE"
PART = "Part 2. What is installed beside neeco, none of it passed on with it"
# what neeco imports when it runs; with the rest it is built, tested and looked after
IMPORTED = (
    "neeco",
    "cluster",
    "downstream",
    "hub",
    "ingest",
    "lerobot",
    "ros",
    "triton",
    "urdf",
    "usd",
    "view",
)

ALLOWED = re.compile(
    r"((the )?mit\b|mit-cmu|apache|(3-clause )?bsd|freebsd|0bsd|isc\b|zlib|cc0|bsl-1|psf|python software foundation"
    r"|cnri-python|mpl-2|mozilla public license 2)",
    re.IGNORECASE,
)
# where the package says nothing that can be read by a machine, and where it was read instead
FOUND = {
    "cuda-toolkit": "NVIDIA's, an empty package that names others",  # its description on PyPI
    "usd-core": "Apache-2.0",  # LICENSE.txt: TOST-1.0, which is Apache-2.0 but for the paragraph on trademarks
    "apsw": "MIT",  # LICENSE: any licence that the OSI approves
}
# what a package's own licence does not tell
REMARKS = {
    "av": "its wheels bring FFmpeg (LGPL) linked to x264 and x265 (GPL-2.0-or-later); neeco passes none of it on",
    "lxml": "its wheels bring libxml2 and libxslt (MIT); neeco passes none of it on",
    "opencv-python-headless": "its wheels bring FFmpeg (LGPL-2.1-or-later)",
}


def licence(metadata: Mapping[str, object]) -> str:
    """What a package's metadata say: the expression, else the classifiers, else the free field if a name; else ""."""
    expression = str(metadata.get("license_expression") or "")
    classifiers = metadata.get("classifier") or []
    assert isinstance(classifiers, list)
    named = [each.rpartition(" :: ")[2] for each in classifiers if each.startswith("License :: OSI Approved ::")]
    named = [re.sub(r" \([^()]*\)$", "", each) for each in named]  # an abbreviation
    free = str(metadata.get("license") or "").strip()
    return expression or " AND ".join(named) or (free if len(free) <= 60 and "\n" not in free else "")


def is_allowed(text: str) -> bool:
    """Is every licence that is named one of ALLOWED? "A OR B", too, needs both: a person may choose, in FOUND."""
    names = [name.strip() for name in re.split(r"\b(?:AND|OR)\b|[()]", text) if name.strip()]
    return bool(names) and all(ALLOWED.match(name) for name in names)


def address(metadata: Mapping[str, object]) -> str:
    """Where the project lives."""
    given = metadata.get("project_url") or []
    assert isinstance(given, list)
    urls = {label.strip().lower(): url.strip() for label, _, url in (each.partition(",") for each in given)}
    for label in ("homepage", "home", "source", "source code", "repository", "github"):
        if label in urls:
            return urls[label]
    return str(metadata.get("home_page") or f"https://pypi.org/project/{metadata['name']}/")


def asked(pins: Iterable[str]) -> dict[str, Mapping[str, object]]:
    """The metadata of these "name==version", by name, as pip has them from the index."""
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--no-deps", "--quiet"]
    report = subprocess.run([*command, "--report", "-", *pins], check=True, stdout=subprocess.PIPE).stdout
    found = [entry["metadata"] for entry in json.loads(report)["install"]]
    return {re.sub(r"[-_.]+", "-", metadata["name"]).lower(): metadata for metadata in found}


def main() -> None:
    listed = {group: locked(group) for group in groups()}
    known = asked(sorted({f"{entry.name}=={entry.version}" for entries in listed.values() for entry in entries}))
    lines, refused = [PART, "=" * len(PART)], []
    for group, entries in listed.items():
        imported = "" if group in IMPORTED else " (neeco imports none of it)"
        lines += ["", f"{groups()[group].purpose}: requirements/{group}.txt{imported}", ""]
        for entry in entries:
            metadata = known[entry.name]
            text = FOUND.get(entry.name) or licence(metadata)
            if not text or (group in IMPORTED and not is_allowed(text)):
                refused.append(f"requirements/{group}.txt: {entry.name} {entry.version}: licence {text or 'unknown'}")
            lines += [f"    {entry.name} {entry.version}: {text}; {address(metadata)}"]
            lines += [f"        {REMARKS[entry.name]}"] if entry.name in REMARKS else []
    if refused:
        sys.exit("\n".join([*refused, "tools/notice.py: leave it out, or look and say what you found: FOUND, ALLOWED"]))
    NOTICE.write_text(NOTICE.read_text().partition(PART)[0] + "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
