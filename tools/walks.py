"""How far does a reader walk who follows a command through the source? Stays, files and returns.

    python tools/walks.py [MODULE:FUNCTION ...] [--list]

From the start every call is followed, in the order of the text, depth first, each function once. A stay is a function
visited; a return is a step from one to the next in another file that had a stay before. Rooms of general tools (BELOW)
are not entered. A call names what the module has or imports, a method of `self`, or else the only method of that name
in the package; of several, the only one in PREFERRED modules; others are not followed. A class stands for its
constructors. Numbers compare versions of this source."""

from __future__ import annotations

import argparse
import ast
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

SOURCE = Path(__file__).resolve().parents[1] / "src"
STARTS = ("neeco.cli.train:run", "neeco.cli.ingest:run", "neeco.cli.track:run")
PREFERRED = ("neeco.methods.kinematic", "neeco.training.session")
BELOW = ("neeco.base", "neeco.geometry", "neeco.raster", "neeco.capture")
CONSTRUCTORS = ("__init__", "__post_init__")
Key = tuple[str, str]  # module, qualified name of a function or class


@dataclass
class Source:
    """Functions, classes and imports of a package, by module."""

    functions: dict[Key, ast.FunctionDef] = field(default_factory=dict)
    classes: dict[Key, ast.ClassDef] = field(default_factory=dict)
    imports: dict[str, dict[str, str]] = field(default_factory=dict)  # module -> name -> dotted name
    methods: dict[str, list[Key]] = field(default_factory=dict)  # by attribute

    @classmethod
    def read(cls, folder: Path) -> Source:
        """Read all modules below `folder`, which holds packages."""
        source = cls()
        for path in sorted(folder.rglob("*.py")):
            parts = path.relative_to(folder).with_suffix("").parts
            module = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            tree = ast.parse(path.read_text(encoding="utf-8"))
            source.imports[module] = dict(_imported(tree))
            source._add(module, tree.body, "")
        return source

    def _add(self, module: str, body: list[ast.stmt], owner: str) -> None:
        for node in body:
            if isinstance(node, ast.ClassDef):
                self.classes[module, node.name] = node
                self._add(module, node.body, f"{node.name}.")
            elif isinstance(node, ast.FunctionDef):
                self.functions[module, owner + node.name] = node
                if owner:
                    self.methods.setdefault(node.name, []).append((module, owner + node.name))

    def resolve(self, module: str, name: str) -> Key | None:
        """Return the function or class that a name of a module stands for."""
        seen = set()
        while (module, name) not in self.functions and (module, name) not in self.classes:
            dotted = self.imports.get(module, {}).get(name, "")
            if not dotted or (module, name) in seen:
                return None
            seen.add((module, name))
            module, _, name = dotted.rpartition(".")
        return module, name

    def method(self, owner: Key | None, name: str) -> Key | None:
        """Return a method of a class or of its bases."""
        if owner is None or owner not in self.classes:
            return None
        if (key := (owner[0], f"{owner[1]}.{name}")) in self.functions:
            return key
        bases = (base.id for base in self.classes[owner].bases if isinstance(base, ast.Name))
        found = (self.method(self.resolve(owner[0], base), name) for base in bases)
        return next((key for key in found if key), None)

    def called(self, caller: Key, call: ast.Call) -> list[Key]:
        """Return the functions that a call in `caller` leads to, none where that is not known."""
        (module, qualified), function = caller, call.func
        if isinstance(function, ast.Name):
            return self._constructed(self.resolve(module, function.id))
        if not isinstance(function, ast.Attribute):
            return []
        if isinstance(function.value, ast.Name):
            owner = function.value.id
            if owner in ("self", "cls") and "." in qualified:
                own = self.method((module, qualified.partition(".")[0]), function.attr)
                if own:
                    return [own]
            dotted = self.imports[module].get(owner, "")
            if (key := self.resolve(dotted, function.attr)) is not None:
                return self._constructed(key)
            if (key := self.method(self.resolve(module, owner), function.attr)) is not None:
                return [key]
        known = self.methods.get(function.attr, [])
        if len(known) > 1:
            known = [key for key in known if key[0].startswith(PREFERRED)]
        return known if len(known) == 1 else []

    def _constructed(self, key: Key | None) -> list[Key]:
        if key in self.classes:
            return [found for name in CONSTRUCTORS if (found := self.method(key, name))]
        return [key] if key else []

    def walk(self, start: Key) -> list[Key]:
        """Return the functions that a reader visits from `start`, in order."""
        visited: dict[Key, None] = {}

        def visit(key: Key) -> None:
            visited[key] = None
            calls = [node for node in ast.walk(self.functions[key]) if isinstance(node, ast.Call)]
            for call in sorted(calls, key=lambda node: (node.lineno, node.end_col_offset or 0)):
                for other in self.called(key, call):
                    if other not in visited and not other[0].startswith(BELOW):
                        visit(other)

        visit(start)
        return list(visited)


def _imported(tree: ast.Module) -> Iterator[tuple[str, str]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            yield from ((alias.asname or alias.name, f"{node.module}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from ((alias.asname or alias.name, alias.name) for alias in node.names)


def count(walked: list[Key]) -> tuple[int, int, int]:
    """Return the numbers of stays, files and returns."""
    modules = [module for module, _ in walked]
    entered = [module for before, module in zip(["", *modules], modules, strict=False) if before != module]
    return len(modules), len(set(modules)), len(entered) - len(set(modules))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("starts", nargs="*", default=STARTS, metavar="MODULE:FUNCTION")
    parser.add_argument("--source", type=Path, default=SOURCE, help="folder with the package")
    parser.add_argument("--list", action="store_true", help="print every stay")
    arguments = parser.parse_args()
    read = Source.read(arguments.source)
    for begin in arguments.starts:
        module_name, _, function_name = begin.partition(":")
        stays = read.walk((module_name, function_name))
        if arguments.list:
            print("\n".join(f"{module}:{name}" for module, name in stays))
        print("{}: {} stays in {} files, {} returns".format(begin, *count(stays)))
