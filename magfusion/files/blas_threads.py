"""One thread for BLAS, unless somebody asks for more by its environment.

The matrices of an estimate are small: threads that wait for each other's part of them took two
fifths more processor and nothing off the time, of `calibrate fieldmap` half as long again.  BLAS
asks its environment when it is imported.
"""

import os

THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
OF_ALL = "OMP_NUM_THREADS"  # for others, too: Arrow reads by so many


def use_one_thread() -> None:
    """Let BLAS have one thread, where its environment does not say how many."""
    if OF_ALL in os.environ:
        return
    for name in THREADS:
        os.environ.setdefault(name, "1")
