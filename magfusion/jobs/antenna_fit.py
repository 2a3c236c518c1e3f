"""The fits of a tracker's bench: the probe first, then the survey with the probe's result."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from magfusion.calibration.antenna import (
    AntennaFit,
    fit_at_known_poses,
    prior_sigma,
    with_receiver_gain,
)
from magfusion.calibration.antenna_observability import AntennaObservability, observability
from magfusion.calibration.antenna_probe import (
    Predict,
    bench_sigma,
    fit_by_probe,
    in_units_of_sensitivity,
    left_out_errors,
    read_of_beacon,
    read_of_term,
)
from magfusion.calibration.antenna_site import BodySurvey, coils_of, of_site, with_fit
from magfusion.calibration.antenna_tracking import (
    Expected,
    PoseErrors,
    differences,
    expected,
    own_errors,
    turned_elsewhere,
)
from magfusion.files.probe import Side
from magfusion.files.site import load_site, save_site
from magfusion.jobs.antenna_inputs import columns_of
from magfusion.jobs.antenna_settings import AntennaSettings
from magfusion.model.antenna import Antenna, antenna_from_vector
from magfusion.model.probe import ProbeReadings
from magfusion.model.site import Beacon, Site
from magfusion.units import DEGREE, Array

FOLDS = 5  # each pose is judged by an antenna that was fitted without it
# Prior uncertainty of a nominal antenna; wide, since the couplings are more accurate.
GAIN_SIGMA, TILT_SIGMA, CENTRE_SIGMA, KAPPA_SIGMA = 0.05, 0.05, 0.01, 1e-3
KAPPA_KEPT = 1e-12  # m^2; a micrometre squared


@dataclass(frozen=True, eq=False)
class Bench:
    """Readings and their antennas; ``site`` has the assumed mounting."""

    site: Site
    beacon: Beacon
    start: Antenna
    survey: BodySurvey | None
    probed: dict[Side, ProbeReadings]


@dataclass(frozen=True, eq=False)
class AntennaSolution:
    """The antennas of a bench."""

    fit: AntennaFit
    prior: Array  # (k,), mean before the survey: from the site and the probe
    root: Array  # (k, k), factor of its covariance
    observed: AntennaObservability | None  # what the survey's poses determine
    # relative leave-one-out errors of readings, before and after
    probed: dict[Side, tuple[Array, Array]] = field(default_factory=dict)
    # (2,), predicted errors of fixes in attitudes that were not surveyed (rad, m)
    elsewhere: Array | None = None


def declared_sigma(start: Antenna, *, sizes: bool) -> Array:
    """Return the prior sigmas of the site's antennas, sizes included if requested."""
    kappa = KAPPA_SIGMA if sizes else KAPPA_KEPT
    return prior_sigma(start, GAIN_SIGMA, TILT_SIGMA, CENTRE_SIGMA, kappa)


def solved(bench: Bench, settings: AntennaSettings) -> AntennaSolution:
    """Return the maximum-likelihood antennas of all readings.

    Raises EstimationError where a fit does not converge.
    """
    mean = bench.start.vector()
    cov = np.diag(declared_sigma(bench.start, sizes=settings.sizes) ** 2)
    chi2, dof, errors = 0.0, 0, {}
    for side, readings in bench.probed.items():
        mean, cov, of_side, errors[side] = _by_probe(bench, side, readings, mean, cov, settings)
        chi2, dof = chi2 + of_side[0], dof + of_side[1]
    root = np.asarray(np.linalg.cholesky(cov))
    if bench.survey is None:
        result = antenna_from_vector(mean)
        poses = np.zeros((0, 3, 3)), np.zeros((0, 3))
        fit = AntennaFit(result, cov, np.asarray(chi2), dof, *poses)
        return AntennaSolution(fit, mean, root, None, errors)
    fit = _by_survey(bench, bench.survey, mean, root, settings)
    own = bench.survey.of_sensor(bench.beacon, bench.site.platform.magnetometer)
    whole = replace(fit, chi2=fit.chi2 + chi2, dof=fit.dof + dof)
    written = with_fit(bench.site, bench.beacon, fit)
    beacon = next(b for b in written.beacons if b.name == bench.beacon.name)
    elsewhere = turned_elsewhere(written, beacon, fit, bench.survey)
    return AntennaSolution(whole, mean, root, observability(own, fit.antenna), errors, elsewhere)


def _by_survey(
    bench: Bench, survey: BodySurvey, mean: Array, root: Array, settings: AntennaSettings
) -> AntennaFit:
    from magfusion.calibration.antenna_graph import fit_at_uncertain_poses

    sensor = bench.site.platform.magnetometer
    own, model = survey.of_sensor(bench.beacon, sensor), of_site(bench.beacon, sensor)
    start = antenna_from_vector(mean)
    if settings.exact:
        fit = fit_at_known_poses(own, start, root, model)
    else:
        turn, place = settings.pose_rotation_deg * DEGREE, settings.pose_position_m
        fit = fit_at_uncertain_poses(own, start, root, turn, place, model)
    # A probe measures tesla, and so determines the moments, which couplings do not.
    return fit if "transmitter" in bench.probed else with_receiver_gain(fit, bench.start)


def _by_probe(
    bench: Bench,
    side: Side,
    readings: ProbeReadings,
    mean: Array,
    cov: Array,
    settings: AntennaSettings,
) -> tuple[Array, Array, tuple[float, int], tuple[Array, Array]]:
    """Return mean and covariance of all parameters, chi square and readings, and test errors."""
    columns = columns_of(side, len(mean))
    start, sigma = mean[columns], np.sqrt(np.diagonal(cov))[columns]
    predict: Predict = read_of_term
    if side == "transmitter":
        predict = _of_coils(bench.beacon, len(start))
    else:
        readings = in_units_of_sensitivity(readings, start)
    bench_error = settings.probe_position_m, settings.probe_tilt_deg * DEGREE
    readings = replace(readings, sigma=bench_sigma(start, readings, *bench_error))
    fit = fit_by_probe(readings, start, sigma, predict)
    errors = left_out_errors(readings, start, sigma, predict)
    vector, own = fit.vector, max(1.0, fit.chi2 / fit.dof) * fit.cov
    if side == "receiver":  # with what current it was driven nobody knows
        rows, before = vector[:9].reshape(3, 3), start[:9].reshape(3, 3)
        sizes = np.log(np.linalg.norm(before, axis=1) / np.linalg.norm(rows, axis=1))
        vector = vector.copy()
        vector[:9] *= np.exp(np.mean(sizes))
        own[:9, :9] += GAIN_SIGMA**2 * np.outer(vector[:9], vector[:9])
    mean, cov = mean.copy(), cov.copy()
    mean[columns], cov[np.ix_(columns, columns)] = vector, own
    return mean, cov, (fit.chi2, fit.dof), errors


def _of_coils(beacon: Beacon, size: int) -> Predict:
    """Return a probe's readings of the site's beacon coils."""
    none = np.zeros((3, 3))

    def put(coils: Beacon, vector: Array) -> Beacon:
        moments, centres = vector[:9].reshape(3, 3), vector[9:18].reshape(3, 3)
        sizes = (vector[18:], np.zeros(())) if size > 18 else ()
        return coils_of(coils, Antenna(moments, centres, none, none, *sizes))

    return read_of_beacon(beacon, put)


def left_out(
    bench: Bench, declared: Site, result: AntennaSolution, settings: AntennaSettings
) -> tuple[PoseErrors, PoseErrors]:
    """Return errors of fixes with the declared site, and with sites fitted without each pose.

    Every fold's site is written to a file and read again, so that the file itself is tested.
    """
    survey, name = bench.survey, bench.beacon.name
    assert survey is not None
    own = np.array([settings.pose_rotation_deg * DEGREE, settings.pose_position_m])
    n = len(survey.sigma)
    separate, square, excess = np.empty((n, 2)), np.empty((n, 2)), np.empty(n)
    fold = np.arange(n) % FOLDS
    with TemporaryDirectory() as directory:
        for k in range(FOLDS):
            rows = fold == k
            fit = _by_survey(bench, survey.rows(~rows), result.prior, result.root, settings)
            path = Path(directory) / "site.yaml"
            save_site(with_fit(bench.site, bench.beacon, fit), path)
            site = load_site(path)
            beacon = next(b for b in site.beacons if b.name == name)
            separate[rows] = differences(site, beacon, survey.rows(rows))
            built = expected(site, beacon, fit, survey.rows(rows))
            square[rows], excess[rows] = built.square, built.excess
    before = own_errors(differences(declared, bench.beacon, survey), own, None)
    return before, own_errors(separate, own, Expected(square, excess))
