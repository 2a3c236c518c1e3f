"""The job that finds where beacons are and how they are turned: survey in, refined site out."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.calibration.beacon import REACH, BeaconFits, BeaconMeasurements
from magfusion.calibration.beacon_refined import RefinedBeacon, calibrate_one
from magfusion.errors import InputError
from magfusion.job import claim, named
from magfusion.observation import model_error_cov, predict
from magfusion.plots.beacon import BeaconPanel, write_beacon_plot
from magfusion.records.survey import Survey, read_survey
from magfusion.refinement import DETERMINED_RATIO, Finding
from magfusion.report import AMBIGUOUS_CHI_SQUARE, Figures, write_report
from magfusion.site import Beacon, Site
from magfusion.site_file import load_site, save_site
from magfusion.units import DEGREE, Array

JOB = "calibrate beacon"
FARTHEST = 5.0  # m from the declared place, however wide its sigma
CONTRADICTED = 4.0  # sigmas of survey and calibration together
Report = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class _Calibrated:
    measured: BeaconMeasurements
    fits: BeaconFits
    refined: RefinedBeacon
    point: Array

    @property
    def freedom(self) -> int:
        return 6 * int(np.count_nonzero(self.measured.valid)) - int(self.fits.cov.shape[-1])


def run_calibrate_beacon(
    survey_path: Path, site_path: Path, names: tuple[str, ...], output: Path, *, report: Report
) -> Figures:
    """Calibrate beacons from magnetometers at the known poses of a survey.

    A beacon that is not synchronised must have had one drive phase at all points, as for
    magnetometers that record at the same time.

    Parameters
    ----------
    survey_path, site_path : Path
    names : tuple of str
        The beacons; empty for all that the survey heard.
    output : Path
    report : callable

    Returns
    -------
    dict
        The figures of ``report.json``.

    Raises
    ------
    InputError
        Where a file cannot be used, a beacon was not surveyed, or it is not determined.
    """
    claimed = claim(output, JOB)
    site, survey = load_site(site_path), read_survey(survey_path)
    if survey.phasor_sensor is None:
        raise InputError(
            f"{survey_path}: holds amplitudes, and the calibration of a beacon needs phasors;"
            " survey again"
        )
    beacons = _chosen(site, survey, names, survey_path)
    found = []
    for done, beacon in enumerate(beacons):
        report(f"beacon {beacon.name}", done, len(beacons))
        with named(survey_path):
            found.append(_calibrated(site, beacon, survey))
    report("done", len(beacons), len(beacons))
    figures = _figures(survey_path, survey, found)
    with claimed as directory:
        save_site(_refined_site(site, found, survey_path, figures), directory / "site.yaml")
        write_beacon_plot(directory / "beacon.png", [_panel(c) for c in found])
        write_report(directory, figures)
    return figures


def _chosen(site: Site, survey: Survey, names: tuple[str, ...], path: Path) -> list[Beacon]:
    known = {b.name: b for b in site.beacons}
    heard = list(dict.fromkeys(name for name, _ in survey.channels))
    for name in names:
        if name not in known:
            raise InputError(f"--beacon {name}: the site has {', '.join(known)}; choose of these")
        if name not in heard:
            raise InputError(
                f"{path}: beacon {name} was not surveyed (found {', '.join(heard)}); survey it"
            )
    strange = [name for name in heard if name not in known]
    if strange and not names:
        raise InputError(
            f"{path}: beacon {strange[0]} is unknown to the site (it has {', '.join(known)}); give"
            " the site that was surveyed, or choose with --beacon"
        )
    chosen = [known[name] for name in dict.fromkeys(names or heard)]
    for name, tone in survey.channels:
        if name in known and tone >= len(known[name].tones):
            raise InputError(
                f"{path}: beacon {name} has no tone {tone} in the site (it has"
                f" {len(known[name].tones)}); give the site that was surveyed"
            )
    return chosen


def _calibrated(site: Site, beacon: Beacon, survey: Survey) -> _Calibrated:
    assert survey.phasor_sensor is not None
    shape = (len(survey), len(beacon.tones))
    phasor, sigma = np.full((*shape, 3), np.nan + 0j), np.ones(shape)
    for c, (name, tone) in enumerate(survey.channels):
        if name == beacon.name:
            phasor[:, tone], sigma[:, tone] = survey.phasor_sensor[:, c], survey.sigma[:, c]
    model = np.nan_to_num(model_error_cov(phasor, site.model_error)[..., 0, 0])
    total = np.sqrt(np.nan_to_num(sigma, nan=1.0) ** 2 + model)
    heard = np.isfinite(phasor).any(axis=(1, 2))
    measured = BeaconMeasurements(
        beacon,
        site.platform.magnetometer,
        survey.world_from_body[heard],
        survey.position_world[heard],
        phasor[None, heard],
        np.stack([total, total], axis=-1)[heard],
    )
    reach = float(np.clip(3.0 * np.max(beacon.sigma.position_world), REACH, FARTHEST))
    return _Calibrated(measured, *calibrate_one(measured, reach), survey.point[heard])


def _residual(found: _Calibrated) -> Array:
    """Return the root mean square of each point's whitened residual."""
    measured = found.measured
    turned, place = measured.world_from_body, measured.position_world
    phase = np.broadcast_to(found.refined.phase, (len(place), len(found.refined.phase)))
    model = predict(found.refined.beacon, measured.magnetometer, turned, place, phase)
    error = np.nan_to_num(measured.phasor_sensor[0]) - model
    parts = np.stack([error.real, error.imag], axis=2) * measured.weight[..., None]
    numbers = 6 * np.count_nonzero(measured.valid, axis=1)
    return np.asarray(np.sqrt(np.sum(parts**2, axis=(1, 2, 3)) / numbers))


def _panel(found: _Calibrated) -> BeaconPanel:
    return BeaconPanel(
        declared=found.measured.beacon,
        found=found.refined.beacon,
        centre_cov=found.fits.cov[0, :3, :3],
        point=found.point,
        residual=_residual(found),
    )


def _told(found: _Calibrated) -> list[tuple[Finding, bool]]:
    """Return each parameter before and after, and whether the survey determined it."""
    old, new = found.measured.beacon, found.refined.beacon
    turn = Rotation.from_matrix(old.world_from_beacon.T @ new.world_from_beacon).as_rotvec()
    size = [np.linalg.norm(b.moments_beacon, axis=1) for b in (old, new)]
    rows = []
    for i, axis in enumerate("xyz"):
        place = new.position_world[i] - old.position_world[i]
        sigma = new.sigma.position_world[i], old.sigma.position_world[i]
        rows.append((Finding(f"{old.name}.position_{axis}_m", place, *sigma), False))
    for i, axis in enumerate("xyz"):
        sigma = new.sigma.rotation_beacon[i] / DEGREE, old.sigma.rotation_beacon[i] / DEGREE
        is_open = bool(np.any(np.abs(found.refined.open_beacon[:, i]) > 0.5))
        rows.append((Finding(f"{old.name}.rotation_{axis}_deg", turn[i] / DEGREE, *sigma), is_open))
    for i, change in enumerate(np.log(size[1] / size[0])):
        sigma = new.sigma.log_moment[i], old.sigma.log_moment[i]
        tail = f"_{i}" if len(size[0]) > 1 else ""
        rows.append((Finding(f"{old.name}.log_moment{tail}", change, *sigma), False))
    # A sigma that the site does not declare is no prior.
    return [
        (told, not is_open and told.sigma < DETERMINED_RATIO * (told.prior_sigma or np.inf))
        for told, is_open in rows
    ]


def _figures(path: Path, survey: Survey, found: list[_Calibrated]) -> Figures:
    figures: Figures = {"job": JOB, "log": path.stem, "points": len(survey)}
    told = [(c, row) for c in found for row in _told(c)]
    for c in found:
        name = c.measured.beacon.name
        chi_square = float(c.fits.chi_square[0])
        figures[f"residual_rms_{name}"] = float(np.sqrt(chi_square / max(c.freedom, 1)))
        figures[f"centre_moved_m_{name}"] = float(
            np.linalg.norm(c.refined.beacon.position_world - c.measured.beacon.position_world)
        )
        figures[f"coil_bent_deg_{name}"] = _bent_deg(c)
        figures[f"other_places_{name}"] = len(_rivals(c))
    for _, (one, _) in told:
        figures[one.name] = float(one.change)
        figures[f"{one.name}_sigma"] = float(one.sigma)
        figures[f"{one.name}_prior_sigma"] = float(one.prior_sigma)
    figures["determined"] = [one.name for _, (one, yes) in told if yes]
    figures["undetermined"] = [one.name for _, (one, yes) in told if not yes]
    figures["notes"] = [sentence for c in found for sentence in _notes(c)]
    return figures


def _bent_deg(found: _Calibrated) -> float:
    """Return the largest angle of a coil from where it should be in its beacon (deg)."""
    old, new = (
        b.moments_beacon / np.linalg.norm(b.moments_beacon, axis=1, keepdims=True)
        for b in (found.measured.beacon, found.refined.beacon)
    )
    sine = np.linalg.norm(np.cross(old, new), axis=1)
    return float(np.max(np.arctan2(sine, np.sum(old * new, axis=1))) / DEGREE)


def _rivals(found: _Calibrated) -> list[tuple[Array, float]]:
    excess = found.fits.rival_chi_square[0] - found.fits.chi_square[0]
    out: list[tuple[Array, float]] = []
    for place, worse in zip(found.fits.rivals_world[0], excess, strict=True):
        new = all(np.linalg.norm(place - other) > 0.01 for other, _ in out)
        if worse < AMBIGUOUS_CHI_SQUARE and new:
            out.append((place, float(worse)))
    return out


def _notes(found: _Calibrated) -> list[str]:
    name = found.measured.beacon.name
    notes = [
        f"Beacon {name} could be at {np.round(place, 3).tolist()} as well: the chi square is only"
        f" {worse:.2g} larger there; measure at more points."
        for place, worse in _rivals(found)
    ]
    if len(found.refined.open_beacon):
        notes.append(
            f"The field does not tell a turn of beacon {name} about its own axis: there the"
            " declared attitude and its sigma are kept."
        )
    for one, _ in _told(found):
        both = float(np.hypot(one.sigma, one.prior_sigma))
        if one.prior_sigma > 0.0 and abs(one.change) > CONTRADICTED * both:
            notes.append(
                f"{one.name} changed by {abs(one.change) / both:.0f} sigmas of survey and"
                " calibration; check the beacon's coils, or declare larger sigmas."
            )
    return notes


def _refined_site(site: Site, found: list[_Calibrated], path: Path, figures: Figures) -> Site:
    new = {c.refined.beacon.name: c.refined.beacon for c in found}
    record = {
        "log": path.name,
        "determined": figures["determined"],
        "undetermined": figures["undetermined"],
    }
    beacons = tuple(new.get(b.name, b) for b in site.beacons)
    known = site.correlation
    return replace(
        site,
        beacons=beacons,
        calibration=record,
        correlation=known and known.without(("beacons", "moments"), new),
    )
