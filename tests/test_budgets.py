"""The source does not grow: lines of each room, files, functions and numbers at module level have a limit.

A limit is what was reached last; who deletes lowers it. `pytest tests/test_budgets.py -s` prints what there is, beside
the limit and the aim.
"""

from __future__ import annotations

import ast
from collections import Counter

import pytest
from source_trees import module_paths, module_trees

# lines of Python: the limit, and the aim
ROOMS = {
    "cli": (1738, 1700),
    "viewer": (2765, 2100),
    "report": (1481, 1500),
    "studies": (3694, 2600),
    "ingest": (15_018, 10_500),
    "tracking": (1611, 1200),
    "synthesis": (4114, 3200),
    "evaluation": (1301, 1200),
    "labels": (866, 800),
    "methods": (5092, 3500),
    "training": (1973, 1700),
    "states": (3257, 2600),
    "evidence": (1057, 1200),
    "scene": (1942, 1800),
    "capture": (4493, 3900),
    "raster": (3923, 3800),
    "geometry": (983, 1000),
    "base": (1544, 1500),
}
FILES, FUNCTIONS, NUMBERS = (281, 240), (3107, 3000), (284, 300)


def lines_of_rooms() -> Counter[str]:
    found: Counter[str] = Counter()
    for module, path in module_paths().items():
        if path.parent.name != "neeco":
            found[module.split(".")[1]] += len(path.read_text(encoding="utf-8").splitlines())
    return found


def numbers_at_module_level() -> int:
    """Numbers in constants, tuples of them and arithmetic, which are no fields of settings."""
    kinds = (ast.Constant, ast.Tuple, ast.UnaryOp, ast.BinOp)
    values = [
        statement.value
        for tree in module_trees().values()
        for statement in tree.body
        if isinstance(statement, ast.Assign | ast.AnnAssign) and isinstance(statement.value, kinds)
    ]
    return sum(
        isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool)
        for value in values
        for node in ast.walk(value)
    )


def require(what: str, there: int, limit: int, aim: int) -> None:
    print(f"{what:12} {there:6} limit {limit:6} aim {aim:6}")
    assert there <= limit, f"{what}: {there} are more than {limit}; delete as much as was added"


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_is_no_larger_than_it_was(room: str) -> None:
    require(room, lines_of_rooms()[room], *ROOMS[room])


def test_every_room_has_a_limit() -> None:
    assert lines_of_rooms().keys() == ROOMS.keys()


def test_files_functions_and_numbers_at_module_level_are_no_more_than_they_were() -> None:
    functions = sum(
        isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        for tree in module_trees().values()
        for node in ast.walk(tree)
    )
    require("files", len(module_paths()), *FILES)
    require("functions", functions, *FUNCTIONS)
    require("numbers", numbers_at_module_level(), *NUMBERS)
