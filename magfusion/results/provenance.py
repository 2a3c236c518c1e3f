"""Provenance of a result: command, options, input files, version, date and duration."""

import hashlib
import platform
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from magfusion.files.commit import commit

MAX_HASHED = 64 << 20  # bytes; a tenth of a second
MAX_FILES = 60
_LIBRARIES = ("numpy", "scipy", "gtsam")


@dataclass(frozen=True)
class Run:
    """One run of a command."""

    command: str  # as typed
    options: Mapping[str, object] = field(default_factory=dict)  # value of every option
    given: frozenset[str] = frozenset()  # those typed rather than left at their defaults
    inputs: tuple[Path, ...] = ()  # input files and directories
    overwrite: bool = False  # whether an earlier result is removed rather than moved
    started: datetime = field(default_factory=lambda: datetime.now(UTC))
    began: float = field(default_factory=time.perf_counter)

    @property
    def elapsed(self) -> float:
        """Elapsed time (s)."""
        return time.perf_counter() - self.began


# A job has its settings and not the command: pages are written many calls below it.
_RUN: ContextVar[Run | None] = ContextVar("run", default=None)


@contextmanager
def recorded_as(run: Run) -> Iterator[None]:
    """Record the run as the provenance of results written meanwhile."""
    token = _RUN.set(run)
    try:
        yield
    finally:
        _RUN.reset(token)


def current_run() -> Run | None:
    """Return the current run; None in a program of the user's own."""
    return _RUN.get()


@cache
def versions() -> str:
    """Return the versions of the software."""
    known = commit()
    at = f" (commit {known})" if known else ""
    libraries = [f"{name} {_version(name)}" for name in _LIBRARIES]
    return (
        f"magfusion {_version('magfusion')}{at}; Python {platform.python_version()},"
        f" {', '.join(libraries)}; {platform.system()} {platform.machine()}"
    )


def input_files(run: Run) -> list[tuple[str, int, str]]:
    """Return name, size (bytes) and SHA-256 of the input files, also those in directories."""
    result = []
    for path in run.inputs:
        own = sorted(p for p in path.iterdir() if p.is_file()) if path.is_dir() else [path]
        result += [p for p in own if p.is_file()]
    return [(str(p), p.stat().st_size, _sha256(p)) for p in result[:MAX_FILES]]


def _sha256(path: Path) -> str:
    if path.stat().st_size > MAX_HASHED:
        return f"not computed (above {MAX_HASHED >> 20} MiB)"
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "of unknown version"
