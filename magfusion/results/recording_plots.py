"""The series of a recording: position, errors with their sigmas, biases, innovations."""

from collections.abc import Mapping

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
_BEACONS = ((240, 165, 30), (205, 115, 220), (245, 100, 60), (240, 228, 66), (30, 190, 165))


def beacon_colour(index: int) -> tuple[int, int, int]:
    """Return the colour of a beacon by its place in the site."""
    return _BEACONS[index % len(_BEACONS)]


def rows_of(count: int, limit: int = MAX_ROWS) -> IntArray:
    """Return rows, evenly, of a series that may be too long."""
    return np.unique(np.linspace(0, count - 1, min(count, limit)).astype(np.int64))


def gaps_of(time: Array) -> IntArray:
    """Return where the series resumes after a gap; no line is drawn across."""
    step = np.diff(time)
    return np.flatnonzero(step > 5.0 * np.median(step)) + 1 if len(step) else rows_of(0)


def log_series(
    recording: rr.RecordingStream,
    place: str,
    time: Array,
    value: Array,
    style: rr.SeriesLines,
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


def log_errors(recording: rr.RecordingStream, errors: TrajectoryErrors) -> None:
    """Draw the components of the errors between three sigmas."""
    kinds = (
        ("position_error_mm", 1e3, errors.position_world, errors.position_sigma_world),
        (
            "attitude_error_deg",
            np.rad2deg(1.0),
            errors.attitude_body,
            errors.attitude_sigma_body,
        ),
    )
    for name, unit, error, sigma in kinds:
        for i, (axis, colour) in enumerate(AXES.items()):
            place = f"plots/{name}/{axis}"
            style = rr.SeriesLines(colors=colour, names=f"{axis} error", widths=1.5)
            log_series(recording, f"{place}/error", errors.time, unit * error[:, i], style)
            if sigma is not None:
                bound = 3.0 * unit * sigma[:, i, None] * np.array([1.0, -1.0])
                names = ["+3 sigma", "-3 sigma"]
                band = rr.SeriesLines(colors=[SIGMA, SIGMA], names=names, widths=[1.0, 1.0])
                log_series(recording, f"{place}/three_sigma", errors.time, bound, band)


def log_biases(recording: rr.RecordingStream, trajectory: Trajectory) -> None:
    """Draw the biases, where they were estimated."""
    kinds = (
        ("gyro_bias_deg_s", np.rad2deg(1.0), trajectory.gyro_bias_body),
        ("accel_bias_m_s2", 1.0, trajectory.accel_bias_body),
    )
    for name, unit, bias in kinds:
        if bias is not None:
            for i, (axis, colour) in enumerate(AXES.items()):
                style = rr.SeriesLines(colors=colour, names=axis, widths=1.5)
                place = f"plots/{name}/{axis}"
                log_series(recording, place, trajectory.time, unit * bias[:, i], style)


def log_innovations(
    recording: rr.RecordingStream,
    site: Site,
    innovations: Mapping[str, tuple[Array, Array]],
    span: Array,
) -> None:
    """Draw the whitened residuals of each beacon, and what is expected."""
    colours = {beacon.name: beacon_colour(i) for i, beacon in enumerate(site.beacons)}
    for name, (time, rms) in innovations.items():
        present = np.isfinite(rms)
        if not present.any():
            continue
        style = rr.SeriesLines(colors=colours[name], names=name, widths=1.0)
        place = f"plots/innovations/beacons/{rr.escape_entity_path_part(name)}"
        log_series(recording, place, time[present], rms[present], style)
    style = rr.SeriesLines(colors=(255, 255, 255), names="expected", widths=1.5)
    log_series(recording, "plots/innovations/expected", span, np.ones(2), style)
