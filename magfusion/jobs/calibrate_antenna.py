"""The job that calibrates a tracker's antennas: a survey of known poses in, a refined site out."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.antenna import (
    CENTRES,
    KAPPAS,
    MOMENTS,
    SENSITIVITIES,
    SENSOR_CENTRES,
    Antenna,
    antenna_from_vector,
    antenna_of,
)
from magfusion.calibration.antenna import (
    AntennaFit,
    AntennaSurvey,
    fit_at_known_poses,
    prior_sigma,
    with_receiver_gain,
)
from magfusion.calibration.antenna_graph import fit_at_uncertain_poses
from magfusion.calibration.antenna_observability import Observability, observability
from magfusion.errors import EstimationError, InputError
from magfusion.fixes.tracker import locate_by_svd, refine_poses, whitened
from magfusion.job import claim, named
from magfusion.plots.antenna import write_antenna_plot
from magfusion.records.survey import Survey, read_survey
from magfusion.report import Figures, write_report
from magfusion.site import Beacon, Site
from magfusion.site_file import load_site, save_site
from magfusion.units import DEGREE, Array

JOB = "calibrate antenna"
FEWEST_POSES = 5  # four determine the antenna; with less than one to spare nothing is tested
FOLDS = 5  # each pose is judged by an antenna that was fitted without it
# What a nominal antenna may be off by; wide, since the couplings say more.
GAIN_SIGMA, TILT_SIGMA, CENTRE_SIGMA, KAPPA_SIGMA = 0.05, 0.05, 0.01, 1e-3
DETERMINED_RATIO = 0.5
_AXES = "xyz"


@dataclass(frozen=True)
class AntennaSettings:
    """How the antennas are calibrated.

    Parameters
    ----------
    beacon : str, optional
        Which; None takes the only one with three coils, each in a tone or slot of its own.
    rotation_sigma, position_sigma : float
        Error of the survey's poses, each axis (rad, m); zero takes them as exact.
    sizes : bool
        Estimate the coils' finite size too.
    """

    beacon: str | None = None
    rotation_sigma: float = 0.1 * DEGREE
    position_sigma: float = 0.5e-3
    sizes: bool = False


def run_calibrate_antenna(
    survey_path: Path, site_path: Path, settings: AntennaSettings, output: Path
) -> Figures:
    """Calibrate the antennas of a beacon and of the magnetometer: site, picture and report.

    Returns
    -------
    dict
        The figures of ``report.json``.

    Raises
    ------
    InputError
        Where a file cannot be read, the site has no tracker, the survey does not fit it, its poses
        are too few, a wire is swapped, or ``output`` is in the way.
    EstimationError
        Where the fit does not converge.
    """
    claimed = claim(output, JOB)
    _check(settings)
    site = load_site(site_path)
    with named(site_path):
        beacon = _tracker(site, settings.beacon)
        start = antenna_of(beacon, site.platform.magnetometer)
    with named(survey_path):
        survey, dropped = _couplings(read_survey(survey_path), site, beacon)
        before = _pose_errors(start, survey)
    if settings.sizes:
        start = antenna_from_vector(np.concatenate([start.vector(), np.zeros(2)]))
    fit = with_receiver_gain(_fit(survey, start, settings), start)
    told = observability(survey, fit.antenna)
    after = _judged(survey, start, settings)
    figures: Figures = {"job": JOB, "log": survey_path.stem, "beacon": beacon.name}
    figures |= {"poses": len(survey.sigma), "poses_dropped": dropped}
    figures |= _error_figures(before, after) | _figures(fit, told, start, settings)
    with claimed as directory:
        save_site(_refined(site, beacon, fit, figures), directory / "site.yaml")
        write_antenna_plot(directory / "antenna.png", before, after)
        write_report(directory, figures)
    return figures


def _check(settings: AntennaSettings) -> None:
    sigmas = (settings.rotation_sigma, settings.position_sigma)
    for name, value in zip(("--pose-rotation-deg", "--pose-position-m"), sigmas, strict=True):
        if not 0.0 <= value < np.inf:
            raise InputError(f"{name} must be at least 0; got {value:g}")
    if (sigmas[0] == 0.0) != (sigmas[1] == 0.0):
        raise InputError(
            "--pose-rotation-deg and --pose-position-m must both be 0 (poses exact) or both above"
        )


def _tracker(site: Site, name: str | None) -> Beacon:
    names = ", ".join(b.name for b in site.beacons)
    trackers = [b for b in site.beacons if len(b.coils) == 3 and len(b.tones) == 3]
    if name is not None:
        found = [b for b in site.beacons if b.name == name]
        if not found:
            raise InputError(f"has no beacon {name} (it has {names}); choose one with --beacon")
    else:
        found = trackers
    if len(found) != 1:
        what = "no beacon" if not found else f"{len(found)} beacons"
        raise InputError(
            f"has {what} of three coils, each in a tone or slot of its own; describe the tracker,"
            " or choose one with --beacon"
        )
    if not found[0].synchronised:
        raise InputError(
            f"beacon {found[0].name} is not synchronised: the sign of its couplings is unknown;"
            " survey it with synchronised: true"
        )
    if found[0].field_map is not None:
        raise InputError(
            f"beacon {found[0].name} has a field map, learnt with the old antennas; calibrate the"
            " antennas first and learn the map anew"
        )
    return found[0]


def _couplings(survey: Survey, site: Site, beacon: Beacon) -> tuple[AntennaSurvey, int]:
    """Return a survey's couplings at poses of the sensor in beacon axes, and how many it lost."""
    if survey.phasor_sensor is None:
        raise InputError("holds amplitudes, and antennas need phasors; survey again")
    wanted = [(beacon.name, tone) for tone in range(3)]
    missing = [str(tone) for name, tone in wanted if (name, tone) not in survey.channels]
    if missing:
        raise InputError(
            f"has no tone {', '.join(missing)} of beacon {beacon.name}; a tracker's survey holds"
            " the tones or slots 0, 1 and 2"
        )
    columns = [survey.channels.index(channel) for channel in wanted]
    phasor, sigma = survey.phasor_sensor[:, columns], survey.sigma[:, columns]
    whole = np.isfinite(phasor).all(axis=(1, 2))
    if np.sum(whole) < FEWEST_POSES:
        raise InputError(
            f"holds {np.sum(whole)} poses with all three tones of beacon {beacon.name}; survey at"
            f" least {FEWEST_POSES}, at different positions and attitudes"
        )
    # Tones are in the order of the coils, one each.
    declared = np.array([coil.phase for coil in beacon.coils])
    real = (phasor[whole] * np.exp(-1j * declared)[:, None]).real
    sensor = site.platform.magnetometer
    world_from_body = survey.world_from_body[whole]
    place = survey.position_world[whole] + world_from_body @ sensor.position_body
    turn = beacon.world_from_beacon.T @ world_from_body @ sensor.body_from_sensor
    return (
        AntennaSurvey(
            beacon_from_sensor=turn,
            position_beacon=(place - beacon.position_world) @ beacon.world_from_beacon,
            coupling=np.swapaxes(real, 1, 2),
            sigma=np.sqrt(np.mean(sigma[whole] ** 2, axis=1)),
        ),
        int(np.sum(~whole)),
    )


def _some(survey: AntennaSurvey, rows: Array) -> AntennaSurvey:
    return AntennaSurvey(
        survey.beacon_from_sensor[rows],
        survey.position_beacon[rows],
        survey.coupling[rows],
        survey.sigma[rows],
    )


def _fit(survey: AntennaSurvey, start: Antenna, settings: AntennaSettings) -> AntennaFit:
    sigma = prior_sigma(start, GAIN_SIGMA, TILT_SIGMA, CENTRE_SIGMA, KAPPA_SIGMA)
    if settings.rotation_sigma == 0.0:
        return fit_at_known_poses(survey, start, sigma)
    return fit_at_uncertain_poses(
        survey, start, sigma, settings.rotation_sigma, settings.position_sigma
    )


def _pose_errors(antenna: Antenna, survey: AntennaSurvey) -> tuple[Array, Array]:
    """Return how far tracked poses are from the surveyed ones (rad, m)."""
    receiver = np.asarray(np.linalg.inv(antenna.sensitivities_sensor))
    free = whitened(survey.coupling, receiver, antenna.moments_beacon.T)
    try:
        start = locate_by_svd(free).nearest(survey.position_beacon)
        rotation, position = refine_poses(
            antenna,
            survey.coupling,
            np.swapaxes(start.sensor_from_beacon, -1, -2),
            start.position_beacon[:, 0],
        )
    except EstimationError as error:
        raise InputError(f"{error}; mend the wiring or the site") from error
    turn = np.swapaxes(survey.beacon_from_sensor, -1, -2) @ rotation
    off = np.linalg.norm(position - survey.position_beacon, axis=-1)
    return np.asarray(Rotation.from_matrix(turn).magnitude()), np.asarray(off)


def _judged(
    survey: AntennaSurvey, start: Antenna, settings: AntennaSettings
) -> tuple[Array, Array]:
    """Return the errors of every pose by an antenna that was fitted without it."""
    n = len(survey.sigma)
    attitude, position = np.empty(n), np.empty(n)
    fold = np.arange(n) % FOLDS
    for k in range(FOLDS):
        own = fold == k
        antenna = _fit(_some(survey, ~own), start, settings).antenna
        attitude[own], position[own] = _pose_errors(antenna, _some(survey, own))
    return attitude, position


def _error_figures(before: tuple[Array, Array], after: tuple[Array, Array]) -> Figures:
    figures: Figures = {}
    for name, (attitude, position) in (("before", before), ("after", after)):
        figures[f"attitude_deg_{name}"] = float(np.sqrt(np.mean(attitude**2)) / DEGREE)
        figures[f"position_m_{name}"] = float(np.sqrt(np.mean(position**2)))
    return figures


def _names(parameters: int) -> list[str]:
    blocks = ("transmitter.moment", "transmitter.centre", "receiver.matrix", "receiver.centre")
    names = [f"{block}_{coil}{axis}" for block in blocks for coil in _AXES for axis in _AXES]
    return [*names, "transmitter.kappa", "receiver.kappa"][:parameters]


def _figures(
    fit: AntennaFit, told: Observability, start: Antenna, settings: AntennaSettings
) -> Figures:
    sigma = np.sqrt(np.diagonal(fit.cov))
    prior = prior_sigma(start, GAIN_SIGMA, TILT_SIGMA, CENTRE_SIGMA, KAPPA_SIGMA)
    found = fit.antenna.vector()
    change = found - start.vector()
    figures: Figures = {
        "poses_taken_as": "exact" if settings.rotation_sigma == 0.0 else "uncertain",
        "chi2_per_dof": float(fit.chi2 / fit.dof),
        "parameters": told.parameters,
        "rank": told.rank,
        "not_seen_by_these_poses": list(told.null_space),
        "weakest_seen_relative": float(told.singular[told.rank - 1]),
        "fewest_of_these_poses": told.fewest_poses,
    }
    for columns, name in (
        (MOMENTS, "moment_change_a_m2"),
        (CENTRES, "transmitter_centre_change_m"),
        (SENSITIVITIES, "matrix_change"),
        (SENSOR_CENTRES, "receiver_centre_change_m"),
    ):
        figures[f"{name}_largest"] = float(np.max(np.abs(change[columns])))
        figures[f"{name}_sigma_largest"] = float(np.max(sigma[columns]))
    if settings.sizes:
        for name, value, error in zip(
            ("transmitter", "receiver"), found[KAPPAS], sigma[KAPPAS], strict=True
        ):
            figures[f"{name}_kappa_m2"] = float(value)
            figures[f"{name}_kappa_m2_sigma"] = float(error)
    settled = sigma < DETERMINED_RATIO * prior
    names = _names(len(found))
    figures["determined"] = [n for n, yes in zip(names, settled, strict=True) if yes]
    figures["undetermined"] = [n for n, yes in zip(names, settled, strict=True) if not yes]
    return figures


def _refined(site: Site, beacon: Beacon, fit: AntennaFit, figures: Figures) -> Site:
    """Return the site with the antennas' vectors, centres and matrix, and their sigmas."""
    antenna, sensor = fit.antenna, site.platform.magnetometer
    sigma = np.sqrt(np.diagonal(fit.cov))
    size = np.linalg.norm(antenna.moments_beacon, axis=1)
    along = antenna.moments_beacon / size[:, None]
    blocks = [fit.cov[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(3)]
    log_moment = np.sqrt([a @ c @ a for a, c in zip(along, blocks, strict=True)]) / size
    coils = tuple(
        replace(coil, moment_beacon=moment, centre_beacon=centre)
        for coil, moment, centre in zip(
            beacon.coils, antenna.moments_beacon, antenna.centres_beacon, strict=True
        )
    )
    refined = replace(beacon, coils=coils, sigma=replace(beacon.sigma, log_moment=log_moment))
    magnetometer = replace(
        sensor,
        matrix=antenna.sensitivities_sensor,
        coil_centres_sensor=antenna.centres_sensor,
        sigma=replace(sensor.sigma, matrix=sigma[SENSITIVITIES].reshape(3, 3)),
    )
    record = {
        "log": figures["log"],
        "determined": figures["determined"],
        "undetermined": figures["undetermined"],
    }
    known, owners = site.correlation, (beacon.name, "magnetometer")
    return replace(
        site,
        beacons=tuple(refined if b.name == beacon.name else b for b in site.beacons),
        platform=replace(site.platform, magnetometer=magnetometer),
        calibration=record,
        correlation=known and known.without(("moments", "magnetometer"), owners),
    )
