"""Print the lowest versions that `pyproject.toml` allows, as constraints for pip.

They are true on the oldest Python that the package accepts::

    python tools/lowest.py > lowest.txt
    pip install -c lowest.txt '.[test]'
"""

import re
import tomllib
from pathlib import Path
from typing import Any

PYPROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"
LOWER_BOUND = re.compile(r"^([\w.-]+)(?:\[[\w,]+\])?>=([\w.]+)")


def lowest(project: dict[str, Any]) -> list[str]:
    """Return ``name==version`` for every dependency and every extra of a `[project]` table.

    Raises
    ------
    ValueError
        Where a dependency has no lower bound.
    """
    pins = set()
    for requirement in sum(project["optional-dependencies"].values(), project["dependencies"]):
        bound = LOWER_BOUND.match(requirement)
        if bound is None:
            raise ValueError(f"{requirement}: no lower bound; write name>=version")
        pins.add(f"{bound[1]}=={bound[2]}")
    return sorted(pins)


if __name__ == "__main__":
    print(*lowest(tomllib.loads(PYPROJECT.read_text())["project"]), sep="\n")
