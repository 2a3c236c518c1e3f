"""Map of the steel near the paths of logs, made before they are calibrated together.

Each log is smoothed with the map of those before it, and adds what that map does not explain, if
its own map predicts beacons left out.
"""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.estimation.integrity.judge import judge_result
from magfusion.estimation.integrity.steel_map import MOVED, SteelMap, explained_without_map
from magfusion.estimation.integrity.steel_test import STEEL
from magfusion.estimation.solve.memory import give_back_memory
from magfusion.files.atomic import real
from magfusion.files.checkpoint import run_key
from magfusion.files.kept import StoredArrays, digest_of_files, load_kept, save_kept
from magfusion.files.site import load_site, save_site
from magfusion.files.steel_map import STEEL_MAP, join_steel_maps, write_steel_map
from magfusion.jobs.failure import reason_of
from magfusion.jobs.inputs import Job, named, read_job, read_site
from magfusion.jobs.smooth_result import map_of_steel
from magfusion.jobs.written import KEPT, SITE_FILES
from magfusion.model.progress import Report
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.steel_field import SteelField
from magfusion.model.trust import Finding, Trust, Verdict
from magfusion.results.figures import Figure, Figures, Section
from magfusion.results.provenance import versions

_MOVED = "it is explained better without the map of the site or of the logs before it"
_Steel = dict[str, SteelField | None]  # of each beacon


@dataclass(frozen=True, eq=False)
class SteelOfLogs:
    """Map of the steel near the paths of logs, as far as it is used."""

    jobs: list[Job]  # with sites that have the map
    rows: list[dict[str, Any]] = field(default_factory=list)  # table of maps, one of each log
    voxels: list[Path] = field(default_factory=list)  # files of the maps that are used

    @property
    def figures(self) -> Figures:
        """Table of the maps."""
        of_logs = Figure("steel_maps", self.rows, section=Section.REPORT)
        return Figures(of_logs) if self.rows else Figures()

    @property
    def trust(self) -> Trust:
        """What is mapped, and the logs that contradict the map of others."""
        used = [row for row in self.rows if row["used"] == "yes"]
        reasons = "; ".join(dict.fromkeys(row["reason"] for row in self.rows))
        text = f"The steel is not mapped: {reasons}."
        if used:
            shares = ", ".join(f"{100.0 * r['error_ratio']:.3g} % ({r['log']})" for r in used)
            text = (
                "The steel near the paths is mapped, and the site has the map. Made without a"
                f" beacon, it predicts its fields with {shares} of the error without a map."
            )
        findings = [Finding(STEEL, text, Verdict.TRUSTWORTHY)] if self.rows else []
        for row in self.rows:
            if row["reason"] == _MOVED:
                text = (
                    f"Log {row['log']} contradicts the map of steel that the site or the logs"
                    " before it have: steel was moved. Calibrate the logs before and after"
                    " separately."
                )
                findings.append(Finding(MOVED.code, text, Verdict.DOUBTFUL))
        return Trust(tuple(findings))

    def write(self, directory: Path) -> None:
        """Write the voxels of all maps that are used."""
        if self.voxels:
            join_steel_maps(directory / STEEL_MAP, self.voxels)

    def keep(self, directory: Path, output: Path) -> None:
        """Copy what a rerun with more logs resumes from."""
        if self.rows:
            shutil.copytree(_place(output), directory / STEEL)


def map_steel_of_logs(
    jobs: Sequence[Job], smoother: SmootherSettings, output: Path, report: Report
) -> SteelOfLogs:
    """Map the steel near the paths of logs.

    A rerun with the same output resumes from the logs that are mapped.
    """
    place, steel = _place(output), _Steel()
    rows, voxels = list[dict[str, Any]](), list[Path]()
    for i, job in enumerate(jobs):
        report("mapping steel", i, len(jobs))
        own = place / str(i + 1)
        with named(job.log_path):
            rows.append(_mapped(own, job, steel, smoother))
        steel |= {beacon.name: beacon.steel for beacon in load_site(own / "site.yaml").beacons}
        if rows[-1]["used"] == "yes":
            voxels.append(own / STEEL_MAP)
        give_back_memory()
    mapped = [replace(job, site_path=place / f"{i + 1}.yaml") for i, job in enumerate(jobs)]
    for job, known in zip(jobs, mapped, strict=True):
        save_site(_with_steel(read_site(job), steel), known.declared_path)
    return SteelOfLogs(mapped, rows, voxels)


def _place(output: Path) -> Path:
    """Return the directory of what is kept."""
    return real(output) / KEPT / STEEL


def _with_steel(site: Site, steel: _Steel) -> Site:
    beacons = (replace(b, steel=steel.get(b.name, b.steel)) for b in site.beacons)
    return replace(site, beacons=tuple(beacons))


def _mapped(place: Path, job: Job, steel: _Steel, smoother: SmootherSettings) -> dict[str, Any]:
    """Return the row of a log, and write the site with the steel of it and the logs before."""
    declared, stored = _with_steel(read_site(job), steel), place / "row.npz"
    content = digest_of_files([job.log_path], without=frozenset(SITE_FILES))
    key = run_key(STEEL, content, declared, job.start, job.end, job.topics, smoother, versions())
    known = load_kept(stored, key)
    if known is not None:
        return known.facts
    log, detected = read_job(job)
    site = _with_steel(detected, steel)
    added = _map_of(log, site, smoother)
    row: dict[str, Any] = {"log": job.log_path.name, "used": "no"}
    place.mkdir(parents=True, exist_ok=True)
    if isinstance(added, str):
        row["reason"] = added
    else:
        row["reason"] = "" if added.is_used else "it does not predict beacons left out"
        row |= {"error_ratio": added.ratio, "distortion_percent": 100.0 * added.steel.distortion}
    if isinstance(added, SteelMap) and added.is_used:
        row["used"] = "yes"
        declared = _with_steel(declared, {b.name: b.steel for b in added.on(site).beacons})
        write_steel_map(place / STEEL_MAP, *added.voxels, *added.polarisability)
    save_site(declared, place / "site.yaml")
    save_kept(stored, key, StoredArrays({}, row))
    return row


def _map_of(log: Log, site: Site, smoother: SmootherSettings) -> SteelMap | str:
    """Return what a log adds to the steel of a site, or why it adds nothing."""
    try:
        result = smooth(log, site, smoother)
    except RuntimeError as error:  # GTSAM's own, of a singular system, or an EstimationError
        return reason_of(error)
    if explained_without_map(result):
        return _MOVED
    return map_of_steel(result, judge_result(result, log)[1], log)
