"""The job that demodulates a waveform: a log in, a log of phasors out."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.data_checks.data_quality import passed_on
from magfusion.estimation.demodulation.drive_reference import referred
from magfusion.files.fields import by_own_clocks
from magfusion.files.log import write_log
from magfusion.files.site import save_site
from magfusion.jobs.rest_settings import RestSettings
from magfusion.jobs.settings import Command, LogSettings, WindowSettings
from magfusion.model.detection_range import MANY
from magfusion.model.progress import Report, quiet
from magfusion.model.samples import FieldSamples, Log
from magfusion.model.site import Site
from magfusion.model.trust import Trust
from magfusion.results.figures import Figure, Figures, heading
from magfusion.results.rest_figures import rest_figures
from magfusion.results.verdict import trust_figures


@dataclass(frozen=True, kw_only=True)
class DemodulateSettings(LogSettings, WindowSettings, RestSettings):
    """Settings of the demodulation."""


def run_demodulate(settings: DemodulateSettings, output: Path, report: Report = quiet) -> Figures:
    """Demodulate a waveform: a log with phasors instead."""
    from magfusion.estimation.demodulation.demodulation import phasors
    from magfusion.estimation.demodulation.separate_demodulation import demodulated_apart
    from magfusion.jobs.inputs import named, read_job
    from magfusion.jobs.result_directory import claim, result_in
    from magfusion.results.report import dropped_figures

    claimed, job = claim(output, "demodulate"), settings.job(output)
    lockin = settings.lockin(job)
    used = settings.at_rest
    log, site = read_job(
        job,
        fewer=not used,
        separately=not used,
        several=True,
        raw=True,
        reference=used,
        select_beacons=not used,
        report=report,
    )
    if used and log.waveforms:
        raise InputError(
            "--at-rest integrates the samples of one magnetometer; omit it, or give a site of the"
            " one to integrate"
        )
    if log.waveform is None and not log.waveforms:
        raise InputError(
            f"{job.log_path}: has no magnetometer.parquet to demodulate; give the raw log"
        )
    report("demodulating", 0, 1)
    with named(job.log_path):
        rested = settings.integrated(log, site, lockin)
        if log.waveforms:
            separate = demodulated_apart(log, site, lockin)
            assert separate.log.fields is not None
            log = replace(separate.log, findings=(*log.findings, *separate.findings))
            samples, dropped = by_own_clocks(separate.log.fields, site), separate.dropped
        elif rested is None:
            samples, dropped = phasors(log, site, lockin)
        else:
            samples, dropped = rested.fields, rested.dropped
        samples = samples if site.platform.further else referred(samples, site)
    report("done", 1, 1)
    trust = passed_on(log, site)
    if rested is not None:
        trust |= Trust(rested.findings)
    every = not samples.magnetometers and len(site.every_beacon) <= MANY
    figures = heading("demodulate", log.name) | trust_figures(trust)
    figures |= _phasor_figures(samples, every)
    figures |= dropped_figures(dropped)
    if rested is not None:
        figures |= rest_figures(rested)
    with result_in(claimed, figures, trust, job.log_path, job.output) as directory:
        write_log(
            replace(log, waveform=None, fields=samples, drive=None, reference=None), directory
        )
        save_site(_without_temperature(log, site), directory / "site.yaml")
    return figures


def _phasor_figures(samples: FieldSamples, every: bool) -> Figures:
    """Return the number of phasors, and their sigmas.

    `every`: whether a tone that is in no window is reported.
    """
    sigma = np.sqrt(np.trace(samples.phasor_cov, axis1=2, axis2=3) / 3.0)
    return Figures(
        Figure("epochs", len(samples)),
        Figure("window_s", float(np.median(samples.window)), "s"),
        *(
            Figure(
                f"sigma_{_of(samples, c, '_')}{{beacon}}_{tone}_t",
                float(np.median(sigma[samples.valid[:, c], c])),
                "T",
                beacon,
                label=f"sigma of a phasor of tone {tone}{_of(samples, c, ' by ')}",
            )
            for c, (beacon, tone) in enumerate(samples.channels)
            if every or np.any(samples.valid[:, c])
        ),
    )


def _of(samples: FieldSamples, channel: int, joint: str) -> str:
    """Return the name of a channel's magnetometer; empty for a single magnetometer."""
    if not samples.magnetometers:
        return ""
    name = samples.magnetometers[channel]
    return f"{name}{joint}" if joint == "_" else f"{joint}{name}"


def _without_temperature(log: Log, site: Site) -> Site:
    """Return the site of phasors in which the magnetometer's temperature is compensated."""
    magnetometer = site.platform.magnetometer
    missing = any(finding.code == "temperature_missing" for finding in log.findings)
    if magnetometer.temperature_model is None or missing:
        return site
    at_reference = replace(magnetometer, temperature_model=None)
    return replace(site, platform=replace(site.platform, magnetometer=at_reference))


COMMAND = Command(DemodulateSettings, run_demodulate, example="magfusion demodulate log -o phasors")
