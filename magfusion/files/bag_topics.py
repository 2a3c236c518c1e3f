"""What is known of a bag before it is read: that it is one, and which of its topics to read."""

from dataclasses import dataclass
from pathlib import Path

from magfusion.errors import InputError

BAG_SUFFIXES = (".mcap", ".db3", ".bag")
UNFINISHED = ".bag.active"  # as ROS 1 leaves a bag of which the recorder was killed


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
        return [path] if _is_file_of_bag(path) else []
    if (path / "metadata.yaml").is_file():
        return [path]
    return files_in(path)


def files_in(directory: Path) -> list[Path]:
    """Return the files of bags in a directory."""
    return sorted(p for p in directory.iterdir() if p.is_file() and _is_file_of_bag(p))


def refuse_bag_folders(path: Path) -> None:
    """Refuse a folder with folders of bags in it, by how these are given."""
    folders = sorted(p for p in path.iterdir() if p.is_dir() and is_bag(p)) if path.is_dir() else []
    if folders:
        parts = " ".join(map(str, folders))
        raise InputError(
            f"{path}: holds {len(folders)} folders of bags; give one of them, or join parts of one"
            f" recording by magfusion import {parts} -o LOG."
        )


def _is_file_of_bag(path: Path) -> bool:
    return path.suffix in BAG_SUFFIXES or path.name.endswith(UNFINISHED)


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag: a directory of one, or a single file."""
    return bool(bag_files(path))
