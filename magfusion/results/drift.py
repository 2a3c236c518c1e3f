"""Whether an error grows with time: slopes with their standard errors, and verdicts.

Neighbouring errors of one run are correlated, so that a slope's standard error comes from the
scatter between independent worlds or, for a single world, from their correlation time
(`magfusion.results.trend`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.special import fdtrc, stdtrit

from magfusion.results.trend import trend
from magfusion.units import DAY, HOUR, Array, BoolArray

CONFIDENCE = 0.95  # with which a slope is told to be within its limit
CERTAIN = 0.999  # and beyond it: many slopes are judged, and one may not fail by chance
MIN_COMMON = 5  # worlds whose scatter determines three slopes
THREE_SIGMA = 0.0027  # how often chance alone goes beyond three standard errors
# Columns of an error, as in the estimators' states.
ATTITUDE, POSITION, VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9)
ACCEL_BIAS, GYRO_BIAS = slice(9, 12), slice(12, 15)

Verdict = Literal["pass", "fail", "undecided"]


@dataclass(frozen=True)
class Criterion:
    """One criterion and its verdict."""

    name: str  # of its verdict in the report
    verdict: Verdict
    sentence: str


@dataclass(frozen=True, eq=False)
class ErrorSeries:
    """Errors of the states of one run."""

    time: Array  # (n,) (s)
    # (n,), whether a field was measured there; the states between are propagated by the IMU
    measured: BoolArray
    # error, sigma: (n, 15), attitude (rad), position (m) and velocity (m/s) in world axes, so that
    # a steady drift accumulates whatever the body's attitude; biases of the accelerometer (m/s^2)
    # and the gyro (rad/s) in body axes
    error: Array
    sigma: Array
    # pose_nees, bias_nees: (n,), normalised errors squared, of six degrees of freedom each
    pose_nees: Array
    bias_nees: Array

    def __len__(self) -> int:
        return len(self.time)

    def rows(self, chosen: BoolArray) -> "ErrorSeries":
        """Return a subset of the states."""
        return ErrorSeries(
            self.time[chosen],
            self.measured[chosen],
            self.error[chosen],
            self.sigma[chosen],
            self.pose_nees[chosen],
            self.bias_nees[chosen],
        )

    def size(self, part: slice) -> Array:
        """Return the length of a part of the error, shape (n,)."""
        return np.asarray(np.linalg.norm(self.error[:, part], axis=1))


@dataclass(frozen=True)
class Slope:
    """Growth of an error per day.

    `freedom`: degrees of freedom of the standard error.
    """

    per_day: float
    standard_error: float
    freedom: float

    @property
    def margin(self) -> float:
        """Half the confidence interval of the slope, at `CONFIDENCE`."""
        return self._margin(CONFIDENCE)

    def _margin(self, confidence: float) -> float:
        return float(stdtrit(self.freedom, 0.5 + 0.5 * confidence) * self.standard_error)

    def verdict(self, limit: float) -> Verdict:
        """Return whether the slope is within plus or minus a limit.

        It passes only if the whole interval is inside, and fails only if the whole interval of
        `CERTAIN` is outside: a short run that decides neither has not passed and not failed.
        """
        size = abs(self.per_day)
        return within(size - self._margin(CERTAIN), size + self.margin, limit)


def within(low: float, high: float, limit: float) -> Verdict:
    """Return whether an interval is below a limit: all of it, none of it, or neither."""
    if high < limit:
        return "pass"
    return "fail" if low > limit else "undecided"


@dataclass(frozen=True, eq=False)
class CommonSlope:
    """Common drift of the components of an error in all worlds.

    The length of an error does not show it: a drift of a millimetre adds nothing to a constant
    error of a centimetre perpendicular to it.
    """

    per_day: Array  # (3,), mean over the worlds
    standard_error: Array  # (3,), from their scatter
    # of slopes as far from zero by chance, by Hotelling's test of all three components at once;
    # below `THREE_SIGMA` they are beyond three standard errors
    probability: float

    @property
    def verdict(self) -> Verdict:
        """Return whether the worlds drift in one direction."""
        return "fail" if self.probability < THREE_SIGMA else "pass"


def common_slope(times: Sequence[Array], values: Sequence[Array]) -> CommonSlope:
    """Return the mean slope of the components of an error over worlds.

    Raises ValueError with fewer than `MIN_COMMON` worlds, for which the scatter of three components
    is unknown. `times` (n,): one per world (s). `values` (n, 3).
    """
    worlds = len(values)
    if worlds < MIN_COMMON:
        raise ValueError(f"at least {MIN_COMMON} worlds are needed; got {worlds}")
    rates = np.array([np.polyfit(t / DAY, v, 1)[0] for t, v in zip(times, values, strict=True)])
    mean, cov = np.mean(rates, axis=0), np.cov(rates, rowvar=False) / worlds
    square = float(mean @ np.linalg.solve(cov, mean))
    freedom = worlds - 3
    chance = float(fdtrc(3, freedom, square * freedom / (3 * (worlds - 1))))
    return CommonSlope(mean, np.sqrt(np.diag(cov)), chance)


def slope_of_one(time: Array, value: Array) -> Slope:
    """Return the slope of one world's errors, for any correlation time.

    Raises ValueError where fewer than three blocks have any value. `time` (n,) (s). `value` (n,).
    """
    return Slope(*trend(time / DAY, value))


def slope_over_worlds(times: Sequence[Array], values: Sequence[Array]) -> Slope:
    """Return the mean slope of several worlds, its standard error from their scatter.

    `times`, `values` (n,): one per world (s); for a single one, see `slope_of_one`.
    """
    if len(values) == 1:
        return slope_of_one(times[0], values[0])
    rates = [np.polyfit(t / DAY, v, 1)[0] for t, v in zip(times, values, strict=True)]
    error = float(np.std(rates, ddof=1) / np.sqrt(len(rates)))
    return Slope(float(np.mean(rates)), error, len(rates) - 1)


def evenly(series: ErrorSeries, interval: float) -> ErrorSeries:
    """Return the measured states at multiples of an interval (s): equal weight of all hours."""
    off = np.abs(series.time / interval - np.round(series.time / interval))
    return series.rows(series.measured & (off * interval < 1e-6))


def in_windows(time: Array, value: Array, edges: Array) -> Array:
    """Return the mean of each window, NaN where it is empty, shape (windows,)."""
    own = np.searchsorted(edges, time, side="right") - 1
    out = np.full(len(edges) - 1, np.nan)
    for k in np.unique(own[(own >= 0) & (own < len(out))]):
        out[k] = np.mean(value[own == k])
    return out


@dataclass(frozen=True)
class Quantity:
    """A tested part of the error."""

    # name, unit: as in the report
    name: str
    unit: str
    part: slice  # of an error's columns
    scale: float  # from SI to the unit
    # maximum slope, by design (unit per day): it would take days to reach about the error of a good
    # installation
    limit: float

    @property
    def symbol(self) -> str:
        """The unit as printed."""
        return {"deg_h": "deg/h", "m_s2": "m/s^2"}.get(self.unit, self.unit)


DEG_PER_H = float(np.rad2deg(HOUR))
QUANTITIES = (
    Quantity("position", "m", POSITION, 1.0, 2e-3),
    Quantity("attitude", "deg", ATTITUDE, float(np.rad2deg(1.0)), 0.05),
    Quantity("gyro_bias", "deg_h", GYRO_BIAS, DEG_PER_H, 5.0),
    Quantity("accel_bias", "m_s2", ACCEL_BIAS, 1.0, 5e-3),
)


def settled_after(hours: float) -> float:
    """Return the time from which slopes count (s): twelve hours, or a quarter of a shorter run."""
    return HOUR * min(12.0, 0.25 * hours)


@dataclass(frozen=True, eq=False)
class EstimatorPlot:
    """Plotted data of an estimator."""

    name: str
    worlds: tuple[ErrorSeries, ...]  # errors in each world, at equal intervals
    interval: float  # this interval (s)
    # (pieces, 6), of the first world: begin (s), processor time (s), updates, memory (MiB), squared
    # innovation in units of its expectation, processor time of one sample of a bare loop at that
    # time (s)
    pace: Array

    @property
    def errors(self) -> ErrorSeries:
        """Errors in the first world."""
        return self.worlds[0]

    def hourly(self) -> tuple[Array, dict[str, Array]]:
        """Return the middles of the hours (h) and the means of squares over all worlds.

        Returns `time` (hours,); `levels` (hours,): squared errors of pose and bias, and squared
        innovations of the first world, all relative to their expectation.
        """
        edges = HOUR * np.arange(np.ceil(self.errors.time[-1] / HOUR) + 1)
        time = np.concatenate([w.time for w in self.worlds])
        levels = {
            name: in_windows(time, np.concatenate([getattr(w, kind) for w in self.worlds]), edges)
            / 6.0
            for name, kind in (("pose", "pose_nees"), ("bias", "bias_nees"))
        }
        detected = self.pace[np.isfinite(self.pace[:, 4])]
        levels["innovation"] = in_windows(detected[:, 0], detected[:, 4], edges)
        return 0.5 * (edges[1:] + edges[:-1]) / HOUR, levels

    def nees_by_hour(self) -> list[dict[str, Any]]:
        """Return the NEES per degree of freedom of each hour that has states, over all worlds."""
        hours, levels = self.hourly()
        rows = zip(hours, levels["pose"], levels["bias"], strict=True)
        return [
            {"hour": float(hour), "pose": float(pose), "bias": float(bias)}
            for hour, pose, bias in rows
            if np.isfinite(pose)
        ]


def worlds_text(count: object) -> str:
    """Return a number of worlds as printed."""
    return "1 world" if count == 1 else f"{count} worlds"
