"""What is known of a bag before it is read: that it is one, and which of its topics to read."""

from dataclasses import dataclass
from pathlib import Path

BAG_SUFFIXES = (".mcap", ".db3", ".bag")


@dataclass(frozen=True)
class Topics:
    """Names of the topics to read; None takes the only one of the type."""

    imu: str | None = None
    magnetometer: str | None = None
    truth: str | None = None


def bag_files(path: Path) -> list[Path]:
    """Return what the library opens of a bag; nothing of what is none.

    A directory with its metadata is opened as such, one without by the files in it.
    """
    if not path.is_dir():
        return [path] if path.suffix in BAG_SUFFIXES else []
    if (path / "metadata.yaml").is_file():
        return [path]
    return sorted(p for p in path.iterdir() if p.is_file() and p.suffix in BAG_SUFFIXES)


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag: a directory of one, or a single file."""
    return bool(bag_files(path))
