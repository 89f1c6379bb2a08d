"""Rules of style that a program can check: calls, dataclasses and private names of all of `src/neeco`."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from source_trees import module_paths, module_trees

ROOT = Path(__file__).parents[1]
MAX_POSITIONAL = 6  # arguments of a call, fields of a dataclass
# Callables that take arguments by position alone: the C++ kernels, torch's autograd, struct
POSITIONAL_ONLY = ("native().", "_Pose.apply", "struct.pack")
TRITON = "neeco.raster.triton"  # kernels, whose arguments are addresses and strides

FRAGMENTS = {"What", "How", "Where", "Which", "Of", "As", "By", "From", "With", "In"}
PUBLIC_LONG = {"neeco.geometry.camera.Camera"}  # dataclasses that users call by position
PRIVATE_IN_TESTS = {  # at most ten
    "_bagfile",
    "_dispatch",
    "_kernel",
    "_output",
    "_progress",
    "_run",
    "_search",
    "_verb",
}


def long_calls(tree: ast.Module) -> Iterator[str]:
    """Calls with too many positional arguments, `line: callable`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and len(node.args) > MAX_POSITIONAL:
            called = ast.unparse(node.func)
            if not called.startswith(POSITIONAL_ONLY):
                yield f"{node.lineno}: {called}"


def long_dataclasses(tree: ast.Module) -> Iterator[str]:
    """Dataclasses with too many positional fields, `line: name`."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.ClassDef):
            continue
        decorators = [ast.unparse(item) for item in node.decorator_list]
        if not any("dataclass" in item and "kw_only=True" not in item for item in decorators):
            continue
        fields = [item for item in node.body if isinstance(item, ast.AnnAssign)]
        by_keyword = next((at for at, item in enumerate(fields) if "KW_ONLY" in ast.unparse(item.annotation)), None)
        positional = [
            item
            for item in fields[:by_keyword]
            if "ClassVar" not in ast.unparse(item.annotation)
            and (item.value is None or "kw_only=True" not in ast.unparse(item.value))
        ]
        if len(positional) > MAX_POSITIONAL:
            yield f"{node.lineno}: {node.name}"


def private_imports(tree: ast.Module, importer: str, known: set[str]) -> Iterator[str]:
    """Imports of another module's `_name`, or of a `_module` of a package that `importer` is outside of."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            imported = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            imported = [alias.name for alias in node.names]
        else:
            continue
        for name in imported:
            parts = name.split(".")
            private = next((at for at, part in enumerate(parts) if part.startswith("_") and part[:2] != "__"), None)
            if parts[0] != "neeco" or private is None:
                continue
            package, module = ".".join(parts[:private]), ".".join(parts[: private + 1])
            inside = importer == package or importer.startswith(f"{package}.")
            if not (inside and module in known):
                yield f"{node.lineno}: {module}"


def known_modules() -> set[str]:
    return {*module_paths(), "neeco._native"}


def test_no_call_has_more_than_six_positional_arguments() -> None:
    ours = {name: tree for name, tree in module_trees().items() if not name.startswith(TRITON)}
    assert [f"{name}:{item}" for name, tree in ours.items() for item in long_calls(tree)] == []


def test_a_dataclass_of_more_than_six_fields_is_keyword_only() -> None:
    found = [(name, item) for name, tree in module_trees().items() for item in long_dataclasses(tree)]
    assert [f"{name}:{item}" for name, item in found if f"{name}.{item.split(': ')[1]}" not in PUBLIC_LONG] == []


def test_what_is_private_is_not_imported_from_outside() -> None:
    known = known_modules()
    found = [(name, item) for name, tree in module_trees().items() for item in private_imports(tree, name, known)]
    assert [f"{name}:{item}" for name, item in found] == []


def private_names_in(tree: ast.Module) -> Iterator[str]:
    """Private names of ours that a test imports, patches or reads from a module of ours, `line: name`."""
    known = known_modules()
    yield from (item for item in private_imports(tree, "tests", known) if not item.endswith(" neeco._native"))
    ours = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.level == 0:
            names = {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
            ours.update({name: full for name, full in names.items() if full in known})
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and node.attr.startswith("_") and node.attr[:2] != "__":
            if isinstance(node.value, ast.Name) and node.value.id in ours:
                yield f"{node.lineno}: {ours[node.value.id]}.{node.attr}"
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("monkeypatch.setattr"):
            texts = [item.value for item in node.args[:2] if isinstance(item, ast.Constant)]
            for text in texts:
                if isinstance(text, str) and text.split(".")[-1].startswith("_") and text[:2] != "__":
                    yield f"{node.lineno}: {text}"


def test_tests_use_only_the_private_names_listed() -> None:
    paths = sorted((ROOT / "tests").rglob("*.py"))
    found = [
        f"{path.relative_to(ROOT)}:{item}" for path in paths for item in private_names_in(ast.parse(path.read_text()))
    ]
    excess = [item for item in found if re.split("[ .]", item)[-1] not in PRIVATE_IN_TESTS]
    assert not excess, "\n".join(excess)
    assert len(PRIVATE_IN_TESTS) <= 10


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("from neeco.capture._motion import Rays", ["1: neeco.capture._motion"]),
        ("from neeco.capture import _motion", ["1: neeco.capture._motion"]),
        ("from neeco.scene.gaussian_scene import _hidden", ["1: neeco.scene.gaussian_scene._hidden"]),
        ("from neeco.ingest._steps import step", []),
        ("from __future__ import annotations\nfrom neeco.scene import scene\nfrom neeco import __version__", []),
    ],
)
def test_a_private_import_is_found(source: str, found: list[str]) -> None:
    known = {"neeco.capture._motion", "neeco.ingest._steps", "neeco.scene.gaussian_scene"}
    assert list(private_imports(ast.parse(source), "neeco.ingest.pipeline", known)) == found


def fragments(tree: ast.Module) -> Iterator[str]:
    """Docstrings whose first word begins no sentence and names no thing, `line: first line`."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            continue
        text = ast.get_docstring(node) or "Nothing"
        if text.split()[0] in FRAGMENTS:
            yield f"{getattr(node, 'lineno', 1)}: {text.splitlines()[0]}"


def test_a_docstring_begins_with_a_verb_or_names_its_result() -> None:
    assert [f"{name}:{item}" for name, tree in module_trees().items() for item in fragments(tree)] == []


def test_a_fragment_is_found() -> None:
    source = 'def f():\n    """What f finds."""\ndef g():\n    """Return what g finds."""'
    assert list(fragments(ast.parse(source))) == ["1: What f finds."]


def test_long_calls_and_dataclasses_are_found() -> None:
    seven = "\n".join(f"    {letter}: int" for letter in "abcdefg")
    assert list(long_calls(ast.parse("f(1, 2, 3, 4, 5, 6, 7)\nf(1, 2, 3, 4, 5, 6, g=7)"))) == ["1: f"]
    assert list(long_dataclasses(ast.parse(f"@dataclass(frozen=True)\nclass A:\n{seven}"))) == ["2: A"]
    assert list(long_dataclasses(ast.parse(f"@dataclass(kw_only=True)\nclass A:\n{seven}"))) == []
