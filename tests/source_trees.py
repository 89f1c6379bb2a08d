"""The sources of `neeco`, parsed once for all tests that read them."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

SOURCE = Path(__file__).parents[1] / "src"


@cache
def module_paths() -> dict[str, Path]:
    """Files of the package's modules by name; a package's own is named by its folder. Not to be changed."""
    names = {}
    for path in sorted((SOURCE / "neeco").rglob("*.py")):
        parts = path.relative_to(SOURCE).with_suffix("").parts
        names[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return names


@cache
def module_trees() -> dict[str, ast.Module]:
    """Syntax trees of the package's modules by name. Not to be changed."""
    return {name: ast.parse(path.read_text(encoding="utf-8"), str(path)) for name, path in module_paths().items()}
