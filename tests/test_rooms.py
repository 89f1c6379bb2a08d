"""The code is a stack of rooms: a room imports only from rooms below it, and modules do not import in circles."""

from __future__ import annotations

import ast
import functools
import itertools

import pytest
from source_trees import SOURCE, module_paths, module_trees

ROOMS = (  # from the top down; rooms of one line do not know each other
    ("cli",),
    ("api",),
    ("viewer", "report"),
    ("studies",),
    ("ingest",),
    ("tracking",),
    ("synthesis",),
    ("evaluation",),
    ("labels",),
    ("methods",),
    ("training",),
    ("states",),
    ("evidence",),
    ("scene",),
    ("capture",),
    ("raster",),
    ("geometry",),
    ("base",),
)
LEVELS = {room: level for level, rooms in enumerate(ROOMS) for room in rooms}
# folders of ingest from the top down, below its own modules
INGEST = (
    *("posing", "registration", "shaft", "cameras", "foreground"),
    *("frames", "timing", "recording", "readers", "calibration"),
)
OUTSIDE = ("__init__", "__main__", "_native")  # the package's version, its start (the command line's), the C++ kernels
Graph = dict[str, set[str]]  # module -> modules it imports anywhere: at its top, in functions, for types alone


def imports_of(source: str | ast.Module, package: str, known: set[str]) -> set[str]:
    """Modules of `known` that a module in `package` imports; of `from neeco.a import b`, neeco.a.b if it is one."""
    found = set()
    for node in ast.walk(ast.parse(source) if isinstance(source, str) else source):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            levels = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*levels, *([node.module] if node.module else [])])
            submodules = {f"{base}.{alias.name}" for alias in node.names} & known
            found |= submodules
            # `from neeco.a import b, C`: C comes from neeco.a itself; b does not need what neeco.a holds
            if len(submodules) < len(node.names):
                found.add(base)
    return found & known


@functools.cache
def graph() -> Graph:
    paths, trees = module_paths(), module_trees()
    return {
        name: imports_of(trees[name], name if path.name == "__init__.py" else name.rpartition(".")[0], set(paths))
        for name, path in paths.items()
    }


def room(module: str) -> str:
    return module.split(".")[1] if "." in module else "__init__"


def folders(imports: Graph) -> Graph:
    """The imports between folders. A package's own names count as its folder's; what it re-exports does not."""
    packages = {name for name, path in module_paths().items() if path.name == "__init__.py"}

    def folder(module: str) -> str:
        return module if module in packages else module.rpartition(".")[0]

    found: Graph = {folder(module): set() for module in imports}
    for module, others in imports.items():
        inside = f"{module}." if module in packages else None
        imported = {folder(other) for other in others if inside is None or not other.startswith(inside)}
        found[folder(module)] |= imported - {folder(module)}
    return found


def upward(imports: Graph) -> list[str]:
    """Imports that do not lead down, `importer -> imported`."""
    return [
        f"{module} -> {other}"
        for module, others in sorted(imports.items())
        for other in sorted(others)
        if room(module) not in OUTSIDE
        and room(other) not in OUTSIDE
        and room(module) != room(other)
        and LEVELS[room(module)] >= LEVELS[room(other)]
    ]


def circles(imports: Graph) -> list[str]:
    """Every group of modules that reach each other (Tarjan's strongly connected components)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found = []

    def visit(module: str) -> None:
        index[module] = low[module] = len(index)
        stack.append(module)
        for other in sorted(imports[module] - {module}):
            if other not in index:
                visit(other)
            if other in stack:
                low[module] = min(low[module], low[other])
        if low[module] == index[module]:
            group = stack[stack.index(module) :]
            del stack[stack.index(module) :]
            if len(group) > 1:
                found.append(" <-> ".join(sorted(group)))

    for module in sorted(imports):
        if module not in index:
            visit(module)
    return found


def test_every_room_has_its_place() -> None:
    assert {room(module) for module in module_paths()} <= {*LEVELS, *OUTSIDE}


def test_a_room_imports_only_from_rooms_below() -> None:
    assert upward(graph()) == []


def reduced(edges: Graph) -> Graph:
    """The edges that follow from no others (the transitive reduction of a graph without circles)."""

    @functools.cache
    def reached(start: str) -> set[str]:
        return edges[start].union(*(reached(other) for other in edges[start]))

    return {a: edges[a] - set().union(*(reached(b) for b in edges[a])) for a in edges if edges[a]}


def test_the_drawing_in_contributing_is_of_the_imports() -> None:
    low = {*OUTSIDE, *ROOMS[-1]}  # what every room may import is not in the drawing
    edges: Graph = {name: set() for line in ROOMS for name in line if name not in low}
    for module, others in graph().items():
        if room(module) in edges:
            edges[room(module)] |= {room(other) for other in others} - {room(module), *low}
    drawing = (SOURCE.parent / "CONTRIBUTING.md").read_text().split("graph TD\n")[1].split("```")[0]
    drawn: Graph = {}
    for line in drawing.splitlines():
        steps = [step.split(" & ") for step in line.strip().split(" --> ")]
        for sources, targets in itertools.pairwise(steps):
            for source in sources:
                drawn.setdefault(source, set()).update(targets)
    assert drawn == reduced(edges)


def test_no_circle_between_modules() -> None:
    lazy = "neeco"  # its names are imported when they are first used; others take the version from it
    assert circles({module: others - {lazy} for module, others in graph().items()}) == []


def test_no_circle_between_folders() -> None:
    imports = folders(graph())
    root = "neeco"  # holds what uses all (api)
    assert circles({folder: others - {root} for folder, others in imports.items()}) == []


def test_a_folder_of_ingest_imports_only_from_folders_below() -> None:
    imports = folders(graph())
    for level, name in enumerate(INGEST):
        below = {f"neeco.ingest.{other}" for other in INGEST[level + 1 :]}
        assert {other for other in imports[f"neeco.ingest.{name}"] if other.startswith("neeco.ingest")} <= below
    listed = {f"neeco.ingest.{name}" for name in INGEST}
    assert {folder for folder in imports if folder.startswith("neeco.ingest.")} == listed


@pytest.mark.parametrize(
    "source",
    [
        "from neeco.cli import main",
        "import neeco.cli",
        "from neeco import cli",
        "def f():\n    from neeco.cli import main",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from neeco.cli import main",
        "from ..cli import main",
        "from .. import cli",
    ],
)
def test_an_import_upward_is_seen_wherever_it_stands(source: str) -> None:
    known = {"neeco", "neeco.cli", "neeco.raster", "neeco.raster.rasterization"}
    imports = {"neeco.raster.rasterization": imports_of(source, "neeco.raster", known)}
    assert upward(imports) == ["neeco.raster.rasterization -> neeco.cli"]


def test_rooms_of_one_line_do_not_know_each_other() -> None:
    assert upward({"neeco.report.page": {"neeco.viewer.page"}}) == ["neeco.report.page -> neeco.viewer.page"]


def test_circles_are_found() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": {"e"}, "e": set()}) == ["a <-> b <-> c"]
