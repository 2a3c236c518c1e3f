"""The job that estimates the response of a receiver's axes from a coil on a bench."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.snapshot.priors import contradiction, trust_of, unexplained
from magfusion.files.site import load_site, save_site
from magfusion.files.survey import Survey, read_survey
from magfusion.jobs.receiver_axes import three_axes
from magfusion.jobs.settings import Command, Settings, argument, option, required
from magfusion.model.parameters import initial_calibration
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.results.figures import Figure, Figures, determined_figures, heading
from magfusion.results.verdict import notes_of, trust_figures
from magfusion.units import DEGREE

if TYPE_CHECKING:
    from magfusion.calibration.bench_response import BenchSnapshots

JOB = "calibrate response"


@dataclass(frozen=True, kw_only=True)
class ResponseSettings(Settings):
    """Survey about a coil, and the uncertainty of its poses."""

    survey: Path = argument("Survey: phasors of the receiver at known poses about a coil")
    site: Path = required("Site file of the bench: coil, and receiver with response_sigma")
    into: Path | None = option(
        None, "Site file to write the response into", note="default: that of the bench"
    )
    pose_rotation_deg: float = option(
        0.5, "Error of the survey's attitudes, one sigma an axis", least=1e-6
    )
    pose_position_m: float = option(
        0.001, "Error of the survey's positions, one sigma an axis", least=1e-9
    )


def run_calibrate_response(settings: ResponseSettings, output: Path) -> Figures:
    """Estimate the responses of y and z relative to x: site and report.

    A coil that is not synchronised must have had one drive phase at all points, as of a card that
    plays and records by one clock.
    """
    from magfusion.jobs.result_directory import claim, result_in
    from magfusion.results.refinement import parameter_estimates, refined_site

    claimed, path = claim(output, JOB), settings.survey
    site, survey = three_axes(load_site(settings.site), settings.site), read_survey(path)
    if site.platform.magnetometer.response_sigma is None:
        raise InputError(
            f"{settings.site}: platform.magnetometer.response_sigma: is missing; declare how far"
            " the responses of y and z may be from those given"
        )
    target = None if settings.into is None else _target(settings.into, site)
    bench = _bench(survey, site, settings).with_phases()
    chi_square, result, cov, blocks = bench.fit()
    declared = initial_calibration(site, 0.0)
    estimates = parameter_estimates(declared, result.calibration, blocks, cov)
    prior = np.diag(np.concatenate([block.sigma for block in blocks]) ** 2)
    trust, excess = trust_of(
        unexplained(
            "the bench",
            chi_square,
            float(np.sum(bench.samples.numbers)),
            "Check places, axes and drive of the coil, and metal near it.",
        ),
        contradiction(
            [one.key for one in estimates],
            result.estimate,
            prior - cov,
            prior,
            "Check the coil, or declare larger sigmas.",
        ),
    )
    estimates = parameter_estimates(declared, result.calibration, blocks, excess * cov)
    refined = refined_site(result.calibration, blocks, excess * cov, estimates, path.name)
    rms = float(np.sqrt(chi_square / np.sum(bench.samples.numbers)))
    figures = (
        heading(JOB, path.stem)
        | trust_figures(trust)
        | Figures(Figure("points", len(survey)), Figure("residual_rms", rms), *estimates)
        | determined_figures(estimates)
        | notes_of(trust)
    )
    with result_in(claimed, figures, trust, path, output) as directory:
        written = refined if target is None else _with_response(target, refined)
        save_site(written, directory / "site.yaml")
    return figures


def _bench(survey: Survey, site: Site, settings: ResponseSettings) -> BenchSnapshots:
    """Return the survey's phasors of the site's channels."""
    from magfusion.calibration.bench_response import BenchSnapshots

    if survey.phasor_sensor is None:
        raise InputError(
            f"{settings.survey}: contains amplitudes, but a response requires phasors; survey again"
        )
    strange = [c for c in survey.channels if c not in site.channels]
    if strange:
        raise InputError(
            f"{settings.survey}: beacon {strange[0][0]}, tone {strange[0][1]} is not in"
            f" {settings.site}; give the site of the survey"
        )
    count, channels = len(survey), site.channels
    phasor = np.full((count, len(channels), 3), np.nan + 0j)
    sigma = np.ones((count, len(channels)))
    own = [channels.index(channel) for channel in survey.channels]
    phasor[:, own], sigma[:, own] = survey.phasor_sensor, np.nan_to_num(survey.sigma, nan=1.0)
    cov = sigma[..., None, None] ** 2 * np.eye(3)
    return BenchSnapshots(
        FieldSamples(np.zeros(count), np.ones(count), channels, phasor, cov),
        initial_calibration(site, 0.0),
        survey_error=False,
        world_from_body=survey.world_from_body,
        position_world=survey.position_world,
        pose_sigma=np.repeat([settings.pose_rotation_deg * DEGREE, settings.pose_position_m], 3),
    )


def _target(path: Path, bench: Site) -> Site:
    """Return the site that gets the response, if it has the tones of the bench."""
    site = three_axes(load_site(path), path)
    tones, known = (np.unique(s.tone_frequencies_hz) for s in (site, bench))
    if not np.array_equal(tones, known):
        words = ", ".join(f"{tone:g}" for tone in tones)
        raise InputError(f"{path}: has tones of {words} Hz; give the coil on the bench the same")
    return site


def _with_response(site: Site, refined: Site) -> Site:
    sensor, own = site.platform.magnetometer, refined.platform.magnetometer
    sensor = replace(sensor, response=own.response, response_sigma=own.response_sigma)
    correlation, platform = site.correlation, replace(site.platform, magnetometer=sensor)
    return replace(
        site,
        platform=platform,
        correlation=correlation and correlation.without(("magnetometer",), ("magnetometer",)),
    )


COMMAND = Command(
    ResponseSettings,
    run_calibrate_response,
    output="response",
    example="magfusion calibrate response bench_survey --site bench.yaml -o response",
)
