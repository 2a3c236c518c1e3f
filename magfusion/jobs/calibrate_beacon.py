"""The job that estimates positions and attitudes of beacons: survey in, refined site out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.calibration.beacon import REACH, BeaconFits, BeaconMeasurements
from magfusion.calibration.beacon_refined import RefinedBeacon, calibrate_one
from magfusion.errors import InputError
from magfusion.estimation.snapshot.priors import contradiction, trust_of, unexplained
from magfusion.files.site import load_site, save_site
from magfusion.files.survey import Survey, read_survey
from magfusion.jobs.receiver_axes import three_axes
from magfusion.jobs.settings import Command, Settings, argument, option, required
from magfusion.model.field import predict
from magfusion.model.noise import model_error_cov
from magfusion.model.progress import Report, quiet
from magfusion.model.site import Beacon, Site
from magfusion.model.trust import Finding, Trust, Verdict
from magfusion.results.figures import (
    Figure,
    Figures,
    ParameterEstimate,
    calibration_record,
    determined_figures,
    heading,
)
from magfusion.results.verdict import notes_of, trust_figures
from magfusion.units import DEGREE, Array

if TYPE_CHECKING:
    from magfusion.results.plots.beacon import BeaconPanel


JOB = "calibrate beacon"
FARTHEST = 5.0  # m from the declared place, however wide its sigma


@dataclass(frozen=True, eq=False)
class _Calibrated:
    measured: BeaconMeasurements
    fits: BeaconFits
    refined: RefinedBeacon
    point: Array

    @property
    def freedom(self) -> int:
        return 6 * int(np.count_nonzero(self.measured.valid)) - int(self.fits.cov.shape[-1])


@dataclass(frozen=True, kw_only=True)
class BeaconSettings(Settings):
    """Survey, and the beacons to calibrate."""

    survey: Path = argument("Survey: measurements of magnetometers at known poses")
    site: Path = required("Site file with the declared beacons")
    beacon: tuple[str, ...] = option(
        (), "Name of a beacon; repeatable", note="default: all surveyed beacons"
    )


def run_calibrate_beacon(settings: BeaconSettings, output: Path, report: Report = quiet) -> Figures:
    """Calibrate beacons from magnetometers at the known poses of a survey.

    A beacon that is not synchronised must have had one drive phase at all points, as with
    magnetometers that record simultaneously.
    """
    from magfusion.jobs.inputs import named
    from magfusion.jobs.result_directory import claim, result_in
    from magfusion.results.plots.beacon import write_beacon_plot

    claimed, survey_path = claim(output, JOB), settings.survey
    site = three_axes(load_site(settings.site), settings.site)
    survey = read_survey(survey_path)
    if survey.phasor_sensor is None:
        raise InputError(
            f"{survey_path}: contains amplitudes, but the calibration of a beacon requires phasors;"
            " survey again"
        )
    beacons = _chosen(site, survey, settings.beacon, survey_path)
    result, trust = [], Trust()
    for done, beacon in enumerate(beacons):
        report(f"beacon {beacon.name}", done, len(beacons))
        with named(survey_path):
            honest, findings = judge_calibration(_calibrated(site, beacon, survey))
        result.append(honest)
        trust |= findings
    report("done", len(beacons), len(beacons))
    figures = _figures(survey_path, survey, result, trust)
    with result_in(claimed, figures, trust, survey_path, output) as directory:
        save_site(_refined_site(site, result, survey_path), directory / "site.yaml")
        write_beacon_plot(directory / "beacon.png", [_panel(c) for c in result])
    return figures


def _chosen(site: Site, survey: Survey, names: tuple[str, ...], path: Path) -> list[Beacon]:
    known = {b.name: b for b in site.beacons}
    detected = list(dict.fromkeys(name for name, _ in survey.channels))
    for name in names:
        if name not in known:
            raise InputError(f"--beacon {name}: the site has {', '.join(known)}; choose of these")
        if name not in detected:
            raise InputError(
                f"{path}: beacon {name} was not surveyed (found {', '.join(detected)}); survey it"
            )
    strange = [name for name in detected if name not in known]
    if strange and not names:
        raise InputError(
            f"{path}: beacon {strange[0]} is not in the site (it has {', '.join(known)}); give the"
            " site of the survey, or choose with --beacon"
        )
    _check_tones(survey, known, path)
    return [known[name] for name in dict.fromkeys(names or detected)]


def _check_tones(survey: Survey, known: dict[str, Beacon], path: Path) -> None:
    for name, tone in survey.channels:
        if name in known and tone >= len(known[name].tones):
            raise InputError(
                f"{path}: beacon {name} has no tone {tone} in the site (it has"
                f" {len(known[name].tones)}); give the site of the survey"
            )


def _calibrated(site: Site, beacon: Beacon, survey: Survey) -> _Calibrated:
    assert survey.phasor_sensor is not None
    shape = (len(survey), len(beacon.tones))
    phasor, sigma = np.full((*shape, 3), np.nan + 0j), np.ones(shape)
    for c, (name, tone) in enumerate(survey.channels):
        if name == beacon.name:
            phasor[:, tone], sigma[:, tone] = survey.phasor_sensor[:, c], survey.sigma[:, c]
    model = np.nan_to_num(model_error_cov(phasor, site.model_error)[..., 0, 0])
    total = np.sqrt(np.nan_to_num(sigma, nan=1.0) ** 2 + model)
    detected = np.isfinite(phasor).any(axis=(1, 2))
    measured = BeaconMeasurements(
        beacon,
        site.platform.magnetometer,
        survey.world_from_body[detected],
        survey.position_world[detected],
        phasor[None, detected],
        np.stack([total, total], axis=-1)[detected],
    )
    reach = float(np.clip(3.0 * np.max(beacon.sigma.position_world), REACH, FARTHEST))
    return _Calibrated(measured, *calibrate_one(measured, reach), survey.point[detected])


def _residual(calibration: _Calibrated) -> Array:
    """Return the root mean square of each point's whitened residual."""
    measured = calibration.measured
    rotated, place = measured.world_from_body, measured.position_world
    phase = np.broadcast_to(calibration.refined.phase, (len(place), len(calibration.refined.phase)))
    model = predict(calibration.refined.beacon, measured.magnetometer, rotated, place, phase)
    error = np.nan_to_num(measured.phasor_sensor[0]) - model
    parts = np.stack([error.real, error.imag], axis=2) * measured.weight[..., None]
    numbers = 6 * np.count_nonzero(measured.valid, axis=1)
    return np.asarray(np.sqrt(np.sum(parts**2, axis=(1, 2, 3)) / numbers))


def _panel(calibration: _Calibrated) -> BeaconPanel:
    from magfusion.results.plots.beacon import BeaconPanel

    return BeaconPanel(
        declared=calibration.measured.beacon,
        estimated=calibration.refined.beacon,
        centre_cov=calibration.fits.cov[0, :3, :3],
        point=calibration.point,
        residual=_residual(calibration),
    )


def _estimates(calibration: _Calibrated) -> list[ParameterEstimate]:
    """Return each parameter before and after the survey."""
    old, new = calibration.measured.beacon, calibration.refined.beacon
    turn = Rotation.from_matrix(old.world_from_beacon.T @ new.world_from_beacon).as_rotvec()
    size = [np.linalg.norm(b.moments_beacon, axis=1) for b in (old, new)]
    left_open = np.any(np.abs(calibration.refined.open_beacon) > 0.5, axis=0)
    coils = [f"_{i}" for i in range(len(size[0]))] if len(size[0]) > 1 else [""]

    def of(
        kind: str, unit: str, tails: list[str], *values: Array, former: Array | None = None
    ) -> list[ParameterEstimate]:
        known = [None] * len(tails) if former is None else former.tolist()
        rows = zip(tails, *(np.broadcast_to(v, len(tails)) for v in values), known, strict=True)
        return [
            ParameterEstimate(
                f"{{beacon}}.{kind}{tail}",
                float(change),
                unit,
                old.name,
                label=f"{old.name}.{kind}",
                sigma=float(sigma),
                prior_sigma=float(prior),
                is_open=bool(is_open),
                declared=value,
            )
            for tail, change, sigma, prior, is_open, value in rows
        ]

    place = new.position_world - old.position_world
    sigma, prior, closed = new.sigma, old.sigma, np.zeros(1)
    rotated = (turn, sigma.rotation_beacon, prior.rotation_beacon)
    return [
        *of(
            "position",
            "m",
            ["_x_m", "_y_m", "_z_m"],
            place,
            sigma.position_world,
            prior.position_world,
            closed,
            former=old.position_world,
        ),
        *of(
            "rotation",
            "deg",
            ["_x_deg", "_y_deg", "_z_deg"],
            *(v / DEGREE for v in rotated),
            left_open,
        ),
        *of(
            "log_moment",
            "",
            coils,
            np.log(size[1] / size[0]),
            sigma.log_moment,
            prior.log_moment,
            closed,
        ),
    ]


def judge_calibration(calibration: _Calibrated) -> tuple[_Calibrated, Trust]:
    """Return a calibration with sigmas consistent with its tests, and their findings."""
    name = calibration.refined.beacon.name
    fitted = unexplained(
        f"beacon {name}",
        float(calibration.fits.chi_square[0]),
        calibration.freedom,
        "Check the poses of the survey, iron near the beacon, and whether it was moved.",
    )
    closed = [one for one in _estimates(calibration) if not one.is_open]
    prior = np.diag([one.prior_sigma**2 for one in closed])
    moved = contradiction(
        [one.key for one in closed],
        np.array([one.change for one in closed]),
        fitted.excess * np.diag([one.sigma**2 for one in closed]) + prior,
        prior,
        "Check the beacon's coils and the survey's frame, or declare larger sigmas.",
        f"The calibration of beacon {name}",
    )
    trust, excess = trust_of(fitted, moved)
    findings = [
        Finding(
            "ambiguous",
            f"Beacon {name} could also be at {np.round(place, 3).tolist()}: the chi square there is"
            f" higher by only {worse:.2g}; measure at more points.",
        )
        for place, worse in _rivals(calibration)
    ]
    if len(calibration.refined.open_beacon):
        text = (
            f"The field does not determine a rotation of beacon {name} about its own axis: the"
            " declared attitude and its sigma are kept."
        )
        findings.append(Finding("geometry", text, Verdict.TRUSTWORTHY))
    sigma, scale = calibration.refined.beacon.sigma, float(np.sqrt(excess))
    honest = replace(
        sigma,
        position_world=scale * sigma.position_world,
        rotation_beacon=scale * sigma.rotation_beacon,
        log_moment=scale * sigma.log_moment,
    )
    refined = replace(calibration.refined, beacon=replace(calibration.refined.beacon, sigma=honest))
    return replace(calibration, refined=refined), trust | Trust(tuple(findings))


def _figures(path: Path, survey: Survey, calibration: list[_Calibrated], trust: Trust) -> Figures:
    from magfusion.results.report import residual_figure

    estimates = [estimate for c in calibration for estimate in _estimates(c)]
    figures = [Figure("points", len(survey))]
    for c in calibration:
        old, new = c.measured.beacon, c.refined.beacon
        chi_square = float(c.fits.chi_square[0])
        moved = float(np.linalg.norm(new.position_world - old.position_world))
        figures += [
            replace(
                residual_figure(old.name, float(np.sqrt(chi_square / max(c.freedom, 1)))), note=""
            ),
            Figure("centre_moved_m_{beacon}", moved, "m", old.name, label="centre moved"),
            Figure("coil_bent_deg_{beacon}", _bent_deg(c), "deg", old.name, label="coil bent"),
            Figure("other_places_{beacon}", len(_rivals(c)), "", old.name),
        ]
    return (
        heading(JOB, path.stem)
        | trust_figures(trust)
        | Figures(*figures, *estimates)
        | determined_figures(estimates)
        | notes_of(trust)
    )


def _bent_deg(calibration: _Calibrated) -> float:
    """Return the largest angle between a coil and its nominal direction in its beacon (deg)."""
    old, new = (
        b.moments_beacon / np.linalg.norm(b.moments_beacon, axis=1, keepdims=True)
        for b in (calibration.measured.beacon, calibration.refined.beacon)
    )
    sine = np.linalg.norm(np.cross(old, new), axis=1)
    return float(np.max(np.arctan2(sine, np.sum(old * new, axis=1))) / DEGREE)


def _rivals(calibration: _Calibrated) -> list[tuple[Array, float]]:
    from magfusion.estimation.batch.hypothesis_selection import AMBIGUOUS_CHI_SQUARE

    excess = calibration.fits.rival_chi_square[0] - calibration.fits.chi_square[0]
    out: list[tuple[Array, float]] = []
    for place, worse in zip(calibration.fits.rivals_world[0], excess, strict=True):
        new = all(np.linalg.norm(place - other) > 0.01 for other, _ in out)
        if worse < AMBIGUOUS_CHI_SQUARE and new:
            out.append((place, float(worse)))
    return out


def _refined_site(site: Site, calibration: list[_Calibrated], path: Path) -> Site:
    new = {c.refined.beacon.name: c.refined.beacon for c in calibration}
    estimates = [estimate for c in calibration for estimate in _estimates(c)]
    beacons = tuple(new.get(b.name, b) for b in site.beacons)
    known = site.correlation
    return replace(
        site,
        beacons=beacons,
        calibration=calibration_record(path.name, estimates),
        correlation=known and known.without(("beacons", "moments"), new),
    )


COMMAND = Command(
    BeaconSettings,
    run_calibrate_beacon,
    output="beacon",
    example="magfusion calibrate beacon survey --site site.yaml -o beacon",
)
