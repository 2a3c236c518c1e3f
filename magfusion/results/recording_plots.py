"""The series of a recording: position, errors with their sigmas, biases, innovations."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import rerun as rr

from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.results.errors import TrajectoryErrors
from magfusion.units import Array, IntArray

TIMELINE = "time"  # seconds since the log's epoch
MAX_ROWS = 5000  # of each series: more than a screen can show
SIGMA = (150, 150, 160)
AXES = {"x": (235, 85, 85), "y": (90, 200, 90), "z": (95, 145, 255)}
# Distinct also for colour-blind readers, and from the axes' red, green and blue.
_BEACONS = ((245, 150, 30), (190, 120, 255), (40, 205, 190), (245, 232, 80), (255, 140, 190))


def beacon_colour(index: int) -> tuple[int, int, int]:
    """Return the colour of a beacon by its index in the site."""
    return _BEACONS[index % len(_BEACONS)]


def rows_of(count: int, limit: int = MAX_ROWS) -> IntArray:
    """Return evenly spaced rows of a series that may be too long."""
    return np.unique(np.linspace(0, count - 1, min(count, limit)).astype(np.int64))


def gaps_of(time: Array) -> IntArray:
    """Return where the series resumes after a gap; no line is drawn across."""
    step = np.diff(time)
    return np.flatnonzero(step > 5.0 * np.median(step)) + 1 if len(step) else rows_of(0)


def log_series(
    recording: rr.RecordingStream, place: str, time: Array, value: Array, style: rr.SeriesLines
) -> None:
    """Send a series; the columns of a two-dimensional value are lines of one entity."""
    recording.log(place, style, static=True)
    rows = rows_of(len(time))
    gaps = gaps_of(time[rows])
    # A value that is not finite interrupts the line.
    time, value = (
        np.insert(time[rows], gaps, time[rows][gaps - 1] + 1e-6),
        np.insert(value[rows], gaps, np.nan, axis=0),
    )
    columns = rr.Scalars.columns(scalars=value.ravel())
    if value.ndim == 2:
        columns = columns.partition(np.full(len(time), value.shape[1]))
    recording.send_columns(place, [rr.TimeColumn(TIMELINE, duration=time)], columns)


def log_position(
    recording: rr.RecordingStream, trajectory: Trajectory, truth: Trajectory | None
) -> None:
    """Draw the components of the position, and of the true one."""
    for i, (axis, colour) in enumerate(AXES.items()):
        style = rr.SeriesLines(colors=colour, names=f"{axis} estimate", widths=1.5)
        place = f"plots/position_m/{axis}"
        log_series(recording, place, trajectory.time, trajectory.position_world[:, i], style)
        if truth is not None:
            pale = rr.SeriesLines(colors=SIGMA, names=f"{axis} truth", widths=1.0)
            place = f"plots/position_m/{axis}_truth"
            log_series(recording, place, truth.time, truth.position_world[:, i], pale)


class ErrorPlot(NamedTuple):
    """Plots of the components of an error, with their names."""

    place: str
    name: str
    axes: str  # of which frame
    unit: str
    scale: float  # from SI to the unit

    def of(self, errors: TrajectoryErrors) -> tuple[Array, Array | None]:
        """Return the error and its sigma in the unit, shape (n, 3)."""
        position = "position" in self.place
        error = errors.position_world if position else errors.attitude_body
        sigma = errors.position_sigma_world if position else errors.attitude_sigma_body
        return self.scale * error, None if sigma is None else self.scale * sigma

    def title(self, axis: str, sigma: bool) -> str:
        """Return the title of a component's plot."""
        grey = "; grey: 3 sigma" if sigma else ""
        return f"{self.name} {self.axes} {axis} ({self.unit}){grey}"


ERRORS = (
    ErrorPlot("plots/position_error_mm", "Position error", "along world", "mm", 1e3),
    ErrorPlot(
        "plots/attitude_error_deg", "Attitude error", "about body", "deg", float(np.rad2deg(1.0))
    ),
)


def log_errors(recording: rr.RecordingStream, errors: TrajectoryErrors) -> None:
    """Draw the components of the errors between three sigmas."""
    for kind in ERRORS:
        error, sigma = kind.of(errors)
        for i, (axis, colour) in enumerate(AXES.items()):
            place = f"{kind.place}/{axis}"
            style = rr.SeriesLines(colors=colour, names=f"{axis} error", widths=1.5)
            log_series(recording, f"{place}/error", errors.time, error[:, i], style)
            if sigma is not None:
                bound = 3.0 * sigma[:, i, None] * np.array([1.0, -1.0])
                names = ["+3 sigma", "-3 sigma"]
                band = rr.SeriesLines(colors=[SIGMA, SIGMA], names=names, widths=[1.0, 1.0])
                log_series(recording, f"{place}/three_sigma", errors.time, bound, band)


def biases(trajectory: Trajectory) -> tuple[tuple[str, str, float, Array | None], ...]:
    """Return for each bias: its plot, its name, the factor from SI to its unit, and the bias."""
    gyro, accel = trajectory.gyro_bias_body, trajectory.accel_bias_body
    return (
        ("plots/gyro_bias_deg_s", "Gyro bias (deg/s)", float(np.rad2deg(1.0)), gyro),
        ("plots/accel_bias_m_s2", "Accel bias (m/s²)", 1.0, accel),
    )


def log_biases(recording: rr.RecordingStream, trajectory: Trajectory) -> None:
    """Draw the biases, where they were estimated."""
    for place, _, unit, bias in biases(trajectory):
        if bias is not None:
            for i, (axis, colour) in enumerate(AXES.items()):
                style = rr.SeriesLines(colors=colour, names=axis, widths=1.5)
                log_series(recording, f"{place}/{axis}", trajectory.time, unit * bias[:, i], style)


def log_innovations(
    recording: rr.RecordingStream,
    site: Site,
    innovations: Mapping[str, tuple[Array, Array]],
    span: Array,
) -> None:
    """Draw the whitened residuals of each beacon, and their expectation."""
    colours = {beacon.name: beacon_colour(i) for i, beacon in enumerate(site.beacons)}
    for name, (time, rms) in innovations.items():
        present = np.isfinite(rms)
        if not present.any():
            continue
        style = rr.SeriesLines(colors=colours[name], names=f"beacon {name}", widths=1.0)
        place = f"plots/innovations/beacons/{rr.escape_entity_path_part(name)}"
        log_series(recording, place, time[present], rms[present], style)
    style = rr.SeriesLines(colors=(255, 255, 255), names="expected", widths=1.5)
    log_series(recording, "plots/innovations/expected", span, np.ones(2), style)
