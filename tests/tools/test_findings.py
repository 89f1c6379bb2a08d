"""Each script of findings/ has the form that CONTRIBUTING states; the scripts themselves are run by hand."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

SCRIPTS = sorted((Path(__file__).resolve().parents[2] / "findings").iterdir())


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_a_finding_installs_pinned_packages_in_a_temporary_folder_and_states_its_output(script: Path) -> None:
    text = script.read_text(encoding="utf-8")
    assert script.suffix == ".sh"
    assert os.access(script, os.X_OK)
    lines = text.splitlines()
    assert lines[0] == "#!/usr/bin/env bash"
    assert re.search(r"\d+\.\d+\.\d+", lines[1]), "its first line states a version"
    assert "set -euo pipefail" in lines
    assert "folder=$(mktemp -d)" in lines
    assert "trap 'rm -rf \"$folder\"' EXIT" in lines
    commands = "\n".join(line for line in lines if not line.startswith("#")).replace("\\\n", " ")
    installed = [word for line in re.findall(r"(?:pip|npm) install(.*)", commands) for word in line.split()]
    packages = [word for word in installed if not word.startswith("-")]
    assert packages
    assert all(re.fullmatch(r"@?[\w./-]+(==|@)[\w.-]+", package) for package in packages), packages
    assert "neeco" not in commands
    assert re.search(r"^# Output of \d{4}-\d\d-\d\d", text, re.MULTILINE)
