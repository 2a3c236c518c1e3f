"""What a wheel and an sdist know of the commit that they were built of: `magfusion --version`."""

import subprocess
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class CommitHook(BuildHookInterface[Any]):
    """Put the name of the commit into the package; without git, an sdist's own stays."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add ``magfusion/commit.txt`` to what is built; an editable install asks git instead."""
        root = Path(self.root)
        if version == "editable" or not (root / ".git").exists():
            return
        asked = ["git", "-C", str(root), "describe", "--always", "--dirty", "--exclude=*"]
        try:
            done = subprocess.run(asked, capture_output=True, text=True, check=True)
        except (OSError, subprocess.CalledProcessError):
            return
        with tempfile.NamedTemporaryFile("w", suffix=".txt", delete=False) as file:
            file.write(done.stdout)
        self.written = Path(file.name)
        build_data["force_include"][file.name] = "magfusion/commit.txt"

    def finalize(self, *_: Any) -> None:
        """Remove what was only on its way into the archive."""
        if hasattr(self, "written"):
            self.written.unlink(missing_ok=True)
