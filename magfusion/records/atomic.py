"""Directories appear whole or not at all; single files by `magfusion.files.whole_file`."""

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from magfusion.errors import InputError


@contextmanager
def whole_directory(path: Path, replaces: Callable[[Path], bool]) -> Iterator[Path]:
    """Yield a temporary directory beside ``path`` that takes its place only if nothing fails.

    Parameters
    ----------
    path : Path
    replaces : callable
        Whether the directory that is there may be replaced; an empty one always may.

    Raises
    ------
    InputError
        Where something else is at ``path``, or nothing can be written there.
    """
    path = path.resolve()
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file; give the path of a directory to write.")
    if path.exists() and any(path.iterdir()) and not replaces(path):
        raise InputError(f"{path}: holds other files; give the path of a new directory.")
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        unfinished.mkdir(parents=True)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror}); give another path."
        ) from error
    try:
        yield unfinished
        _take_place(unfinished, path)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


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
