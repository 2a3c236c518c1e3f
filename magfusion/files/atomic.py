"""Directories appear whole or not at all; for single files see `yaml_files.whole_file`."""

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from magfusion.errors import InputError


def refuse_in_the_way(path: Path, replaces: Callable[[Path], bool]) -> None:
    """Refuse a path at which no directory can be written, before any work is done for it.

    Raises
    ------
    InputError
        As `whole_directory`.
    """
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file; give the path of a directory to write.")
    if path.exists() and any(path.iterdir()) and not replaces(path):
        raise InputError(f"{path}: holds other files; give the path of a new directory.")
    nearest = next(parent for parent in (path, *path.parents) if parent.exists())
    if not nearest.is_dir() or not os.access(nearest, os.W_OK | os.X_OK):
        raise InputError(f"{path}: cannot be written in {nearest}; give another path.")


@contextmanager
def whole_directory(path: Path, replaces: Callable[[Path], bool]) -> Iterator[Path]:
    """Yield a temporary directory beside ``path`` that takes its place only if nothing fails.

    Parameters
    ----------
    replaces : callable
        Whether the directory that is there may be replaced; an empty one always may.

    Raises
    ------
    InputError
        Where something else is at ``path``, or nothing can be written there.
    """
    path = path.resolve()
    refuse_in_the_way(path, replaces)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    made = [parent for parent in path.parents if not parent.exists()]
    try:
        _make(unfinished)
        yield unfinished
        _take_place(unfinished, path)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
        if not path.exists():
            _remove_empty(made)


def _make(path: Path) -> None:
    try:
        path.mkdir(parents=True)
    except OSError as error:
        raise InputError(
            f"{path.parent}: cannot be written ({error.strerror}); give another path."
        ) from error


def _remove_empty(directories: list[Path]) -> None:
    with suppress(OSError):
        for directory in directories:
            directory.rmdir()


def _take_place(unfinished: Path, path: Path) -> None:
    if not path.exists():
        unfinished.rename(path)
        return
    former = unfinished.with_name(f"{unfinished.name}.former")
    path.rename(former)
    try:
        unfinished.rename(path)
    except OSError:
        former.rename(path)
        raise
    shutil.rmtree(former)
