"""Files and directories appear whole or not at all."""

import os
import platform
import re
import shutil
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from magfusion.errors import InputError

UNFINISHED, FORMER = "unfinished", "former"  # what is written, and what it replaces, meanwhile


def refuse_in_the_way(path: Path, replaces: Callable[[Path], bool]) -> None:
    """Refuse a path at which no directory can be written, before any work is done for it."""
    if path.is_symlink() and not path.exists():
        raise InputError(f"{path}: is a symbolic link that leads nowhere; give another path.")
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file; give the path of a directory to write.")
    if path.exists() and any(path.iterdir()) and not replaces(path):
        raise InputError(f"{path}: holds other files; give the path of a new directory.")
    nearest = next(parent for parent in (path, *path.parents) if parent.exists())
    if not nearest.is_dir() or not os.access(nearest, os.W_OK | os.X_OK):
        raise InputError(f"{path}: cannot be written in {nearest}; give another path.")


def real(path: Path) -> Path:
    """Return a path without symbolic links, but for those that lead nowhere."""
    return Path(os.path.realpath(path))


@contextmanager
def naming(path: Path, unfinished: Path | None = None) -> Iterator[None]:
    """Name the path in errors of a system that do not name the file.

    `unfinished`: what it is called while it is written; a user knows no such name.
    """
    try:
        yield
    except OSError as error:
        if error.errno is None:
            raise  # not the system's
        named = str(path) if error.filename is None else str(error.filename)
        error.filename = named if unfinished is None else named.replace(str(unfinished), str(path))
        raise


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary name next to ``path`` that replaces it only on success."""
    clear_abandoned(path)
    unfinished = _temporary_path(path, UNFINISHED)
    try:
        with naming(path, unfinished):
            yield unfinished
            unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def clear_abandoned(path: Path) -> None:
    """Remove files of a killed run next to ``path``; restore those that it had moved."""
    own = re.compile(abandoned_pattern(re.escape(path.name)))
    for remaining in _entries(path.parent):
        result = own.fullmatch(remaining.name)
        if result is None or result["machine"] != _machine() or _runs(int(result["process"])):
            continue
        if result["kind"] == FORMER and not os.path.lexists(path):
            remaining.rename(path)
        elif remaining.is_dir():
            shutil.rmtree(remaining, ignore_errors=True)
        else:
            remaining.unlink(missing_ok=True)


def abandoned_pattern(name: str) -> str:
    """Return the regular expression of temporary names of a path, itself one."""
    kinds = f"{UNFINISHED}|{FORMER}"
    return rf"\.{name}\.(?P<machine>[0-9a-f]{{8}})-(?P<process>\d+)\.(?P<kind>{kinds})"


def _temporary_path(path: Path, kind: str) -> Path:
    return path.with_name(f".{path.name}.{_machine()}-{os.getpid()}.{kind}")


def _machine() -> str:
    # On a disk of several machines the number of a process says nothing of those elsewhere.
    return f"{zlib.crc32(platform.node().encode()):08x}"


def _entries(directory: Path) -> list[Path]:
    with suppress(OSError):
        return list(directory.iterdir())
    return []


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        return True  # another user's
    return True


@contextmanager
def whole_directory(
    path: Path,
    replaces: Callable[[Path], bool],
    backup: Callable[[Path], Path | None] = lambda _: None,
) -> Iterator[Path]:
    """Yield a temporary directory next to ``path`` that replaces it only on success.

    `replaces`: whether the directory that is there may be replaced; an empty one always may.
    `backup`: the path to which it is moved then; None removes it. Raises InputError where something
    else is at ``path``, or nothing can be written there.
    """
    path = real(path)
    refuse_in_the_way(path, replaces)
    clear_abandoned(path)
    unfinished = _temporary_path(path, UNFINISHED)
    built = [parent for parent in path.parents if not parent.exists()]
    try:
        _make(unfinished)
        with naming(path, unfinished):
            yield unfinished
            _take_place(unfinished, path, backup)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
        if not path.exists():
            _remove_empty(built)


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


def _take_place(unfinished: Path, path: Path, backup: Callable[[Path], Path | None]) -> None:
    if not path.exists():
        unfinished.rename(path)
        return
    kept = backup(path)
    former = kept or _temporary_path(path, FORMER)
    path.rename(former)
    try:
        unfinished.rename(path)
    except OSError:
        former.rename(path)
        raise
    if kept is None:
        shutil.rmtree(former)
