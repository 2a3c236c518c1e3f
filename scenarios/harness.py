"""What all scenarios share: options, parallel runs, pictures, a table and one JSON line."""

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.simulation.monte_carlo import Report
from magfusion.units import DEGREE, Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Scale(TypedDict, total=False):
    """Keywords of `magfusion.simulation.monte_carlo.run_many`."""

    cluster: str | None
    workers: int | None
    report: Report


def scenario_parser(
    doc: str | None,
    seed: int | None = None,
    quick: str | None = None,
    output: str | None = "directory of the pictures",
    *,
    parallel: bool = False,
) -> argparse.ArgumentParser:
    """Return a parser of the options that a scenario has.

    Parameters
    ----------
    doc : str
        Of the scenario; its first line describes the command.
    seed : int, optional
        Default of ``--seed``.
    quick, output : str, optional
        Help of ``--quick`` and ``--output``.
    parallel : bool
        Whether there are ``--cluster`` and ``--workers``.
    """
    parser = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
    if seed is not None:
        parser.add_argument("--seed", type=int, default=seed)
    if quick is not None:
        parser.add_argument("--quick", action="store_true", help=quick)
    if output is not None:
        parser.add_argument("-o", "--output", type=Path, help=output)
    if parallel:
        parser.add_argument("--cluster", metavar="ADDRESS", help="Dask scheduler, tcp://host:8786")
        parser.add_argument("--workers", type=int, help="processes here; default: one per core")
    return parser


def chosen_scale(options: argparse.Namespace) -> Scale:
    """Return the keywords of `run_many` that the options give, with progress."""
    return Scale(cluster=options.cluster, workers=options.workers, report=show_progress)


def show_progress(stage: str, done: int, total: int) -> None:
    """Show how many runs are done, on a terminal only."""
    if sys.stderr.isatty():
        sys.stderr.write(f"\r{stage} {done}/{total}" + ("\n" if done == total else ""))


def conclude(text: str, figures: object) -> None:
    """Print the text, and the figures (dataclasses and containers) as one JSON line."""
    print(text)
    print(json.dumps(figures, default=asdict))


def blank_figure(width: float, height: float) -> "Figure":
    """Return a figure of a size (inches)."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def save_picture(figure: "Figure", path: Path, dpi: int = 110) -> None:
    """Write a figure as a PNG, and the directory that holds it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=dpi, metadata={"Software": None})


def rms(value: Array) -> float:
    """Return the root mean square of all numbers."""
    return float(np.sqrt(np.mean(np.square(value))))


def between_deg(result: Array, true: Array) -> Array:
    """Return the angle of the rotation between matrices (..., 3, 3) (deg)."""
    turn = np.swapaxes(true, -1, -2) @ result
    angle = Rotation.from_matrix(turn.reshape(-1, 3, 3)).magnitude() / DEGREE
    return angle.reshape(turn.shape[:-2])
