"""Released memory: kept for later arrays, or returned to the system."""

import ctypes
import os
from collections.abc import Callable
from pathlib import Path

RESIDENT = 512e6  # bytes; a smaller program keeps its released memory
KEPT_ARRAY = 2**25  # bytes; larger ones glibc always maps again
KEPT_TOP = 2**27  # bytes
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h
PAGES = Path("/proc/self/statm")


def keep_memory() -> None:
    """Keep the memory of released arrays for later ones.

    Otherwise glibc returns each array above some hundred kilobytes to the system at once, and maps
    every page of the next again: a tenth of the time of smoothing.
    """
    change = _of_glibc("mallopt")
    if change is not None:
        change(MMAP_THRESHOLD, KEPT_ARRAY)
        change(TRIM_THRESHOLD, KEPT_TOP)


def give_back_memory() -> None:
    """Return released memory of a large program to the system.

    Factors are small allocations, which glibc keeps.
    """
    trim = _of_glibc("malloc_trim")
    if trim is not None and _resident() > RESIDENT:
        trim(0)


def _of_glibc(name: str) -> Callable[..., int] | None:
    try:
        result: Callable[..., int] = getattr(ctypes.CDLL(None), name)
    except (AttributeError, OSError, TypeError):  # another system's library
        return None
    return result


def _resident() -> float:
    """Return the resident memory (bytes); infinite where the system does not report it."""
    try:
        return float(PAGES.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError, IndexError):
        return float("inf")
