"""Stored results of a finished part, for another run of the same request."""

import hashlib
import json
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from magfusion.files.atomic import whole_file
from magfusion.units import AnyArray


class StoredArrays(NamedTuple):
    """Arrays and plain facts of what was done."""

    arrays: Mapping[str, AnyArray]
    facts: dict[str, Any]


def save_kept(path: Path, key: str, kept: StoredArrays) -> None:
    """Write what was done.

    `key`: of all that made it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    facts = np.array(json.dumps({"key": key, "facts": kept.facts}))
    with whole_file(path) as unfinished, unfinished.open("wb") as file:
        np.savez(file, allow_pickle=False, facts=facts, **kept.arrays)


def load_kept(path: Path, key: str) -> StoredArrays | None:
    """Return what was done with the same key; None where there is nothing, or it cannot be read."""
    try:
        with np.load(path, allow_pickle=False) as file:
            declared = json.loads(str(file["facts"]))
            if declared["key"] != key:
                return None
            return StoredArrays({k: file[k] for k in file.files if k != "facts"}, declared["facts"])
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile):
        return None


def digest_of_files(paths: Iterable[Path], *, without: frozenset[str] = frozenset()) -> str:
    """Return a digest of the content of files, and of all files in directories.

    `without`: names of files that do not count.
    """
    every: list[tuple[str, Path]] = []
    for path in paths:
        if path.is_dir():
            own = sorted(p for p in path.rglob("*") if p.is_file() and p.name not in without)
            every += [(str(p.relative_to(path)), p) for p in own]
        elif path.is_file():
            every.append(("", path))
    digest = hashlib.sha256()
    for name, path in every:
        with path.open("rb") as file:
            content = hashlib.file_digest(file, "sha256").hexdigest()
        digest.update(f"{name}\0{content}\0".encode())
    return digest.hexdigest()
