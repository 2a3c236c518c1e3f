"""Which commit this package is of: the build's word, or that of the git checkout it runs from."""

import subprocess
from importlib.resources import files
from pathlib import Path


def commit() -> str | None:
    """Return the short name of the commit; None if unknown.

    A wheel has it from `hatch_build.py`; it ends in ``-dirty`` where files had been changed since.
    """
    package = files("magfusion")
    built = package / "commit.txt"
    if built.is_file():
        return built.read_text(encoding="utf-8").strip()
    root = Path(str(package)).parent
    if not (root / ".git").exists():
        return None
    requested = ["git", "-C", str(root), "describe", "--always", "--dirty", "--exclude=*"]
    try:
        done = subprocess.run(requested, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()
