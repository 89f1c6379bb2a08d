"""What GitHub's workflows run is pinned: a tag or a branch can be moved to other code, a commit cannot."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

WORKFLOWS = sorted((Path(__file__).resolve().parents[2] / ".github" / "workflows").glob("*.yml"))


def jobs(workflow: Path) -> dict[str, dict[str, Any]]:
    read = yaml.safe_load(workflow.read_text(encoding="utf-8"))["jobs"]
    assert isinstance(read, dict)
    return read


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.name)
def test_actions_are_pinned_by_commit_and_tools_by_version(workflow: Path) -> None:
    for name, job in jobs(workflow).items():
        for step in job["steps"]:
            if "uses" in step:
                assert re.fullmatch(r"[\w./-]+@[0-9a-f]{40}", step["uses"]), f"{name}: {step['uses']}"
            for command in re.findall(r"^.*\bpipx? .*$", step.get("run", ""), re.MULTILINE):
                assert re.search(r"pipx run [\w-]+==[\d.]+|--require-hashes", command), f"{name}: {command}"


def test_the_job_that_holds_the_publishing_token_installs_nothing() -> None:
    holders = [
        (workflow, name, job)
        for workflow in WORKFLOWS
        for name, job in jobs(workflow).items()
        if (job.get("permissions") or {}).get("id-token") == "write"
    ]
    assert [name for _, name, _ in holders] == ["publish"]
    commands = [step["run"] for step in holders[0][2]["steps"] if "run" in step]
    assert all(command.startswith("test ") for command in commands)
