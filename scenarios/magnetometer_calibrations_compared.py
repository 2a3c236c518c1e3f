"""What each way of calibrating a magnetometer leaves, on turntable and by hand, and what it needs.

Paper 001 calibrates on a turntable in twelve positions by closed formulas.  The scenario draws 200
sensors (scale 8 %, misalignment 0.02, offset 60 mG) and measures the error of the direction of the
field that the calibrated sensor gives, all round the sphere:

1. How much do noise, a tilted table, a wrong reference field and a wrong heading cost?  Reference
   and heading nothing: they are a pure scale.  A tilt of one degree costs 0.7 degrees.
2. Least squares over the same readings takes a tenth off.  A graph that lets each position be off,
   and reads an accelerometer in each, takes half off at half a degree and more beyond.
3. Without a turntable, by turning the sensor by hand: the ellipsoid alone leaves a degree, because
   it does not see by which rotation it became a sphere; with the vertical at each reading a
   tenth of that; the graph, which weighs the two by the noise they share, half of it again.
"""

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from harness import blank_figure, conclude, save_picture, scenario_parser
from scipy.spatial.transform import Rotation

from magfusion.calibration.ellipsoid import fit_ellipsoid, fit_ellipsoid_gravity
from magfusion.calibration.magnetometer import MagnetometerFit, field_from_measured, from_paper
from magfusion.calibration.magnetometer_graph import (
    MagnetometerEpochs,
    MagnetometerPrior,
    fit_graph,
)
from magfusion.papers.p001_magnetometer.twelve_positions import (
    closed_form,
    least_squares,
    positions,
)
from magfusion.units import DEGREE, Array

MILLIGAUSS = 1e-7  # T
# IGRF at Shenyang, 41.8 N 123.4 E, 50 m, middle of 2013: north, east, down.
FIELD_NED = np.array([26914.0, -4175.3, 46741.2]) * 1e-9  # T
LEVEL_FROM_NED = np.diag([1.0, -1.0, -1.0])  # north, west, up
FIELD_LEVEL = LEVEL_FROM_NED @ FIELD_NED
GRAVITY = 9.8  # m/s^2
ACCEL_NOISE = 0.002  # of gravity
HAND_NOISE = 2.0 * MILLIGAUSS
# Nothing is known of the sensor beforehand; in units where its matrix is near one.
PRIOR_COV = np.diag(np.repeat([0.3, 1e-5], [9, 3]) ** 2)


@dataclass(frozen=True)
class Config:
    """How many sensors, by hand how many readings of each, and how many of them in a graph."""

    sensors: int = 200
    graph_sensors: int = 100
    readings: tuple[int, ...] = (50, 200)
    seed: int = 1


@dataclass(frozen=True, eq=False)
class Sensors:
    """True matrices (n, 3, 3) and offsets (n, 3)."""

    matrix: Array
    offset: Array


def draw_sensors(count: int, rng: np.random.Generator) -> Sensors:
    """Draw sensors as the analysis of paper 001 has them."""
    misalignment = 0.02 * rng.standard_normal((count, 3, 3))
    misalignment[:, range(3), range(3)] = 0.0
    scale = 1.0 + 0.08 * rng.standard_normal((count, 3))
    offset = 60.0 * MILLIGAUSS * rng.standard_normal((count, 3))
    return Sensors(*from_paper(offset, scale, misalignment))


def read(sensors: Sensors, field: Array, noise: float, rng: np.random.Generator) -> Array:
    """Return readings (n, k, 3) of fields (k, 3) or (n, k, 3) (T)."""
    clean = field @ np.swapaxes(sensors.matrix, 1, 2) + sensors.offset[:, None]
    return np.asarray(clean + noise * rng.standard_normal(clean.shape))


def sphere(count: int = 400) -> Array:
    """Return fields of equal size, evenly all round (T), shape (count, 3)."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    flat = np.sqrt(1.0 - z**2)
    unit = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)
    return np.asarray(np.linalg.norm(FIELD_NED) * unit)


def angle_deg(sensors: Sensors, fit: MagnetometerFit) -> float:
    """Return the RMS angle (deg) between true and calibrated field, over sphere and sensors."""
    true = sphere()
    measured = true @ np.swapaxes(sensors.matrix, 1, 2) + sensors.offset[:, None]
    result = field_from_measured(measured, fit.matrix, fit.offset)
    sine = np.linalg.norm(np.cross(result, true), axis=-1)
    angle = np.arctan2(sine, np.sum(result * true, axis=-1))
    return float(np.sqrt(np.mean(angle**2)) / DEGREE)


def tilts(
    sigma_deg: float,
    shape: tuple[int, int],
    rng: np.random.Generator,
    axes: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> Array:
    """Return random small rotations, sigma times ``axes`` about each axis, (*shape, 3, 3)."""
    vectors = sigma_deg * DEGREE * rng.standard_normal((shape[0] * shape[1], 3)) * axes
    return np.asarray(Rotation.from_rotvec(vectors).as_matrix().reshape(*shape, 3, 3))


def on_table(
    sensors: Sensors,
    rng: np.random.Generator,
    noise: float = 0.0,
    tilt_deg: float = 0.0,
    down_error: float = 0.0,
    heading_deg: float = 0.0,
) -> dict[str, float]:
    """Return the errors (deg) of the closed formulas and of least squares on a turntable.

    ``tilt_deg`` is of the table's level in each position, sigma about both horizontal axes;
    ``down_error`` (T) and ``heading_deg`` are what the user of the formulas does not know.
    """
    tilted = tilts(tilt_deg, (len(sensors.matrix), 12), rng, (1.0, 1.0, 0.0))
    rotated = positions(heading_deg * DEGREE) @ tilted @ FIELD_NED
    measured = read(sensors, rotated, noise, rng)
    assumed = FIELD_NED + np.array([0.0, 0.0, down_error])
    return {
        "paper": angle_deg(sensors, closed_form(measured, float(assumed[2]))),
        "least_squares": angle_deg(sensors, least_squares(measured, positions(0.0) @ assumed)),
    }


def graphs(
    sensors: Sensors, epochs: list[MagnetometerEpochs], dip_sigma: float
) -> tuple[MagnetometerFit, float]:
    """Return the fits of one graph a sensor, and the mean NEES of their twelve numbers."""
    prior = MagnetometerPrior(
        np.eye(3), np.eye(3), np.zeros(3), PRIOR_COV, FIELD_LEVEL, dip_sigma, GRAVITY
    )
    fits = [fit_graph(own, prior).fit for own in epochs]
    fit = MagnetometerFit(*(np.array([getattr(f, k) for f in fits]) for k in vars(fits[0])))
    error = np.concatenate(
        [(fit.matrix - sensors.matrix).reshape(-1, 9), fit.offset - sensors.offset], axis=1
    )
    whitened = np.linalg.solve(fit.cov, error[..., None])[..., 0]
    return fit, float(np.mean(np.sum(error * whitened, axis=1)))


def on_table_graph(sensors: Sensors, rng: np.random.Generator, tilt_deg: float) -> dict[str, float]:
    """Return the errors (deg) of all methods on a table set wrong about all axes, at 2 mG."""
    count = len(sensors.matrix)
    table = positions(0.0) @ LEVEL_FROM_NED.T  # sensor_from_level
    true = tilts(tilt_deg, (count, 12), rng) @ table
    measured = read(sensors, true @ FIELD_LEVEL, HAND_NOISE, rng)
    force = GRAVITY * (true[..., 2] + ACCEL_NOISE * rng.standard_normal(measured.shape))
    out = {
        "paper": angle_deg(sensors, closed_form(measured, float(FIELD_NED[2]))),
        "least_squares": angle_deg(sensors, least_squares(measured, table @ FIELD_LEVEL)),
    }
    accel_sigma = np.full(12, GRAVITY * ACCEL_NOISE)
    for name, forces in (("graph", [None] * count), ("graph_accel", list(force))):
        epochs = [
            MagnetometerEpochs(
                measured_sensor=own,
                field_sigma=HAND_NOISE,
                accel_body=own_force,
                accel_sigma=None if own_force is None else accel_sigma,
                world_from_body=np.swapaxes(table, 1, 2),
                table_sigma=tilt_deg * DEGREE,
            )
            for own, own_force in zip(measured, forces, strict=True)
        ]
        fit, out[f"{name}_nees"] = graphs(sensors, epochs, 0.0)
        out[name] = angle_deg(sensors, fit)
    return out


def by_hand(sensors: Sensors, rng: np.random.Generator, readings: int) -> dict[str, float]:
    """Return the errors (deg) of the methods that need no turntable, at 2 mG."""
    count, size = len(sensors.matrix), float(np.linalg.norm(FIELD_NED))
    attitude = Rotation.random(count * readings, rng=rng).as_matrix()
    sensor_from_level = attitude.reshape(count, readings, 3, 3)
    measured = read(sensors, sensor_from_level @ FIELD_LEVEL, HAND_NOISE, rng)
    up = sensor_from_level[..., 2]
    noisy = up + ACCEL_NOISE * rng.standard_normal(up.shape)
    accel_sigma = np.full(readings, GRAVITY * ACCEL_NOISE)
    epochs = [
        MagnetometerEpochs(own, HAND_NOISE, GRAVITY * own_up, accel_sigma)
        for own, own_up in zip(measured, noisy, strict=True)
    ]
    fit, nees = graphs(sensors, epochs, 0.3)
    return {
        "ellipsoid": angle_deg(sensors, fit_ellipsoid(measured, size)),
        "ellipsoid_gravity": angle_deg(sensors, fit_ellipsoid_gravity(measured, noisy, size)),
        "graph": angle_deg(sensors, fit),
        "graph_nees": nees,
    }


def run(config: Config) -> dict[str, dict[str, float]]:
    """Return the errors (deg) of every method under every disturbance."""
    rng = np.random.default_rng(config.seed)
    sensors = draw_sensors(config.sensors, rng)
    few = draw_sensors(config.graph_sensors, rng)
    out = {
        "noise 1 mG": on_table(sensors, rng, noise=MILLIGAUSS),
        "tilt 0.1 deg": on_table(sensors, rng, tilt_deg=0.1),
        "tilt 1 deg": on_table(sensors, rng, tilt_deg=1.0),
        "down field 20 mG wrong": on_table(sensors, rng, down_error=20.0 * MILLIGAUSS),
        "heading 8.8 deg wrong": on_table(sensors, rng, heading_deg=8.8),
        "noise 2 mG, tilt 0.2 deg": on_table(sensors, rng, 2.0 * MILLIGAUSS, 0.2),
    }
    for tilt_deg in (0.5, 1.0):
        out[f"noise 2 mG, setting {tilt_deg:g} deg"] = on_table_graph(few, rng, tilt_deg)
    for readings in config.readings:
        out[f"by hand, {readings} readings"] = by_hand(few, rng, readings)
    return out


_COLUMNS = ("paper", "least_squares", "ellipsoid", "ellipsoid_gravity", "graph", "graph_accel")


def report(rows: dict[str, dict[str, float]]) -> str:
    """Return the table that a reader sees."""
    lines = [
        "RMS angle (deg) of the calibrated field",
        f"{'':26}" + "".join(f"{name.replace('_', ' '):>19}" for name in _COLUMNS),
    ]
    for name, row in rows.items():
        cells = [_cell(row.get(column)) for column in _COLUMNS]
        lines.append(f"{name:26}" + "".join(f"{cell:>19}" for cell in cells))
    return "\n".join(lines)


def _cell(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.3f}" if value > 1e-6 else f"{value:.0e}"


def draw(path: Path, rows: dict[str, dict[str, float]]) -> None:
    """Write a PNG: the error of each method by hand and on a tilted table."""
    shown = [name for name in rows if "graph" in rows[name]]
    figure = blank_figure(11.0, 4.5)
    axes = figure.subplots(1, len(shown), sharey=True)
    for panel, name in zip(axes, shown, strict=True):
        bars = {k: v for k, v in rows[name].items() if k in _COLUMNS}
        panel.bar([k.replace("_", "\n") for k in bars], list(bars.values()))
        panel.set_title(name, fontsize=9)
        panel.tick_params(axis="x", labelsize=7)
    axes[0].set_ylabel("RMS angle of the field (deg)")
    save_picture(figure, path)


def main() -> None:
    """Print the table and one JSON line."""
    given = scenario_parser(__doc__, Config.seed, quick="a tenth of the sensors").parse_args()
    config = Config(seed=given.seed)
    if given.quick:
        config = Config(sensors=20, graph_sensors=10, seed=given.seed)
    rows = run(config)
    if given.output is not None:
        draw(given.output / "magnetometer_calibrations_compared.png", rows)
    conclude(report(rows), {"config": asdict(config), "rows": rows})


if __name__ == "__main__":
    main()
