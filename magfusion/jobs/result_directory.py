"""Output directory of a job: where its results become visible, and an earlier result goes."""

import json
import os
import re
import shutil
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from itertools import count
from pathlib import Path

from magfusion.errors import EstimationError
from magfusion.files.atomic import abandoned_pattern, real, refuse_in_the_way, whole_directory
from magfusion.jobs.written import KEPT, LOGS, UNFINISHED, WRITTEN
from magfusion.model.trust import Trust, Verdict
from magfusion.results.figures import Figures
from magfusion.results.page import PAGE
from magfusion.results.provenance import current_run
from magfusion.results.report import FAILED, write_report


def _may_be_replaced(path: Path, kinds: tuple[str, ...]) -> bool:
    """Return whether a directory contains only an earlier result of these jobs."""
    result = {entry.name for entry in path.iterdir()}
    # An incomplete checkpoint of a killed run.
    abandoned = re.compile(abandoned_pattern(r"checkpoint\.(bin|rows)"))
    result = {name for name in result if not abandoned.fullmatch(name)}
    if any(result <= UNFINISHED.get(kind, set()) for kind in kinds):
        return True
    try:
        report = json.loads((path / "report.json").read_text(encoding="utf-8"))
        job = report["job"]
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return job in kinds and result <= WRITTEN[job] | {FAILED, PAGE}


def claim(output: Path, *kinds: str, overwrite: bool = False) -> AbstractContextManager[Path]:
    """Return a context whose directory becomes ``output`` only on success.

    An obstacle raises an error at once, before the work. `overwrite`: whether an earlier result is
    removed, as with ``--overwrite``, rather than moved. Raises InputError where ``output`` contains
    anything but an earlier result of these jobs.
    """

    def replaces(path: Path) -> bool:
        return _may_be_replaced(path, kinds)

    def backup(path: Path) -> Path | None:
        run = current_run()
        if overwrite or (run is not None and run.overwrite):
            return None
        return _backup_path(path, kinds)

    refuse_in_the_way(real(output), replaces)
    return whole_directory(output, replaces, backup)


def _backup_path(path: Path, kinds: tuple[str, ...]) -> Path | None:
    """Return the place of an earlier result, without files of the run that ends; None of none."""
    if not (path / "report.json").is_file():
        return None
    working = set[str]().union(*(UNFINISHED.get(kind, set()) for kind in kinds))
    for name in working - {KEPT}:  # which a result of several logs is extended from
        if (path / name).is_dir():
            shutil.rmtree(path / name)
        (path / name).unlink(missing_ok=True)
    numbered = (path.with_name(f"{path.name}.{number}") for number in count(1))
    kept = next(other for other in numbered if not os.path.lexists(other))
    sys.stderr.write(
        f"magfusion: {path}: the earlier result is now in {kept.name}; --overwrite replaces it\n"
    )
    return kept


def keep_results(whole: Path, logs: list[tuple[str, Path, Path]]) -> None:
    """Copy the files of several logs into the directory that becomes the output.

    `logs`: name of each, its file, and the directory of its results.
    """
    (whole / KEPT).mkdir()
    for name, kept, results in logs:
        if kept.is_file():
            shutil.copy2(kept, whole / KEPT / kept.name)
        if results.is_dir():
            shutil.copytree(results, whole / LOGS / name)


def found_in(directory: Path, trust: Trust) -> Path:
    """Return the directory of results: a separate one for a failed verdict."""
    if trust.verdict is not Verdict.FAILED:
        return directory
    (directory / FAILED).mkdir()
    return directory / FAILED


def refuse_failed(place: Path, output: Path, trust: Trust) -> None:
    """Raise an error for a failed verdict, after its report is written.

    Raises EstimationError with the first reason.
    """
    if trust.verdict is Verdict.FAILED:
        raise EstimationError(
            f"{place}: failed: {trust.ordered[0].text} The reasons are in {output / 'report.json'},"
            f" the estimates in {output / FAILED}"
        )


@contextmanager
def result_in(
    claimed: AbstractContextManager[Path], figures: Figures, trust: Trust, place: Path, output: Path
) -> Iterator[Path]:
    """Yield the directory of results, and write the report; raise an error for a failed verdict."""
    with claimed as whole:
        yield found_in(whole, trust)
        write_report(whole, figures)
    refuse_failed(place, output, trust)
