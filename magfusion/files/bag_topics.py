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


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag: a directory with its metadata, or a single file."""
    return (path / "metadata.yaml").is_file() if path.is_dir() else path.suffix in BAG_SUFFIXES
