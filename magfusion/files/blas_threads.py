"""One thread for BLAS, unless its environment requests more.

The matrices of an estimate are small: threads that wait for each other's part of them took two
fifths more processor and nothing off the time, of `calibrate fieldmap` half as long again.  BLAS
reads its environment when it is imported.
"""

import os
import warnings
from functools import cache

THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
OF_ALL = "OMP_NUM_THREADS"  # for others, too: Arrow reads by so many


def use_one_thread() -> None:
    """Limit BLAS to one thread, where its environment does not set the number."""
    if OF_ALL in os.environ:
        return
    for name in THREADS:
        os.environ.setdefault(name, "1")


@cache
def warn_about_threads() -> None:
    """Warn once that BLAS has several threads, where its environment does not set the number.

    To be called by a function that a user calls: the warning names the line that called it.
    """
    if any(name in os.environ for name in (*THREADS, OF_ALL)):
        return
    from threadpoolctl import threadpool_info

    libraries = [one for one in threadpool_info() if one["user_api"] == "blas"]
    maximum = max((one["num_threads"] for one in libraries), default=1)
    if maximum > 1:
        warnings.warn(
            f"BLAS uses {maximum} threads, which costs up to twice the processor time and saves"
            f" none: the matrices of magfusion are small. Set {THREADS[0]}=1 before NumPy is"
            " imported, or call threadpoolctl.threadpool_limits(1, user_api='blas'). Any value"
            f" of {THREADS[0]} silences this warning.",
            RuntimeWarning,
            stacklevel=3,
        )
