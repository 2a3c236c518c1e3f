"""What people get wrong of aiding sensors: units, signs, axes, known points, sizes of the noise.

A sensor that is wrong by so much is rejected, and no small step of a parameter leads to what is
right: whole hypotheses are compared on its samples, given the states that all sensors determine.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from magfusion.estimation.batch.batch import Smoothed
from magfusion.estimation.graph.state import States, states_in
from magfusion.estimation.integrity.explanation import CLEARLY, ENOUGH, MARGIN
from magfusion.estimation.integrity.fault_candidates import MAX_SIZE
from magfusion.estimation.integrity.fault_isolation import CAUSE_FIRST, Diagnosis
from magfusion.estimation.integrity.motion_causes import signed_permutations
from magfusion.estimation.measurements.aiding import AidingMeasurement
from magfusion.estimation.solve.batched import (
    NormalEquations,
    by_differences,
    minimise,
    normal_equations,
)
from magfusion.files.site_changes import changed_keys
from magfusion.model.aiding import OF_MOTION, AidingSensor, Quantity, sensor_named
from magfusion.model.parameters import AIDING_POSITION
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.units import DEGREE, Array, IntArray

_LENGTHS = {"mm": 1e-3, "cm": 1e-2, "feet": 0.3048, "km": 1e3, "m": 1.0}
_SPEEDS = {"km/h": 1.0 / 3.6, "mm/s": 1e-3, "cm/s": 1e-2, "knots": 0.514444, "mph": 0.44704}
UNITS: dict[Quantity, dict[str, float]] = {
    "velocity": _SPEEDS | {"m/s": 1.0},
    "pressure": {"hPa": 1e2, "kPa": 1e3, "bar": 1e5, "Pa": 1.0},
    "heading": {"radians": 1.0 / DEGREE, "degrees where radians belong": DEGREE, "degrees": 1.0},
    **dict.fromkeys(("range", "position", "height", "relative_pose"), _LENGTHS),
}
WITH_OFFSET: tuple[Quantity, ...] = ("range", "height", "pressure", "heading")
MIN_SAMPLES = 20
MAX_SAMPLES = 400  # of a sensor that are compared
BEYOND = 9.0  # squared sigmas; what is farther off is an outlier, or another mistake
OF_OFFSET = 3.0  # sigmas of a declared offset, within which it is kept
NOISIER = 2.0  # times the declared noise
SLOW = 1.5  # ratio of the scatter to that of white noise, above which an error is none
MAD = 1.4826  # ratio of sigma to the median absolute deviation


@dataclass(frozen=True, eq=False)
class AidingComparison:
    """Samples of a sensor, and what is predicted of them by the states and the declared site."""

    time: Array  # (n,) (s)
    # (n, k), measured and its noise, infinite where nothing is; predicted, and its sigma
    value: Array
    sigma: Array
    predicted: Array
    spread: Array
    point_world: Array  # (n, 3), of the sensor (m)

    def last(self, count: int) -> "AidingComparison":
        """Return the newest rows."""
        return AidingComparison(*(part[-count:] for part in vars(self).values()))


def joined(parts: Iterable[AidingComparison]) -> AidingComparison:
    """Return the rows of several."""
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    return AidingComparison(*map(np.concatenate, columns))


def compared(
    measurement: AidingMeasurement, time: Array, states: States, cov: Array, sensor: AidingSensor
) -> AidingComparison:
    """Compare samples with states (n), of covariance (n, 6 or more, 6 or more).

    `sensor`: as declared.
    """
    rate_body = measurement.inertial_body[:, :3] - states.read_bias()[:, 3:]
    at = measurement.predicted(states, rate_body, sensor)
    jacobian = at.by_pose
    if at.by_velocity is not None and cov.shape[1] > 6:
        jacobian = np.concatenate([jacobian, at.by_velocity], axis=2)
    own = cov[:, : jacobian.shape[2], : jacobian.shape[2]]
    variance = np.einsum("nki,nij,nkj->nk", jacobian, own, jacobian)
    lever_world = states.world_from_body @ sensor.position_body
    return AidingComparison(
        time,
        measurement.value,
        measurement.sigma,
        at.value,
        np.sqrt(np.maximum(variance, 0.0)),
        states.position_world + lever_world,
    )


@dataclass(frozen=True)
class _Cause:
    """A mistake that explains the samples of a sensor."""

    code: str
    text: str
    sensor: AidingSensor  # corrected


def compared_smoothed(result: Smoothed) -> dict[str, AidingComparison]:
    """Return the comparisons of all aiding sensors of a smoothed log."""
    states, cov = states_in(result.estimate.values), result.states.pose_cov
    parts: dict[str, list[AidingComparison]] = {}
    for one in result.graph.measurements:
        if isinstance(one, AidingMeasurement) and cov is not None:
            sensor, at = sensor_named(result.declared.site.aiding, one.sensor), one.epoch
            own = compared(one, result.states.time[at], states.rows(at), cov[at], sensor)
            parts.setdefault(one.sensor, []).append(own)
    return {name: joined(own) for name, own in parts.items()}


def aiding_diagnosis(site: Site, compared: Mapping[str, AidingComparison]) -> Diagnosis | None:
    """Return what is wrong with aiding sensors by a unit, an axis, a point or the noise.

    `site`: as declared. All that is wrong is one finding, as one remedy has all.
    """
    causes = {}
    for sensor in site.aiding:
        seen = compared.get(sensor.name)
        if seen is None or sensor.quantity == "mark" or len(seen.time) < MIN_SAMPLES:
            continue
        cause = _cause_of(sensor, seen, [one for one in site.aiding if one is not sensor])
        if cause is not None:
            causes[sensor.name] = cause
    if not causes:
        return None
    sensors = (causes[s.name].sensor if s.name in causes else s for s in site.aiding)
    corrected = replace(site, aiding=tuple(sensors))
    first = min(causes.values(), key=lambda one: one.code == "aiding_noise")
    text = " ".join(one.text for one in (first, *(c for c in causes.values() if c is not first)))
    remedy = changed_keys(site, corrected)
    finding = Finding(first.code, text, Verdict.DOUBTFUL, CAUSE_FIRST, remedy=remedy)
    return Diagnosis(finding, corrected, np.inf)


def _cause_of(
    sensor: AidingSensor, seen: AidingComparison, others: list[AidingSensor]
) -> _Cause | None:
    """Return the mistake that explains the samples of a sensor; None where none does."""
    rows = np.linspace(0, len(seen.time) - 1, min(len(seen.time), MAX_SAMPLES)).astype(int)
    some = AidingComparison(*(part[rows] for part in vars(seen).values()))
    expected = float(np.isfinite(some.sigma).sum())
    as_declared = _square(sensor, some, some.value, some.predicted)
    if as_declared < CLEARLY * expected:
        return None
    # An offset is a parameter, which the score tests; samples without a signal show no unit.
    rivals = [_in_other_axes(sensor, some, factor, np.eye(3))[0] for factor in (0.0, 1.0)]
    near = min(as_declared, *rivals)
    for tried in (_of_units, _of_points):
        square, cause = _simplest(list(tried(sensor, some, others)))
        if square < ENOUGH * expected and CLEARLY * square < near:
            return cause
    return _of_noise(sensor, seen)


def _simplest(tried: list[tuple[float, _Cause]]) -> tuple[float, _Cause | None]:
    """Return the first of some causes that explains about as well as the best."""
    least = min((square for square, _ in tried), default=np.inf)
    return next((one for one in tried if one[0] < least + MARGIN), (np.inf, None))


def _square(sensor: AidingSensor, seen: AidingComparison, value: Array, predicted: Array) -> float:
    """Return the sum of squared residuals; each counts to a limit."""
    away = value - predicted
    if sensor.quantity == "heading":
        away = (away + np.pi) % (2.0 * np.pi) - np.pi
    speed = np.linalg.norm(np.where(np.isfinite(seen.sigma), value, 0.0), axis=1, keepdims=True)
    noise = np.where(
        np.isfinite(seen.sigma) & (seen.sigma != sensor.constraint_sigma),
        np.hypot(sensor.sigma, sensor.relative_sigma * speed),
        seen.sigma,
    )
    if sensor.quantity == "relative_pose":  # its rotation, of no unit
        noise[:, 3:] = np.inf
    variance = noise**2 + seen.spread**2 + (sensor.sigmas.scale * predicted) ** 2
    return float(np.sum(np.minimum(away**2 / variance, BEYOND)))


def _with_offset(
    sensor: AidingSensor, seen: AidingComparison, factor: float = 1.0
) -> tuple[float, AidingSensor]:
    """Return the squares of samples times a factor, and the sensor, with the offset they have."""
    value, sigma = factor * seen.value, float(sensor.sigmas.offset)
    away = value - seen.predicted
    if sensor.quantity == "heading":
        middle = np.angle(np.mean(np.exp(1j * away)))
        away = (away - middle + np.pi) % (2.0 * np.pi) - np.pi + middle
    offset = float(np.median(away))
    declared = _square(sensor, seen, value, seen.predicted)
    moved = _square(sensor, seen, value, seen.predicted + offset)
    if abs(offset) < max(OF_OFFSET * sigma, sensor.sigma) or moved > declared - MARGIN:
        return min(declared, moved), sensor
    return moved, replace(sensor, offset=sensor.offset + offset)


def _of_units(
    sensor: AidingSensor, seen: AidingComparison, _: list[AidingSensor]
) -> Iterator[tuple[float, _Cause]]:
    """Yield what units, signs and axes would explain, the simplest first."""
    of_axes = [np.eye(3)]
    if sensor.quantity in OF_MOTION:
        every = (np.asarray(axes, dtype=float) for axes in signed_permutations())
        of_axes += [axes for axes in every if np.linalg.det(axes) > 0.0 and np.trace(axes) < 3.0]
    units = [(name, sign * one) for name, one in UNITS[sensor.quantity].items() for sign in (1, -1)]
    units.sort(key=lambda one: abs(one[1]) != 1.0)  # a sign is more often wrong

    def changes(one: tuple[tuple[str, float], Array]) -> int:
        factor = one[0][1] / sensor.unit
        return (factor < 0.0) + (abs(factor) != 1.0) + 2 * bool(np.trace(one[1]) < 3.0)

    for (name, unit), axes in sorted(product(units, of_axes), key=changes)[1:]:
        square, corrected = _in_other_axes(sensor, seen, unit / sensor.unit, axes)
        of_unit = f"its values are in {name}" + " of the opposite sign" * (unit < 0.0)
        what = [of_unit] if unit != sensor.unit else []
        what += ["its axes are turned against the declared ones"] * bool(np.trace(axes) < 3.0)
        code = "aiding_units" if unit != sensor.unit else "aiding_mounting"
        yield square, _cause(code, " and ".join(what), replace(corrected, unit=unit), sensor)


def _in_other_axes(
    sensor: AidingSensor, seen: AidingComparison, factor: float, axes: Array
) -> tuple[float, AidingSensor]:
    """Return the squares of samples in another unit and other axes, and the sensor with these."""
    if sensor.quantity in WITH_OFFSET:
        return _with_offset(sensor, seen, factor)
    value, predicted, own = factor * seen.value, seen.predicted.copy(), seen
    if sensor.quantity == "position":
        value = value @ axes.T
        sensor = replace(sensor, world_from_sensor=axes @ sensor.world_from_sensor)
    else:
        predicted[:, :3] = predicted[:, :3] @ axes
        spread = seen.spread.copy()
        spread[:, :3] = spread[:, :3] @ np.abs(axes)
        own = replace(seen, spread=spread)
        sensor = replace(sensor, body_from_sensor=sensor.body_from_sensor @ axes)
    return _square(sensor, own, value, predicted), sensor


def _of_points(
    sensor: AidingSensor, seen: AidingComparison, others: list[AidingSensor]
) -> Iterator[tuple[float, _Cause]]:
    """Yield what another point of a range would explain: of another sensor, mirrored, or any."""
    if sensor.quantity != "range" or sensor.point_world is None:
        return
    known = {f"its ranges are those to the point of {o.name}": o.point_world for o in others}
    for signs in list(product((1.0, -1.0), repeat=3))[1:]:
        names = " and ".join(axis for axis, one in zip("xyz", signs, strict=True) if one < 0.0)
        mirrored = np.array(signs) * sensor.point_world
        known[f"its point is mirrored: {names} has the other sign"] = mirrored
    for words, point in known.items():
        if point is not None:
            square, corrected = _at_point(sensor, seen, point)
            yield square, _cause("aiding_point", words, corrected, sensor)
    starts = [sensor.point_world, *(p for p in known.values() if p is not None)]
    for point in _fitted_points(sensor, seen, np.array(starts)):
        moved = float(np.linalg.norm(point - sensor.point_world))
        if moved > MAX_SIZE[AIDING_POSITION]:  # a smaller error is a parameter
            square, corrected = _at_point(sensor, seen, np.round(point, 3))
            words = f"its point is {moved:.3g} m from the declared one"
            yield square + MARGIN, _cause("aiding_point", words, corrected, sensor)


def _at_point(
    sensor: AidingSensor, seen: AidingComparison, point: Array
) -> tuple[float, AidingSensor]:
    distance = np.linalg.norm(seen.point_world - point, axis=1, keepdims=True)
    own = replace(sensor, point_world=np.asarray(point))
    return _with_offset(own, replace(seen, predicted=distance + sensor.offset))


def _fitted_points(sensor: AidingSensor, seen: AidingComparison, start: Array) -> Array:
    """Return the points that explain ranges best from some starts (m, 3), the offset as declared.

    Far residuals count by their logarithm, as those of outliers.
    """
    sigma = np.hypot(sensor.sigma, seen.spread[:, 0])
    prior = max(float(sensor.sigmas.offset), sensor.sigma)

    def residual(guess: Array) -> Array:
        distance = np.linalg.norm(seen.point_world - guess[:, None, :3], axis=2)
        away = seen.value[:, 0] - distance - float(sensor.offset) - guess[:, 3:]
        limited = np.sign(away) * np.sqrt(np.log1p((away / sigma) ** 2))
        return np.concatenate([limited, guess[:, 3:] / prior], axis=1)

    def model(_: IntArray, guess: Array) -> NormalEquations:
        return normal_equations(*by_differences(residual, guess))

    return minimise(model, np.pad(start, ((0, 0), (0, 1)))).state[:, :3]


def _of_noise(sensor: AidingSensor, seen: AidingComparison) -> _Cause | None:
    """Return that the noise is declared too small, where the residuals scatter as white noise."""
    away = (seen.value - seen.predicted) / seen.sigma
    parts = [slice(0, 3), slice(3, 6)] if sensor.quantity == "relative_pose" else [slice(None)]
    white = [_white_scatter(away[:, part]) for part in parts]
    if max(white) < NOISIER:
        return None
    times = [max(one, 1.0) for one in white]
    noisier = replace(
        sensor,
        sigma=float(f"{times[0] * sensor.sigma:.2g}"),
        relative_sigma=float(f"{times[0] * sensor.relative_sigma:.2g}"),
        rotation_sigma=float(f"{times[-1] * sensor.rotation_sigma:.2g}"),
    )
    words = f"its noise is {max(white):.2g} times the declared one"
    return _cause("aiding_noise", words, noisier, sensor)


def _white_scatter(away: Array) -> float:
    """Return the sigma of what changes from sample to sample, zero where slow errors dominate."""
    away = away[:, np.isfinite(away).all(axis=0) & np.any(away, axis=0)]
    if not away.size:
        return 0.0
    second = np.diff(away, 2, axis=0) / np.sqrt(6.0)
    fast = MAD * float(np.median(np.abs(second)))
    whole = MAD * float(np.median(np.abs(away - np.median(away, axis=0))))
    return fast if whole < SLOW * fast else 0.0


def _cause(code: str, what: str, corrected: AidingSensor, declared: AidingSensor) -> _Cause:
    if corrected.offset != declared.offset:
        size, unit = (DEGREE, "deg") if declared.quantity == "heading" else (1.0, "")
        moved = float(corrected.offset - declared.offset) / size
        what += f", and its offset is {moved:+.3g} {unit}".rstrip()
    remedy = "Correct them in the site's aiding as in the remedy, or convert the samples."
    if code == "aiding_noise":
        remedy = "Declare the larger noise."
    elif code == "aiding_point":
        remedy = "Survey the point again, and check the names of the sensors."
    text = f"{declared.name} contradicts the estimate as declared: {what}, which explains it."
    return _Cause(code, f"{text} {remedy}", corrected)
