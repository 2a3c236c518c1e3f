"""Measure the structure: rooms, the arrows between them, loose files and lines.

``python tools/house.py`` prints one JSON line.  A room is a wing of the package, a loose file of
it, `scenarios` or `tools`; an arrow says that at least one file of a room imports from another.
"""

import ast
import json
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "magfusion"


def room_of(path: Path) -> str:
    """Return the room that a file belongs to."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return parts[1] if parts[0] == "magfusion" else parts[0]


def imported_rooms(path: Path) -> Iterator[str]:
    """Yield the rooms of the package that a file imports from, wherever the import stands."""
    for node in ast.walk(ast.parse(path.read_text())):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for name in names:
            parts = name.split(".")
            if parts[0] == "magfusion" and len(parts) > 1 and (PACKAGE / parts[1]).is_dir():
                yield parts[1]
            elif parts[0] == "magfusion":
                loose = parts[1] if len(parts) > 1 else "__init__"
                yield loose if (PACKAGE / f"{loose}.py").is_file() else "__init__"


def arrows() -> set[tuple[str, str]]:
    """Return every pair of rooms of which the first imports from the second."""
    files = [
        p for folder in ("magfusion", "scenarios", "tools") for p in (ROOT / folder).rglob("*.py")
    ]
    return {
        (room_of(path), other)
        for path in files
        for other in imported_rooms(path)
        if other != room_of(path)
    }


def circles(pairs: set[tuple[str, str]]) -> set[str]:
    """Return the rooms that can reach themselves."""
    reach = {a: {b for x, b in pairs if x == a} for a, _ in pairs}
    grown = True
    while grown:
        grown = False
        for seen in reach.values():
            more = set().union(*(reach.get(b, set()) for b in seen)) - seen
            seen |= more
            grown = grown or bool(more)
    return {room for room, seen in reach.items() if room in seen}


def measured() -> dict[str, int]:
    """Return the figures of the structure."""
    pairs = arrows()
    files = list(PACKAGE.rglob("*.py"))
    rooms = {room_of(p) for p in files} | {"scenarios", "tools"}
    return {
        "rooms": len(rooms),
        "arrows": len(pairs),
        "rooms_in_a_circle": len(circles(pairs)),
        "loose_files": len(list(PACKAGE.glob("*.py"))),
        "package_lines": sum(len(p.read_text().splitlines()) for p in files),
        "longest_file_lines": max(len(p.read_text().splitlines()) for p in files),
    }


if __name__ == "__main__":
    print(json.dumps(measured()))
