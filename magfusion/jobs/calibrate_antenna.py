"""The job that calibrates a tracker's antennas: bench readings in, a refined site out."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from magfusion.calibration.antenna_site import BodySurvey, into_mounting, with_fit
from magfusion.calibration.antenna_tracking import PoseErrors
from magfusion.files.site import load_site, save_site
from magfusion.files.survey import read_survey
from magfusion.jobs import antenna_report as reported
from magfusion.jobs.antenna_fit import Bench, left_out, solved
from magfusion.jobs.antenna_inputs import (
    couplings,
    mounted_by_fixes,
    probed,
    refuse_swapped,
    tracker,
)
from magfusion.jobs.antenna_settings import AntennaSettings
from magfusion.jobs.antenna_trust import judge_fit
from magfusion.jobs.receiver_axes import three_axes
from magfusion.jobs.settings import Command
from magfusion.model.antenna import Antenna, antenna_from_vector, antenna_of
from magfusion.model.site import Beacon
from magfusion.results.figures import (
    Figure,
    Figures,
    calibration_record,
    determined_figures,
    heading,
)
from magfusion.results.verdict import trust_figures

JOB = "calibrate antenna"


def run_calibrate_antenna(settings: AntennaSettings, output: Path) -> Figures:
    """Calibrate the antennas of a beacon and of the magnetometer: site, picture and report."""
    from magfusion.jobs.inputs import named
    from magfusion.jobs.result_directory import claim, result_in
    from magfusion.results.plots.antenna import write_antenna_plot

    claimed, site_path = claim(output, JOB), settings.site
    declared = site = three_axes(load_site(site_path), site_path)
    with named(site_path):
        beacon = tracker(site, settings.beacon)
        start = antenna_of(beacon, site.platform.magnetometer)
    if settings.sizes and start.kappa_beacon is None:
        start = antenna_from_vector(np.concatenate([start.vector(), np.zeros(4)]))
    survey, dropped = _survey(settings, beacon, start)
    if survey is not None and settings.boresight:
        site = mounted_by_fixes(survey, site, beacon)
    bench = Bench(site, beacon, start, survey, probed(settings.probe))
    result = solved(bench, settings)
    errors: tuple[PoseErrors, PoseErrors] | None = None
    if survey is not None:
        errors = left_out(bench, declared, result, settings)
    estimates = reported.estimates(result.fit, start, sizes=settings.sizes)
    fit, trust = judge_fit(result, estimates, errors)
    estimates = reported.estimates(fit, start, sizes=settings.sizes)
    if settings.boresight:
        sensor = site.platform.magnetometer
        fit, mounted = into_mounting(fit, sensor, start.sensitivities_sensor)
        site = replace(site, platform=replace(site.platform, magnetometer=mounted))
    figures = (
        heading(JOB, settings.name)
        | trust_figures(trust)
        | Figures(Figure("beacon", beacon.name))
        | reported.read_figures(bench, dropped)
        | reported.error_figures(errors, result)
        | reported.figures(fit, result.observed, start, settings)
        | (reported.mounting_figures(site, declared) if settings.boresight else Figures())
        | determined_figures(estimates)
    )
    refined = replace(
        with_fit(site, beacon, fit), calibration=calibration_record(settings.name, estimates)
    )
    with result_in(
        claimed, figures, trust, settings.survey or settings.probe[0], output
    ) as directory:
        save_site(refined, directory / "site.yaml")
        if errors is not None:
            write_antenna_plot(directory / "antenna.png", *errors)
    return figures


def _survey(
    settings: AntennaSettings, beacon: Beacon, start: Antenna
) -> tuple[BodySurvey | None, int]:
    """Return the readings at known poses, if any, and the number of omitted poses."""
    from magfusion.jobs.inputs import named

    if settings.survey is None:
        return None, 0
    listed = read_survey(settings.survey, settings.poses)
    with named(settings.survey):
        survey, dropped = couplings(listed, beacon)
        refuse_swapped(survey, start)
    return survey, dropped


COMMAND = Command(
    AntennaSettings,
    run_calibrate_antenna,
    output="antenna",
    example="magfusion calibrate antenna survey --site site.yaml -o antenna",
)
