"""The job that calibrates a tracker's antennas: a survey of known poses in, a refined site out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from magfusion.errors import EstimationError, InputError
from magfusion.jobs.settings import Command, Settings, argument, option, required
from magfusion.model.site import Beacon, Coil, Site
from magfusion.units import DEGREE, Array

if TYPE_CHECKING:
    from magfusion.calibration.antenna import AntennaFit, AntennaSurvey
    from magfusion.calibration.antenna_observability import Observability
    from magfusion.files.survey import Survey
    from magfusion.model.antenna import Antenna
    from magfusion.results.figures import Estimate, Figures


JOB = "calibrate antenna"
FEWEST_POSES = 5  # four determine the antenna; with less than one to spare nothing is tested
FOLDS = 5  # each pose is judged by an antenna that was fitted without it
# What a nominal antenna may be off by; wide, since the couplings say more.
GAIN_SIGMA, TILT_SIGMA, CENTRE_SIGMA, KAPPA_SIGMA = 0.05, 0.05, 0.01, 1e-3
KAPPA_KEPT = 1e-12  # m^2; a micrometre squared
_AXES = "xyz"


@dataclass(frozen=True, kw_only=True)
class AntennaSettings(Settings):
    """How the antennas are calibrated."""

    survey: Path = argument("Survey: known poses and the phasors of a three-coil beacon")
    site: Path = required("Site file")
    beacon: str | None = option(None, "Which", note="default: the only one of three coils")
    pose_rotation_deg: float = option(
        0.1, "Error of the survey's attitudes, one sigma an axis", least=0.0, note="0: exact"
    )
    pose_position_m: float = option(
        0.0005, "Error of the survey's positions, one sigma an axis", least=0.0, note="0: exact"
    )
    sizes: bool = option(False, "Estimate the coils' size too")

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.pose_rotation_deg == 0.0) != (self.pose_position_m == 0.0):
            raise InputError(
                "--pose-rotation-deg and --pose-position-m must both be 0 (poses exact) or both"
                " above"
            )

    @property
    def kappa_sigma(self) -> float:
        """Prior of the coils' size (m^2): where it is not asked for, that declared is kept."""
        return KAPPA_SIGMA if self.sizes else KAPPA_KEPT

    @property
    def exact(self) -> bool:
        """Whether the survey's poses are taken as exact."""
        return self.pose_rotation_deg == 0.0


def run_calibrate_antenna(settings: AntennaSettings, output: Path) -> Figures:
    """Calibrate the antennas of a beacon and of the magnetometer: site, picture and report.

    Raises
    ------
    InputError
        Where a file cannot be read, the site has no tracker, the survey does not fit it, its poses
        are too few, a wire is swapped, or ``output`` is in the way.
    EstimationError
        Where the fit does not converge.
    """
    from magfusion.calibration.antenna import with_receiver_gain
    from magfusion.calibration.antenna_observability import observability
    from magfusion.files.site import load_site, save_site
    from magfusion.files.survey import read_survey
    from magfusion.jobs.antenna_trust import judged
    from magfusion.jobs.inputs import claim, found_in, named, refuse_failed
    from magfusion.model.antenna import antenna_from_vector, antenna_of
    from magfusion.results.figures import (
        Figure,
        Figures,
        calibration_record,
        determined_figures,
        heading,
    )
    from magfusion.results.plots.antenna import write_antenna_plot
    from magfusion.results.report import write_report
    from magfusion.results.verdict import trust_figures

    claimed, survey_path, site_path = claim(output, JOB), settings.survey, settings.site
    site = load_site(site_path)
    with named(site_path):
        beacon = _tracker(site, settings.beacon)
        start = antenna_of(beacon, site.platform.magnetometer)
    with named(survey_path):
        survey, dropped = _couplings(read_survey(survey_path), site, beacon)
        before = _pose_errors(start, survey)
    if settings.sizes and start.kappa_beacon is None:
        start = antenna_from_vector(np.concatenate([start.vector(), np.zeros(2)]))
    fit = with_receiver_gain(_fit(survey, start, settings), start)
    observed = observability(survey, fit.antenna)
    after = _left_out(survey, start, settings)
    fit, trust = judged(fit, _estimates(fit, start, settings), observed.null_space, before, after)
    figures = (
        heading(JOB, survey_path.stem)
        | trust_figures(trust)
        | Figures(
            Figure("beacon", beacon.name),
            Figure("poses", len(survey.sigma)),
            Figure("poses_dropped", dropped),
        )
    )
    estimates = _estimates(fit, start, settings)
    record = calibration_record(survey_path.stem, estimates)
    figures |= _error_figures(before, after) | _figures(fit, observed, start, settings)
    figures |= determined_figures(estimates)
    with claimed as whole:
        directory = found_in(whole, trust)
        save_site(_refined(site, beacon, fit, record), directory / "site.yaml")
        write_antenna_plot(directory / "antenna.png", before, after)
        write_report(whole, figures)
    refuse_failed(survey_path, output, trust)
    return figures


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
    from magfusion.calibration.antenna import AntennaSurvey

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
    from magfusion.calibration.antenna import AntennaSurvey

    return AntennaSurvey(
        survey.beacon_from_sensor[rows],
        survey.position_beacon[rows],
        survey.coupling[rows],
        survey.sigma[rows],
    )


def _fit(survey: AntennaSurvey, start: Antenna, settings: AntennaSettings) -> AntennaFit:
    from magfusion.calibration.antenna import fit_at_known_poses, prior_sigma
    from magfusion.calibration.antenna_graph import fit_at_uncertain_poses

    sigma = prior_sigma(start, GAIN_SIGMA, TILT_SIGMA, CENTRE_SIGMA, settings.kappa_sigma)
    if settings.exact:
        return fit_at_known_poses(survey, start, sigma)
    return fit_at_uncertain_poses(
        survey, start, sigma, settings.pose_rotation_deg * DEGREE, settings.pose_position_m
    )


def _pose_errors(antenna: Antenna, survey: AntennaSurvey) -> tuple[Array, Array]:
    """Return how far tracked poses are from the surveyed ones (rad, m)."""
    from scipy.spatial.transform import Rotation

    from magfusion.papers.p000_tracker.equations import eq_09_whitened
    from magfusion.papers.p000_tracker.pose import locate_by_svd, refine_poses

    receiver = np.asarray(np.linalg.inv(antenna.sensitivities_sensor))
    free = eq_09_whitened(survey.coupling, receiver, antenna.moments_beacon.T)
    try:
        start = locate_by_svd(free).nearest(survey.position_beacon)
        rotation, position = refine_poses(
            antenna,
            survey.coupling,
            np.swapaxes(start.sensor_from_beacon, -1, -2),
            start.position_beacon[:, 0],
        )
    except EstimationError as error:
        raise InputError(f"{error}; correct the wiring or the site") from error
    turn = np.swapaxes(survey.beacon_from_sensor, -1, -2) @ rotation
    off = np.linalg.norm(position - survey.position_beacon, axis=-1)
    return np.asarray(Rotation.from_matrix(turn).magnitude()), np.asarray(off)


def _left_out(
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
    from magfusion.results.figures import Figure, Figures

    figures = []
    for name, (attitude, position) in (("before", before), ("after", after)):
        turned = float(np.sqrt(np.mean(attitude**2)) / DEGREE)
        moved = float(np.sqrt(np.mean(position**2)))
        figures += [
            Figure(f"attitude_deg_{name}", turned, "deg", label=f"attitude error {name}"),
            Figure(f"position_m_{name}", moved, "m", label=f"position error {name}"),
        ]
    return Figures(*figures)


def _estimates(fit: AntennaFit, start: Antenna, settings: AntennaSettings) -> list[Estimate]:
    from magfusion.calibration.antenna import prior_sigma
    from magfusion.results.figures import Estimate

    blocks = ("transmitter.moment", "transmitter.centre", "receiver.matrix", "receiver.centre")
    names = [f"{block}_{coil}{axis}" for block in blocks for coil in _AXES for axis in _AXES]
    found = fit.antenna.vector()
    names += ["transmitter.kappa", "receiver.kappa"] if settings.sizes else []
    prior = prior_sigma(start, GAIN_SIGMA, TILT_SIGMA, CENTRE_SIGMA, KAPPA_SIGMA)
    columns = (found - start.vector(), np.diagonal(fit.cov), prior)
    rows = zip(names, *(column[: len(names)] for column in columns), strict=True)
    return [
        Estimate(name, float(change), sigma=float(np.sqrt(variance)), prior_sigma=float(before))
        for name, change, variance, before in rows
    ]


def _figures(
    fit: AntennaFit, observed: Observability, start: Antenna, settings: AntennaSettings
) -> Figures:
    from magfusion.model.antenna import CENTRES, KAPPAS, MOMENTS, SENSITIVITIES, SENSOR_CENTRES
    from magfusion.results.figures import Figure, Figures

    sigma = np.sqrt(np.diagonal(fit.cov))
    found = fit.antenna.vector()
    change = found - start.vector()
    figures = [
        Figure("poses_taken_as", "exact" if settings.exact else "uncertain"),
        Figure("chi2_per_dof", float(fit.chi2 / fit.dof), label="chi square per degree of freedom"),
        Figure("parameters", observed.parameters),
        Figure("rank", observed.rank),
        Figure("not_seen_by_these_poses", list(observed.null_space)),
        Figure("weakest_seen_relative", float(observed.singular[observed.rank - 1])),
        Figure("fewest_of_these_poses", observed.fewest_poses),
    ]
    for columns, name, unit in (
        (MOMENTS, "moment_change_a_m2", "A m^2"),
        (CENTRES, "transmitter_centre_change_m", "m"),
        (SENSITIVITIES, "matrix_change", ""),
        (SENSOR_CENTRES, "receiver_centre_change_m", "m"),
    ):
        figures += [
            Figure(f"{name}_largest", float(np.max(np.abs(change[columns]))), unit),
            Figure(f"{name}_sigma_largest", float(np.max(sigma[columns])), unit),
        ]
    if settings.sizes:
        sizes = zip(("transmitter", "receiver"), found[KAPPAS], sigma[KAPPAS], strict=True)
        for name, value, error in sizes:
            figures += [
                Figure(f"{name}_kappa_m2", float(value), "m^2", label=f"{name} kappa"),
                Figure(f"{name}_kappa_m2_sigma", float(error), "m^2", label=f"{name} kappa sigma"),
            ]
    return Figures(*figures)


def _refined(site: Site, beacon: Beacon, fit: AntennaFit, record: dict[str, object]) -> Site:
    """Return the site with the antennas' vectors, centres and matrix, and their sigmas."""
    from magfusion.model.antenna import SENSITIVITIES

    antenna, sensor = fit.antenna, site.platform.magnetometer
    sigma = np.sqrt(np.diagonal(fit.cov))
    size = np.linalg.norm(antenna.moments_beacon, axis=1)
    along = antenna.moments_beacon / size[:, None]
    blocks = [fit.cov[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(3)]
    log_moment = np.sqrt([a @ c @ a for a, c in zip(along, blocks, strict=True)]) / size
    coils = tuple(
        _of_size(replace(coil, moment_beacon=moment, centre_beacon=centre), antenna.kappa_beacon)
        for coil, moment, centre in zip(
            beacon.coils, antenna.moments_beacon, antenna.centres_beacon, strict=True
        )
    )
    refined = replace(beacon, coils=coils, sigma=replace(beacon.sigma, log_moment=log_moment))
    magnetometer = replace(
        sensor,
        matrix=antenna.sensitivities_sensor,
        coil_centres_sensor=antenna.centres_sensor,
        coil_kappa=0.0 if antenna.kappa_sensor is None else float(antenna.kappa_sensor),
        sigma=replace(sensor.sigma, matrix=sigma[SENSITIVITIES].reshape(3, 3)),
    )
    known, owners = site.correlation, (beacon.name, "magnetometer")
    return replace(
        site,
        beacons=tuple(refined if b.name == beacon.name else b for b in site.beacons),
        platform=replace(site.platform, magnetometer=magnetometer),
        calibration=record,
        correlation=known and known.without(("moments", "magnetometer"), owners),
    )


def _of_size(coil: Coil, kappa: Array | None) -> Coil:
    """Return the coil as the circular, or long, one of this size."""
    from magfusion.model.physics.finite_size import coil_shape

    if kappa is None:
        return coil
    radius, length = coil_shape(float(kappa), coil.length)
    return replace(coil, radius=radius, length=length)


COMMAND = Command(
    AntennaSettings,
    run_calibrate_antenna,
    output="antenna",
    example="magfusion calibrate antenna survey --site site.yaml -o antenna",
)
