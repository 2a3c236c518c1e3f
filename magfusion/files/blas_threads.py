"""One thread for BLAS, unless somebody asks for more by its environment.

The matrices of an estimate are small: threads that wait for each other's part of them took two
fifths more processor, and nothing off the time.  BLAS asks its environment when it is imported.
"""

import os
from collections.abc import Sequence

LARGE = ["calibrate", "fieldmap"]  # a command whose matrices are
THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
OF_ALL = "OMP_NUM_THREADS"  # for others, too: Arrow reads by so many


def use_one_thread(command: Sequence[str]) -> None:
    """Let BLAS have one thread in a command, where its environment does not say how many."""
    if OF_ALL in os.environ or list(command[: len(LARGE)]) == LARGE:
        return
    for name in THREADS:
        os.environ.setdefault(name, "1")
