"""Figures of the antenna calibration."""

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.calibration.antenna import AntennaFit
from magfusion.calibration.antenna_observability import AntennaObservability
from magfusion.calibration.antenna_tracking import PoseErrors
from magfusion.jobs.antenna_fit import AntennaSolution, Bench, declared_sigma
from magfusion.jobs.antenna_settings import AntennaSettings
from magfusion.model.antenna import CENTRES, KAPPAS, MOMENTS, SENSITIVITIES, SENSOR_CENTRES, Antenna
from magfusion.model.site import Site
from magfusion.results.figures import Figure, Figures, ParameterEstimate
from magfusion.units import DEGREE

_AXES = "xyz"


def estimates(fit: AntennaFit, start: Antenna, *, sizes: bool) -> list[ParameterEstimate]:
    """Return every parameter of the antennas with its sigma and that of its prior."""
    blocks = ("transmitter.moment", "transmitter.centre", "receiver.matrix", "receiver.centre")
    names = [f"{block}_{coil}{axis}" for block in blocks for coil in _AXES for axis in _AXES]
    names += [*(f"transmitter.kappa_{c}" for c in _AXES), "receiver.kappa"] if sizes else []
    result = fit.antenna.vector()
    prior = declared_sigma(start, sizes=True)
    columns = (result - start.vector(), np.diagonal(fit.cov), prior)
    rows = zip(names, *(column[: len(names)] for column in columns), strict=True)
    return [
        ParameterEstimate(
            name, float(change), sigma=float(np.sqrt(variance)), prior_sigma=float(before)
        )
        for name, change, variance, before in rows
    ]


def read_figures(bench: Bench, dropped: int) -> Figures:
    """Return the number of readings."""
    result = []
    if bench.survey is not None:
        result += [Figure("poses", len(bench.survey.sigma)), Figure("poses_dropped", dropped)]
    for side, readings in bench.probed.items():
        result.append(Figure(f"{side}_probe_readings", len(readings), label=f"{side}, readings"))
    return Figures(*result)


def error_figures(errors: tuple[PoseErrors, PoseErrors] | None, solved: AntennaSolution) -> Figures:
    """Return errors before and after: of fixes at poses, and of probe readings at points."""
    result, probed = [], solved.probed
    for k, (name, unit, size) in enumerate((("attitude", "deg", DEGREE), ("position", "m", 1.0))):
        for when, one in zip(("before", "after"), errors or (), strict=False):
            key = f"{name}_{unit}_{when}"
            raw = float(np.sqrt(np.mean(one.difference[:, k] ** 2))) / size
            words = f"{name} error {when}"
            result.append(Figure(key, float(one.rms[k]) / size, unit, label=words))
            result.append(
                Figure(f"{key}_against_survey", raw, unit, label=f"{words}, incl. the survey's own")
            )
            if when == "after":
                known = float(one.rms_sigma[k]) / size
                result.append(Figure(f"{key}_sigma", known, unit, label=f"{words}, standard error"))
                assert solved.elsewhere is not None
                rotated, words = float(solved.elsewhere[k]) / size, f"{name} error in any attitude"
                result.append(Figure(f"{name}_{unit}_any_attitude", rotated, unit, label=words))
    for side, (before, after) in probed.items():
        for when, value in (("before", before), ("after", after)):
            rms = float(np.sqrt(np.mean(value**2)))
            words = f"{side}, field at points left out, {when}"
            result.append(Figure(f"{side}_field_error_{when}", rms, label=words))
    return Figures(*result)


def figures(
    fit: AntennaFit,
    observed: AntennaObservability | None,
    start: Antenna,
    settings: AntennaSettings,
) -> Figures:
    """Return estimated and undetermined parameters of the antennas."""
    sigma = np.sqrt(np.diagonal(fit.cov))
    result = fit.antenna.vector()
    change = result - start.vector()
    chi2 = float(fit.chi2 / fit.dof)
    figures = [Figure("chi2_per_dof", chi2, label="chi square per degree of freedom")]
    if observed is not None:
        figures += _observed_figures(observed, exact=settings.exact)
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
        kappas = np.stack([result[KAPPAS], sigma[KAPPAS]])
        sizes = {"transmitter": np.mean(kappas[:, :3], axis=1)}
        sizes |= {f"transmitter_{c}": kappas[:, k] for k, c in enumerate(_AXES)}
        for name, (value, error) in (sizes | {"receiver": kappas[:, 3]}).items():
            key, words = f"{name}_kappa_m2", f"{name.replace('_', ' ')} kappa"
            figures += [
                Figure(key, float(value), "m^2", label=words),
                Figure(f"{key}_sigma", float(error), "m^2", label=f"{words} sigma"),
            ]
    return Figures(*figures)


def _observed_figures(observed: AntennaObservability, *, exact: bool) -> list[Figure]:
    return [
        Figure("poses_taken_as", "exact" if exact else "uncertain"),
        Figure("parameters", observed.parameters),
        Figure("rank", observed.rank),
        Figure("not_seen_by_these_poses", list(observed.null_space)),
        Figure("weakest_seen_relative", float(observed.singular[observed.rank - 1])),
        Figure("fewest_of_these_poses", observed.min_poses),
    ]


def mounting_figures(site: Site, declared: Site) -> Figures:
    """Return the change of the receiver's mounting relative to the declared, and its sigmas."""
    result, before = site.platform.magnetometer, declared.platform.magnetometer
    turn = before.body_from_sensor.T @ result.body_from_sensor
    rotated = float(Rotation.from_matrix(turn).magnitude()) / DEGREE
    moved = float(np.linalg.norm(result.position_body - before.position_body))
    known = float(np.max(result.sigma.rotation_sensor)) / DEGREE
    return Figures(
        Figure("boresight_change_deg", rotated, "deg", label="boresight, change"),
        Figure("boresight_sigma_deg", known, "deg", label="boresight, sigma an axis"),
        Figure("lever_change_m", moved, "m", label="lever arm, change"),
        Figure(
            "lever_sigma_m",
            float(np.max(result.sigma.position_body)),
            "m",
            label="lever arm, sigma an axis",
        ),
    )
