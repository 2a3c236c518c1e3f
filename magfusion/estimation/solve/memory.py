"""Memory that was freed: kept for what comes next, or given back to the system."""

import ctypes
import os
from collections.abc import Callable
from pathlib import Path

RESIDENT = 512e6  # bytes; what a smaller program has freed nobody misses
KEPT_ARRAY = 2**25  # bytes; larger ones glibc always maps anew
KEPT_TOP = 2**27  # bytes
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h
PAGES = Path("/proc/self/statm")


def keep_memory() -> None:
    """Keep the memory of arrays that are freed for those that come next.

    Otherwise glibc gives each of more than some hundred kilobytes back at once, and every page of
    the next is made anew: a tenth of what smoothing takes.
    """
    change = _of_glibc("mallopt")
    if change is not None:
        change(MMAP_THRESHOLD, KEPT_ARRAY)
        change(TRIM_THRESHOLD, KEPT_TOP)


def give_back_memory() -> None:
    """Give what was freed back to the system, of a program that is large.

    Factors are in small pieces, which glibc keeps.
    """
    trim = _of_glibc("malloc_trim")
    if trim is not None and _resident() > RESIDENT:
        trim(0)


def _of_glibc(name: str) -> Callable[..., int] | None:
    try:
        found: Callable[..., int] = getattr(ctypes.CDLL(None), name)
    except (AttributeError, OSError, TypeError):  # another system's library
        return None
    return found


def _resident() -> float:
    """Return what is in memory (bytes); infinite where the system does not tell."""
    try:
        return float(PAGES.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError, IndexError):
        return float("inf")
