"""Options by which a scenario runs on all cores of this machine, or on a cluster."""

import argparse
import sys
from typing import TypedDict


class Scale(TypedDict, total=False):
    """Keywords of `magfusion.monte_carlo.run_many`."""

    cluster: str | None
    workers: int | None


def add_scale_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--cluster`` and ``--workers``."""
    parser.add_argument("--cluster", metavar="ADDRESS", help="Dask scheduler, tcp://host:8786")
    parser.add_argument("--workers", type=int, help="processes here; default: one a core")


def chosen_scale(options: argparse.Namespace) -> Scale:
    """Return what the options say."""
    return Scale(cluster=options.cluster, workers=options.workers)


def show_progress(stage: str, done: int, total: int) -> None:
    """Tell how many runs are done, on a terminal only."""
    if sys.stderr.isatty():
        sys.stderr.write(f"\r{stage} {done}/{total}" + ("\n" if done == total else ""))
