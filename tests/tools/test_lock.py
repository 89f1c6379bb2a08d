"""What is installed is pinned by version and hash, and NOTICE names all of it; nothing is installed in another way."""

from __future__ import annotations

import importlib
import importlib.metadata
import re
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest
from packaging.markers import Marker
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tools"))


@pytest.fixture(scope="module")
def lock() -> ModuleType:
    return importlib.import_module("lock")


@pytest.fixture(scope="module")
def notice() -> ModuleType:
    return importlib.import_module("notice")


def closure(lock: ModuleType, group: str) -> dict[str, object]:
    """All that pip installs for a group's file, by name."""
    return {entry.name: entry for each in (*lock.included(group), group) for entry in lock.locked(each)}


def test_every_requirement_of_every_extra_is_locked(lock: ModuleType) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wanted = {"neeco": project["project"]["dependencies"], "build": project["build-system"]["requires"]}
    wanted |= project["project"]["optional-dependencies"]
    for group, requirements in wanted.items():
        entries = closure(lock, group)
        for requirement in map(Requirement, requirements):
            if requirement.name != "neeco":
                assert requirement.specifier.contains(entries[canonicalize_name(requirement.name)].version), requirement


def test_what_the_locked_packages_need_is_locked_too(lock: ModuleType) -> None:
    everything = closure(lock, "dev") | closure(lock, "nvidia")
    looked_at = 0
    for entry in everything.values():
        try:
            distribution = importlib.metadata.distribution(entry.name)
        except importlib.metadata.PackageNotFoundError:
            continue
        if distribution.version.partition("+")[0] != entry.version:
            continue
        looked_at += 1
        for requirement in map(Requirement, distribution.requires or ()):
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
                found = everything[canonicalize_name(requirement.name)]
                assert requirement.specifier.contains(found.version), f"{entry.name}: {requirement}"
    assert looked_at > 20


def test_every_locked_version_has_a_hash_and_is_the_same_everywhere(lock: ModuleType) -> None:
    versions: dict[str, set[str]] = {}
    for group in lock.groups():
        for entry in lock.locked(group):
            assert entry.hashes, f"{group}: {entry.name}"
            versions.setdefault(entry.name, set()).add(entry.version)
    assert all(len(each) == 1 for each in versions.values())
    assert all(entry.hashes for entry in lock.locked(lock.TORCH_CPU))
    assert {entry.version.partition("+")[0] for entry in lock.locked(lock.TORCH_CPU)} <= versions["torch"]


def test_the_oldest_python_gets_all_of_it(lock: ModuleType) -> None:
    """Debian 12 has 3.11.2; a package that wants a newer one would be missing there."""
    for group in lock.groups():
        for entry in lock.locked(group):
            oldest = {"python_full_version": "3.11.0", "python_version": "3.11", "sys_platform": "linux"}
            if "python" in (entry.marker or ""):
                assert Marker(entry.marker).evaluate(oldest), f"{group}: {entry.pin}"


def test_constraints_are_those_of_the_lock(lock: ModuleType) -> None:
    everything = [entry for group in lock.groups() for entry in lock.locked(group)]
    assert lock.constraints(everything) == lock.CONSTRAINTS.read_text(), "run tools/lock.py"


def test_files_list_the_others_that_their_group_includes(lock: ModuleType) -> None:
    for name, group in lock.groups().items():
        named = re.findall(r"^-r (.+)\.txt$", (lock.FOLDER / f"{name}.txt").read_text(), re.MULTILINE)
        assert tuple(named) == group.includes


def test_nothing_is_installed_without_its_hash() -> None:
    """But neeco itself, by the build tools that are locked."""
    calls = [
        line
        for file in (".ci/run", "Makefile", "tools/install")
        for line in (ROOT / file).read_text().splitlines()
        if "pip install" in line
    ]
    assert calls
    for call in calls:
        assert "--require-hashes" in call or "--no-deps --no-build-isolation" in call, call


def test_a_line_that_is_not_understood_is_not_passed_over(lock: ModuleType) -> None:
    with pytest.raises(ValueError, match="numpy"):
        lock.read("numpy>=2\n")


def test_only_the_cpu_builds_of_the_locked_pytorch_stay(lock: ModuleType, tmp_path: Path) -> None:
    torch = lock.Locked("torch", "9.0", None, ("sha256:" + "0" * 64,))
    wheels = [tmp_path / f"torch-{version}-cp311-cp311-linux_x86_64.whl" for version in ("9.0+cpu", "8.0+cpu")]
    for wheel in wheels:
        wheel.write_bytes(b"built")
    [entry] = lock.torch_cpu(wheels, torch)
    assert entry.version == "9.0+cpu"
    assert entry.hashes == ("sha256:586a866f990ab55e36decfffc2011f172e4452d5141c939a5436baffba11111d",)


def test_notice_names_all_that_is_locked(lock: ModuleType, notice: ModuleType) -> None:
    listed = notice.NOTICE.read_text().partition(notice.PART)[2]
    named = set(re.findall(r"^    (\S+) (\S+): \S", listed, re.MULTILINE))
    assert named == {(entry.name, entry.version) for group in lock.groups() for entry in lock.locked(group)}
    assert set(notice.IMPORTED) <= lock.groups().keys()


@pytest.mark.parametrize(
    ("text", "allowed"),
    [
        ("MIT", True),
        ("Apache-2.0 AND (BSD-3-Clause OR MIT)", True),
        ("Mozilla Public License 2.0", True),
        ("GPL-3.0-or-later", False),
        ("AGPL-3.0-only", False),
        ("MIT AND LGPL-2.1-or-later", False),
        ("MIT OR GPL-2.0-only", False),
        ("LicenseRef-NVIDIA-Proprietary", False),
        ("", False),
    ],
)
def test_only_licences_that_are_known_to_be_free_may_be_imported(notice: ModuleType, text: str, allowed: bool) -> None:
    assert notice.is_allowed(text) is allowed


def test_licences_are_read_from_wherever_a_package_says_them(notice: ModuleType) -> None:
    osi = "License :: OSI Approved :: "
    assert notice.licence({"license_expression": "MIT", "license": "all that follows"}) == "MIT"
    assert (
        notice.licence({"classifier": [osi + "Mozilla Public License 2.0 (MPL 2.0)"]}) == "Mozilla Public License 2.0"
    )
    assert notice.licence({"license": "Apache 2.0", "classifier": ["Topic :: Games"]}) == "Apache 2.0"
    assert notice.licence({"license": "GNU\nGENERAL PUBLIC LICENSE"}) == ""
