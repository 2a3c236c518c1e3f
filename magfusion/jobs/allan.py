"""The job that measures noise at rest: Allan deviations of a log, in the keys of a site."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from magfusion.files.site import load_site, save_site
from magfusion.jobs.settings import Command, LogSettings
from magfusion.model.progress import Report, quiet
from magfusion.model.site import Site
from magfusion.model.trust import Verdict
from magfusion.results.figures import Figure, Figures, Section, heading
from magfusion.results.verdict import trust_figures

if TYPE_CHECKING:
    from magfusion.jobs.allan_noise import MeasuredNoise
    from magfusion.jobs.inputs import Job

AXES = "xyz"


@dataclass(frozen=True, kw_only=True)
class AllanSettings(LogSettings):
    """Log recorded at rest; given a site, a site with the measured noise is written."""


def run_allan(settings: AllanSettings, output: Path, report: Report = quiet) -> Figures:
    """Estimate white noise, instability and random walk of the instruments of a log at rest.

    The log is read in blocks; memory does not grow with its length.
    """
    from magfusion.jobs.allan_noise import measured
    from magfusion.jobs.result_directory import claim, found_in
    from magfusion.results.plots.allan import write_allan_plot
    from magfusion.results.report import write_report

    claimed, job = claim(output, "allan"), settings.job(output)
    began = time.perf_counter()
    site = _site(job)
    result = measured(job, site, report)
    figures = heading("allan", job.log_path.resolve().name) | trust_figures(result.trust)
    figures |= _figures(result)
    figures |= Figures(Figure("elapsed_s", time.perf_counter() - began, "s"))
    with claimed as whole:
        write_allan_plot(found_in(whole, result.trust) / "allan.png", result.plotted())
        if site is not None and result.trust.verdict is not Verdict.FAILED:
            save_site(with_noise(site, result), whole / "site.yaml")
        write_report(whole, figures)
    report("done", 3, 3)
    return figures


def _site(job: Job) -> Site | None:
    if job.site_path is None and not job.declared_path.is_file():
        return None
    return load_site(job.declared_path, unknown=True, without=True)


def with_noise(site: Site, fitted: MeasuredNoise) -> Site:
    """Return a site with the estimated noise; a bias sigma is only ever increased.

    One switch-on gives a lower limit of the bias's sigma, but no upper limit.
    """
    imu, magnetometer = site.platform.imu, site.platform.magnetometer
    keys = fitted.keys
    for key, value in keys.items():
        if key == "noise_density_t_rthz":
            magnetometer = replace(magnetometer, noise_density=value)
        elif key.endswith("_sigma"):
            imu = replace(imu, **{key: max(value, getattr(imu, key))})
        else:
            imu = replace(imu, **{key: value})
    return replace(site, platform=replace(site.platform, imu=imu, magnetometer=magnetometer))


def _figures(fitted: MeasuredNoise) -> Figures:
    """Return the figures of the site's keys, and those of each axis."""
    figures = Figures(
        Figure("duration_s", fitted.duration, "s"),
        *(
            Figure(f"{stream}_samples", count, section=Section.REPORT)
            for stream, count in fitted.samples.items()
        ),
    )
    for key, value in fitted.keys.items():
        low, high = fitted.intervals.get(key, (None, None))
        between = "" if low is None else f" (95 %: {low:.3g} to {high:.3g})"
        figures |= Figures(Figure(key, value, f"{fitted.units[key]}{between}", label=key))
    for one in fitted.instruments:
        for axis, fit in zip(AXES, one.fits, strict=True):
            if fit is None:
                continue
            for name, part in (
                ("white", fit.white),
                ("instability", fit.instability),
                ("random_walk", fit.walk),
            ):
                for end, number in (("", part.value), ("_low", part.low), ("_high", part.high)):
                    figures |= Figures(
                        Figure(f"{one.key}_{name}_{axis}{end}", number, section=Section.REPORT)
                    )
            figures |= Figures(
                Figure(f"{one.key}_least_{axis}", fit.least, section=Section.REPORT),
                Figure(f"{one.key}_least_tau_{axis}_s", fit.least_tau, "s", section=Section.REPORT),
                Figure(f"{one.key}_misfit_{axis}", fit.misfit, section=Section.REPORT),
            )
    return figures


COMMAND = Command(
    AllanSettings, run_allan, example="magfusion allan rest_log --site site.yaml -o noise"
)
