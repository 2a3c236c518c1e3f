"""Paper 001, figure 6: attitude from the magnetometer alone, within 5 degrees; and where that ends.

The paper looks a field vector up in a database of attitudes (Eq 18 and 20) and claims three angles
within 5 degrees, with no assumption on the yaw.  The scenario finds:

1. With the yaw known, roll and pitch are found within 5 degrees by the nearest entry up to a step
   of 5 degrees, and by interpolation at 10, where it equals the closed form without a database.
2. With the yaw unknown the claim fails: it holds up to some 2 degrees of freedom in yaw, for half
   the attitudes at 10, and in a database of all attitudes the typical error is a right angle, with
   no noise at all: each vector has a circle of attitudes.
3. Even with the yaw known pitch has a fold, 60 degrees nose down when heading north in Shenyang:
   there neither angle is determined, and on both sides of it one vector has two attitudes.
4. What is lacking for three angles is a second vector: with gravity, at rest, all are found.

Angles are printed as in the paper (north, east, down; pitch up is positive).
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from harness import blank_figure, conclude, rms, save_picture, scenario_parser
from roll_matching import (
    FIELD_WORLD,
    MILLIGAUSS,
    calibrated_error,
    ideal,
    measure,
)
from roll_matching import Config as Instruments
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from magfusion.files.attitude_table import AttitudeDatabase
from magfusion.papers.p001_magnetometer.matching import (
    attitude_with_gravity,
    match_roll_pitch,
    predict_field,
    wrap,
)
from magfusion.papers.p001_magnetometer.matching_database import (
    Index,
    match_interpolated,
    match_nearest,
    prepare,
)
from magfusion.units import DEGREE, Array

METHODS = ("nearest", "interpolated", "closed form")
PAPER_DEG = 5.0
PITCH_NED_DEG = (-30.0, 45.0)


@dataclass(frozen=True)
class Config:
    """Instruments and size of the experiment."""

    seeds: int = 5
    attitudes: int = 2000
    noise_mg: float = 3.0
    database_noise_mg: float = 0.5
    steps_deg: tuple[float, ...] = (1.0, 2.0, 5.0, 10.0)
    yaw_free_deg: tuple[float, ...] = (2.0, 3.0, 5.0, 10.0, 180.0)
    entries: int = 200_000
    pitches_ned_deg: tuple[float, ...] = (30.0, 0.0, -30.0, -45.0, -55.0, -59.0, -65.0, -80.0)
    force_noise_mg: float = 5.0  # accelerometer, thousandths of g
    seed: int = 0


@dataclass(frozen=True)
class Step:
    """Errors of roll and pitch, yaw known, at one step of the database (deg)."""

    step_deg: float
    entries: int
    rms: dict[str, float]
    median_max: dict[str, float]


@dataclass(frozen=True)
class FreeYaw:
    """What remains of the claim where the yaw is free by so much either way."""

    yaw_deg: float
    within_paper: float  # share of all attitudes, worst of three angles


@dataclass(frozen=True)
class Fold:
    """Both solutions at one pitch, heading north (deg), and their claimed sigma for 1 mG."""

    pitch_deg: float
    found_deg: tuple[float | None, ...]
    roll_sigma_deg: float
    pitch_sigma_deg: float
    determined: bool


@dataclass(frozen=True)
class Result:
    """All answers."""

    steps: tuple[Step, ...]
    free_yaw: tuple[FreeYaw, ...]
    all_attitudes_median_deg: float
    all_attitudes_within_paper: float
    all_attitudes_vector_deg: float  # angle between measured and matched field, median
    folds: tuple[Fold, ...]
    with_gravity_rms_deg: float


def from_ned(rpy_ned_deg: Array) -> Array:
    """Return our roll, pitch, yaw (rad), z up, of the paper's (deg), z down."""
    roll, pitch, yaw = np.moveaxis(rpy_ned_deg * DEGREE, -1, 0)
    return np.stack([roll, -pitch, wrap(0.5 * np.pi - yaw)], axis=-1)


def random_attitudes(count: int, yaw_free_deg: float, rng: np.random.Generator) -> Array:
    """Return attitudes (ours, rad) with any roll, the paper's pitch, and yaw about north."""
    low = (-180.0, PITCH_NED_DEG[0], -yaw_free_deg)
    high = (180.0, PITCH_NED_DEG[1], yaw_free_deg)
    return from_ned(rng.uniform(low, high, (count, 3)))


def database(config: Config, step_deg: float, rng: np.random.Generator) -> Index:
    """Return the database of a grid of roll and pitch, two steps wider than required."""
    low, high = PITCH_NED_DEG
    pitch = np.arange(low - 2.0 * step_deg, high + 2.001 * step_deg, step_deg)
    roll = np.arange(-180.0, 180.0, step_deg)
    grid = np.stack(np.meshgrid(roll, pitch, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    rpy = from_ned(grid)
    field_body = measure(rpy, ideal(), config.database_noise_mg, rng)
    return prepare(AttitudeDatabase(field_body, rpy, "roll-pitch", "MTi"))


def found_by_all(index: Index, measured: Array, sigma: float) -> dict[str, Array]:
    """Return the first attitude of each method (rad)."""
    yaw = float(index.database.rpy[0, 2])
    result = (
        match_nearest(index, measured, sigma),
        match_interpolated(index, measured, sigma),
        match_roll_pitch(measured, yaw, FIELD_WORLD, sigma),
    )
    return {name: m.rpy[:, 0] for name, m in zip(METHODS, result, strict=True)}


def by_step(config: Config, step_deg: float) -> Step:
    """Match noisy vectors with the yaw known."""
    errors: dict[str, list[Array]] = {name: [] for name in METHODS}
    for rng in np.random.default_rng(config.seed).spawn(config.seeds):
        index = database(config, step_deg, rng)
        true = random_attitudes(config.attitudes, 0.0, rng)
        left_over = calibrated_error(Instruments(), rng)
        measured = measure(true, left_over, config.noise_mg, rng)
        result = found_by_all(index, measured, config.noise_mg * MILLIGAUSS)
        for name in METHODS:
            errors[name].append(np.abs(wrap(result[name] - true)[:, :2]) / DEGREE)
    return Step(
        step_deg=step_deg,
        entries=len(index.database),
        rms={name: rms(np.array(e)) for name, e in errors.items()},
        median_max={name: float(np.median([x.max() for x in e])) for name, e in errors.items()},
    )


def with_free_yaw(config: Config, yaw_deg: float) -> FreeYaw:
    """Match exact vectors in a database whose yaw is free as well."""
    rng = np.random.default_rng(config.seed)
    entries = random_attitudes(config.entries, yaw_deg, rng)
    true = random_attitudes(config.attitudes, yaw_deg, rng)
    _, row = KDTree(predict_field(entries, FIELD_WORLD)).query(predict_field(true, FIELD_WORLD))
    worst = np.max(np.abs(wrap(entries[row] - true)), axis=1) / DEGREE
    return FreeYaw(yaw_deg, float(np.mean(worst <= PAPER_DEG)))


def among_all_attitudes(config: Config) -> tuple[float, float, float]:
    """Return median error (deg), share within the claim, and median distance of the vectors."""
    rng = np.random.default_rng(config.seed)
    entries = Rotation.random(config.entries, random_state=rng)
    true = Rotation.random(config.attitudes, random_state=rng)
    direction = FIELD_WORLD / np.linalg.norm(FIELD_WORLD)
    distance, row = KDTree(entries.apply(direction, inverse=True)).query(
        true.apply(direction, inverse=True)
    )
    error = (true.inv() * entries[row]).magnitude() / DEGREE
    separate = 2.0 * np.arcsin(0.5 * distance) / DEGREE
    return float(np.median(error)), float(np.mean(error <= PAPER_DEG)), float(np.median(separate))


def at_fold(pitch_ned_deg: float) -> Fold:
    """Return both pitches that explain an exact vector, heading north."""
    true = from_ned(np.array([20.0, pitch_ned_deg, 0.0]))
    result = match_roll_pitch(predict_field(true, FIELD_WORLD), true[2], FIELD_WORLD, MILLIGAUSS)
    pitch_deg = -result.rpy[:, 1] / DEGREE
    nearest = int(np.nanargmin(np.abs(pitch_deg - pitch_ned_deg)))
    return Fold(
        pitch_deg=pitch_ned_deg,
        found_deg=tuple(None if np.isnan(p) else float(p) for p in pitch_deg),
        roll_sigma_deg=float(result.sigma[nearest, 0] / DEGREE),
        pitch_sigma_deg=float(result.sigma[nearest, 1] / DEGREE),
        determined=bool(result.determined[nearest]),
    )


def with_gravity(config: Config) -> float:
    """Return the error of the whole attitude, any yaw, with an accelerometer at rest (deg)."""
    rng = np.random.default_rng(config.seed)
    true = random_attitudes(config.seeds * config.attitudes, 180.0, rng)
    measured = measure(true, ideal(), config.noise_mg, rng)
    force_noise = 1e-3 * config.force_noise_mg
    force = predict_field(true, np.array([0.0, 0.0, 1.0]))
    force += rng.normal(0.0, force_noise, force.shape)
    share = config.noise_mg * MILLIGAUSS / float(np.linalg.norm(FIELD_WORLD))
    result = attitude_with_gravity(measured, force, FIELD_WORLD, share, force_noise)
    turn = Rotation.from_matrix(result).inv() * Rotation.from_euler("xyz", true)
    return rms(turn.magnitude()) / DEGREE


def run(config: Config) -> Result:
    """Answer all questions."""
    return Result(
        tuple(by_step(config, step) for step in config.steps_deg),
        tuple(with_free_yaw(config, yaw) for yaw in config.yaw_free_deg),
        *among_all_attitudes(config),
        tuple(at_fold(pitch) for pitch in config.pitches_ned_deg),
        with_gravity(config),
    )


def report(result: Result) -> str:
    """Return the tables that a reader sees."""
    lines = [
        f"yaw known, 3 mG: error of roll and pitch (deg), RMS / median over the seeds of the"
        f" largest; the paper: < {PAPER_DEG:g}",
        f"{'step':>6}{'entries':>9}" + "".join(f"{name:>16}" for name in METHODS),
    ]
    for row in result.steps:
        cells = "".join(f"{row.rms[n]:8.2f} /{row.median_max[n]:6.2f}" for n in METHODS)
        lines.append(f"{row.step_deg:6g}{row.entries:9d}{cells}")
    lines.append(f"\nyaw free, no noise: share of attitudes within {PAPER_DEG:g} degrees")
    lines += [f"{row.yaw_deg:+6g}{row.within_paper:9.1%}" for row in result.free_yaw]
    lines.append(
        f"   any attitude: {result.all_attitudes_within_paper:.1%}; median error"
        f" {result.all_attitudes_median_deg:.1f} deg, of the vector"
        f" {result.all_attitudes_vector_deg:.2f} deg"
    )
    lines.append("\nthe fold, heading north: pitches that explain the vector; sigma for 1 mG (deg)")
    for fold in result.folds:
        both = " or ".join(f"{p:.1f}" for p in fold.found_deg if p is not None)
        lines.append(
            f"{fold.pitch_deg:6g} ->{both:>16}   roll {fold.roll_sigma_deg:7.2f}"
            f"   pitch {fold.pitch_sigma_deg:5.2f}{'' if fold.determined else '   refused'}"
        )
    lines.append(
        f"\nall three angles, with an accelerometer at rest: {result.with_gravity_rms_deg:.2f} deg"
    )
    return "\n".join(lines)


def draw(config: Config, path: Path) -> None:
    """Write a picture like the paper's figure 6, and what becomes of it with another yaw."""
    rng = np.random.default_rng(config.seed)
    index = database(config, 5.0, rng)
    time = np.linspace(0.0, 60.0, 1201)
    swing = 0.5 * np.sum(PITCH_NED_DEG) + 35.0 * np.sin(0.3 * time)
    roll_deg = 180.0 * wrap(0.5 * time) / np.pi
    figure = blank_figure(9.0, 8.0)
    panels = figure.subplots(3, 1, sharex=True)
    for yaw_deg, color in ((0.0, "tab:blue"), (5.0, "tab:orange")):
        rpy = from_ned(np.stack([roll_deg, swing, np.full_like(time, yaw_deg)], axis=1))
        measured = measure(rpy, ideal(), config.noise_mg, rng)
        result = match_interpolated(index, measured, config.noise_mg * MILLIGAUSS).rpy[:, 0]
        for k, (name, sign) in enumerate((("roll", 1.0), ("pitch", -1.0))):
            error = sign * wrap(result[:, k] - rpy[:, k]) / DEGREE
            panels[k + 1].plot(time, error, color=color, lw=0.8, label=f"yaw {yaw_deg:g} deg")
            panels[k + 1].set(ylabel=f"error of {name} (deg)")
    panels[0].plot(time, roll_deg, ".", ms=2, label="roll")
    panels[0].plot(time, swing, label="pitch")
    figure.suptitle("Database of 5 degrees at yaw 0, interpolated; 3 mG")
    panels[0].set(ylabel="attitude (deg)")
    for axes in panels[1:]:
        for limit, label in ((-PAPER_DEG, None), (PAPER_DEG, f"paper 001: {PAPER_DEG:g} deg")):
            axes.axhline(limit, color="red", ls="--", lw=0.8, label=label)
    for axes in panels:
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False)
    panels[2].set(xlabel="time (s)")
    save_picture(figure, path)


def main() -> None:
    """Print the tables and one JSON line; draw where an output directory is given."""
    given = scenario_parser(__doc__, Config.seed).parse_args()
    config = Config(seed=given.seed)
    result = run(config)
    if given.output is not None:
        draw(config, given.output / "attitude_matching.png")
    conclude(report(result), {"paper_max_deg": PAPER_DEG} | vars(result))


if __name__ == "__main__":
    main()
