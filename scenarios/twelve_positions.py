"""The twelve-position calibration of paper 001, from its formulas to a recorded stream.

1. The formulas are exact, at any heading of the table.  Eq 2 as printed (``ezy By``) cannot be
   meant: it makes ``ezy`` one with the scale, and the paper's own Eq 16 then finds zero for it.
2. From a stream: a sensor that was never calibrated (scale 8 %, misalignment 0.02, offset 6 uT) is
   set down by hand, a degree off, in each position, among beacons that transmit.  The stops are
   found in the stream.  The formulas, which take the table for level, keep those degrees; the
   graph, which reads gyro and accelerometer as well, does not.
3. The picture is the paper's figure 2: a turn about the vertical before and after, an ellipse off
   the centre and a circle.
"""

from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from harness import blank_figure, conclude, save_picture, scenario_parser
from magnetometer_calibrations_compared import (
    FIELD_LEVEL,
    FIELD_NED,
    LEVEL_FROM_NED,
    Sensors,
    angle_deg,
    draw_sensors,
    read,
    tilts,
)
from scipy.interpolate import BPoly, BSpline
from scipy.spatial.transform import Rotation, RotationSpline

from magfusion.calibration.magnetometer import (
    MagnetometerFit,
    field_from_measured,
    from_paper,
    to_paper,
)
from magfusion.calibration.magnetometer_log import calibrate_log
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.papers.p001_magnetometer.twelve_positions import closed_form, positions
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.field import synchronised_drives
from magfusion.simulation.inertial import simulate_imu
from magfusion.simulation.log import EPOCH_NS
from magfusion.simulation.motion import SimulatedMotion
from magfusion.simulation.waveform import simulate_waveform
from magfusion.units import DEGREE, Array

HEADINGS_DEG = (0.0, 10.0, 45.0, 133.0)
RATE_HZ = 200.0
_RAMP = 0.5  # s from rest to turning


@dataclass(frozen=True)
class Config:
    """Stops and moves between them (s), and how far off the positions a hand sets the sensor."""

    stop: float = 4.0
    move: float = 3.0
    hand_deg: float = 1.0
    sessions: int = 10
    seed: int = 1


@dataclass(frozen=True, eq=False)
class Session:
    """A recorded session, the site as the user has it, and the true sensor."""

    log: Log
    site: Site
    true: Sensors


def exactness(rng: np.random.Generator, count: int = 200) -> list[float]:
    """Return the largest relative error of the formulas at each heading, without noise."""
    sensors = draw_sensors(count, rng)
    out = []
    for heading_deg in HEADINGS_DEG:
        measured = read(sensors, positions(heading_deg * DEGREE) @ FIELD_NED, 0.0, rng)
        fit = closed_form(measured, float(FIELD_NED[2]))
        offset = np.max(np.abs(fit.offset - sensors.offset)) / np.max(np.abs(sensors.offset))
        out.append(float(max(np.max(np.abs(fit.matrix - sensors.matrix)), offset)))
    return out


def misprint(ezy: float = 0.02) -> tuple[float, float]:
    """Return what Eq 16 finds for ``ezy`` in readings by Eq 2 as printed, and as corrected."""
    result = []
    for column in (1, 2):  # of the field: y as printed, z as meant
        misalignment = np.zeros((3, 3))
        misalignment[1, column] = ezy
        matrix, offset = from_paper(np.zeros(3), np.ones(3), misalignment)
        measured = positions(0.0) @ FIELD_NED @ matrix.T + offset
        fit = closed_form(measured, float(FIELD_NED[2]))
        result.append(float(to_paper(fit.matrix, fit.offset)[2][1, 2]))
    return result[0], result[1]


def stop_motion(world_from_body: Array, stop: float, move: float) -> tuple[SimulatedMotion, float]:
    """Return a motion that rests in each attitude (n, 3, 3), and its duration (s)."""
    times, rates = [0.0], [0.0]
    for _ in range(len(world_from_body) - 1):
        begin = times[-1] + stop
        times += [begin, begin + _RAMP, begin + move - _RAMP, begin + move]
        rates += [0.0, 1.0, 1.0, 0.0]
    times.append(times[-1] + stop)
    rates.append(0.0)
    progress = BPoly.from_derivatives(times, [[rate, 0.0, 0.0] for rate in rates])
    knots = (move - _RAMP) * np.arange(len(world_from_body))
    attitude = RotationSpline(knots, Rotation.from_matrix(world_from_body))
    middle = np.mean(DEMO_BOX_WORLD, axis=0)
    place = BSpline(np.array([0.0, 1.0]), middle[None], 0)
    return SimulatedMotion(place, attitude, progress), times[-1]


def record(config: Config, attitude_count: int, rng: np.random.Generator) -> Session:
    """Simulate a session of the first positions of the table, set by hand."""
    true = draw_sensors(1, rng)
    declared = demo_site()
    sensor = declared.platform.magnetometer
    nothing = replace(sensor.sigma, matrix=np.zeros((3, 3)), offset=np.zeros(3))
    sensor = replace(sensor, matrix=np.eye(3), offset=np.zeros(3), sigma=nothing)
    platform = replace(declared.platform, magnetometer=sensor)
    site = replace(declared, platform=platform, earth_field_world=FIELD_LEVEL)
    bent = replace(sensor, matrix=true.matrix[0], offset=true.offset[0])
    true_site = replace(site, platform=replace(platform, magnetometer=bent))
    sensor_from_level = positions(0.0) @ LEVEL_FROM_NED.T
    set_down = tilts(config.hand_deg, (1, 12), rng)[0] @ sensor_from_level
    body_from_level = sensor.body_from_sensor @ set_down[:attitude_count]
    motion, duration = stop_motion(np.swapaxes(body_from_level, 1, 2), config.stop, config.move)
    imu = simulate_imu(motion, platform.imu, site.gravity, RATE_HZ, duration, rng)
    drives = synchronised_drives(site)
    waveform = simulate_waveform(motion, true_site, drives, RATE_HZ, duration, rng)
    log = Log("twelve_positions", EPOCH_NS, "simulation", imu.samples, waveform)
    return Session(log, site, true)


def calibrated(session: Session) -> dict[str, float]:
    """Return the errors (deg) of formulas and graph from the stops found in a session."""
    log = session.log
    assert log.waveform is not None
    result = calibrate_log(log.waveform, log.imu, session.site, at_stops=True)
    formulas = closed_form(result.readings.measured_sensor, float(FIELD_NED[2]))
    nothing = MagnetometerFit(np.eye(3), np.zeros(3), np.zeros((12, 12)))
    error = np.concatenate(
        [
            (result.graph.fit.matrix - session.true.matrix[0]).ravel(),
            result.graph.fit.offset - session.true.offset[0],
        ]
    )
    return {
        "uncalibrated": angle_deg(session.true, nothing),
        "formulas": angle_deg(session.true, formulas),
        "graph": angle_deg(session.true, result.graph.fit),
        "graph_nees": float(error @ np.linalg.solve(result.graph.fit.cov, error)),
    }


def run(config: Config) -> dict[str, object]:
    """Return all figures; errors of the sessions as RMS over them, the NEES as a mean."""
    rng = np.random.default_rng(config.seed)
    printed, cleaned = misprint()
    sessions = [calibrated(record(config, 12, rng)) for _ in range(config.sessions)]
    errors = {
        name: float(np.sqrt(np.mean([s[name] ** 2 for s in sessions])))
        for name in ("uncalibrated", "formulas", "graph")
    }
    return {
        "exactness": exactness(rng),
        "ezy_by_printed_eq_2": printed,
        "ezy_by_mended_eq_2": cleaned,
        "session_deg": errors,
        "session_graph_nees": float(np.mean([s["graph_nees"] for s in sessions])),
    }


def turned_about_vertical(rng: np.random.Generator) -> tuple[Array, Array]:
    """Return readings and calibrated fields (n, 3) of one turn on a single-axis table (T)."""
    sensors = draw_sensors(1, rng)
    measured = read(sensors, positions(0.0) @ FIELD_NED, 2e-7, rng)
    fit = closed_form(measured, float(FIELD_NED[2]))
    turn = Rotation.from_euler("z", np.linspace(0.0, 2.0 * np.pi, 73)[:, None])
    readings = read(sensors, turn.inv().apply(FIELD_NED), 2e-7, rng)
    return readings[0], field_from_measured(readings, fit.matrix, fit.offset)[0]


def draw(path: Path, seed: int) -> None:
    """Write the paper's figure 2 as a PNG."""
    pair = turned_about_vertical(np.random.default_rng(seed))
    figure = blank_figure(10.0, 5.0)
    titles = ("before: the readings", "after: the fields")
    for panel, title, field in zip(figure.subplots(1, 2), titles, pair, strict=True):
        panel.plot(*(1e6 * field[:, :2]).T, ".")
        panel.axhline(0.0, c="0.7", lw=0.8)
        panel.axvline(0.0, c="0.7", lw=0.8)
        panel.set(title=title, xlabel="x (µT)", ylabel="y (µT)", aspect="equal")
        panel.set(xlim=(-45.0, 45.0), ylim=(-45.0, 45.0))
    save_picture(figure, path)


def report(result: dict[str, object], config: Config) -> str:
    """Return the table that a reader sees."""
    exact, errors = result["exactness"], result["session_deg"]
    assert isinstance(exact, list)
    assert isinstance(errors, dict)
    lines = ["largest relative error of the formulas without noise (analysis: 1e-14)"]
    lines += [f"  heading {h:5g} deg  {e:.0e}" for h, e in zip(HEADINGS_DEG, exact, strict=True)]
    lines.append("ezy of 0.02 as Eq 16 finds it")
    lines.append(f"  readings by Eq 2 as printed  {result['ezy_by_printed_eq_2']:.4f}")
    lines.append(f"  readings by Eq 2 with Bz     {result['ezy_by_mended_eq_2']:.4f}")
    lines.append(
        f"twelve stops in a stream, set {config.hand_deg:g} deg off: RMS angle of the field"
    )
    lines += [f"  {name:14} {value:8.3f} deg" for name, value in errors.items()]
    lines.append(f"  NEES of the graph's twelve numbers {result['session_graph_nees']:.1f} (12)")
    return "\n".join(lines)


def main() -> None:
    """Print the table and one JSON line."""
    given = scenario_parser(__doc__, Config.seed, quick="two sessions").parse_args()
    config = Config(seed=given.seed, sessions=2 if given.quick else Config.sessions)
    result = run(config)
    if given.output is not None:
        draw(given.output / "twelve_positions.png", config.seed)
    conclude(report(result, config), {"config": asdict(config), **result})


if __name__ == "__main__":
    main()
