"""Faults of one beacon alone: each is left out once."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.data_checks.detection import DETECTION_CHI_SQUARE_ONLINE, above_noise
from magfusion.estimation.integrity.explanation import Explanation
from magfusion.estimation.integrity.field_causes import (
    LENGTH_FACTORS,
    MOMENT_FACTORS,
    coils_exchanged,
    in_other_unit,
    length_cause,
    scaled,
)
from magfusion.estimation.integrity.field_snapshots import Snapshots
from magfusion.estimation.integrity.phase_causes import coil_phase
from magfusion.estimation.snapshot.fix import Fixes
from magfusion.estimation.snapshot.fix_separation import MIN_DETECTED
from magfusion.model.detection_range import are_many
from magfusion.model.parameters import (
    BEACON_POSITION,
    BEACON_ROTATION,
    LOG_MOMENT,
    MATRIX,
    PHASE,
    beacons_of,
    predict_channels,
)
from magfusion.model.site import Beacon, Site
from magfusion.units import DEGREE, Array, BoolArray

MAX_BEACONS = 2  # beacons that are looked at
WORSE = 6.0  # times its sigmas, that a survey may be wrong
SURVEYED = 0.3  # of chi square's freedom, that a survey leaves: snapshots weigh by its sigmas too
MISFIT = 1.2  # chi square of snapshots over its freedom, above which fields are not explained
SILENT = 0.2  # of the field that is expected
STRONG = 5.0  # times its noise: a field that is measured, whatever is expected,
LEAKING = 0.01  # unless it is less than this of another's, of which a part leaks into its tone
STEADY = 0.05  # spread of a gain over time that is none
WIDE = (0.5, 1.0, 0.7, 3.0)  # sigmas: position (m), rotation (rad), log moment, phase (rad)


def beacon_causes(known: Snapshots) -> Iterator[Explanation]:
    """Yield what would be explained by a mistake in one beacon."""
    site = known.site
    names = [beacon.name for beacon in site.beacons]
    if are_many(site):  # those that are not detected explain nothing
        detected = np.any(above_noise(known.samples, DETECTION_CHI_SQUARE_ONLINE), axis=0)
        names = [names[k] for k in beacons_of(site, detected).tolist()]
    if len(names) < MIN_DETECTED:
        return
    without = {name: known.without(name) for name in names}
    ranked = sorted(
        names, key=lambda name: without[name].chi_square / max(without[name].freedom, 1.0)
    )
    for name in ranked[:MAX_BEACONS]:
        # No mistake in a beacon explains more than to leave it out.
        clear = _explained(known, without[name].chi_square, 0, "phase", "", "").clear
        if clear and _contradicts(known, without[name], name):
            for one in _of_one(known, without[name], name):
                yield replace(one, beacon=name)


def _contradicts(known: Snapshots, without: Snapshots, name: str) -> bool:
    """Return whether a beacon contradicts the others, whose survey errs as declared.

    Either as another pose and moment of it would, or in any other way.
    """
    kinds = (BEACON_POSITION, BEACON_ROTATION, LOG_MOMENT)
    released = [(kind, name, wide) for kind, wide in zip(kinds, WIDE[:3], strict=True)]
    tests = 2 * len(known.site.beacons)
    return known.rejects_rest(without, tests) or known.rejects(released, tests)


def matrix_causes(known: Snapshots, static: float | None) -> Iterator[Explanation]:
    """Yield what iron on the body, or another scale of all fields, would explain.

    `static`: usual size of the static field, relative to the Earth's.
    """
    released = [(MATRIX, MATRIX.owner, 0.3)]
    if known.excess < MISFIT and not known.rejects(released, tests=1):
        return
    after, fitted = known.fitted(released, known.fixes)
    magnetometer = known.site.platform.magnetometer
    change = fitted.site.platform.magnetometer.matrix - magnetometer.matrix
    even = 0.5 * (change + change.T)
    scale = float(np.trace(even)) / 3.0
    uneven = float(np.max(np.abs(even - scale * np.eye(3))))
    if uneven < max(0.1 * abs(scale), 0.003):
        yield from _scales(known, 1.0 + scale, static)
        return
    yield _explained(
        known,
        after,
        9,
        "magnetometer_matrix",
        f"the magnetometer's matrix is off by up to {100.0 * float(np.max(np.abs(even))):.2g} %,"
        " as by iron on the body",
        "Calibrate the magnetometer on the body (magfusion calibrate magnetometer).",
        fitted.site,
    )


def survey_causes(known: Snapshots) -> Iterator[Explanation]:
    """Yield what a survey that is worse than declared, of all beacons, would explain."""
    if known.excess < MISFIT:
        return
    released = []
    for beacon in known.site.beacons:
        released += [
            (
                BEACON_POSITION,
                beacon.name,
                WORSE * max(float(np.max(beacon.sigma.position_world)), 0.01),
            ),
            (
                BEACON_ROTATION,
                beacon.name,
                WORSE * max(float(np.max(beacon.sigma.rotation_beacon)), 0.01),
            ),
            (LOG_MOMENT, beacon.name, WORSE * max(float(np.max(beacon.sigma.log_moment)), 0.005)),
        ]
    after, fitted = known.fitted(released, known.fixes)
    if after > SURVEYED * known.freedom:
        return  # beacons elsewhere explain a part of anything
    steps = [
        np.linalg.norm(BEACON_POSITION.difference(known.calibration, fitted, beacon.name))
        for beacon in known.site.beacons
    ]
    yield _explained(
        known,
        after,
        3 * len(steps),
        "survey_overconfident",
        "the survey of the beacons is worse than its declared sigmas (they are found"
        f" {_listed(100.0 * np.array(steps), 2)} cm from where they are declared)",
        "Declare the sigmas that the survey has, so that the beacons are estimated.",
    )


def _scales(known: Snapshots, scale: float, static: float | None) -> Iterator[Explanation]:
    """Yield what fields so many times as large as declared mean."""
    trial = scale * np.array([0.98, 1.0, 1.02])
    costs = [known.of(_stronger(known.site, s)).chi_square for s in trial]
    fit = np.polyfit(trial / scale - 1.0, costs, 2)
    best = scale * (1.0 + float(np.clip(-0.5 * fit[1] / max(fit[0], 1e-300), -0.02, 0.02)))
    after = known.of(_stronger(known.site, best)).chi_square
    # A room that is larger and has stronger beacons has the same fields.
    units = [w for w, f in LENGTH_FACTORS.items() if abs(best * f**3 - 1.0) < 0.03]
    if units:
        metric = in_other_unit(known.site, units[0])
        yield _explained(known, after, 0, *length_cause(units[0]), metric)
        return
    if static is not None and abs(static / best - 1.0) < abs(static - 1.0) / 3.0:
        code, cause = "field_scale", f"the magnetometer's readings are {best:.4g} times the field"
        remedy = "Check its unit (T) and platform.magnetometer.matrix."
    else:
        declared = [float(np.mean(beacon.sigma.log_moment)) for beacon in known.site.beacons]
        near = 0.01 + float(np.mean(declared))
        words = [w for w, factor in MOMENT_FACTORS.items() if abs(best * factor - 1.0) < near]
        code = "moment_units" if words else "field_scale"
        cause = f"all moments are {best:.4g} times those declared"
        longer = 100.0 * (best ** (1.0 / 3.0) - 1.0)  # the field falls with the cube
        cause += (
            f": {words[0]}"
            if words
            else f" (or all distances of the survey are {longer:+.2g} % too long, or the"
            " magnetometer's scale is wrong)"
        )
        remedy = "Give moment_a_m2 as amplitudes in A m^2."
    corrected = _stronger(known.site, best) if code == "moment_units" else None
    yield _explained(known, after, int(corrected is None), code, cause, remedy, corrected)


def _stronger(site: Site, factor: float) -> Site:
    return replace(site, beacons=tuple(scaled(beacon, factor) for beacon in site.beacons))


def _of_one(known: Snapshots, without: Snapshots, name: str) -> Iterator[Explanation]:
    gain = _gains(known, without.fixes, name)
    silent = _silent(known, without, name, gain)
    if silent is not None:
        yield silent
        return
    steady = list(_steady_causes(known, without, name))
    yield from steady
    fault = _fault(known, without, name, gain)
    # Whatever is wrong with a beacon, to leave it out explains it.
    if not any(one.as_well_as(fault) for one in steady):
        yield fault


def _steady_causes(known: Snapshots, without: Snapshots, name: str) -> Iterator[Explanation]:
    """Yield what is wrong with a beacon all the time."""
    site, fixes = known.site, without.fixes
    index = [beacon.name for beacon in site.beacons].index(name)
    beacon = site.beacons[index]

    def trial(other: Beacon) -> Snapshots:
        beacons = (*site.beacons[:index], other, *site.beacons[index + 1 :])
        return known.of(replace(site, beacons=beacons))

    rewired = [
        _explained(
            known,
            trial(other).chi_square,
            0,
            "coil_reversed",
            cause,
            "Check the wires of its coils, and the sign of phase_deg.",
            trial(other).site,
        )
        for cause, other in _rewired(beacon)
    ]
    yield from rewired
    if any(one.clear for one in rewired):
        return  # to turn the beacon over, or its phase, says the same in other words
    after, fitted = known.fitted([(LOG_MOMENT, name, WIDE[2])], fixes)
    factors = np.exp(LOG_MOMENT.difference(known.calibration, fitted, name))
    moments = _explained(
        known,
        after,
        len(factors),
        "moments",
        f"the moments of beacon {name} are {_listed(factors, 3)} times those declared",
        f"Measure the current of beacon {name}, or calibrate it (magfusion calibrate beacon).",
        fitted.site,
    )
    yield moments
    if not moments.clear:
        yield from coil_phase(known, beacon, trial)
    if beacon.synchronised:
        after, fitted = known.fitted([(PHASE, name, WIDE[3])], fixes)
        lag = PHASE.difference(known.calibration, fitted, name) / DEGREE
        yield _explained(
            known,
            after,
            len(lag),
            "phase",
            f"the drive phase of beacon {name} is {_listed(lag, 3)} degrees beyond the declared",
            "Check its phase_deg, and that its drive is synchronised.",
        )
    yield _moved(known, fixes, beacon, trial)


def _moved(
    known: Snapshots, fixes: Fixes, beacon: Beacon, trial: Callable[[Beacon], Snapshots]
) -> Explanation:
    name = beacon.name
    released = [(BEACON_POSITION, name, WIDE[0]), (BEACON_ROTATION, name, WIDE[1])]
    best, at = np.inf, known.calibration
    for place in _placed(beacon):
        after, fitted = trial(place).fitted(released, fixes)
        if after < best:
            best, at = after, fitted
        if best < known.freedom:
            break
    step = BEACON_POSITION.difference(known.calibration, at, name)
    angle = np.linalg.norm(BEACON_ROTATION.difference(known.calibration, at, name)) / DEGREE
    return _explained(
        known,
        best,
        6,
        "beacon_pose",
        f"beacon {name} is not where it was surveyed, but off by"
        f" ({_listed(100.0 * step, 2)}) cm and {angle:.2g} degrees",
        "Survey it again, or declare larger sigmas for it.",
        at.site,
    )


def _silent(known: Snapshots, without: Snapshots, name: str, gain: Array) -> Explanation | None:
    """Return that a beacon is silent, where it is."""
    detected = np.isfinite(gain)
    silent = detected & (np.abs(gain) < SILENT) & ~_is_strong(known, name)
    if np.sum(silent) < max(2, 0.05 * np.sum(detected)):
        return None
    whole = np.sum(silent) > 0.9 * np.sum(detected)
    when = "" if whole else f" {_when(known.samples.time, silent)}"
    return _explained(
        known,
        without.chi_square,
        0,
        "silent_beacon",
        f"beacon {name} is silent{when}",
        "Check that it is powered, and its frequency_hz.",
    )


def _fault(known: Snapshots, without: Snapshots, name: str, gain: Array) -> Explanation:
    """Return that a beacon is false, in a part of the log or in some way."""
    usual = np.nanmedian(gain.real) + 1j * np.nanmedian(gain.imag)
    false = np.isfinite(gain) & (np.abs(gain - usual) > STEADY)
    worst = 100.0 * float(np.nanmax(np.abs(gain - 1.0)))
    size = f"by up to {worst:.2g} %" if worst < 1e3 else "altogether"
    cause = f"the field of beacon {name} is false {size}"
    is_transient = abs(usual - 1.0) < STEADY and 2 <= np.sum(false) < 0.8 * np.sum(
        np.isfinite(gain)
    )
    if is_transient:
        cause += f" {_when(known.samples.time, false)}"
    else:
        cause += ": it fits no pose and no moment of the beacon"
    fault = _explained(
        known,
        without.chi_square * known.freedom / max(without.freedom, 1.0),
        3,
        "beacon_fault",
        cause,
        "Check its supply and what is near it; leave it out.",
    )
    return replace(fault, catch_all=not is_transient)


def _when(time: Array, chosen: BoolArray) -> str:
    return f"from {time[chosen][0]:.3g} to {time[chosen][-1]:.3g} s"


def _gains(known: Snapshots, fixes: Fixes, name: str) -> Array:
    """Return what a beacon's phasors are of those expected, complex, shape (n,)."""
    at, place = fixes.world_from_body[:, 0], fixes.position_world[:, 0]
    expected = predict_channels(known.calibration, known.samples.time, at, place)
    own = np.array([beacon == name for beacon, _ in known.samples.channels])
    measured = known.samples.phasor_sensor[:, own]
    expected = expected[:, own]
    power = np.sum(np.abs(expected) ** 2, axis=(1, 2))
    return np.sum(np.conj(expected) * measured, axis=(1, 2)) / power


def _is_strong(known: Snapshots, name: str) -> BoolArray:
    """Return at which epochs a beacon's field is measured, shape (n,)."""
    samples = known.samples
    own = np.array([beacon == name for beacon, _ in samples.channels])
    power = np.nansum(np.abs(samples.phasor_sensor) ** 2, axis=2)
    noise = 2.0 * np.trace(samples.phasor_cov, axis1=2, axis2=3)
    field, others = np.sum(power[:, own], axis=1), np.max(power[:, ~own], axis=1, initial=0.0)
    is_field = field > STRONG**2 * np.nansum(noise[:, own], axis=1)
    return np.asarray(is_field & (field > LEAKING**2 * others))


def _rewired(beacon: Beacon) -> Iterator[tuple[str, Beacon]]:
    def reversed_(which: set[int]) -> Beacon:
        return replace(
            beacon,
            coils=tuple(
                replace(c, moment_beacon=-c.moment_beacon) if i in which else c
                for i, c in enumerate(beacon.coils)
            ),
        )

    count = len(beacon.coils)
    for i in range(count if count > 1 else 0):
        yield (
            f"coil {i} of beacon {beacon.name} is wired in reverse (or the sign of a phase is)",
            reversed_({i}),
        )
    every = set(range(count))
    yield f"every coil of beacon {beacon.name} is wired in reverse", reversed_(every)
    if count > 1:
        yield f"the coils of beacon {beacon.name} are exchanged", coils_exchanged(beacon)


def _placed(beacon: Beacon) -> Iterator[Beacon]:
    """Yield a beacon as surveyed, by quarter and half turns, and with a usual slip of its place."""
    yield beacon
    for angle in (np.pi, 0.5 * np.pi, -0.5 * np.pi):
        for axis in np.eye(3):
            turn = Rotation.from_rotvec(angle * axis).as_matrix()
            yield replace(beacon, world_from_beacon=beacon.world_from_beacon @ turn)
    for k in range(3):
        sign, order = np.ones(3), np.arange(3)
        sign[k], order[[k, k - 1]] = -1.0, order[[k - 1, k]]
        yield replace(beacon, position_world=sign * beacon.position_world)
        yield replace(beacon, position_world=beacon.position_world[order])


def _explained(
    known: Snapshots,
    after: float,
    count: int,
    code: str,
    cause: str,
    remedy: str,
    site: Site | None = None,
) -> Explanation:
    return Explanation(
        code, cause, remedy, known.chi_square, after, known.freedom, count, site=site
    )


def _listed(values: Array, digits: int) -> str:
    return ", ".join(f"{value:.{digits}g}" for value in values)
