"""A tracker of three wound coils in time slots, navigated live through the pipe.

Raw samples at 20 kHz come from code that shares nothing with the estimators: every turn of every
winding by elliptic integrals, a drive that drifts, steps of a 16-bit converter, mains, the Earth
field, and a head that turns at 100 deg/s, rests and turns again.  `magfusion navigate -` reads
them with an inertial stream as records of 10 ms, and the scenario tells

1. how far its states are from the truth at rest and turning, and how many there are a second;
2. how far those are that it predicts to the instant of a display, 20 ms ahead of the samples;
3. what a second of data takes of a processor once it has begun, beside the start;
4. with ``--plate``, how soon a plate of aluminium that is moved beside the head is said, and
   whether the sigmas hold meanwhile.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from harness import conclude, rms, scenario_parser
from moving_plate import Plate
from scipy.interpolate import CubicSpline, make_interp_spline
from scipy.spatial.transform import Rotation, RotationSpline
from scipy.special import ellipe, ellipk

from magfusion.units import DEGREE, Array, ComplexArray

CARRIER_HZ, RATE_HZ, FIELD_KNOTS_HZ = 6000.0, 20e3, 1000.0
LAYERS, ROWS, WIRE, CURRENT = 8, 20, 5e-4, 1.0  # m, A
FORMERS = (0.020, 0.026, 0.032)  # m; of the coils, one about the other
EARTH_WORLD = np.array([0.0, 2e-5, -4.5e-5])  # T
GRAVITY = 9.80665
BITS, RANGE = 16, 100e-6  # T
PIECE = 0.01  # s
SOURCE_PPM = 20.0  # of a crystal
UNKNOWN = 0.0123  # s; when a cycle of a clock of its own begins
RESTING, TURNING = 5.0, 8.5  # s; it turns at its full rate until a second before, and from then
CHANGE, BEGUN = 1.0, 6.5  # s; from rest to the full rate, and from when states are compared
PLATE_CENTRE, PLATE_FAR = np.array([0.3, 0.16, 0.0]), 1.0  # m; held there, and from how far beside
WRONG_SIDE = 0.2  # m; the source is farther away
PLATE_NEAR, PLATE_RUN = 0.01, 18.5  # share of the fields; s
PLATE_COMES, PLATE_HELD, PLATE_MOVES, PLATE_KNOTS_HZ = 9.5, 4.0, 1.0, 50.0  # s

REGION = """region:
  half_space: {normal: [1, 0, 0]}
"""
IMU = """  imu:
    gyro_noise: 1.0e-4
    accel_noise: 1.0e-3
    gyro_bias_walk: 1.0e-6
    accel_bias_walk: 1.0e-5
    gyro_bias_sigma: 5.0e-3
    accel_bias_sigma: 0.05
    time_offset_sigma_s: 0.001
"""
PRIOR = """  motion_prior:
    accel_density_m_s2_rthz: 2.0
    angular_accel_density_rad_s2_rthz: 3.0
"""


@dataclass(frozen=True)
class Config:
    """One run.

    Parameters
    ----------
    duration : float
        (s)
    rate_deg_s : float
        While turning, about.
    noise : float
        Of a sample (T).
    mains : float
        Amplitude of its fundamental (T).
    drive_drift : float
        Share of the current that is lost in a minute.
    imu_rate_hz : float
    ahead : float
        Of the display's instant (s).
    source_ppm : float, optional
        By how much the clock of the source runs fast, which is then its own: when a cycle begins
        the site does not say, a fourth slot is silent, and the stream must tell.
    plate : bool
        Whether a plate of aluminium is brought beside the head, held there, and taken away.
    hemisphere : bool
        Whether the site says on which side of the source the head is.
    inertial : bool
        Whether there is an IMU; else the site has a motion prior.
    rate_hz : float
        Cycles a second.
    carrier_hz : float
        Zero of pulses of direct current.
    """

    duration: float = 16.0
    rate_deg_s: float = 100.0
    noise: float = 1e-9
    mains: float = 0.15e-6
    drive_drift: float = 1e-3
    imu_rate_hz: float = 500.0
    ahead: float = 0.02
    source_ppm: float | None = None
    plate: bool = False
    hemisphere: bool = True
    inertial: bool = True
    rate_hz: float = 120.0
    carrier_hz: float = CARRIER_HZ
    seed: int = 0

    @property
    def cycle(self) -> float:
        """Duration of a cycle (s)."""
        return 1.0 / self.rate_hz

    @property
    def slots(self) -> int:
        """Of a cycle."""
        return 3 if self.source_ppm is None else 4


@dataclass(frozen=True)
class Figures:
    """What a run of the pipe gave; errors are root mean squares, of position in mm."""

    states_per_s: float
    rest_mm: float
    rest_deg: float
    turning_mm: float
    turning_deg: float
    ahead_mm: float
    ahead_deg: float
    turned_deg_s: float
    processor_share: float  # seconds of processor for a second of data
    python_ms: float  # a million turns of an empty loop, in the same run


@dataclass(frozen=True)
class SideFigures:
    """What the states say of the side of the source, where nobody told it."""

    first_s: float  # of the states
    ambiguous: float  # share of the states that say so
    wrong: float  # share that do not, and are on the other side
    mm: float  # of those that do not


@dataclass(frozen=True)
class PlateFigures:
    """What a plate did to a run of the pipe: positions in mm, mean squared errors in variances."""

    largest_share: float  # of the fields
    said_after_s: float  # it made a hundredth of them
    wrongly_said: int  # states before
    poses: float  # share of the states that have one while it is there
    nees: float  # of the poses from when it made a hundredth of the fields until it is gone
    error_mm: float
    error_deg: float
    after_mm: float  # two seconds after it has gone
    after_nees: float


def loop_field(radius: float, place: Array) -> Array:
    """Return the field (T) of 1 A in a loop about z, at places (n, 3) (m)."""
    x, y, z = place.T
    rho = np.maximum(np.hypot(x, y), 1e-9)
    far, near = (radius + rho) ** 2 + z**2, (radius - rho) ** 2 + z**2
    m = 1.0 - near / far
    k, e = ellipk(m), ellipe(m)
    scale = 2e-7 / np.sqrt(far)
    along = scale * (k + (radius**2 - rho**2 - z**2) / near * e)
    across = scale * z / rho * (-k + (radius**2 + rho**2 + z**2) / near * e)
    return np.stack([across * x / rho, across * y / rho, along], axis=1)


def winding_field(former: float, axis: int, place: Array) -> Array:
    """Return the field (T) of all turns of a coil along an axis of the source."""
    own = np.roll(place, 2 - axis, axis=1)
    field = np.zeros_like(own)
    for layer in range(LAYERS):
        for row in range(ROWS):
            height = (row - 0.5 * (ROWS - 1)) * WIRE
            turn = own - [0.0, 0.0, height]
            field += CURRENT * loop_field(former + (layer + 0.5) * WIRE, turn)
    return np.roll(field, axis - 2, axis=1)


class Head:
    """Turns while it sways by centimetres, rests, and turns again."""

    def __init__(self, config: Config) -> None:
        rng = np.random.default_rng(config.seed)
        knots = np.arange(0.0, config.duration + 3.0, 0.5)
        turn, axis = [Rotation.random(rng=rng)], rng.standard_normal(3)
        for _ in knots[1:]:
            axis = axis / np.linalg.norm(axis) + 0.3 * rng.standard_normal(3)
            step = config.rate_deg_s * DEGREE * 0.5 * axis / np.linalg.norm(axis)
            turn.append(turn[-1] * Rotation.from_rotvec(step))
        sway = np.array([0.45, 0.0, -0.05]) + rng.uniform(-0.08, 0.08, (len(knots), 3))
        self._turn = RotationSpline(knots, Rotation.concatenate(turn))
        self._place = make_interp_spline(knots, sway, 5)

    @staticmethod
    def _run(time: Array) -> tuple[Array, Array, Array]:
        """Return how far along its path it is (s), how fast that grows, and how fast this does."""
        far, speed, growth = time.copy(), np.ones(len(time)), np.zeros(len(time))
        for sign, begin in ((-1.0, RESTING - CHANGE), (1.0, TURNING - CHANGE)):
            share = np.clip((time - begin) / CHANGE, 0.0, 1.0)
            beyond = np.maximum(time - begin - CHANGE, 0.0)
            far += sign * (CHANGE * (share**3 - 0.5 * share**4) + beyond)
            speed += sign * (3.0 * share**2 - 2.0 * share**3)
            growth += sign * 6.0 * (share - share**2) / CHANGE
        return far, speed, growth

    def place(self, time: Array) -> Array:
        """Return the position (n, 3) (m)."""
        return np.asarray(self._place(self._run(time)[0]))

    def turn(self, time: Array) -> Rotation:
        """Return world_from_body."""
        return self._turn(self._run(time)[0])

    def rate_body(self, time: Array) -> Array:
        """Return the angular rate (n, 3) (rad/s)."""
        far, speed, _ = self._run(time)
        return np.asarray(self._turn(far, 1) * speed[:, None])

    def accel_world(self, time: Array) -> Array:
        """Return the acceleration (n, 3) (m/s^2)."""
        far, speed, growth = self._run(time)
        own = self._place(far, 2) * speed[:, None] ** 2 + self._place(far, 1) * growth[:, None]
        return np.asarray(own)

    def imu(self, config: Config, rng: np.random.Generator) -> tuple[Array, Array, Array]:
        """Return stamps, rates and specific forces of a good consumer's IMU."""
        step = 1.0 / config.imu_rate_hz
        time = np.arange(0.0, config.duration, step)
        gyro = self.rate_body(time)
        force_world = self.accel_world(time) + np.array([0.0, 0.0, GRAVITY])
        accel = self.turn(time).inv().apply(force_world)
        white = np.sqrt(config.imu_rate_hz)
        gyro = gyro + 2e-3 * rng.standard_normal(3) + 1e-4 * white * rng.standard_normal(gyro.shape)
        accel = accel + 0.03 * rng.standard_normal(3)
        return time, gyro, accel + 1e-3 * white * rng.standard_normal(accel.shape)


def sample_times(config: Config) -> Array:
    """Return the stamps of the converter (s)."""
    return np.arange(int(config.duration * RATE_HZ)) / RATE_HZ


def waveform(
    config: Config, head: Head, rng: np.random.Generator, gates: Array | None = None
) -> tuple[Array, Array]:
    """Return stamps and what the converter gives of three axes (T).

    Parameters
    ----------
    gates : ndarray, shape (n, 3), optional
        Share of its current that each coil has at each sample, where no clock tells.
    """
    time = sample_times(config)
    knots = np.arange(0.0, config.duration + 2.0 / FIELD_KNOTS_HZ, 1.0 / FIELD_KNOTS_HZ)
    own_clock = (
        time if config.source_ppm is None else (time - UNKNOWN) * (1 + 1e-6 * config.source_ppm)
    )
    slot = np.floor(own_clock / config.cycle * config.slots + 1e-9).astype(int) % config.slots
    if gates is None:
        gates = (slot[:, None] == np.arange(3)).astype(float)
    current = np.exp(2j * np.pi * config.carrier_hz * own_clock)
    current *= 1.0 - config.drive_drift * time / 60.0
    coarse = np.arange(0.0, config.duration + 2.0 / PLATE_KNOTS_HZ, 1.0 / PLATE_KNOTS_HZ)
    metal = plate_fields(head, coarse)[0] if config.plate else None
    world_from_body = head.turn(knots)
    body = CubicSpline(knots, world_from_body.inv().apply(EARTH_WORLD))(time)
    for axis, former in enumerate(FORMERS):
        coil_world = winding_field(former, axis, head.place(knots))
        driven = (gates[:, axis] * current)[:, None]
        own = CubicSpline(knots, world_from_body.inv().apply(coil_world))(time)
        body += driven.real * own
        if metal is not None:
            added = CubicSpline(coarse, metal[axis])(knots)
            for wave, part in ((driven.real, added.real), (-driven.imag, added.imag)):
                body += wave * CubicSpline(knots, world_from_body.inv().apply(part))(time)
    hum = sum(
        share * np.cos(2.0 * np.pi * order * 49.97 * time + phase)
        for order, share, phase in ((1, 1.0, 0.3), (3, 0.3, 1.1), (5, 0.1, 2.0))
    )
    toward = CubicSpline(knots, world_from_body.inv().apply([0.6, 0.0, 0.8]))(time)
    body += config.mains * np.asarray(hum)[:, None] * toward
    body += config.noise * rng.standard_normal(body.shape)
    step = 2.0 * RANGE / 2**BITS
    return time, step * np.round(body / step)


def plate_centre(time: Array) -> Array:
    """Return where the plate is (n, 3) (m)."""
    leaves = PLATE_COMES + PLATE_MOVES + PLATE_HELD
    come, gone = (
        np.clip((time - begin) / PLATE_MOVES, 0.0, 1.0) for begin in (PLATE_COMES, leaves)
    )
    away = 1.0 - come**2 * (3.0 - 2.0 * come) + gone**2 * (3.0 - 2.0 * gone)
    return np.asarray(PLATE_CENTRE + away[:, None] * [0.0, PLATE_FAR, 0.0])


def plate_fields(head: Head, time: Array) -> tuple[ComplexArray, Array]:
    """Return what the plate adds to each coil (3, n, 3) (T), and its share of the fields (n,)."""
    place, centre, plate = head.place(time), plate_centre(time), Plate()
    added, whole = [], []
    for axis, former in enumerate(FORMERS):
        coil = partial(winding_field, former, axis)
        added.append(plate.added(coil, centre, place, CARRIER_HZ))
        whole.append(coil(place))
    share = np.linalg.norm(added, axis=(0, 2)) / np.linalg.norm(whole, axis=(0, 2))
    return np.array(added), share


def site_text(config: Config) -> str:
    """Return the site as its owner would write it."""
    coils = "".join(
        f"""
      - slot: {axis}
        winding:
          axis: {np.eye(3)[axis].tolist()}
          current_a: {CURRENT}
          layers: {LAYERS}
          rows: {ROWS}
          inner_radius_m: {former}
          wire_m: {WIRE}"""
        for axis, former in enumerate(FORMERS)
    )
    return f"""magfusion_site: 1
world:
  gravity_m_s2: {GRAVITY}
  earth_field_t: {EARTH_WORLD.tolist()}
  model_error: 0.002
beacons:
  - name: T
    position_m: [0, 0, 0]
    rpy_deg: [0, 0, 0]
    frequency_hz: {config.carrier_hz}
    slots: {{duration_s: {config.cycle / config.slots!r}, count: {config.slots}}}
    synchronised: {"true" if config.source_ppm is None else "false"}
    coils:{coils}
{REGION if config.hemisphere else ""}platform:
{IMU if config.inertial else PRIOR}  magnetometer:
    noise_density_t_rthz: 1.4e-11
"""


def records(config: Config) -> bytes:
    """Return the streams as the lines that a driver would write, every hundredth of a second."""
    rng = np.random.default_rng(config.seed + 1)
    head = Head(config)
    wave, imu = waveform(config, head, rng), head.imu(config, rng)
    lines, edges = [], PIECE * np.arange(round(config.duration / PIECE) + 1)
    for begin, end in pairwise(edges.tolist()):
        own = slice(*np.searchsorted(imu[0], [begin - 1e-9, end - 1e-9]))
        rows = slice(*np.searchsorted(wave[0], [begin - 1e-9, end - 1e-9]))
        record: dict[str, Any] = {
            "magnetometer": {"time": wave[0][rows].tolist(), "field": wave[1][rows].tolist()},
        }
        if config.inertial:
            parts = (part[own].tolist() for part in imu)
            record = {"imu": dict(zip(("time", "gyro", "accel"), parts, strict=True))} | record
        lines.append(json.dumps(record).encode())
    return b"\n".join(lines) + b"\n"


def piped(site: Path, given: bytes, *options: str) -> tuple[list[dict[str, Any]], float]:
    """Return the states that the pipe gives, and the processor time that it took (s)."""
    command = [sys.executable, "-m", "magfusion", "navigate", "-", "--site", str(site)]
    with tempfile.TemporaryFile() as source, tempfile.TemporaryFile() as sink:
        source.write(given)
        source.seek(0)
        process = subprocess.Popen(
            [*command, "--estimator", "ekf", *options], stdin=source, stdout=sink
        )
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise SystemExit(process.returncode)
        sink.seek(0)
        states = [json.loads(line) for line in sink]
    return [s for s in states if s["started"]], usage.ru_utime + usage.ru_stime


def errors(states: list[dict[str, Any]], head: Head, begin: float, end: float) -> Array:
    """Return the RMS errors of the states of a stretch: position (mm), attitude (deg)."""
    some = [s for s in states if begin <= s["time"] < end and not s["lost"]]
    if not some:
        return np.full(2, np.inf)
    time = np.array([s["time"] for s in some])
    place = np.array([s["position"] for s in some]) - head.place(time)
    quaternion = np.array([s["quaternion"] for s in some])
    turn = head.turn(time).inv() * Rotation.from_quat(quaternion, scalar_first=True)
    return np.array([1e3 * rms(np.linalg.norm(place, axis=1)), rms(turn.magnitude() / DEGREE)])


def nees(states: list[dict[str, Any]], head: Head) -> float:
    """Return the mean squared error of poses, each component in units of its sigma."""
    time = np.array([s["time"] for s in states])
    sigma = np.array([[s["sigma"]["position"], s["sigma"]["rotation_body"]] for s in states])
    place = np.array([s["position"] for s in states]) - head.place(time)
    quaternion = np.array([s["quaternion"] for s in states])
    turn = head.turn(time).inv() * Rotation.from_quat(quaternion, scalar_first=True)
    return float(np.mean(np.sum((np.stack([place, turn.as_rotvec()], 1) / sigma) ** 2, (1, 2))))


def run_beside_plate(config: Config) -> PlateFigures:
    """Simulate a head beside which a plate is moved, and navigate it through the pipe."""
    given, head = records(config), Head(config)
    with tempfile.TemporaryDirectory() as directory:
        site = Path(directory) / "site.yaml"
        site.write_text(site_text(config))
        states, _ = piped(site, given)
    time = np.arange(0.0, config.duration, 0.02)
    share = plate_fields(head, time)[1]
    near, gone = time[share > PLATE_NEAR][[0, -1]]
    said = [s["time"] for s in states if any(r["code"] == "metal_near" for r in s["reasons"])]
    there = [s for s in states if near <= s["time"] < gone]
    posed = [s for s in there if not s["lost"]]
    after = [s for s in states if s["time"] >= gone + 2.0 and not s["lost"]]
    return PlateFigures(
        float(np.max(share)),
        next((t for t in said if t >= near), np.inf) - near,
        sum(t < PLATE_COMES for t in said),
        len(posed) / len(there),
        nees(posed, head),
        *errors(posed, head, near, gone),
        errors(after, head, gone, config.duration)[0],
        nees(after, head),
    )


def run_without_hemisphere(config: Config) -> SideFigures:
    """Navigate a head through the pipe where no side of the source is told."""
    given, head = records(replace(config, hemisphere=False)), Head(config)
    with tempfile.TemporaryDirectory() as directory:
        site = Path(directory) / "site.yaml"
        site.write_text(site_text(replace(config, hemisphere=False)))
        states, _ = piped(site, given)
    sure = [s for s in states if not s["ambiguous"] and not s["lost"]]
    place = np.array([s["position"] for s in sure]).reshape(-1, 3)
    off = np.linalg.norm(place - head.place(np.array([s["time"] for s in sure])), axis=1)
    wrong, found = int(np.sum(off > WRONG_SIDE)), off[off <= WRONG_SIDE]
    return SideFigures(
        states[0]["time"],
        sum(bool(s["ambiguous"]) for s in states) / len(states),
        wrong / len(states),
        1e3 * rms(found) if len(found) else np.inf,
    )


def python_ms() -> float:
    """Return the processor time of a million turns of an empty loop (ms): that of the machine."""
    began = time.process_time()
    for _ in range(1_000_000):
        pass
    return 1e3 * (time.process_time() - began)


def run(config: Config) -> Figures:
    """Simulate one head, and navigate it through the pipe."""
    given, head = records(config), Head(config)
    with tempfile.TemporaryDirectory() as directory:
        site = Path(directory) / "site.yaml"
        site.write_text(site_text(config))
        beginning = b"\n".join(given.splitlines()[: int(BEGUN / PIECE)]) + b"\n"
        _, startup = piped(site, beginning)
        speed = python_ms()
        states, seconds = piped(site, given)
        speed = 0.5 * (speed + python_ms())
        rate = f"{config.rate_hz:g}"
        carried, _ = piped(site, given, "--rate", rate, "--horizon", str(config.ahead))
    end = config.duration
    turned = np.linalg.norm(head.rate_body(np.arange(TURNING, end, 0.01)), axis=1)
    told = [s for s in states if s["time"] >= BEGUN and not s["lost"]]
    return Figures(
        len(told) / (end - BEGUN),
        *errors(states, head, BEGUN, TURNING - CHANGE),
        *errors(states, head, TURNING, end),
        *errors(carried, head, TURNING, end),
        rms(turned) / DEGREE,
        (seconds - startup) / (end - BEGUN),
        speed,
    )


def report(found: Figures) -> str:
    """Return the table that a reader sees."""
    return "\n".join(
        [
            "three wound coils, 0.3 to 0.6 m away",
            f"{'states a second':<32}{found.states_per_s:8.1f}",
            f"{'at rest':<32}{found.rest_mm:8.3f} mm {found.rest_deg:7.3f} deg",
            f"{'turning, ' + format(found.turned_deg_s, '.0f') + ' deg/s':<32}"
            f"{found.turning_mm:8.3f} mm {found.turning_deg:7.3f} deg",
            f"{'predicted to the display':<32}{found.ahead_mm:8.3f} mm {found.ahead_deg:7.3f} deg",
            f"{'processor for a second':<32}{found.processor_share:8.2f} s"
            f" (a million empty turns: {found.python_ms:.0f} ms)",
        ]
    )


def report_of_plate(found: PlateFigures) -> str:
    """Return what a reader sees of the run beside a plate."""
    return "\n".join(
        [
            f"a plate of aluminium makes up to {100 * found.largest_share:.1f} % of the fields",
            f"said {found.said_after_s:.2f} s after it made {100 * PLATE_NEAR:g} %;"
            f" before it came, {found.wrongly_said} states said so",
            f"{'while it is there':<32}{found.error_mm:8.3f} mm {found.error_deg:7.3f} deg,"
            f" NEES {found.nees:.1f}, poses in {100 * found.poses:.0f} %",
            f"{'after it':<32}{found.after_mm:8.3f} mm, NEES {found.after_nees:.1f}",
        ]
    )


def main() -> None:
    """Print the table and one JSON line."""
    parser = scenario_parser(__doc__, Config.seed, quick="four seconds of turning")
    parser.add_argument("--plate", action="store_true", help="beside a moving plate alone")
    parser.add_argument("--no-hemisphere", action="store_true", help="no side is told, alone")
    parser.add_argument("--no-imu", action="store_true", help="without an IMU, 60 cycles a second")
    parser.add_argument("--rate", type=float, default=Config.rate_deg_s, help="of turning (deg/s)")
    given = parser.parse_args()
    config = Config(seed=given.seed, rate_deg_s=given.rate)
    if given.no_hemisphere:
        side = run_without_hemisphere(replace(config, duration=TURNING + 2.0))
        told_of_side = (
            f"first state {side.first_s:.1f} s after the data begin; {100 * side.ambiguous:.0f} %"
            f" say ambiguous, {100 * side.wrong:.1f} % are wrong and do not; the others err by"
            f" {side.mm:.2f} mm"
        )
        conclude(told_of_side, side)
        return
    if given.plate:
        beside = run_beside_plate(replace(config, duration=PLATE_RUN, plate=True))
        conclude(report_of_plate(beside), beside)
        return
    if given.quick:
        config = replace(config, duration=TURNING + 4.0)
    if given.no_imu:
        alone = run(replace(config, inertial=False, rate_hz=60.0))
        conclude(report(alone), alone)
        return
    known, searched = run(config), run(replace(config, source_ppm=SOURCE_PPM))
    told = [report(known), "a clock of its own, slots found in the stream:", report(searched)]
    conclude("\n".join(told), {"known": known, "searched": searched})


if __name__ == "__main__":
    main()
