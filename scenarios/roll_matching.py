"""Paper 001, figure 4: roll from the magnetometer alone, on a turntable, within 3 degrees.

The paper records the field of an MTi over a turn about one axis as a database, and finds the roll
of another magnetometer by the nearest entry (Eq 17 and 19).  It prints neither noise nor step.  The
scenario calibrates that magnetometer in twelve positions (section 1.1), rotates it and answers:

1. What noise and step give the printed 3 degrees?  A database every degree and some 3 mG.
2. What does the paper's proposal to interpolate in a coarser database cost?  Nothing: up to a step
   of 10 degrees it equals the closed form (atan2), which needs no database.
3. What is the law?  The squares add of calibration, of noise over the field across the axis, and,
   for the nearest entry alone, of the step over the root of 12.

4. And the title's "large dynamic"?  At 20 turns a second, where a gyroscope of 2000 deg/s clips, a
   roll from each sample errs as at rest, and the rolls that the clipped rates give are useless.

The axis is vertical, as in the paper, roll zero at magnetic north; and, for comparison, level and
northwards, where more of the field lies across it.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from harness import blank_figure, conclude, rms, save_picture, scenario_parser
from scipy.spatial.transform import Rotation

from magfusion.files.attitude_table import AttitudeDatabase
from magfusion.papers.p001_magnetometer.matching import Matches, match_roll, predict_field, wrap
from magfusion.papers.p001_magnetometer.matching_database import (
    match_interpolated,
    match_nearest,
    prepare,
)
from magfusion.papers.p001_magnetometer.twelve_positions import least_squares, positions
from magfusion.units import DEGREE, Array

MILLIGAUSS = 1e-7  # T
# Shenyang, 41.8 N 123.4 E, 2013.5 (IGRF-14): north, east, down.
FIELD_NED = np.array([269.140, -41.753, 467.412]) * MILLIGAUSS
WORLD_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FIELD_WORLD = WORLD_FROM_NED @ FIELD_NED
MAGNETIC_NORTH = float(np.arctan2(FIELD_WORLD[1], FIELD_WORLD[0]))  # rad, from world x
NORTH = 0.5 * np.pi

METHODS = ("nearest", "interpolated", "closed form")
PAPER_DEG = 3.0
SPIN = 20.0  # turns/s
GYRO_RANGE_DEG_S = 2000.0


@dataclass(frozen=True)
class Config:
    """Instruments and size of the experiment."""

    seeds: int = 20
    rolls: int = 2000
    gain_sigma: float = 0.08  # of the module before its calibration
    cross_sigma: float = 0.02
    offset_mg: float = 60.0
    position_noise_mg: float = 2.0  # of a reading in the twelve positions
    position_tilt_deg: float = 0.2
    database_noise_mg: float = 0.5  # MTi
    seed: int = 0


@dataclass(frozen=True)
class Spin:
    """Roll errors (deg) of single samples at rest and at `SPIN`, and of clipped rates in 1 s."""

    rest_rms_deg: float
    spin_rms_deg: float
    clipped_gyro_deg: float


@dataclass(frozen=True)
class Row:
    """Errors of one step and noise, by each method (deg)."""

    axis: str
    step_deg: float
    noise_mg: float
    rms: dict[str, float]
    median_max: dict[str, float]  # over the seeds
    worst_max: dict[str, float]


CASES = (
    *(("vertical", step, noise) for step, noise in ((1, 1), (1, 3), (1, 5), (5, 3), (10, 3))),
    ("north", 1, 3),
)


def calibrated_error(config: Config, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return the map from true to calibrated field, matrix and offset (T), that is left over.

    Twelve positions, linear least squares.
    """
    true_matrix = np.diag(1.0 + rng.normal(0.0, config.gain_sigma, 3))
    true_matrix = true_matrix @ (
        np.eye(3) + rng.normal(0.0, config.cross_sigma, (3, 3)) * (1.0 - np.eye(3))
    )
    true_offset = rng.normal(0.0, config.offset_mg * MILLIGAUSS, 3)
    declared = positions(0.0) @ FIELD_NED
    tilt = Rotation.from_rotvec(rng.normal(0.0, config.position_tilt_deg * DEGREE, (12, 3)))
    reading = tilt.apply(declared) @ true_matrix.T + true_offset
    reading += rng.normal(0.0, config.position_noise_mg * MILLIGAUSS, (12, 3))
    result = least_squares(reading, declared)
    inverse = np.linalg.inv(result.matrix)
    return inverse @ true_matrix, inverse @ (true_offset - result.offset)


def measure(
    rpy: Array, left_over: tuple[Array, Array], noise_mg: float, rng: np.random.Generator
) -> Array:
    """Return what a calibrated magnetometer measures at attitudes (n, 3) (T)."""
    matrix, offset = left_over
    exact = predict_field(rpy, FIELD_WORLD) @ matrix.T + offset
    return np.asarray(exact + rng.normal(0.0, noise_mg * MILLIGAUSS, exact.shape))


def ideal() -> tuple[Array, Array]:
    """Return the calibration of an instrument without error."""
    return np.eye(3), np.zeros(3)


def on_axis(roll: Array, axis: str) -> Array:
    """Return the attitudes of a body whose x axis is vertical (down) or level to the north."""
    pitch, yaw = (0.5 * np.pi, MAGNETIC_NORTH) if axis == "vertical" else (0.0, NORTH)
    return np.stack([roll, np.full_like(roll, pitch), np.full_like(roll, yaw)], axis=1)


def once(
    config: Config, axis: str, step_deg: float, noise_mg: float, rng: np.random.Generator
) -> dict[str, Array]:
    """Return the roll errors (deg) of one magnetometer by each method."""
    left_over = calibrated_error(config, rng)
    entries = on_axis(np.arange(-180.0, 180.0, step_deg) * DEGREE, axis)
    field_body = measure(entries, ideal(), config.database_noise_mg, rng)
    index = prepare(AttitudeDatabase(field_body, entries, "roll", "MTi"))
    true = on_axis(rng.uniform(-np.pi, np.pi, config.rolls), axis)
    measured = measure(true, left_over, noise_mg, rng)
    sigma = noise_mg * MILLIGAUSS
    result: tuple[Matches, ...] = (
        match_nearest(index, measured, sigma),
        match_interpolated(index, measured, sigma),
        match_roll(measured, true[0, 1], true[0, 2], FIELD_WORLD, sigma),
    )
    return {
        name: wrap(matches.rpy[:, 0, 0] - true[:, 0]) / DEGREE
        for name, matches in zip(METHODS, result, strict=True)
    }


def run(config: Config) -> tuple[Row, ...]:
    """Turn the magnetometers of all seeds in every case."""
    return tuple(_row(config, *case) for case in CASES)


def _row(config: Config, axis: str, step_deg: float, noise_mg: float) -> Row:
    generators = np.random.default_rng(config.seed).spawn(config.seeds)
    runs = [once(config, axis, step_deg, noise_mg, rng) for rng in generators]
    error = {name: np.abs([result[name] for result in runs]) for name in METHODS}
    return Row(
        axis=axis,
        step_deg=step_deg,
        noise_mg=noise_mg,
        rms={name: rms(e) for name, e in error.items()},
        median_max={name: float(np.median(e.max(axis=1))) for name, e in error.items()},
        worst_max={name: float(e.max()) for name, e in error.items()},
    )


def spin(config: Config, noise_mg: float = 3.0, rate_hz: float = 1000.0) -> Spin:
    """Match every sample of a second at rest and of one at `SPIN`, and integrate clipped rates."""
    rng = np.random.default_rng(config.seed)
    left_over = calibrated_error(config, rng)
    time = np.arange(rate_hz) / rate_hz
    errors = []
    for turns in (0.0, SPIN):
        # At rest at as many rolls as in the spin, so that calibration errors are the same.
        start = 2.0 * np.pi * (0.0 if turns else SPIN) * time
        true = on_axis(wrap(start + 2.0 * np.pi * turns * time), "vertical")
        measured = measure(true, left_over, noise_mg, rng)
        sigma = noise_mg * MILLIGAUSS
        matched = match_roll(measured, true[0, 1], true[0, 2], FIELD_WORLD, sigma).rpy[:, 0, 0]
        errors.append(rms(wrap(matched - true[:, 0]) / DEGREE))
    clipped = 360.0 * SPIN - GYRO_RANGE_DEG_S  # deg/s of each second
    return Spin(errors[0], errors[1], clipped)


def report(rows: tuple[Row, ...], spun: Spin) -> str:
    """Return the table that a reader sees."""
    lines = [
        f"roll error (deg): RMS / median over the seeds of the largest; the paper: < {PAPER_DEG:g}",
        f"{'axis':>9}{'step':>6}{'noise':>7}" + "".join(f"{name:>16}" for name in METHODS),
    ]
    for row in rows:
        cells = "".join(f"{row.rms[n]:8.2f} /{row.median_max[n]:6.2f}" for n in METHODS)
        lines.append(f"{row.axis:>9}{row.step_deg:6g}{row.noise_mg:4g} mG{cells}")
    lines.append(
        f"{SPIN:g} turns/s, 3 mG, each sample alone: RMS {spun.spin_rms_deg:.2f} deg, at rest"
        f" {spun.rest_rms_deg:.2f}; a gyroscope of {GYRO_RANGE_DEG_S:g} deg/s is off by"
        f" {spun.clipped_gyro_deg:.0f} deg after a second"
    )
    return "\n".join(lines)


def draw(config: Config, path: Path) -> None:
    """Write a picture like the paper's figure 4: fields, roll found, and its error."""
    rng = np.random.default_rng(config.seed)
    left_over = calibrated_error(config, rng)
    entries = on_axis(np.arange(-180.0, 180.0) * DEGREE, "vertical")
    field_body = measure(entries, ideal(), config.database_noise_mg, rng)
    index = prepare(AttitudeDatabase(field_body, entries, "roll", "MTi"))
    true_deg = np.linspace(-180.0, 180.0, 1001)[:-1]
    measured = measure(on_axis(true_deg * DEGREE, "vertical"), left_over, 3.0, rng)
    figure = blank_figure(8.0, 8.0)
    fields, rolls, errors = figure.subplots(3, 1, sharex=True)
    for k, name in enumerate("xyz"):
        fields.plot(true_deg, measured[:, k] / MILLIGAUSS, label=f"field {name}")
    figure.suptitle("A calibrated magnetometer, 3 mG, on a vertical axis")
    fields.set(ylabel="field (mG)")
    for match, name in ((match_nearest, "nearest"), (match_interpolated, "interpolated")):
        result = match(index, measured, 3.0 * MILLIGAUSS).rpy[:, 0, 0]
        rolls.plot(true_deg, result / DEGREE, ".", ms=2, label=name)
        errors.plot(true_deg, wrap(result - true_deg * DEGREE) / DEGREE, lw=0.7, label=name)
    for limit, label in ((-PAPER_DEG, None), (PAPER_DEG, f"paper 001: {PAPER_DEG:g} deg")):
        errors.axhline(limit, color="red", ls="--", lw=0.8, label=label)
    rolls.set(ylabel="roll found (deg)")
    errors.set(xlabel="true roll (deg)", ylabel="error of roll (deg)")
    for axes in (fields, rolls, errors):
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False)
    save_picture(figure, path)


def main() -> None:
    """Print the table and one JSON line; draw where an output directory is given."""
    given = scenario_parser(__doc__, Config.seed).parse_args()
    config = Config(seed=given.seed)
    rows, spun = run(config), spin(config)
    if given.output is not None:
        draw(config, given.output / "roll_matching.png")
    conclude(report(rows, spun), {"paper_max_deg": PAPER_DEG, "rows": rows, "spin": spun})


if __name__ == "__main__":
    main()
