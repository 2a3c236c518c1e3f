"""Measure the structure: rooms, the imports between them, circles of files, and the size of code.

``python tools/house.py`` prints one JSON object: the figures of the whole tree and those of
`estimation`.  A room of the tree is a wing of the package, a loose file of it, `scenarios` or
`tools`; a room of a wing is a folder in it, or a loose file.  An arrow means that at least one file
of a room imports from another; it runs up where `house_order` has them the other way round.
Imports inside functions and under ``TYPE_CHECKING`` count.
"""

import ast
import json
from collections import Counter
from collections.abc import Iterable, Mapping
from functools import cache
from itertools import chain
from pathlib import Path

from house_order import ROOMS, WINGS
from house_sizes import sizes

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "magfusion"
Graph = Mapping[str, set[str]]


def name_of(path: Path) -> str:
    """Return the dotted name of a module; of a package's ``__init__`` that of the package."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def modules() -> dict[str, Path]:
    """Return every module of the package by its dotted name."""
    return {name_of(path): path for path in sorted(PACKAGE.rglob("*.py"))}


@cache
def parsed(path: Path) -> ast.Module:
    """Return the syntax tree of a file."""
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def nodes_of(path: Path) -> tuple[ast.AST, ...]:
    """Return every node of a file's syntax tree, breadth first."""
    return tuple(ast.walk(parsed(path)))


@cache
def imports_of(path: Path) -> tuple[str, ...]:
    """Return the dotted names that a file imports, wherever the import is."""
    result: list[str] = []
    for node in nodes_of(path):
        if isinstance(node, ast.Import):
            result += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide the floor"
            result += [f"{node.module}.{alias.name}" for alias in node.names]
    return tuple(result)


def own_imports(path: Path) -> set[str]:
    """Return the modules of the package that a file imports."""
    known, result = modules(), set()
    for name in imports_of(path):
        while name and name not in known:
            name = name.rpartition(".")[0]
        if name:
            result.add(name)
    return result


@cache
def file_graph() -> dict[str, set[str]]:
    """Return which modules of the package each imports."""
    return {name: own_imports(path) - {name} for name, path in modules().items()}


def room_of(module: str, wing: str | None = None) -> str | None:
    """Return the room of the package, or of a wing, that a module is in; None where in none."""
    if wing is None and module == "magfusion":
        return "__init__"
    own = "magfusion." if wing is None else f"magfusion.{wing}."
    return module.removeprefix(own).split(".")[0] if module.startswith(own) else None


def arrows(wing: str | None = None) -> set[tuple[str, str]]:
    """Return every pair of rooms of which the first imports from the second."""
    pairs = {
        (room_of(module, wing), room_of(other, wing))
        for module, seen in file_graph().items()
        for other in seen
    }
    if wing is None:
        for folder in ("scenarios", "tools"):
            for path in (ROOT / folder).rglob("*.py"):
                pairs |= {(folder, room_of(other)) for other in own_imports(path)}
    return {(a, b) for a, b in pairs if a is not None and b is not None and a != b}


def upward(wing: str | None = None) -> list[str]:
    """Return the arrows that run up, and the rooms that `house_order` does not know."""
    order = WINGS if wing is None else ROOMS[wing]
    rooms = {room_of(module, wing) for module in modules()} - {None}
    here = f"magfusion.{wing}" if wing else "magfusion"
    out = [f"{here}.{room} is not in tools/house_order.py" for room in rooms if room not in order]
    out += [
        f"{here}: {a} imports {b}"
        for a, b in sorted(arrows(wing))
        if a in order and b in order and order.index(a) < order.index(b)
    ]
    return sorted(out)


def circles(graph: Graph) -> list[list[str]]:
    """Return the nodes that can reach one another, each circle sorted (Tarjan's algorithm)."""
    number: dict[str, int] = {}
    lowest: dict[str, int] = {}
    open_nodes: list[str] = []
    result: list[list[str]] = []

    def visit(node: str) -> None:
        number[node] = lowest[node] = len(number)
        open_nodes.append(node)
        for other in graph.get(node, ()):
            if other not in number:
                visit(other)
                lowest[node] = min(lowest[node], lowest[other])
            elif other in open_nodes:
                lowest[node] = min(lowest[node], number[other])
        if lowest[node] == number[node]:
            begin = open_nodes.index(node)
            result.append(sorted(open_nodes[begin:]))
            del open_nodes[begin:]

    for node in graph:
        if node not in number:
            visit(node)
    return [circle for circle in result if len(circle) > 1]


def room_circles() -> list[list[str]]:
    """Return the circles of the tree's rooms."""
    pairs = arrows()
    return circles({a: {b for x, b in pairs if x == a} for a, _ in pairs})


def files_by_folder(wing: str | None = None) -> Counter[Path]:
    """Return how many files each folder holds, besides its ``__init__.py``."""
    place = PACKAGE if wing is None else PACKAGE / wing
    return Counter(p.parent for p in place.rglob("*.py") if p.name != "__init__.py")


def imported_once() -> list[str]:
    """Return the modules that exactly one other module of the package imports."""
    users = Counter(chain.from_iterable(file_graph().values()))
    return sorted(name for name, count in users.items() if count == 1)


def shape(wing: str | None = None) -> dict[str, float]:
    """Return the figures of rooms and imports, of the tree or of a wing of it."""
    own = "magfusion" if wing is None else f"magfusion.{wing}"
    inside = {name: seen for name, seen in file_graph().items() if f"{name}.".startswith(f"{own}.")}
    place = PACKAGE if wing is None else PACKAGE / wing
    folders, pairs = files_by_folder(wing), arrows(wing)
    rooms = {room_of(name, wing) for name in inside} - {None}
    counts = [len(seen) for seen in inside.values()]
    return {
        "rooms": len(rooms) + (2 if wing is None else 0),  # scenarios and tools
        "arrows": len(pairs),
        "upward": len(upward(wing)),
        "loose_files": folders[place] + (wing is None),
        "largest_folder": max(folders.values()),
        "circles_of_files": len(circles(inside)),
        "own_imports_mean": round(sum(counts) / len(counts), 2),
        "own_imports_max": max(counts),
        "imported_by_one": sum(name in inside for name in imported_once()),
    }


def measured() -> dict[str, dict[str, float]]:
    """Return the figures of the whole tree and of `estimation`."""
    wings = sum(len(upward(wing)) for wing in ROOMS)
    whole = shape() | {"upward_in_wings": wings, "rooms_in_a_circle": _inside(room_circles())}
    own = {path: parsed(path) for path in modules().values()}
    here = {path: tree for path, tree in own.items() if "estimation" in path.parts}
    tests = {path: parsed(path) for path in sorted((ROOT / "tests").glob("*.py"))}
    return {
        "tree": whole | sizes(own, own, tests),
        "estimation": shape("estimation") | sizes(here, own),
    }


def _inside(result: Iterable[list[str]]) -> int:
    return sum(map(len, result))


if __name__ == "__main__":
    print(json.dumps(measured(), indent=1))
