"""A head that turns while its tracker measures: slots are not simultaneous, and an IMU knows it.

A tracker in time slots sees each coil at another time.  The scenario turns it at 100 deg/s, about
coils of 4 cm whose size is known to all estimators, by Biot and Savart in what they are given:

1. The closed form takes three slots for one: it is wrong by 0.6 degrees with slots of 5 ms.  When
   each slot is a measurement of its own, at its own time, with the turn between them from the gyro,
   nothing is left, 1e-6 degrees or less without noise.
2. The same in a whole system: a carrier of 10 kHz in slots of 2.5 ms, 100 poses a second, noise of
   60 dB, hum, and an inertial stream.  Fused with it the attitude is fifty times better than the
   closed form's after the fact (the smoother) and forty times at once (the error-state filter),
   with an IMU of 200 Hz as with one of 1 kHz.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from harness import blank_figure, conclude, rms, save_picture, scenario_parser
from scipy.spatial.transform import Rotation, RotationSpline
from time_slots_and_mains import DISTANCE, UNIT, located, tracker
from tracker_poses import world_poses

from magfusion.estimation.batch.batch import smooth
from magfusion.estimation.graph.state import as_trajectory
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.model.field import observe_from
from magfusion.model.samples import FieldSamples, ImuSamples, Log
from magfusion.model.site import Site, Slots
from magfusion.model.trajectory import Trajectory
from magfusion.receiver.receivers import received
from magfusion.simulation.field import phasors_world, synchronised_drives
from magfusion.simulation.inertial import simulate_imu
from magfusion.simulation.motion import ATTITUDE_KNOT, Rests, SimulatedMotion, turning_motion
from magfusion.simulation.waveform import Mains, simulate_waveform
from magfusion.units import DEGREE, Array

CARRIER_HZ = 10e3
SAMPLE_RATE_HZ = 48e3
HANN = 1.5  # what the taper costs in variance
BOX_WORLD = np.array([[0.25, -0.25, -0.25], [0.75, 0.25, 0.25]])  # m
STEPS = 6  # of Gauss and Newton


@dataclass(frozen=True)
class Config:
    """Poses and rates of the skew; the system of the head tracker.

    Parameters
    ----------
    poses : int
    rate_deg_s : float
    slots_ms : tuple of float
    duration : float
        Of the head's motion (s).
    slot_ms : float
        Of the head tracker; four make a cycle.
    snr_db : float
        In each slot, at 0.5 m.
    imu_rates_hz : tuple of float
    """

    poses: int = 400
    rate_deg_s: float = 100.0
    slots_ms: tuple[float, ...] = (1.0, 5.0, 20.0)
    duration: float = 12.0
    slot_ms: float = 2.5
    snr_db: float = 60.0
    imu_rates_hz: tuple[float, ...] = (200.0, 1000.0)
    seed: int = 0


@dataclass(frozen=True)
class Skew:
    """Attitude errors without noise at one slot length (deg, RMS)."""

    slot_ms: float
    together_deg: float  # three slots taken for one, against the middle one's time
    apart_deg: float  # each at its own time


@dataclass(frozen=True)
class Fused:
    """Errors of the head tracker (RMS) against the truth at each estimate's time."""

    imu_rate_hz: float
    rate_deg_s: float  # of the motion, RMS
    snapshot_deg: float
    smoothed_deg: float
    filtered_deg: float
    snapshot_mm: float
    smoothed_mm: float
    filtered_mm: float


def skew(config: Config, slot_ms: float) -> Skew:
    """Measure at random poses, turning about random axes."""
    rng = np.random.default_rng(config.seed)
    n = config.poses
    middle = Rotation.random(n, rng=rng)
    axis, away = rng.standard_normal((2, n, 3))
    axis, away = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (axis, away))
    step = config.rate_deg_s * DEGREE * slot_ms * 1e-3 * axis
    turns = [Rotation.from_rotvec(k * step) for k in (-1.0, 0.0, 1.0)]  # as the gyro tells them
    position = DISTANCE * away
    site = tracker(CARRIER_HZ, Slots(slot_ms * 1e-3, 4))
    field_world = phasors_world(site.beacons[0], position)
    seen = np.stack(
        [(middle * turn).inv().apply(field_world[:, k].real) for k, turn in enumerate(turns)],
        axis=1,
    )
    fix = located(site, seen.astype(np.complex128))
    together = np.swapaxes(fix.sensor_from_beacon, 1, 2)
    start = fix.nearest(position).position_beacon[:, 0]
    separate = slots_apart(site, seen, turns, together, start)
    return Skew(slot_ms, *(rms(_between_deg(result, middle)) for result in (together, separate)))


def slots_apart(
    site: Site, seen: Array, turns: list[Rotation], rotation: Array, position: Array
) -> Array:
    """Return the attitude at the middle slot (n, 3, 3) when each slot is seen at its own time.

    Parameters
    ----------
    site : Site
    seen : ndarray, shape (n, 3, 3)
        Field in each slot (T), sensor axes.
    turns : list of Rotation
        From the body at each slot to that at the middle one.
    rotation, position : ndarray, shape (n, 3, 3) and (n, 3)
        Start.
    """
    beacon, sensor = site.beacons[0], site.platform.magnetometer
    for _ in range(STEPS):
        rows, rest = [], []
        for k, turn in enumerate(turns):
            at_slot = rotation @ turn.as_matrix()
            value, by_pose = observe_from(beacon, sensor, at_slot, position)
            # A turn and a step of the middle pose, in the axes of this slot.
            back = np.swapaxes(turn.as_matrix(), 1, 2)
            jacobian = by_pose[:, k].real
            rows.append(np.concatenate([jacobian[..., :3] @ back, jacobian[..., 3:] @ back], -1))
            rest.append(seen[:, k] - value[:, k].real)
        design, remaining = np.concatenate(rows, axis=1), np.concatenate(rest, axis=1)
        size = np.linalg.norm(design, axis=1, keepdims=True)
        move = (np.linalg.pinv(design / size) @ remaining[..., None])[..., 0] / size[:, 0]
        position = position + (rotation @ move[:, 3:, None])[..., 0]
        rotation = rotation @ Rotation.from_rotvec(move[:, :3]).as_matrix()
    return rotation


def head_motion(config: Config) -> SimulatedMotion:
    """Return a head in a volume of half a metre: two seconds of rest, then turns without pause.

    Every second it turns by the rate about an axis of its own, so that it never turns much slower.
    """
    rng = np.random.default_rng(config.seed)
    rests = Rests(start=2.0, move=config.duration)
    path = turning_motion(rng, config.duration, BOX_WORLD, speed=0.3, rests=rests)
    knots = np.arange(np.ceil(config.duration / ATTITUDE_KNOT) + 2) * ATTITUDE_KNOT
    attitude, axis = [Rotation.random(rng=rng)], rng.standard_normal(3)
    for _ in knots[1:]:
        axis = axis / np.linalg.norm(axis) + 0.3 * rng.standard_normal(3)
        turn = config.rate_deg_s * DEGREE * ATTITUDE_KNOT * axis / np.linalg.norm(axis)
        attitude.append(attitude[-1] * Rotation.from_rotvec(turn))
    return replace(path, attitude=RotationSpline(knots, Rotation.concatenate(attitude)))


def head_site(config: Config) -> Site:
    """Return the tracker with the noise of the given SNR, and an Earth field."""
    duration = config.slot_ms * 1e-3
    sigma = 10.0 ** (-config.snr_db / 20.0) * UNIT
    density = sigma * np.sqrt(duration / HANN)
    site = tracker(CARRIER_HZ, Slots(duration, 4), density, -np.pi / 2.0)
    return replace(site, earth_field_world=np.array([0.0, 2e-5, -5e-5]))


def fuse(config: Config, imu_rate_hz: float) -> Fused:
    """Simulate one head, and estimate its motion in three ways from the same samples."""
    site, motion = head_site(config), head_motion(config)
    rng = np.random.default_rng(config.seed + 1)
    imu = simulate_imu(
        motion, site.platform.imu, site.gravity, imu_rate_hz, config.duration, rng
    ).samples
    waveform = simulate_waveform(
        motion,
        site,
        synchronised_drives(site),
        SAMPLE_RATE_HZ,
        config.duration,
        rng,
        Mains(0.15e-6, 49.8),
    )
    slots, _ = received(waveform, imu, site)
    log = Log("head", 0, "simulation", imu, waveform)
    smoothed = smooth(log, site).states
    filtered = navigate(site, imu, slots)
    snapshot = snapshots(site, slots, motion)
    # Where all three are, and the head turns.
    begin = max(filtered.time[0], 3.0)
    errors = [_errors(result, motion, begin) for result in (snapshot, smoothed, filtered)]
    time = snapshot.time[snapshot.time >= begin]
    rate = np.linalg.norm(motion.rate_body(time), axis=1) / DEGREE
    return Fused(imu_rate_hz, rms(rate), *(e[0] for e in errors), *(e[1] for e in errors))


def snapshots(site: Site, slots: FieldSamples, motion: SimulatedMotion) -> Trajectory:
    """Return the closed form of each cycle, its three slots taken for one, at their mean time."""
    beacon = site.beacons[0]
    assert beacon.slots is not None
    order = beacon.slots.running(slots.time) // beacon.slots.count
    _, cycle, fixed = np.unique(order, return_inverse=True, return_counts=True)
    time = (np.bincount(cycle, slots.time) / fixed)[fixed == 3]
    row, channel = np.nonzero(slots.valid)
    phasor = np.full((len(fixed), *slots.phasor_sensor.shape[1:]), np.nan, dtype=np.complex128)
    phasor[cycle[row], channel] = slots.phasor_sensor[row, channel]
    fix = located(site, phasor[fixed == 3])
    guess = (motion.position_world(time) - beacon.position_world) @ beacon.world_from_beacon
    attitude, position = world_poses(site, beacon, fix.nearest(guess))
    return Trajectory(time, attitude[:, 0], position[:, 0])


def navigate(site: Site, imu: ImuSamples, slots: FieldSamples) -> Trajectory:
    """Return the states of the error-state filter, fed as the samples come."""
    filter_ = Navigator(site, NavigatorSettings(estimator="ekf", start_duration=2.0))
    edges = np.arange(0.1, imu.time[-1] + 0.1, 0.1)
    for begin, end in zip(edges - 0.1, edges, strict=True):
        now = (imu.time >= begin) & (imu.time < end)
        filter_.add_imu(imu.time[now], imu.gyro_body[now], imu.accel_body[now])
        now = (slots.time >= begin) & (slots.time < end)
        if np.any(now):
            filter_.add_fields(
                replace(
                    slots,
                    time=slots.time[now],
                    window=slots.window[now],
                    phasor_sensor=slots.phasor_sensor[now],
                    phasor_cov=slots.phasor_cov[now],
                )
            )
    return as_trajectory(filter_.take())


def _errors(result: Trajectory, motion: SimulatedMotion, begin: float) -> tuple[float, float]:
    used = result.time >= begin
    time = result.time[used]
    attitude = _between_deg(result.world_from_body[used], motion.world_from_body(time))
    position = result.position_world[used] - motion.position_world(time)
    return rms(attitude), 1e3 * rms(np.linalg.norm(position, axis=1))


def _between_deg(result: Array, true: Rotation) -> Array:
    turn = true.inv() * Rotation.from_matrix(result)
    return np.asarray(turn.magnitude() / DEGREE)


def report(skews: list[Skew], fused: list[Fused]) -> str:
    """Return the tables that a reader sees."""
    lines = ["100 deg/s, no noise: attitude RMS (deg)   together              apart"]
    for one in skews:
        lines.append(
            f"{'slots of':>24}{one.slot_ms:4g} ms {one.together_deg:16.3f}{'':11}"
            f"{one.apart_deg:11.1e}"
        )
    lines.append("head tracker, 100 cycles a second, 60 dB: RMS of attitude (deg), position (mm)")
    lines.append(f"{'IMU':>10}{'turning':>12}{'closed form':>20}{'smoother':>20}{'filter':>20}")
    for run in fused:
        pairs = (
            (run.snapshot_deg, run.snapshot_mm),
            (run.smoothed_deg, run.smoothed_mm),
            (run.filtered_deg, run.filtered_mm),
        )
        cells = "".join(f"{a:12.4f}{p:8.3f}" for a, p in pairs)
        lines.append(f"{run.imu_rate_hz:7g} Hz{run.rate_deg_s:7.0f} deg/s{cells}")
    return "\n".join(lines)


def draw(path: Path, fused: list[Fused]) -> None:
    """Write a PNG of the attitude errors."""
    figure = blank_figure(6.0, 4.0)
    axes = figure.subplots()
    names = ("closed form", "filter", "smoother")
    for i, run in enumerate(fused):
        height = (run.snapshot_deg, run.filtered_deg, run.smoothed_deg)
        place = np.arange(3) + 0.8 / len(fused) * i
        axes.bar(place, height, 0.75 / len(fused), label=f"IMU at {run.imu_rate_hz:g} Hz")
    axes.set_xticks(np.arange(3) + 0.4 - 0.4 / len(fused), names)
    axes.set(yscale="log", ylabel="attitude RMS (deg)")
    axes.set_title("Turning at 100 deg/s, slots of 2.5 ms, 60 dB")
    axes.legend()
    save_picture(figure, path)


def main() -> None:
    """Print the tables and one JSON line; draw them where a directory is given."""
    given = scenario_parser(__doc__, Config.seed, quick="five seconds, one IMU").parse_args()
    config = Config(seed=given.seed)
    if given.quick:
        config = replace(config, duration=5.0, imu_rates_hz=(500.0,))
    skews = [skew(config, slot_ms) for slot_ms in config.slots_ms]
    fused = [fuse(config, rate_hz) for rate_hz in config.imu_rates_hz]
    if given.output is not None:
        draw(given.output / "tracker_motion_skew.png", fused)
    conclude(report(skews, fused), {"skew": skews, "fused": fused})


if __name__ == "__main__":
    main()
