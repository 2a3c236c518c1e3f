"""The job that checks a log in seconds: streams, fields, compass, first fixes; a verdict."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from magfusion.errors import InputError
from magfusion.jobs.settings import Command, LogSettings, WindowSettings, option
from magfusion.model.progress import Report, quiet
from magfusion.model.trust import Trust
from magfusion.results.figures import Figure, Figures, Section, heading
from magfusion.results.verdict import trust_figures

if TYPE_CHECKING:
    from magfusion.estimation.integrity.quick_check import Look
    from magfusion.model.site import Site


@dataclass(frozen=True, kw_only=True)
class CheckSettings(LogSettings, WindowSettings):
    """Settings of a check; without a site only the recording is checked."""

    correct: Path | None = option(
        None, "File for the site with the most likely mistake undone", metavar="SITE.yaml"
    )


def run_check(
    settings: CheckSettings, output: Path | None = None, report: Report = quiet
) -> Figures:
    """Check a log: consistency of its streams, fields, compass and first fixes.

    `output`: directory of report and picture; by default nothing is written.
    """
    from magfusion.estimation.demodulation.separate_demodulation import by_name, each_recorded
    from magfusion.estimation.integrity.quick_check import quick_check
    from magfusion.files.site import site_tables
    from magfusion.jobs.inputs import named, read_recording
    from magfusion.jobs.result_directory import claim, found_in
    from magfusion.model.aiding import check_declared
    from magfusion.results.plots.check import write_check_plot
    from magfusion.results.report import write_report

    if (new := settings.correct) is not None:
        present = next((p for p in (new, *site_tables(new)) if p.exists()), None)
        if present is not None:
            raise InputError(f"{present}: exists; give --correct another path, or remove it")
    claimed = nullcontext(None) if output is None else claim(output, "check")
    job = settings.job(Path() if output is None else output)
    began = time.perf_counter()
    report("reading", 0, 3)
    log, site = read_recording(job, report)
    if site is not None:
        with named(job.log_path):
            check_declared(site.aiding, log.aiding)
    report("checking", 1, 3)
    lockin = None if site is None or not site.beacons else settings.lockin(job)
    if log.waveforms and settings.correct is not None:
        raise InputError("--correct takes a site of one magnetometer; omit it")
    if log.waveforms:
        looks = {
            name: quick_check(own, alone, lockin) for name, own, alone in each_recorded(log, site)
        }
        trust = Trust(tuple(by_name({name: one.trust.findings for name, one in looks.items()})))
        look = replace(next(iter(looks.values())), trust=trust)
        figures = heading("check", log.name) | trust_figures(trust) | _of_several(looks)
    else:
        look = quick_check(log, site, lockin)
        figures = heading("check", log.name) | trust_figures(look.trust) | check_figures(look)
        if settings.correct is not None:
            figures |= _corrected(settings.correct, look, site)
    figures |= Figures(Figure("elapsed_s", time.perf_counter() - began, "s"))
    with claimed as whole:
        if whole is not None:
            write_check_plot(found_in(whole, look.trust) / "check.png", look)
            write_report(whole, figures)
    report("done", 3, 3)
    return figures


def _corrected(place: Path, look: Look, site: Site | None) -> Figures:
    """Write the site with the most likely mistake undone, where one explains the log."""
    from magfusion.files.site import save_site
    from magfusion.files.site_changes import changed_keys

    if site is None or look.cause is None or look.cause.site is None:
        return Figures(Figure("corrected", "nothing: no mistake of the site explains the log"))
    save_site(look.cause.site, place)
    keys = ", ".join(changed_keys(site, look.cause.site))
    return Figures(Figure("corrected", f"{keys} in {place}"))


def _of_several(looks: Mapping[str, Look]) -> Figures:
    """Return the figures of each of several magnetometers by its name; of the IMU once."""
    result: dict[tuple[str, str | None], Figure] = {}
    for name, look in looks.items():
        for figure in check_figures(look).all:
            if figure.name.startswith("imu_") or figure.name == "gravity_m_s2":
                result.setdefault((figure.name, None), figure)
            else:
                key = f"{name}_{figure.name.removeprefix('magnetometer_')}"
                result[key, figure.beacon] = replace(
                    figure, name=key, label=f"{figure.title} by {name}"
                )
    return Figures(*result.values())


def check_figures(look: Look) -> Figures:
    """Return the figures of a quick check."""
    figures = Figures()
    for one in look.timings:
        figures |= Figures(
            Figure(f"{one.stream}_rate_hz", one.rate_hz, "Hz"),
            Figure(f"{one.stream}_duration_s", one.end - one.begin, "s"),
            Figure(f"{one.stream}_jitter_ms", 1e3 * one.jitter, "ms"),
            Figure(f"{one.stream}_lost_share", one.lost_share, section=Section.REPORT),
            Figure(f"{one.stream}_gaps", len(one.gap_begin), section=Section.REPORT),
            Figure(
                f"{one.stream}_gap_s",
                float((one.gap_end - one.gap_begin).sum()),
                "s",
                section=Section.REPORT,
            ),
        )
    figures |= _gravity_and_field_figures(look)
    for name, snr, share in look.detection_rows():
        figures |= Figures(
            Figure("snr_{beacon}", snr, beacon=name, label="signal to noise"),
            Figure("heard_{beacon}", share, beacon=name, label="share of the epochs detected"),
        )
    for name, (distance, depths) in look.depths.items():
        figures |= Figures(
            Figure("range_{beacon}_m", distance, "m", beacon=name, label="range from strength"),
            Figure("skin_depths_{beacon}", depths, beacon=name, label="skin depths away"),
        )
    if look.lines is not None:
        words = [
            f"{line.frequency_hz:.2f} Hz, {1e9 * line.amplitude:.3g} nT" for line in look.lines
        ]
        figures |= Figures(Figure("lines", words, label="lines in the field"))
    if look.fixes is not None:
        figures |= Figures(
            Figure("fix_epochs", len(look.fixes), label="epochs fixed"),
            Figure("fix_residual_rms", look.fix_residual, label="residual of the fixes"),
        )
    return figures


def _gravity_and_field_figures(look: Look) -> Figures:
    """Return the magnitudes of gravity and field, and the angle between them."""
    means = look.means
    if len(means) == 0:
        return Figures()
    force = float(np.median(np.linalg.norm(means.force_body, axis=1)))
    figures = Figures(Figure("gravity_m_s2", force, "m/s^2", label="mean specific force"))
    if np.any(np.isfinite(means.field_body)):
        size = float(np.nanmedian(np.linalg.norm(means.field_body, axis=1)))
        angle = float(np.degrees(np.nanmedian(means.angle)))
        figures |= Figures(
            Figure("steady_field_ut", 1e6 * size, "uT", label="static field"),
            Figure("field_from_vertical_deg", angle, "deg", label="static field from the vertical"),
        )
    return figures


COMMAND = Command(
    CheckSettings, run_check, output_optional=True, example="magfusion check log --site site.yaml"
)
