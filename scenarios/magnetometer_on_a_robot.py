"""A magnetometer calibrated by what a robot's computer records: jitter, iron, little turning.

After a real recording: an RM3100 on a robot arm at 100 Hz, steps of 13 nT, in 90 uT of hard iron,
stamped by a host whose intervals are 2 to 17 ms, or by bursts of a bus that repeat stamps.  The
arm turns it by 20 to 180 degrees about one, two or three axes.  The site declares the Earth's field
there, or a location's where steel in a building left 30 uT of 48, or none; and of the sensor's
offset of the data sheet (2 uT), room for iron (60 uT), or nothing.

The rule, stated before the runs: what the job calls determined is within 3 uT of the truth, and all
that it writes without refusing within 3.5 of its sigmas.  `wrong` counts what breaks it.  How many
are refused is reported, not judged: twenty degrees about one axis do not determine 90 uT.

The simulation shares nothing with the calibration: angles of joints in, samples out.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np
from harness import conclude, scenario_parser
from scipy.spatial.transform import Rotation

from magfusion.errors import EstimationError, InputError
from magfusion.estimation.data_checks.data_cleaning import clean_log
from magfusion.jobs.magnetometer_trust import calibrated, estimates_of
from magfusion.model.platform_motion import NO_IMU
from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.model.site import (
    EarthModel,
    ImuModel,
    Magnetometer,
    MagnetometerSigma,
    Platform,
    Site,
)
from magfusion.model.trust import Verdict
from magfusion.model.without_imu import logged
from magfusion.units import DEGREE, Array

EARTH_WORLD = np.array([0.0, 1.9e-5, -4.4e-5])  # T; 48 uT
INDOORS_WORLD = np.array([0.6e-5, 1.9e-5, -2.24e-5])  # T; 30 uT, beside steel
HARD_IRON = 9e-5  # T
SOFT_IRON, MISALIGNED = 0.03, 1.0 * DEGREE
STEP = 13e-9  # T; of the RM3100 at 200 cycle counts
NOISE = 15e-9  # T, of a sample
MAGNETOMETER_HZ, IMU_HZ = 100.0, 200.0
GRAVITY = 9.81
LEVER = np.array([0.08, -0.03, 0.05])  # m; of the IMU from the wrist
FINE = 1e-3  # s; of the true motion

TURNS_DEG = (20.0, 45.0, 90.0, 180.0)
AXES = (1, 2, 3)
Host = Literal["jitter", "bursts"]
HOSTS: tuple[Host, ...] = ("jitter", "bursts")
Field = Literal["as declared", "30 uT indoors", "not declared"]
FIELDS: tuple[Field, ...] = ("as declared", "30 uT indoors", "not declared")
Declared = Literal["sheet", "room for iron", "nothing"]
OFFSET_SIGMA: dict[Declared, float] = {"sheet": 2e-6, "room for iron": 6e-5, "nothing": 0.0}
MATRIX_SIGMA: dict[Declared, float] = {"sheet": 0.01, "room for iron": 0.05, "nothing": 0.0}

LIMIT = 3e-6  # T; the rule
SIGMAS = 3.5


@dataclass(frozen=True)
class Case:
    """One recording: how it was turned, stamped, and what its site declares."""

    turn_deg: float
    axes: int
    host: Host
    field: Field
    declared: Declared
    imu: bool = True
    seed: int = 1
    duration: float = 60.0


@dataclass(frozen=True)
class Row:
    """What the job made of a case (uT): ``sigma`` and ``error`` are the largest of the axes."""

    case: Case
    verdict: str
    error_ut: float | None
    sigma_ut: float | None
    determined: int
    wrong: bool
    findings: str


def joint_angles(case: Case, time: Array, rng: np.random.Generator) -> Array:
    """Return angles about the wrist's z, y and x (rad), shape (n, 3): moves between way points."""
    half = 0.5 * case.turn_deg * DEGREE
    angles = np.zeros((len(time), 3))
    for axis in range(case.axes):
        move = rng.uniform(1.5, 3.0)
        count = int(time[-1] / move) + 3
        points = np.where(np.arange(count) % 2, 1.0, -1.0) * rng.uniform(0.6, 1.0, count) * half
        points[:2] = [-half, half]
        phase = np.clip((time % move) / (0.8 * move), 0.0, 1.0)  # and then it dwells
        smooth = phase**3 * (10.0 - 15.0 * phase + 6.0 * phase**2)
        at = (time / move).astype(int)
        angles[:, axis] = points[at] + smooth * (points[at + 1] - points[at])
    return angles


def stamps(selected: Array, host: Host, rng: np.random.Generator) -> Array:
    """Return when samples arrived by the host's clock (s), equal within a packet of the bus."""
    step = float(np.median(np.diff(selected)))
    if host == "bursts":
        poll = 0.02 + 0.02 * rng.random()
        begun = poll * rng.random()
        arrived = begun + poll * np.ceil((selected - begun) / poll)
        within = np.concatenate([[0.0], np.diff(arrived)]) == 0.0
        place = np.arange(len(selected)) - np.maximum.accumulate(
            np.where(within, 0, np.arange(len(selected)))
        )
        arrived = arrived + 2e-4 * rng.random(len(selected))[0] + 1e-4 * place
        return np.asarray(arrived)
    late = rng.uniform(0.0, 0.75, len(selected)) * step
    fixed = rng.random(len(selected)) < 0.01
    late[fixed] += 2.5 * step
    # No sample overtakes another: those behind one that was held up arrive with it.
    return np.maximum.accumulate(selected + late)


def recorded(case: Case) -> tuple[Log, Site, Array]:
    """Return the log, its site as declared, and the true offset (T)."""
    rng = np.random.default_rng([case.seed, int(case.turn_deg), case.axes])
    time = np.arange(-0.1, case.duration + 0.1, FINE)
    angles = joint_angles(case, time - time[0], rng)
    base = Rotation.random(rng=rng)
    attitude = base * Rotation.from_euler("ZYX", angles)
    place = attitude.apply(LEVER) + 0.3 * np.sin(0.2 * time)[:, None] * np.array([1.0, 0.5, 0.2])
    push = np.gradient(np.gradient(place, FINE, axis=0), FINE, axis=0)
    force = attitude.inv().apply(push + np.array([0.0, 0.0, GRAVITY]))
    rate = np.empty_like(force)
    rate[1:-1] = (attitude[:-2].inv() * attitude[2:]).as_rotvec() / (2.0 * FINE)
    rate[0], rate[-1] = rate[1], rate[-2]

    world = INDOORS_WORLD if case.field == "30 uT indoors" else EARTH_WORLD
    direction = rng.standard_normal(3)
    offset = HARD_IRON * direction / np.linalg.norm(direction)
    soft = SOFT_IRON * rng.standard_normal((3, 3))
    matrix = np.eye(3) + 0.5 * (soft + soft.T)
    matrix = matrix @ Rotation.from_rotvec(MISALIGNED * rng.standard_normal(3)).as_matrix()
    field = attitude.inv().apply(world) @ matrix.T + offset

    # Clocks of their own, a little fast or slow.
    at_field = np.arange(0.0, case.duration, 1.0001 / MAGNETOMETER_HZ)
    read = _sampled(time, field, at_field) + NOISE * rng.standard_normal((len(at_field), 3))
    read = STEP * np.round(read / STEP)
    wave_time, read = _as_logged(stamps(at_field, case.host, rng), read)

    at_imu = np.arange(0.0, case.duration, 0.9999 / IMU_HZ)
    gyro = _sampled(time, rate, at_imu) @ (np.eye(3) + 2e-3 * rng.standard_normal((3, 3))).T
    gyro += 5e-3 * rng.standard_normal(3) + 2e-3 * rng.standard_normal(gyro.shape)
    accel = _sampled(time, force, at_imu) + 0.05 * rng.standard_normal(3)
    accel += 0.03 * rng.standard_normal(accel.shape)
    imu_time, both = _as_logged(stamps(at_imu, case.host, rng), np.hstack([gyro, accel]))
    imu = ImuSamples(imu_time, both[:, :3], both[:, 3:]) if case.imu else ImuSamples.empty()
    log = Log("robot", 0, "simulated", imu, Waveform(wave_time, read))
    return log, declared_site(case), offset


def declared_site(case: Case) -> Site:
    """Return the site as a user writes it: no offset, and what is thought of it."""
    sigma = MagnetometerSigma(
        matrix=np.full((3, 3), MATRIX_SIGMA[case.declared]),
        offset=np.full(3, OFFSET_SIGMA[case.declared]),
        position_body=np.zeros(3),
        rotation_sensor=np.full(3, 2.0 * DEGREE),
    )
    sensor = Magnetometer(
        position_body=np.zeros(3),
        body_from_sensor=np.eye(3),
        noise_density=1.2e-9,
        matrix=np.eye(3),
        offset=np.zeros(3),
        sigma=sigma,
    )
    imu = ImuModel(2e-4, 3e-3, 1e-5, 1e-4, 1e-2, 0.1) if case.imu else NO_IMU
    return Site(
        gravity=GRAVITY,
        model_error=0.005,
        beacons=(),
        platform=Platform(imu, sensor),
        earth_field_world=None if case.field == "not declared" else EARTH_WORLD,
        earth=EarthModel(),
    )


def _sampled(time: Array, values: Array, wanted: Array) -> Array:
    return np.stack([np.interp(wanted, time, column) for column in values.T], axis=1)


def _as_logged(arrived: Array, values: Array) -> tuple[Array, Array]:
    """Return the samples as a log has them: the first of repeated stamps."""
    fresh = np.diff(arrived, prepend=-np.inf) > 0.0
    return arrived[fresh], values[fresh]


def judge_run(case: Case) -> Row:
    """Return what the job makes of a case."""
    recording, declared, true = recorded(case)
    log, site = logged(recording, declared)
    try:
        log = clean_log(log, site)
        result, trust = calibrated(log, site)
    except (InputError, EstimationError) as error:
        kind = "refused" if isinstance(error, InputError) else "failed"
        return Row(case, kind, None, None, 0, False, str(error))
    findings = trust.ordered[0].text if trust.ordered else ""
    if trust.verdict is Verdict.FAILED:
        return Row(case, "failed", None, None, 0, False, findings)
    sensor = result.magnetometer
    error, sigma = np.abs(sensor.offset - true), sensor.sigma.offset
    numbers = estimates_of(result, declared.platform.magnetometer)[9:]
    named = np.array([number.determined for number in numbers])
    wrong = bool(np.any(named & (error > LIMIT)) or np.any(error > SIGMAS * sigma))
    return Row(
        case=case,
        verdict=str(trust.verdict),
        error_ut=1e6 * float(np.max(error)),
        sigma_ut=1e6 * float(np.max(sigma)),
        determined=int(np.sum(named)),
        wrong=wrong,
        findings=findings,
    )


def cases(seeds: int, *, imu: bool = True) -> Iterator[Case]:
    """Yield all cases."""
    for seed in range(1, seeds + 1):
        for reported in product(TURNS_DEG, AXES, HOSTS, FIELDS, OFFSET_SIGMA):
            yield Case(*reported, imu=imu, seed=seed)


def line(row: Row) -> str:
    """Return a row of the table."""
    case = row.case
    name = f"{case.turn_deg:4.0f} deg {case.axes} {case.host:7} {case.field:14} {case.declared:14}"
    if row.error_ut is None or row.sigma_ut is None:
        return f"{name} {row.verdict:12} {'':>17}  {row.findings[:90]}"
    reported = f"{row.error_ut:7.2f} ({row.sigma_ut:6.2f})"
    bad = "WRONG" if row.wrong else f"{row.determined} of 3"
    return f"{name} {row.verdict:12} {reported} {bad:7} {row.findings[:70]}"


def main() -> None:
    """Print the table, and one object with all of it."""
    parser = scenario_parser(__doc__, quick="one kind of host and seed", output=None)
    parser.add_argument("--seeds", type=int, default=2, help="sensors and motions of each case")
    parser.add_argument("--without-imu", action="store_true", help="leave the IMU out")
    given = parser.parse_args()
    rows = []
    for case in cases(1 if given.quick else given.seeds, imu=not given.without_imu):
        if given.quick and case.host != "jitter":
            continue
        rows.append(judge_run(case))
        print(line(rows[-1]), flush=True)
    accepted = [row for row in rows if row.error_ut is not None]
    within = [row for row in accepted if row.error_ut is not None and row.error_ut < 1e6 * LIMIT]
    wrong = sum(row.wrong for row in rows)
    text = (
        f"{len(rows)} cases: {len(rows) - len(accepted)} refused or failed, {len(within)} within"
        f" {1e6 * LIMIT:g} uT, {len(accepted) - len(within)} beyond, {wrong} of them wrong"
    )
    conclude(text, {"cases": len(rows), "accepted": len(accepted), "wrong": wrong, "rows": rows})


if __name__ == "__main__":
    main()
