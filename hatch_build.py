"""Give a wheel and an sdist what the tree cannot: the commit, a README with absolute links."""

import re
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface

# ![text](place) and [text](place), where the place is a file of the repository.
RELATIVE_LINK = re.compile(r"(!?)\[([^\]]*)\]\((?![a-z]+:|#)([^)]+)\)")


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


class ReadmeHook(MetadataHookInterface):
    """Give the metadata the README with absolute links, as a package index shows it."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set ``readme``."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        repository = metadata.get("urls", {}).get("Repository")
        text = absolute_links(text, repository, f"v{metadata['version']}")
        metadata["readme"] = {"content-type": "text/markdown", "text": text}


def absolute_links(text: str, repository: str | None, tag: str) -> str:
    """Return Markdown with links to files of a tag of the repository.

    Where no repository is known, the text of a link stays without its target.
    """

    def absolute(link: re.Match[str]) -> str:
        image, label, place = link.groups()
        if repository is None:
            return f"*{label}*" if image else label
        kind = "raw" if image else "blob"
        return f"{image}[{label}]({repository.rstrip('/')}/{kind}/{tag}/{place})"

    return RELATIVE_LINK.sub(absolute, text)
